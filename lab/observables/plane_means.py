"""Means of one capture by the planes of the 2 x 2 cell, for fits and diagnosis: of narrowband light, flats and darks.

They are in codes, and no statement about the camera enters. Which colour a plane has, the step of the codes, and from
which code on pixels clip are arguments of what is asked of the means.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet
from sim.camera import Cfa
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray

#: First pixels (row, column) of the planes of the 2 x 2 cell of a mosaic.
CELL = ((0, 0), (0, 1), (1, 0), (1, 1))
CENTRAL_SHARE = 0.25  # of rows and columns: the part of the frame on axis
HIGHEST_SHARE = 2e-4  # of the pixels, whose codes are kept: which share clips is known up to this
ROUNDING_STD_DN = 0.3  # standard deviation that rounding to a step of 1 DN adds to a pixel: 1 / sqrt(12)


@dataclass(frozen=True)
class PlaneSums:
    """The pixels of one plane in a frame, or in a part of it: exact sums of their codes and of the squares of these,
    and the highest codes, ascending, of more than `HIGHEST_SHARE` of the pixels.
    """

    total: int
    squares: int
    pixels: int
    highest: NDArray[Any]

    @staticmethod
    def of(plane: NDArray[Any]) -> PlaneSums:
        """Return the sums of a plane (rows, cols) of integer codes."""
        values = plane.astype(np.int64)
        count = int(HIGHEST_SHARE * plane.size) + 1
        highest = np.sort(np.partition(plane.ravel(), plane.size - count)[plane.size - count :])
        return PlaneSums(int(values.sum()), int(np.einsum("ij,ij->", values, values)), plane.size, highest)


@dataclass(frozen=True)
class ChannelMean:
    """The pixels of one channel: those of its planes."""

    planes: tuple[PlaneSums, ...]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return sum(one.pixels for one in self.planes)

    @property
    def mean_dn(self) -> float:
        """Mean, DN."""
        return sum(one.total for one in self.planes) / self.pixels

    @property
    def std_dn(self) -> float:
        """Standard deviation between the pixels, DN."""
        total, squares = sum(one.total for one in self.planes), sum(one.squares for one in self.planes)
        return float(np.sqrt((self.pixels * squares - total**2) / self.pixels**2))

    def mean_std_dn(self, step_dn: float) -> float:
        """Standard deviation of the mean, DN, by the pixels' own scatter and by rounding to codes of that step."""
        return float(np.hypot(self.std_dn, ROUNDING_STD_DN * step_dn) / np.sqrt(self.pixels))

    def clipped_share(self, saturation_dn: float) -> float:
        """Share of the pixels at `saturation_dn` or above in the plane that has most of them; where that exceeds
        `HIGHEST_SHARE`, a share above it."""
        return max(float(np.count_nonzero(one.highest >= saturation_dn)) / one.pixels for one in self.planes)


Planes = Mapping[tuple[int, int], PlaneSums]


@dataclass(frozen=True)
class CaptureMeans:
    """One capture by the first pixel (row, column) of the planes of its cell: the whole frame, and its central part."""

    whole: Planes
    centre: Planes

    @property
    def mean_dn(self) -> float:
        """Mean of the whole frame, DN."""
        return ChannelMean(tuple(self.whole.values())).mean_dn


def capture_means(recordings: RecordingSet, capture: Capture) -> CaptureMeans:
    """Return the means of a capture, taken once in a recording set."""

    def taken() -> CaptureMeans:
        frame = recordings.frame(capture)
        return CaptureMeans(_plane_sums(frame), _plane_sums(frame[central_part(frame.shape)]))

    return recordings.once(("means of planes", capture.id), taken)


def _plane_sums(frame: NDArray[Any]) -> dict[tuple[int, int], PlaneSums]:
    """Return the sums of the planes of a frame (rows, cols); a frame of one row or column has fewer planes."""
    planes = {place: frame[place[0] :: 2, place[1] :: 2] for place in CELL}
    return {place: PlaneSums.of(plane) for place, plane in planes.items() if plane.size}


def central_part(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of the central part of a frame of `shape` (rows, cols): whole cells."""
    spans = []
    for size in shape:
        half = max(round(size * CENTRAL_SHARE / 4), 1) * 2
        middle = size // 4 * 2
        spans.append(slice(max(middle - half, 0), min(middle + half, size)))
    return spans[0], spans[1]


def channel_means(planes: Planes, cfa: Cfa) -> dict[str, ChannelMean]:
    """Return the channels of a mosaic, from the planes of its cell."""
    if cfa == "MONO":
        return {"Y": ChannelMean(tuple(planes.values()))}
    return {channel: ChannelMean(tuple(planes[place] for place in places)) for channel, places in phases(cfa).items()}


def channel_pixels(frame: NDArray[Any], cfa: Cfa, channel: str) -> FloatArray:
    """Return the values (pixels,), DN, of a channel's pixels. `frame` (rows, cols) begins on a whole period of the
    mosaic."""
    period = step(cfa)
    return np.concatenate([np.asarray(frame[r::period, c::period], float).ravel() for r, c in phases(cfa)[channel]])
