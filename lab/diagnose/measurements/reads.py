"""Quantities of the stages that predictions depend on, and which effects change them."""

from __future__ import annotations

from lab.diagnose.measurements.block import Effects
from sim.effects.base import Effect
from sim.effects.library import changed_by

#: Of measurements in whose prediction the frame before enters.
LAG = frozenset({"charge.lag"})
#: Of measurements in which dark current is a nuisance parameter.
DARK_CURRENT = frozenset({"charge.dark_current"})
#: Of measurements of single frames' means.
LINES = frozenset({"signal.lines"})
#: Of measurements of patterns: what a screen shows of what it is asked for, and reflections of the whole image.
SHOWN = frozenset({"light.screen"})
REFLECTIONS = frozenset({"image.copies"})
#: Of measurements of where light lands.
SHIFT = frozenset({"image.shift"})


def acting(effects: Effects, reads: frozenset[str]) -> tuple[Effect, ...]:
    """Those of the effects that change any of these quantities of the stages."""
    return tuple(effect for effect in effects if not reads.isdisjoint(changed_by(effect)))
