"""A step of a fit, validation or diagnosis that wasn't done."""

from __future__ import annotations

from sim.camera import Side
from sim.parameters import Frozen


class Skipped(Frozen):
    """A step that wasn't done. `reason`: why, and which capture would make it possible."""

    step: str
    reason: str
    side: Side | None = None
