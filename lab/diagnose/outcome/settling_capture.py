"""What to capture where a mismatch has no name: captures of the same kind that change what the measurement depends on.

Only conditions that can change the measurement are proposed: dark frames have no light, so that no lens, lamp or wavelength acts on them.
Where few repeats were taken, more of them come first: a law shows in what stays alike.
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
    "dark": "at another exposure and another temperature of the sensor: what comes with time, with warmth or with every read-out differs in these",
    "narrowband": "at half the exposure, and at the wavelengths between: the response follows the level, a filter the wavelength",
    "chart": "at half the exposure, and with the chart turned by 180 degrees: the response follows the level, the light its place",
    "charuco": "with the board turned by 90 degrees, and nearer: the lens stays with the frame, the board's errors turn with it",
}
BY_AXIS = {
    "spatial_frequency": "at another f-number and in light of another wavelength: diffraction and aberrations follow these, the sensor doesn't",
    "field": "at another f-number, and with the camera turned by 180 degrees: the lens and the sensor stay with the frame, the light turns",
    "level": "at other levels of the light and the same exposure: the response follows the level, the dark signal the exposure",
    "row_frequency": "at another exposure: a source's flicker follows the time of each row, lines of the read-out don't",
}
ELSE = "once more after a break, in the reverse order: what follows the time differs then"


def repeats_of(captures: Iterable[Capture]) -> int:
    """The median number of captures of one setting; 0 for none."""
    setting: dict[Hashable, int] = {}
    for capture in captures:
        key = capture.model_dump_json(exclude={"id", "frame", "time", "temperature_c"})
        setting[key] = setting.get(key, 0) + 1
    counts = sorted(setting.values())
    return counts[len(counts) // 2] if counts else 0


def settling_sentence(recordings: RecordingSet, side: Side, left: Sequence[Unexplained]) -> str | None:
    """What to capture for the most significant mismatch that has no name, as a sentence; None where there is none.

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
    what = " and ".join(sorted(kinds)) + " captures" if kinds else "captures that are off"
    repeats = repeats_of(every)
    if kinds == {"dark"}:
        what = "dark frames"
        if repeats < FEW_REPEATS:
            return (
                f"Take {MORE_REPEATS} {what} at each setting (there are {repeats}): their noise hides how the mismatch of the {side} camera "
                "looks. Then, take them at another exposure."
            )
    (kind,) = kinds if len(kinds) == 1 else ("",)
    return f"Repeat the {what} of the {side} camera {BY_KIND.get(kind) or BY_AXIS.get(item.axis, ELSE)}."
