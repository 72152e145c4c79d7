"""Exposures that are stated in seconds and meant in milliseconds or microseconds."""

from __future__ import annotations

from collections.abc import Sequence

from lab.capture_kinds.base import LONGEST_EXPOSURE_S, Capture
from lab.diagnose.measurements.dark_level import DARK
from lab.diagnose.metadata.misstatement import Misstatement
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6}
USUAL_S = 60.0  # longest exposure that is likely in a unit
MORE_THAN_SPAN = 2.0  # exposures over the time in which they were taken: clocks and read-outs make less of a difference
FEWEST = 3  # captures with times


def misstated_exposure_unit(recordings: RecordingSet, side: Side) -> Misstatement | None:
    """Exposures above `LONGEST_EXPOSURE_S`, or longer together than the time between the first and the last capture. None where they fit.

    The unit is the larger one in which no exposure is above `USUAL_S`, and all fit in that time.
    """
    captures = [c for c in recordings.captures(side=side) if c.exposure_s is not None]  # boards may state none
    longest = max((c.exposure_s for c in captures), default=0.0)
    span_s = _span_s(captures)
    # the first or the last capture may lie outside of the span, as a time is that of the beginning or of the end
    taken_s = sum(c.exposure_s for c in captures) - longest
    too_long = span_s is not None and taken_s > MORE_THAN_SPAN * span_s
    if longest <= LONGEST_EXPOSURE_S and not too_long:
        return None

    def fits(unit_s: float) -> bool:
        return unit_s * longest <= USUAL_S and (span_s is None or unit_s * taken_s <= MORE_THAN_SPAN * span_s)

    unit = next((name for name, unit_s in UNITS.items() if fits(unit_s)), "microseconds")
    limit = (
        f"captures taken within {span_s:.4g} s are exposed for {taken_s:.4g} s together"
        if too_long and span_s is not None
        else f"the longest is {longest:.6g} s, above {LONGEST_EXPOSURE_S:g} s"
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
        check=f"The exposures of the {side} camera aren't in seconds: {limit}. They are read as {unit}, the longest as {UNITS[unit] * longest:.4g} s: "
        "state exposure_s in seconds.",
        chi2_stated=(longest / LONGEST_EXPOSURE_S) ** 2
        if not too_long
        else (taken_s / (MORE_THAN_SPAN * (span_s or 1.0))) ** 2,
        chi2_corrected=0.0,
        n=1,
        captures=tuple(c.id for c in captures if c.exposure_s == longest),
        corrected=recordings.under(recordings.manifest.model_copy(update={"captures": scaled})),
    )


def _span_s(captures: Sequence[Capture]) -> float | None:
    """Time from the first to the last capture, s; None where times aren't stated, or are all equal."""
    times = [c.time.timestamp() for c in captures if c.time is not None]
    if len(times) < max(FEWEST, len(captures)) or max(times) == min(times):
        return None
    return max(times) - min(times)
