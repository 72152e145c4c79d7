"""Exposures that are stated in seconds and meant in milliseconds or microseconds."""

from __future__ import annotations

from lab.capture_kinds.base import LONGEST_EXPOSURE_S
from lab.diagnose.measurements.dark_level import DARK
from lab.diagnose.metadata.misstatement import Misstatement
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6}


def misstated_exposure_unit(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return exposures above `LONGEST_EXPOSURE_S`, read in the larger unit in which none is above
    `longest_usual_exposure_s`; None where they fit.

    The times of captures tell nothing of it: they may be those of copying, or of a clock that runs fast, as the mock
    bench's does."""
    captures = [c for c in recordings.captures(side=side) if c.exposure_s is not None]  # boards may state none
    longest = max((c.exposure_s for c in captures), default=0.0)
    if longest <= LONGEST_EXPOSURE_S:
        return None
    unit = next(
        (name for name, unit_s in UNITS.items() if unit_s * longest <= policy.longest_usual_exposure_s), "microseconds"
    )
    scaled = tuple(
        c.model_copy(update={"exposure_s": UNITS[unit] * c.exposure_s})
        if c.side == side and c.exposure_s is not None
        else c
        for c in recordings.manifest.captures
    )
    return Misstatement(
        measurement=DARK,
        where=f"{len(captures)} captures",
        shape="the stated exposures are too long for seconds",
        check=f"The exposures of the {side} camera aren't in seconds: the longest is {longest:.6g} s, above "
        f"{LONGEST_EXPOSURE_S:g} s. They are "
        f"read as {unit}, the longest as {UNITS[unit] * longest:.4g} s: state exposure_s in seconds.",
        chi2_stated=(longest / LONGEST_EXPOSURE_S) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=tuple(c.id for c in captures if c.exposure_s == longest),
        corrected=recordings.under(recordings.manifest.model_copy(update={"captures": scaled})),
    )
