"""Frames that are ready, in place of a bench: what cameras cost that have nothing to draw, and stored frames once more.

`expose` hands out each side's frames in turn, at once; time is the computer's own.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from mocks.bench import UInt16Array
from mocks.truth import AIR_C
from mocks.wire import MockClock
from sim.camera import Side

#: Distance of neighbouring pixels (um) that the cameras tell of.
PITCH_UM = 3.0


class BeforeCameras(Protocol):
    """What stands before the cameras: `mocks.bench.Bench`, or `ReadyFrames`."""

    @property
    def clock(self) -> MockClock: ...
    def sensor(self, side: Side) -> tuple[int, int, float]: ...
    def sensor_temperature_c(self, side: Side) -> float: ...
    def expose(self, side: Side, exposure_s: float, gain_db: float, start_s: float) -> UInt16Array: ...


class WallClock:
    """The computer's time."""

    def now(self) -> float:
        return time.time()

    def sleep(self, seconds: float) -> None:
        time.sleep(max(0.0, seconds))


class ReadyFrames:
    """`frames` of each side, (rows, cols) DN of 12 bits, in turn and from the start again.

    Raises ValueError where a side has none, or frames of several sizes.
    """

    def __init__(self, frames: Mapping[Side, Sequence[UInt16Array]]) -> None:
        for side, some in frames.items():
            if not some:
                raise ValueError(f"no frame of the {side} camera; name a folder with some")
            shapes = {frame.shape for frame in some}
            if len(shapes) > 1 or any(len(shape) != 2 or shape[0] % 2 or shape[1] % 2 for shape in shapes):
                raise ValueError(
                    f"frames of the {side} camera have the shapes {', '.join(map(str, sorted(shapes)))}; one even "
                    "size is needed"
                )
            if any(frame.dtype != np.uint16 or int(frame.max()) > 4095 for frame in some):
                raise ValueError(f"frames of the {side} camera aren't uint16 of 12 bits; replay others")
        self._shapes = {side: some[0].shape for side, some in frames.items()}
        self._turn = {side: itertools.cycle(some) for side, some in frames.items()}
        self.clock: MockClock = WallClock()

    @classmethod
    def of_folder(cls, folder: Path, sides: Sequence[Side]) -> ReadyFrames:
        """Return the frames `*-left.npy` and `*-right.npy` of a folder (a session's `frames`), by name. Raises
        ValueError, one line."""
        found: dict[Side, list[UInt16Array]] = {}
        for side in sides:
            found[side] = []
            for file in sorted(folder.glob(f"*-{side}.npy")):
                try:
                    found[side].append(np.load(file, mmap_mode="r", allow_pickle=False))
                except (OSError, ValueError) as error:
                    raise ValueError(f"{file}: can't be read ({error}); name a folder of raw frames") from error
            if not found[side]:
                raise ValueError(f"{folder}: holds no *-{side}.npy; name a session's folder `frames`")
        return cls(found)

    def sensor(self, side: Side) -> tuple[int, int, float]:
        rows, cols = self._shapes[side]
        return rows, cols, PITCH_UM

    def sensor_temperature_c(self, side: Side) -> float:
        return AIR_C

    def expose(self, side: Side, exposure_s: float, gain_db: float, start_s: float) -> UInt16Array:
        """Return the next frame of a side once the exposure is over."""
        self.clock.sleep(start_s + exposure_s - self.clock.now())
        return next(self._turn[side])
