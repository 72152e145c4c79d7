"""Stale frames: a capture whose frame equals an earlier one's bit for bit wasn't taken anew."""

from __future__ import annotations

import hashlib

import numpy as np

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

NOISELESS_DN = 0.5  # frames of a smaller standard deviation may be equal by chance


def stale(recordings: RecordingSet, side: Side) -> tuple[tuple[str, str], ...]:
    """(id, reason in one line) of every capture whose frame equals an earlier one's bit for bit, noise included.

    Frames without noise may be equal: those of a standard deviation below `NOISELESS_DN` aren't tested, and nothing is returned where
    more than half of the repeats are equal.
    """
    first: dict[bytes, Capture] = {}
    found: list[tuple[str, str]] = []
    repeats, alike = 0, 0
    before: Capture | None = None
    for capture in recordings.captures(side=side):
        frame = recordings.frame(capture)
        settings = (capture.kind, capture.exposure_s, capture.gain_db)
        is_repeat = before is not None and settings == (before.kind, before.exposure_s, before.gain_db)
        repeats += is_repeat
        before = capture
        if frame.std(dtype=np.float32) < NOISELESS_DN:
            continue
        mark = hashlib.blake2b(frame.tobytes(), digest_size=16).digest()
        twin = first.setdefault(mark, capture)
        if twin is not capture and twin.frame != capture.frame:
            alike += is_repeat
            found.append(
                (
                    capture.id,
                    f"the frame of capture {capture.id} ({capture.kind}) is bit for bit that of {twin.id} ({twin.kind}), noise and all: it wasn't taken anew and is left out; take it again",
                )
            )
    return () if 2 * alike > repeats > 0 else tuple(found)
