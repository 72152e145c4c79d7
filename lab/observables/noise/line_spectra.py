"""Power spectra of dark frames along rows and columns, and their means over bands of frequency."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import digamma, polygamma

from lab.observables.noise.robust import Image
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray

LEVEL_BAND = 0.04, 0.2  # cy/px, along both axes: frequencies over which the power of white noise is averaged
#: Powers above this multiple of the level are tones, and no part of it. Powers of noise are exponentially distributed:
#: a share exp(-16) = 1e-7 is above, with 17 exp(-16) = 2e-6 of the power.
LARGEST_POWER = 16.0


@dataclass(frozen=True)
class Periodogram:
    """Periodogram |FFT|^2 / pixels of one image. Its mean level is the variance of a pixel for white noise."""

    table: FloatArray  # (rows, cols / 2 + 1), the image's unit squared
    rows: FloatArray  # frequencies across rows, cy/px
    cols: FloatArray  # frequencies across columns, cy/px, from 0 on

    @property
    def _level(self) -> FloatArray:
        """The powers in `LEVEL_BAND`, without those of tones."""
        low, high = LEVEL_BAND
        inside = ((np.abs(self.rows) >= low) & (np.abs(self.rows) <= high))[:, None] & (
            (self.cols >= low) & (self.cols <= high)
        )[None, :]
        powers = self.table[inside]
        # the median of an exponential distribution is ln 2 of its mean
        return powers[powers <= LARGEST_POWER / np.log(2.0) * np.median(powers)]

    @property
    def level(self) -> float:
        """Mean power in `LEVEL_BAND`: the variance of a pixel by white noise."""
        return max(float(self._level.mean()), 1e-12)

    def _relative(self, power: FloatArray) -> FloatArray:
        """Power over the level, of expectation 1 for white noise. The level is a mean over L modes and
        gamma-distributed, so that the expectation of its inverse is L / (L - 1)."""
        modes = self._level.size
        return np.asarray(power / self.level * (1.0 - 1.0 / modes if modes > 1 else 1.0))

    def line(self, lines: Lines) -> tuple[FloatArray, FloatArray, float]:
        """(frequency, power over the level, number of the level's modes) of the lines' means, for frequencies above 0
        and below
        0.5 cy/px."""
        table, frequency = (self.table[:, 0], self.rows) if lines == "rows" else (self.table[0], self.cols)
        use = (frequency > 0) & (frequency < 0.4999)
        return frequency[use], self._relative(table[use]), float(self._level.size)

    def along(self, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(frequency, power over the level, number of modes) along rows (columns), for frequencies up to the level
        band. Powers are means over all rows (columns) without the lines' means."""
        if lines == "rows":
            inside, frequency = self.table[np.abs(self.rows) > 1.5 / len(self.rows)], self.cols
            power, modes = inside.mean(axis=0), float(len(inside))
        else:
            inside, frequency = self.table[:, self.cols > 0.75 / len(self.cols)], self.rows
            power, modes = inside.mean(axis=1), float(inside.shape[1])
            # positive and negative frequencies are different modes
            power = 0.5 * (power + np.roll(power[::-1], 1))
            modes *= 2.0
        use = (frequency > 0) & (frequency <= LEVEL_BAND[0])
        return frequency[use], self._relative(power[use]), np.full(int(use.sum()), modes)


def periodogram(image: Image) -> Periodogram:
    """Return the periodogram of an image less its mean."""
    spectrum = fft.rfft2(image - np.float32(image.mean(dtype=np.float64)))
    table = (spectrum.real.astype(float) ** 2 + spectrum.imag.astype(float) ** 2) / image.size
    return Periodogram(table, fft.fftfreq(image.shape[0]), fft.rfftfreq(image.shape[1]))


def pooled(parts: list[tuple[FloatArray, FloatArray, float]]) -> tuple[FloatArray, FloatArray, float]:
    """(frequency, mean relative power, total number of the level's modes) of several spectra (`Periodogram.line`)."""
    return parts[0][0], np.mean([p for _, p, _ in parts], axis=0), float(sum(m for *_, m in parts))


def pooled_along(parts: list[tuple[FloatArray, FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(frequency, mean relative power, total number of modes) of several spectra (`Periodogram.along`)."""
    return parts[0][0], np.mean([p for _, p, _ in parts], axis=0), np.sum([m for *_, m in parts], axis=0)


@dataclass(frozen=True)
class Bands:
    """Bands of a spectrum."""

    first: NDArray[np.intp]  # index of each band's first frequency
    last: NDArray[np.intp]  # index after its last one
    middle: FloatArray  # mean frequency

    @staticmethod
    def of(frequency: FloatArray, count: int, power: float = 1.0) -> Bands:
        """At most `count` bands of at least two frequencies. Their edges follow k^`power`: above 1, low bands are
        narrower."""
        share = np.linspace(0.0, 1.0, min(count, max(len(frequency) // 3, 1)) + 1) ** power
        edges = np.unique(np.rint(len(frequency) * share).astype(int))
        edges = edges[np.append(np.diff(edges) > 1, True)]
        edges[0] = 0
        middle = np.array([frequency[a:b].mean() for a, b in pairwise(edges)])
        return Bands(edges[:-1], edges[1:], middle)

    def mean(self, power: FloatArray) -> FloatArray:
        """Means (bands,) of a spectrum's power."""
        return np.array([power[a:b].mean() for a, b in zip(self.first, self.last, strict=True)])

    @property
    def modes(self) -> FloatArray:
        """Number of frequencies in each band."""
        return (self.last - self.first).astype(float)


def log_mean_bias(modes: FloatArray | float) -> FloatArray:
    """Expectation of ln(mean of `modes` exponential variables of mean 1): digamma(n) - ln n."""
    return np.asarray(digamma(modes) - np.log(modes))


def log_mean_variance(modes: FloatArray | float) -> FloatArray:
    """Variance of ln(mean of n = `modes` exponential variables): trigamma(n), times 1 + 1 / n as few modes have a long
    lower tail."""
    return np.asarray(polygamma(1, modes) * (1.0 + 1.0 / np.asarray(modes)))
