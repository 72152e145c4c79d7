"""Copied frames: a capture whose frame equals an earlier one's bit for bit wasn't taken anew."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

NOISELESS_DN = 0.5  # frames of a smaller standard deviation may be equal by chance
LISTED = 3  # copies that are told one by one; of more, as many are named


@dataclass(frozen=True)
class CopiedFrames:
    """Captures of one side whose frames are copies: (capture, the earlier one that it equals)."""

    side: Side
    pairs: tuple[tuple[Capture, Capture], ...] = ()

    @property
    def ids(self) -> frozenset[str]:
        """Ids of the copies."""
        return frozenset(copy.id for copy, _ in self.pairs)

    @property
    def told(self) -> tuple[str, ...]:
        """Which captures, and what is done, in one line each; in one line for all where there are more than `LISTED`."""
        if len(self.pairs) <= LISTED:
            return tuple(
                f"the frame of capture {copy.id} ({copy.kind}) is bit for bit that of {twin.id} ({twin.kind}), noise and all: it wasn't taken anew "
                "and is left out; take it again"
                for copy, twin in self.pairs
            )
        named = ", ".join(f"{copy.id} is {twin.id}" for copy, twin in self.pairs[:LISTED])
        line = (
            f"the frames of {len(self.pairs)} captures of the {self.side} camera are copies of others, bit for bit, noise and all ({named} ..): they "
            "weren't taken anew and are left out, so that temporal noise is unknown where no other repeat is left; give frames that were captured "
            "one by one"
        )
        return (line,)


def copied_frames(recordings: RecordingSet, side: Side, captures: Sequence[Capture] | None = None) -> CopiedFrames:
    """The copies among `captures` (all of the side). Frames of a standard deviation below `NOISELESS_DN` may be equal, and aren't tested."""
    first: dict[bytes, Capture] = {}
    found = []
    for capture in recordings.captures(side=side) if captures is None else captures:
        frame = recordings.frame(capture)
        if frame.std(dtype=np.float32) < NOISELESS_DN:
            continue
        mark = hashlib.blake2b(frame.tobytes(), digest_size=16).digest()
        twin = first.setdefault(mark, capture)
        if twin is not capture and twin.frame != capture.frame:
            found.append((capture, twin))
    return CopiedFrames(side, tuple(found))
