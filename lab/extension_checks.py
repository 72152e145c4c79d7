"""The contracts of what other packages add, run on an installed package by its name: effects and charts."""

from __future__ import annotations

import re

from lab.errors import InputError
from sim import effect_contract
from sim.effects.library import effects
from sim.extensions import Group, installed, refused
from sim.scene import chart_contract
from sim.scene.catalogue import scenes
from sim.scene.chart import added_charts


def check_effects(package: str) -> dict[str, tuple[str, ...]]:
    """Run the contract of effects on those that a package adds.

    package : its name, or that of one effect
    Returns the complaints by effect. Raises InputError where no installed package adds one under that name.
    """
    points = _names("effects", "an effect", package)
    known = effects()
    return {name: _refusals("effects", name) or effect_contract.complaints(known[name]) for name in points}


def check_charts(package: str) -> dict[str, tuple[str, ...]]:
    """Run the contract of charts on those that a package adds.

    package : its name, or that of one chart
    Returns the complaints by chart. Raises InputError where no installed package adds one under that name.
    """
    points = _names("charts", "a chart", package)
    scenes()  # refuses those whose names are taken
    known = added_charts()
    return {name: _refusals("charts", name) or chart_contract.complaints(name, known[name]) for name in points}


def _names(group: Group, what: str, package: str) -> list[str]:
    wanted = _plain(package)
    points = {
        point.name
        for point in installed(group)
        if wanted in (_plain(point.name), _plain(point.dist.name if point.dist is not None else ""))
    }
    if not points:
        there = ", ".join(sorted(point.name for point in installed(group))) or "none"
        raise InputError(
            f"{package}: no installed package of that name adds {what}; installed are {there}: install it here, or "
            f"look at its entry points, group calibench.{group}"
        )
    return sorted(points)


def _refusals(group: Group, name: str) -> tuple[str, ...]:
    return tuple(line for line in refused() if f"calibench.{group}: {name}: " in line)


def _plain(name: str) -> str:
    """Return a distribution's name as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()
