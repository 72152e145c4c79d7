"""Frames that are ready, in place of a bench: what cameras cost that have nothing to draw, and stored frames once more.

`expose` hands out each side's frames in turn, at once; time is the computer's own."""

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

# ----------------------------------------------------------------------------------------------------------------------
# Pixel formats of the mock cameras, written out a second time: a mistake shared with the driver would not be seen.
#
# Source: EMVA, GenICam Pixel Format Naming Convention.


BAYER_RG8, BAYER_RG12, BAYER_RG12P = 0x01080009, 0x01100011, 0x010C0059


def pack_12p(raw: UInt16Array) -> bytes:
    """Pack 12-bit pixels as a stream of bits, least significant first: two pixels in three bytes.

    raw : (rows, cols), DN

    Source: PFNC, `12p` formats.

    >>> pack_12p(np.array([[0x123, 0x456]], np.uint16)).hex()
    '236145'
    """
    flat = np.append(raw.reshape(-1), np.zeros(raw.size % 2, np.uint16)).astype(np.uint32)
    pair = flat[0::2] | (flat[1::2] << 12)
    return (
        np.stack([pair & 0xFF, (pair >> 8) & 0xFF, (pair >> 16) & 0xFF], axis=1)
        .astype(np.uint8)
        .tobytes()[: (raw.size * 12 + 7) // 8]
    )


def payload_bytes(pixel_format: int, pixels: int) -> int:
    """Return the size of a frame's payload, bytes.

    pixel_format : PFNC code of GenICam, with the bits of a pixel in its second byte from the left
    pixels : of the frame

    >>> payload_bytes(0x010C0047, 100)  # BayerRG12p
    150
    """
    return (pixels * ((pixel_format >> 16) & 0xFF) + 7) // 8


def encode(raw: UInt16Array, pixel_format: int) -> bytes:
    """Return a 12-bit raw frame in one of the camera's formats."""
    if pixel_format == BAYER_RG12P:
        return pack_12p(raw)
    if pixel_format == BAYER_RG8:
        return (raw >> 4).astype(np.uint8).tobytes()
    return raw.astype("<u2").tobytes()


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
        frames: dict[Side, list[UInt16Array]] = {}
        for side in sides:
            frames[side] = []
            for file in sorted(folder.glob(f"*-{side}.npy")):
                try:
                    frames[side].append(np.load(file, mmap_mode="r", allow_pickle=False))
                except (OSError, ValueError) as error:
                    raise ValueError(f"{file}: can't be read ({error}); name a folder of raw frames") from error
            if not frames[side]:
                raise ValueError(f"{folder}: holds no *-{side}.npy; name a session's folder `frames`")
        return cls(frames)

    def sensor(self, side: Side) -> tuple[int, int, float]:
        rows, cols = self._shapes[side]
        return rows, cols, PITCH_UM

    def sensor_temperature_c(self, side: Side) -> float:
        return AIR_C

    def expose(self, side: Side, exposure_s: float, gain_db: float, start_s: float) -> UInt16Array:
        """Return the next frame of a side once the exposure is over."""
        self.clock.sleep(start_s + exposure_s - self.clock.now())
        return next(self._turn[side])
