"""Statements that decide what can be measured at all, weighed before anything is: the unit of exposures, the number of
bits, colour filters and their order, kinds and frames under each other's captures, a board's squares, a screen's
cells.

Each has numbers of its own that no effect and no parameter of the camera predicts, so that its odds don't depend on the
table of sets:

    ln odds = ln(p / (1 - p)) + (chi2 as stated - chi2 with the value that fits) / 2 - ln(alternatives)

with the prior probability p and the number of other values that would have been looked at. Of the unit of exposures the
numbers are the stated exposures themselves, of the bits the pixels that are clipped. Of a mosaic's order they are the
rates of the four planes in all lights, which effects change by less than the factors between colours; the means by
channel that the table is about don't tell RGGB from BGGR where GRBG is stated: both mix red and blue in green."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logit

from lab.diagnose.metadata.frames import (
    UNITS,
    exchanged_kinds,
    misplaced_frames,
    misstated_bit_depth,
    misstated_exposure_unit,
)
from lab.diagnose.metadata.lights import misstated_mosaic, misstated_mosaic_phase
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.metadata.targets import misstated_board, misstated_cell_size
from lab.formats.recording_set import RecordingSet
from lab.inference.posterior import NAMED
from sim.camera import Side

#: Prior probability that a statement of each kind is wrong: some of a hundred recording sets hold one wrong statement
#: of any kind, and there are a dozen kinds.
PRIOR = 0.005
#: Longest exposure of a session: ln t is normal about that of 1 s, with the standard deviation of a factor of ten.
LONGEST_S, LONGEST_LOG_STD = 1.0, float(np.log(10.0))
#: Evidence beyond which odds are those of a probability of 1 to a double's rounding.
LARGEST_LOG_ODDS = 35.0


def exposure_unit_log_odds(longest: float, unit_s: float) -> float:
    """Return ln p(longest | another unit) / p(longest | seconds) of the longest stated exposure."""

    def log_density(seconds: float) -> float:
        return float(-0.5 * (np.log(seconds / LONGEST_S) / LONGEST_LOG_STD) ** 2)

    return log_density(longest * unit_s) - log_density(longest)


def _of_exposures(recordings: RecordingSet, side: Side, found: Misstatement) -> float:
    longest = max(c.exposure_s for c in recordings.captures(side=side) if c.exposure_s is not None)
    corrected = max(c.exposure_s for c in found.corrected.captures(side=side) if c.exposure_s is not None)
    return exposure_unit_log_odds(longest, corrected / longest) - float(np.log(len(UNITS)))


def _of_bits(recordings: RecordingSet, side: Side, found: Misstatement) -> float:
    """Noise puts a pixel above a full well at that code as often as not; one of 2^bits codes is the highest of fewer
    bits."""
    stated, fits = (one.camera(side).bit_depth for one in (recordings, found.corrected))
    return found.chi2_stated * float(np.log(2.0)) + stated * float(np.log(2.0)) - float(np.log(stated - fits))


def _of_chi2(recordings: RecordingSet, side: Side, found: Misstatement) -> float:
    alternatives = max(len(found.captures), 2)
    return 0.5 * (found.chi2_stated - found.chi2_corrected) - float(np.log(alternatives))


@dataclass(frozen=True)
class _Check:
    find: Callable[[RecordingSet, Side], Misstatement | None]
    log_odds: Callable[[RecordingSet, Side, Misstatement], float] = _of_chi2


#: Each gets the recordings as corrected by those before it.
_CHECKS = (
    _Check(misstated_exposure_unit, _of_exposures),
    _Check(exchanged_kinds),
    _Check(misplaced_frames),
    _Check(misstated_bit_depth, _of_bits),
    _Check(misstated_mosaic),
    _Check(misstated_mosaic_phase),
    _Check(misstated_cell_size),
    _Check(misstated_board),
)


def weigh_beforehand(recordings: RecordingSet, side: Side) -> tuple[RecordingSet, tuple[Misstatement, ...]]:
    """Return the recordings with the statements replaced that are wrong with a probability of `NAMED`, less the
    captures that contradict theirs without such a value; and these statements with their probabilities."""
    found: list[Misstatement] = []
    for check in _CHECKS:
        one = check.find(recordings, side)
        if one is None:
            continue
        odds = float(logit(PRIOR)) + check.log_odds(recordings, side, one)
        probability = float(expit(min(odds, LARGEST_LOG_ODDS)))
        if probability >= NAMED:
            found.append(replace(one, probability=probability))
            recordings = one.corrected
    return recordings, tuple(found)
