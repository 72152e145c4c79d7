"""Noise of rows that two amplifiers read in turns, each with an offset of its own a row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.spectrum import FloatArray


@dataclass(frozen=True)
class AlternatingRows:
    """A normal variable a row, frame and amplifier, of even and of odd columns, a `Disturbance`: pixels of one row an
    even number of columns apart share `noise_e`^2, all others nothing. `cols` (an even number) are read a row.

    Its figures are those of `sim.sensor.reading_order.OrderedNoise`, for the same observables.
    """

    noise_e: float
    cols: int

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Electrons (rows, cols) of one frame."""
        offsets = self.noise_e * rng.standard_normal((shape[0], 2))
        return np.asarray(offsets[:, np.arange(shape[1]) % 2])

    def mean_e(self, shape: tuple[int, ...]) -> float:
        """None."""
        return 0.0

    def variance_e2(self, shape: tuple[int, ...]) -> float:
        """Return the variance of a pixel."""
        return self.noise_e**2

    def spectrum_e2(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        """Power at frequencies in reading order, e^2; its mean over -0.5..0.5 cy/px is the variance. It is the expected
        periodogram of a row: that of a constant of cols / 2 pixels at twice the frequency."""
        half = self.cols // 2
        turn = 2.0 * np.asarray(frequency_cy_per_px, float)
        away = turn - np.rint(turn)
        return np.asarray(self.noise_e**2 * half * np.square(np.sinc(half * away) / np.sinc(away)))

    def plane_e2(self, shape: tuple[int, int], across_cy_per_px: FloatArray, down_cy_per_px: FloatArray) -> FloatArray:
        """Expected periodogram |FFT|^2 / pixels of a frame (rows, cols) at frequencies across the columns and down the
        rows, which broadcast: level down the rows."""
        across, _ = np.broadcast_arrays(np.asarray(across_cy_per_px, float), np.asarray(down_cy_per_px, float))
        return self.spectrum_e2(across)

    def along_rows_e2(self, shape: tuple[int, int], across_cy_per_px: FloatArray) -> FloatArray:
        """Mean over all rows of their expected periodograms, at frequencies across the columns."""
        return self.spectrum_e2(across_cy_per_px)

    def along_columns_e2(self, shape: tuple[int, int], down_cy_per_px: FloatArray) -> FloatArray:
        """Mean over the waves across the columns, of 1 to cols / 2 cycles, of a frame's periodogram at frequencies down
        the rows: that of cols / 2 cycles has all of it."""
        return np.full(np.shape(down_cy_per_px), self.noise_e**2)

    def covariance_e2(self, apart_px: NDArray[np.int_]) -> FloatArray:
        """Mean covariance of two pixels that are read as many pixels apart."""
        apart = np.abs(np.asarray(apart_px))
        return np.asarray(self.noise_e**2 * np.maximum(1.0 - apart / self.cols, 0.0) * (apart % 2 == 0))

    def departures_e2(self, shape: tuple[int, int], period: int, phase: int, down: int, right: int) -> float:
        """Covariance of a pixel with the one `down` and `right` of it, after the means of rows and columns were taken
        out of each plane of a mosaic of this `period`: planes of a mosaic lose all of it with their rows' means."""
        if period == 2:
            return 0.0
        return 0.5 * self.noise_e**2 * (-1.0) ** right * (float(down == 0) - 1.0 / shape[0])

    def departures_apart_e2(self, shape: tuple[int, int], period: int, apart: int, turned: bool) -> float:
        """Mean covariance of pixels in one row that are `apart` columns apart, or, `turned`, as far from a border on
        either side, 1 to `apart` columns; after the means of rows and columns were taken out of each plane."""
        return self.departures_e2(shape, period, 0, 0, 1 if turned else apart)
