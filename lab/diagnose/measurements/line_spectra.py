"""Power spectra of dark frames along rows and columns, and their means over bands of frequency."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import digamma, polygamma

from sim.sensor.lines import Lines
from sim.spectrum import FloatArray

Image = NDArray[np.float32]
LEVEL_BAND = 0.04, 0.2  # cy/px, along both axes: where a spectrum's level is taken


@dataclass(frozen=True)
class Periodogram:
    """Periodogram of one image, whose level is the variance for white noise; the rows' frequencies by the columns' (only from 0 on)."""

    table: FloatArray
    rows: FloatArray
    cols: FloatArray
    cells: int

    @property
    def _level(self) -> FloatArray:
        low, high = LEVEL_BAND
        inside = ((np.abs(self.rows) >= low) & (np.abs(self.rows) <= high))[:, None] & (
            (self.cols >= low) & (self.cols <= high)
        )[None, :]
        return self.table[inside]

    @property
    def level(self) -> float:
        return max(float(self._level.mean()), 1e-12)

    def _relative(self, power: FloatArray) -> FloatArray:
        """Power over the level, 1 for white noise: the mean of 1 / level over L modes is L / (L - 1), as the level is gamma-distributed."""
        modes = self._level.size
        return np.asarray(power / self.level * (1.0 - 1.0 / modes if modes > 1 else 1.0))

    def line(self, lines: Lines) -> tuple[FloatArray, FloatArray, float]:
        """(frequency, power over the level) of the lines' means, up to and without 0.5 cy/px; number of the level's modes."""
        table, frequency = (self.table[:, 0], self.rows) if lines == "rows" else (self.table[0], self.cols)
        use = (frequency > 0) & (frequency < 0.4999)
        return frequency[use], self._relative(table[use]), float(self._level.size)

    def along(self, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(frequency, power over the level, modes) within rows (columns), mean over these without what a line has in common."""
        if lines == "rows":
            inside, frequency = self.table[np.abs(self.rows) > 1.5 / len(self.rows)], self.cols
            power, modes = inside.mean(axis=0), float(len(inside))
        else:
            inside, frequency = self.table[:, self.cols > 0.75 / len(self.cols)], self.rows
            power, modes = inside.mean(axis=1), float(inside.shape[1])
            # negative frequencies are others
            power = 0.5 * (power + np.roll(power[::-1], 1))
            modes *= 2.0
        use = (frequency > 0) & (frequency <= LEVEL_BAND[0])
        return frequency[use], self._relative(power[use]), np.full(int(use.sum()), modes)


def periodogram(image: Image) -> Periodogram:
    spectrum = fft.rfft2(image - np.float32(image.mean(dtype=np.float64)))
    table = (spectrum.real.astype(float) ** 2 + spectrum.imag.astype(float) ** 2) / image.size
    return Periodogram(table, fft.fftfreq(image.shape[0]), fft.rfftfreq(image.shape[1]), image.size)


def pooled(parts: list[tuple[FloatArray, FloatArray, float]]) -> tuple[FloatArray, FloatArray, float]:
    """Mean over contrasts of (frequency, relative power); its level's modes add up."""
    return parts[0][0], np.mean([p for _, p, _ in parts], axis=0), float(sum(m for *_, m in parts))


def pooled_along(parts: list[tuple[FloatArray, FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    return parts[0][0], np.mean([p for _, p, _ in parts], axis=0), np.sum([m for *_, m in parts], axis=0)


@dataclass(frozen=True)
class Bands:
    """A spectrum's bands: their edges in the list of frequencies, and their middles."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    middle: FloatArray

    @staticmethod
    def of(frequency: FloatArray, count: int, power: float = 1.0) -> Bands:
        """`power` above 1: narrower ones towards low frequencies, of two frequencies at least."""
        share = np.linspace(0.0, 1.0, min(count, max(len(frequency) // 3, 1)) + 1) ** power
        edges = np.unique(np.rint(len(frequency) * share).astype(int))
        edges = edges[np.append(np.diff(edges) > 1, True)]
        edges[0] = 0
        middle = np.array([frequency[a:b].mean() for a, b in pairwise(edges)])
        return Bands(edges[:-1], edges[1:], middle)

    def mean(self, power: FloatArray) -> FloatArray:
        return np.array([power[a:b].mean() for a, b in zip(self.first, self.last, strict=True)])

    @property
    def modes(self) -> FloatArray:
        return (self.last - self.first).astype(float)


def log_mean_bias(modes: FloatArray | float) -> FloatArray:
    """Of the logarithm of a mean of exponential variables."""
    return np.asarray(digamma(modes) - np.log(modes))


def log_mean_variance(modes: FloatArray | float) -> FloatArray:
    # of few modes the logarithm has a long lower tail
    return np.asarray(polygamma(1, modes) * (1.0 + 1.0 / np.asarray(modes)))
