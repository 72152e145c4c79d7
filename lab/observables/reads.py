"""Quantities of the stages (`sim.stages`) that several measurements read, and the effects that change such
quantities."""

from __future__ import annotations

from sim.effects.base import Effect, Effects
from sim.effects.library import list_changes

#: What frames before leave in a frame: image lag, and charge that traps release.
LAG = frozenset({"charge.lag", "charge.traps"})
#: Charge that packets leave behind on their way to the output.
TRAILS = frozenset({"charge.trails"})
DARK_CURRENT = frozenset({"charge.dark_current"})
#: Light that pixels of a colour collect unlike others.
COLLECTED = frozenset({"charge.collected"})
#: What read-out adds to the pixels, lit or dark.
ADDED = frozenset({"signal.disturbances"})
#: What the converter makes of levels.
CODES = frozenset({"codes.codes"})
#: Light that is collected beside the exposure.
LEAK = frozenset({"charge.leak_s"})
#: How amplifiers of areas couple.
AMPLIFIERS = frozenset({"signal.amplifiers"})
#: Factors on what is read of even light, by place.
GAINS = frozenset({"signal.gains"}) | AMPLIFIERS
#: Factors on what is read of rows and columns, at random.
LINE_GAINS = frozenset({"signal.line_gains"})
#: Noise that pixels of a line share: of rows, of columns, and in the order in which pixels are read.
LINES = frozenset({"signal.lines", "signal.reading_order"})
#: Spectrum of the read noise along a row.
READ_SPECTRUM = frozenset({"signal.read_spectrum"})
#: Charge of single particles.
PARTICLES = frozenset({"charge.particles"})
#: The light of a screen for the picture that it is given.
SHOWN = frozenset({"light.screen"})
#: Displaced, scaled or rotated copies of the image.
REFLECTIONS = frozenset({"image.copies"})
#: Factors on the lens's transfer function.
BLUR = frozenset({"image.transfer"})
#: Sensitivity that differs by place and wavelength.
PATTERNS = frozenset({"image.patterns"})
#: Displacement of the image by place and wavelength.
SHIFT = frozenset({"image.shift"})


def acting(effects: Effects, reads: frozenset[str]) -> tuple[Effect, ...]:
    """Return the effects that change any of the quantities `reads`."""
    return tuple(effect for effect in effects if not reads.isdisjoint(list_changes(effect)))
