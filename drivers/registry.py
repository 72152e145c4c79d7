"""Drivers by family and name. Other packages add theirs through the entry point group `calibench.drivers`.

An entry point's name is `family.name` (`monochromator.cornerstone260`), and it refers to a callable that takes the
`address` of the station file and that table's other keys by name, and returns the family's instrument:
`make(address, *, recorder=None, **settings)`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from drivers.errors import InstrumentError

GROUP = "calibench.drivers"


def names(family: str) -> tuple[str, ...]:
    """Return the names of the installed drivers of one family, sorted.

    family : `camera`, `display`, `light_source`, `monochromator`, `photodiode`, `spectroradiometer` or `stage`

    >>> "cornerstone260" in names("monochromator")
    True
    """
    return tuple(sorted(name.partition(".")[2] for name in _all() if name.partition(".")[0] == family))


def drivers() -> tuple[tuple[str, str], ...]:
    """Return (family, name) of every driver that is installed, sorted.

    >>> ("stage", "prompt") in drivers()
    True
    """
    return tuple(sorted((name.partition(".")[0], name.partition(".")[2]) for name in _all()))


def driver(family: str, name: str) -> Callable[..., Any]:
    """Return what makes an instrument: call it with an address.

    family, name : as `drivers` lists them

    Raises `InstrumentError` if there is no such driver, or where it can't be loaded.

    >>> driver("monochromator", "cm110").__name__
    'Cm110'
    """
    point = _all().get(f"{family}.{name}")
    if point is None:
        known = ", ".join(names(family)) or "none"
        raise InstrumentError(
            f"{family}: no driver {name!r}; installed are {known}: correct `driver` in the station file or install "
            "its package"
        )
    try:
        made: Callable[..., Any] = point.load()
    except (ImportError, AttributeError) as error:
        raise InstrumentError(
            f"{family}: the driver {name!r} ({point.value}) can't be loaded: {error}; install its package again"
        ) from error
    return made


def _all() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}
