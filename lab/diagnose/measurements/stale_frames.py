"""Frames that were recorded twice: a capture whose frame is bit for bit that of an earlier one wasn't taken."""

from __future__ import annotations

import hashlib

import numpy as np

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

NOISELESS_DN = 0.5  # a frame of less standard deviation may be like another by chance


def stale(recordings: RecordingSet, side: Side) -> tuple[tuple[str, str], ...]:
    """(id, reason) of every capture whose frame equals an earlier one bit for bit, noise included: it wasn't taken anew.

    Frames without noise may be equal and don't count: those of nearly one code, and recordings of which most repeats are equal.
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
