"""What to capture where a mismatch has no name: captures of the same kind under another condition.

Only conditions that can change the measurement are proposed: without light, no lens, lamp or wavelength acts on dark
frames. Where there are few repeats, more of them are proposed first.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Unexplained
from sim.camera import Side

#: Repeats of a setting below which more of them are proposed first, and how many then.
FEW_REPEATS, MORE_REPEATS = 8, 16
#: What to vary, by the kind of all captures of a measurement; else by its axis, which says what it follows.
BY_KIND = {
    "dark": "at another exposure and another sensor temperature: dark current grows with both, row and column noise "
    "with neither",
    "narrowband": "at half the exposure, and at the wavelengths between: a nonlinear response depends on the level, a "
    "filter on the wavelength",
    "chart": "at half the exposure, and with the chart rotated by 180 degrees: a nonlinear response depends on the "
    "level, uneven light on the place",
    "charuco": "with the board rotated by 90 degrees, and nearer: errors of the lens stay with the frame, errors of "
    "the board rotate with it",
}
BY_AXIS = {
    "spatial_frequency": "at another f-number and in light of another wavelength: diffraction and aberrations depend "
    "on these, the sensor doesn't",
    "field": "at another f-number, and with the camera rotated by 180 degrees: lens and sensor stay with the frame, "
    "uneven light rotates",
    "level": "at other levels of the light and the same exposure: a nonlinear response depends on the level, the dark "
    "signal on the exposure",
    "row_frequency": "at another exposure: flicker of the source depends on the time of each row, row noise of the "
    "read-out doesn't",
}
ELSE = "again after a break, in the reverse order: a drift with time differs then"


def repeats_of(captures: Iterable[Capture]) -> int:
    """Return the median number of captures of one setting; 0 for none."""
    setting: dict[Hashable, int] = {}
    for capture in captures:
        key = capture.model_dump_json(exclude={"id", "frame", "time", "temperature_c"})
        setting[key] = setting.get(key, 0) + 1
    counts = sorted(setting.values())
    return counts[len(counts) // 2] if counts else 0


def settling_sentence(recordings: RecordingSet, side: Side, left: Sequence[Unexplained]) -> str | None:
    """Return what to capture for the most significant mismatch that has no name, as a sentence; None where there is
    none.

    Captures that contradict what is stated of them are to be corrected before anything is captured.
    """
    if not left:
        return None
    item = max(left, key=lambda one: (not one.check, one.significance_sigma))
    if item.check:
        return "Correct what is stated of the captures above, or take them again."
    captures = [c for c in recordings.captures(side=side) if c.id in set(item.captures)]
    kinds = {c.kind for c in captures}
    every = [c for c in recordings.captures(side=side) if c.kind in kinds]
    what = " and ".join(sorted(kinds)) + " captures" if kinds else "captures with the mismatch"
    repeats = repeats_of(every)
    if kinds == {"dark"}:
        what = "dark frames"
        if repeats < FEW_REPEATS:
            return (
                f"Take {MORE_REPEATS} {what} at each setting (there are {repeats}): their noise hides the shape of "
                f"the mismatch of the {side} "
                "camera. Then take them at another exposure."
            )
    (kind,) = kinds if len(kinds) == 1 else ("",)
    return f"Repeat the {what} of the {side} camera {BY_KIND.get(kind) or BY_AXIS.get(item.axis, ELSE)}."
