"""Means of one frame by channel: what fits and diagnosis take of narrowband light, flats and darks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.formats.recording_set import FrameCodes
from sim.camera import Cfa
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray

ROUNDING_STD_DN = 0.3  # standard deviation that rounding to a step of 1 DN adds to a pixel: 1 / sqrt(12)


@dataclass(frozen=True)
class PlaneMean:
    """The pixels of one channel in a frame, or in a part of it."""

    mean_dn: float
    std_dn: float  # between the pixels
    pixels: int
    clipped_share: float
    step_dn: float = 1.0  # of the codes

    @property
    def mean_std_dn(self) -> float:
        """Standard deviation of the mean, with the pixels' own scatter and rounding."""
        return float(np.hypot(self.std_dn, ROUNDING_STD_DN * self.step_dn) / np.sqrt(self.pixels))


def channel_pixels(frame: NDArray[Any], cfa: Cfa, channel: str) -> FloatArray:
    """Return the values (pixels,), DN, of a channel's pixels. `frame` (rows, cols) begins on a whole period of the
    mosaic."""
    period = step(cfa)
    return np.concatenate([np.asarray(frame[r::period, c::period], float).ravel() for r, c in phases(cfa)[channel]])


def plane_means(frame: NDArray[Any], cfa: Cfa, saturation_dn: float, step_dn: float = 1.0) -> dict[str, PlaneMean]:
    """Return the mean of each channel.

    `frame` (rows, cols), DN, begins on a whole period of the mosaic; a pixel of `saturation_dn` or more is clipped.
    `step_dn`: step of the codes.
    """
    return channel_means(FrameCodes.count(frame), cfa, saturation_dn, step_dn)


def channel_means(codes: FrameCodes, cfa: Cfa, saturation_dn: float, step_dn: float = 1.0) -> dict[str, PlaneMean]:
    """Return the mean of each channel of a frame by its codes; arguments as of `plane_means`."""
    found = {}
    for channel in phases(cfa):
        counts = codes.channel(cfa, channel)
        clipped = counts.share_from(saturation_dn)
        found[channel] = PlaneMean(counts.mean_dn, counts.std_dn, counts.pixels, clipped, step_dn)
    return found
