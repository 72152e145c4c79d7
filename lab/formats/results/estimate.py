"""A number with its standard uncertainty and its unit."""

from __future__ import annotations

from sim.parameters import Frozen


class Estimate(Frozen):
    """A measured quantity. `std`: its standard uncertainty (k = 1); None where it isn't known. `unit`: "1" of a
    ratio."""

    value: float
    std: float | None
    unit: str
