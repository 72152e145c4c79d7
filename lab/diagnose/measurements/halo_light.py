"""Light that a lens spreads over the frame around a place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.diagnose.measurements.block import Effects
from sim.camera import CameraModel
from sim.point import halos
from sim.sensor import mosaic
from sim.spectrum import FloatArray

LOWEST = 48  # harmonics of a frame: all that a halo of a fifth of its half diagonal leaves of a picture


def halo_light(places: Sequence[Surroundings], effects: Effects, camera: CameraModel) -> FloatArray:
    """Light that the effects' halos bring to places in planes of the mosaic from around, (places,), in the planes' unit."""
    step = mosaic.step(camera.cfa)
    found = np.zeros(len(places))
    for share, std_px in halos(camera, effects):
        found += share * np.array([place.mean(std_px / step) for place in places])
    return found


def harmonics(picture: FloatArray) -> FloatArray:
    """The lowest of a picture's cosine transform."""
    return np.asarray(fft.dctn(np.asarray(picture, float), norm="ortho")[:LOWEST, :LOWEST])


@dataclass(frozen=True)
class Surroundings:
    """Means of a picture about a place, weighted by normal distributions; what lies beyond the frame is its mirror image.

    Cosine transforms turn the convolution into a product, of which wide distributions leave the lowest frequencies only.
    """

    table: FloatArray  # of picture times place, (k, l)
    rows: int
    cols: int

    @staticmethod
    def of(low: FloatArray, place: NDArray[np.bool_]) -> Surroundings:
        """`low`: the picture's lowest harmonics; `place`: the pixels about which the mean is wanted."""
        return Surroundings(low * harmonics(place / place.sum()), *place.shape)

    @staticmethod
    def of_box(low: FloatArray, shape: tuple[int, ...], rows: slice, cols: slice) -> Surroundings:
        """The same of a box in a picture of that shape."""
        weights = [np.zeros(size) for size in shape]
        for weight, part in zip(weights, (rows, cols), strict=True):
            weight[part] = 1.0 / (part.stop - part.start)
        down, along = (fft.dct(weight, norm="ortho")[:LOWEST] for weight in weights)
        return Surroundings(low * np.outer(down, along), *shape)

    def mean(self, std_px: float) -> float:
        """Weighted by a normal distribution of that standard deviation."""
        rows, cols = (
            np.exp(-0.5 * np.square(np.pi * std_px * np.arange(count) / size))
            for count, size in zip(self.table.shape, (self.rows, self.cols), strict=True)
        )
        return float(rows @ self.table @ cols)
