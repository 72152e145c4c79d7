"""Effects in packages of their own, drafted from discovered laws."""

from __future__ import annotations

from pathlib import Path

from lab.diagnose.effect_draft import class_name, draft
from lab.formats.results import DiscoveredLaw

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
