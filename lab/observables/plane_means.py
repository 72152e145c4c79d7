"""Means of one capture by the planes of the 2 x 2 cell, for fits and diagnosis: of narrowband light, flats and darks.

They are in codes, and no statement about the camera enters. Which colour a plane has, the step of the codes, and from
which code on pixels clip are arguments of what is asked of the means.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import CodeCounts, FrameCodes, RecordingSet
from sim.camera import Cfa
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray

CENTRAL_SHARE = 0.25  # of rows and columns: the part of the frame on axis
ROUNDING_STD_DN = 0.3  # standard deviation that rounding to a step of 1 DN adds to a pixel: 1 / sqrt(12)


@dataclass(frozen=True)
class ChannelMean:
    """The pixels of one channel: the codes of its cells."""

    cells: tuple[CodeCounts, ...]

    @cached_property
    def _every(self) -> CodeCounts:
        return CodeCounts.total(self.cells)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self._every.pixels

    @property
    def mean_dn(self) -> float:
        """Mean, DN."""
        return self._every.mean_dn

    @property
    def std_dn(self) -> float:
        """Standard deviation between the pixels, DN."""
        return self._every.std_dn

    def mean_std_dn(self, step_dn: float) -> float:
        """Standard deviation of the mean, DN, by the pixels' own scatter and by rounding to codes of that step."""
        return float(np.hypot(self.std_dn, ROUNDING_STD_DN * step_dn) / np.sqrt(self.pixels))

    def clipped_share(self, saturation_dn: float) -> float:
        """Return the share of the pixels at `saturation_dn` or above, in the cell that has most of them."""
        return max(cell.share_from(saturation_dn) for cell in self.cells)


def central_codes(recordings: RecordingSet, capture: Capture) -> FrameCodes:
    """Return the codes of the central part of a capture's frame, counted once whatever is stated."""

    def counted() -> FrameCodes:
        frame = recordings.frame(capture)
        return FrameCodes.count(frame[central_part(frame.shape)])

    return recordings.once(("codes of the central part", capture.frame), counted, whatever_is_stated=True)


def central_part(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of the central part of a frame of `shape` (rows, cols): whole cells."""
    spans = []
    for size in shape:
        half = max(round(size * CENTRAL_SHARE / 4), 1) * 2
        middle = size // 4 * 2
        spans.append(slice(max(middle - half, 0), min(middle + half, size)))
    return spans[0], spans[1]


def channel_means(codes: FrameCodes, cfa: Cfa) -> dict[str, ChannelMean]:
    """Return the channels of a stated mosaic that have pixels, from the codes of its cells."""
    return {channel: ChannelMean(cells) for channel, cells in codes.channels(cfa).items()}


def channel_pixels(frame: NDArray[Any], cfa: Cfa, channel: str) -> FloatArray:
    """Return the values (pixels,), DN, of a channel's pixels. `frame` (rows, cols) begins on a whole period of the
    mosaic."""
    period = step(cfa)
    return np.concatenate([np.asarray(frame[r::period, c::period], float).ravel() for r, c in phases(cfa)[channel]])
