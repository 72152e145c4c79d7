"""Effects in packages of their own: drafted as one, and checked by the contract of effects."""

from __future__ import annotations

import re
from pathlib import Path

from lab.diagnose.effect_draft import class_name, draft
from lab.errors import InputError
from lab.formats.results import DiscoveredLaw
from sim.effect_contract import complaints
from sim.effects.library import effects
from sim.extensions import installed, refused

PROJECT = """[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "calibench-effect-{hyphened}"
version = "0.1.0"
description = "An effect of calibench: {title}."
requires-python = ">=3.11"
dependencies = ["calibench"]

[project.entry-points."calibench.effects"]
{name} = "{name}:{class_name}"

[tool.setuptools]
py-modules = ["{name}"]
"""


def package_files(folder: Path) -> tuple[Path, Path, Path]:
    """Return the files of the package of one effect: its own, its test, and the project's. The folder's name is the
    effect's."""
    return folder / f"{folder.name}.py", folder / f"test_{folder.name}.py", folder / "pyproject.toml"


def drafted_package(law: DiscoveredLaw, number: int, source: str, folder: Path) -> tuple[str, str, str]:
    """Return a discovered law as an installable package: the texts of `package_files`.

    number, source : of the law among those of a diagnosis, and what was diagnosed
    Raises InputError where the folder's name is no effect's.
    """
    name = folder.name
    effect, test = draft(law, number, source, folder / f"{name}.py")
    project = PROJECT.format(
        name=name, hyphened=name.replace("_", "-"), title=name.replace("_", " "), class_name=class_name(name)
    )
    return (
        effect,
        test.replace(f"from sim.effects import {name}\n", "").replace(
            "import numpy as np\n", f"import {name}\nimport numpy as np\n", 1
        ),
        project,
    )


def check_package(package: str) -> dict[str, tuple[str, ...]]:
    """Run the contract of effects on those that a package adds.

    package : its name, or that of one effect
    Returns the complaints by effect. Raises InputError where no installed package adds one under that name.
    """
    wanted = _plain(package)
    points = {
        point.name
        for point in installed("effects")
        if wanted in (_plain(point.name), _plain(point.dist.name if point.dist is not None else ""))
    }
    if not points:
        there = ", ".join(sorted(point.name for point in installed("effects"))) or "none"
        raise InputError(
            f"{package}: no installed package of that name adds an effect; installed are {there}: install it here, or "
            "look at its entry points, group calibench.effects"
        )
    known = effects()
    broken = {name: tuple(line for line in refused() if f"calibench.effects: {name}: " in line) for name in points}
    return {name: broken[name] or complaints(known[name]) for name in sorted(points)}


def _plain(name: str) -> str:
    """Return a distribution's name as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()
