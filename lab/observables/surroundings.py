"""Light that halos (wide, normal point spread) bring to a place from its surroundings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.point import halos
from sim.sensor import mosaic
from sim.spectrum import FloatArray

LOWEST = 48  # cosine harmonics a side: all that is left of a picture by a halo of a fifth of the half diagonal


def halo_light(places: Sequence[Surroundings], effects: Effects, camera: CameraModel) -> FloatArray:
    """Light (places,) that the effects' halos bring to places in planes of the mosaic, in the planes' unit."""
    step = mosaic.step(camera.cfa)
    found = np.zeros(len(places))
    for share, std_px in halos(camera, effects):
        found += share * np.array([place.mean(std_px / step) for place in places])
    return found


def harmonics(picture: FloatArray) -> FloatArray:
    """Return the lowest `LOWEST` x `LOWEST` coefficients of a picture's orthonormal cosine transform."""
    return np.asarray(fft.dctn(np.asarray(picture, float), norm="ortho")[:LOWEST, :LOWEST])


@dataclass(frozen=True)
class Surroundings:
    """Means of a picture about a place, weighted by normal distributions. The picture continues as its mirror image
    beyond the frame.

    The cosine transform turns the convolution into a product, of which wide distributions leave only the lowest
    frequencies."""

    table: FloatArray  # (k, l): product of the transforms of picture and place
    rows: int  # of the picture
    cols: int

    @staticmethod
    def of(low: FloatArray, place: NDArray[np.bool_]) -> Surroundings:
        """`low`: `harmonics` of the picture; `place` (rows, cols): mask of the pixels of the place."""
        return Surroundings(low * harmonics(place / place.sum()), *place.shape)

    @staticmethod
    def of_box(low: FloatArray, shape: tuple[int, ...], rows: slice, cols: slice) -> Surroundings:
        """Return the same for a box of rows and columns in a picture of that shape."""
        weights = [np.zeros(size) for size in shape]
        for weight, part in zip(weights, (rows, cols), strict=True):
            weight[part] = 1.0 / (part.stop - part.start)
        down, along = (fft.dct(weight, norm="ortho")[:LOWEST] for weight in weights)
        return Surroundings(low * np.outer(down, along), *shape)

    def mean(self, std_px: float) -> float:
        """Return the mean weighted by a normal distribution of that standard deviation about each pixel of the
        place."""
        rows, cols = (
            np.exp(-0.5 * np.square(np.pi * std_px * np.arange(count) / size))
            for count, size in zip(self.table.shape, (self.rows, self.cols), strict=True)
        )
        return float(rows @ self.table @ cols)
