"""Statements that determine results and that no recording of the set can check."""

from __future__ import annotations

from collections.abc import Iterator

from lab.capture_kinds.charuco import CharucoCapture
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Skipped
from sim.camera import Side


def unchecked(recordings: RecordingSet, side: Side) -> Iterator[Skipped]:
    """Yield the bit depth, where no pixel reaches its highest bit, and the length of a board's squares; and what the
    instruments themselves said couldn't be set as a measurement wants it."""
    own = f"camera {side}"
    for name, one in recordings.manifest.instruments.items():
        if name == own or (not name.startswith("camera ") and side == recordings.sides[0]):
            for told in one.departures:
                yield Skipped(step="instrument_settings", side=side if name == own else None, reason=told)
    camera = recordings.camera(side)
    highest = 0
    for capture in recordings.captures(side=side):
        highest = max(highest, int(recordings.frame(capture).max()))
        if highest.bit_length() >= camera.bit_depth:
            break
    else:
        if highest:
            yield Skipped(
                step="bit_depth",
                side=side,
                reason=f"no pixel is above {highest} DN, so that bit_depth = {camera.bit_depth} and a white level of "
                f"{camera.saturation_dn:g} DN are "
                "taken as stated: they decide full well and saturation; a flat that clips would check them",
            )
    boards = recordings.captures(CharucoCapture, side)
    if boards:
        sizes = " and ".join(f"{size:g}" for size in sorted({one.square_mm for one in boards}))
        yield Skipped(
            step="square_mm",
            side=side,
            reason=f"squares of {sizes} mm are taken as stated: a board twice as large at twice the distance has the "
            "same picture. Distances and a "
            "pair's baseline grow in proportion; a baseline, or a board, that was measured would check it",
        )
