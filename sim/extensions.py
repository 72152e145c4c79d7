"""What other packages add, by entry points: `calibench.effects`, `calibench.observables`, `calibench.importers`,
`calibench.capture_kinds`, `calibench.illuminants`, `calibench.charts`, `calibench.commands`. Drivers have a registry of
their own.

An extension that can't be loaded, or isn't what its group asks for, is one line in the log and stops nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

Group = Literal["effects", "observables", "importers", "capture_kinds", "illuminants", "charts", "commands"]
log = logging.getLogger(__name__)
_refused: dict[tuple[str, str], str] = {}


def installed(group: Group) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, by name."""
    return tuple(sorted(entry_points(group=f"calibench.{group}"), key=lambda point: point.name))


def extensions(group: Group) -> Iterator[tuple[str, Any]]:
    """Yield name and object of every extension of a group that can be loaded; the others are refused."""
    for point in installed(group):
        try:
            extension = point.load()
        except Exception as error:  # whatever another's module does when it is imported
            refuse(group, point.name, f"{point.value} can't be loaded ({type(error).__name__}: {error})")
        else:
            yield point.name, extension


def refuse(group: Group, name: str, why: str) -> None:
    """Leave an extension out, and say so once, in one line."""
    line = f"calibench.{group}: {name}: {' '.join(why.split())}; it is left out: mend its package, or remove it"
    if _refused.get((group, name)) != line:
        _refused[group, name] = line
        log.warning(line)


def refused() -> tuple[str, ...]:
    """Return the line of every extension that was left out so far."""
    return tuple(_refused.values())
