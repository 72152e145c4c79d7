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

BAND_PIXELS = 1_500_000  # of a band of a large image: they tell the level to 0.4 %, as the numbers that use it say
LEVEL_BAND = 0.04, 0.2  # cy/px, along both axes: frequencies over which the power of white noise is averaged
#: Powers above this multiple of the level are tones, and no part of it. Powers of noise are exponentially distributed:
#: a share exp(-16) = 1e-7 is above, with 17 exp(-16) = 2e-6 of the power.
LARGEST_POWER = 16.0


@dataclass(frozen=True)
class _Powers:
    """|FFT|^2 / pixels of an image less its mean, by frequency (cy/px) across its rows and across its columns."""

    table: NDArray[np.float32]  # (rows, cols / 2 + 1), the image's unit squared
    rows: FloatArray
    cols: FloatArray  # from 0 on

    @classmethod
    def of(cls, image: Image) -> _Powers:
        spectrum = fft.rfft2(image)
        table = (np.square(spectrum.real) + np.square(spectrum.imag)) / np.float32(image.size)
        return cls(table, fft.fftfreq(image.shape[0]), fft.rfftfreq(image.shape[1]))

    def in_level_band(self) -> FloatArray:
        """Return the powers in `LEVEL_BAND`, without those of tones."""
        low, high = LEVEL_BAND
        rows = (np.abs(self.rows) >= low) & (np.abs(self.rows) <= high)
        cols = (self.cols >= low) & (self.cols <= high)
        powers = np.asarray(self.table[np.ix_(rows, cols)].ravel(), float)
        # the median of an exponential distribution is ln 2 of its mean
        return powers[powers <= LARGEST_POWER / np.log(2.0) * np.median(powers)]


@dataclass(frozen=True)
class Periodogram:
    """Periodogram of one image less its mean. Its level is the variance of a pixel for white noise.

    `means`: frequencies and powers of the means of rows, and of columns, of the whole image. `powers`: of a band of
    whole rows, and of one of whole columns; of a small image both are all of it.
    """

    means: dict[Lines, tuple[FloatArray, FloatArray]]
    powers: dict[Lines, _Powers]
    level: float  # mean power in `LEVEL_BAND`
    modes: int  # frequencies of that mean

    def _relative(self, power: FloatArray) -> FloatArray:
        """Power over the level, of expectation 1 for white noise. The level is a mean over L modes and
        gamma-distributed, so that the expectation of its inverse is L / (L - 1)."""
        return np.asarray(power / self.level * (1.0 - 1.0 / self.modes if self.modes > 1 else 1.0))

    def line(self, lines: Lines) -> tuple[FloatArray, FloatArray, float]:
        """(frequency, power over the level, number of the level's modes) of the lines' means, for frequencies above 0
        and below 0.5 cy/px."""
        frequency, power = self.means[lines]
        use = (frequency > 0) & (frequency < 0.4999)
        return frequency[use], self._relative(power[use]), float(self.modes)

    def along(self, lines: Lines) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(frequency, power over the level, number of modes) along rows (columns), for frequencies up to the level
        band. Powers are means over the rows (columns) of the band without the lines' means."""
        of = self.powers[lines]
        if lines == "rows":
            inside, frequency = of.table[np.abs(of.rows) > 1.5 / len(of.rows)], of.cols
            power, modes = inside.mean(axis=0, dtype=float), float(len(inside))
        else:
            inside, frequency = of.table[:, of.cols > 0.75 / len(of.cols)], of.rows
            power, modes = inside.mean(axis=1, dtype=float), float(inside.shape[1])
            # positive and negative frequencies are different modes
            power = 0.5 * (power + np.roll(power[::-1], 1))
            modes *= 2.0
        use = (frequency > 0) & (frequency <= LEVEL_BAND[0])
        return frequency[use], self._relative(power[use]), np.full(int(use.sum()), modes)


def periodogram(image: Image) -> Periodogram:
    """Return the periodogram of an image less its mean; of one larger than two bands of `BAND_PIXELS`, by these."""
    image = image - np.float32(image.mean(dtype=np.float64))
    rows, cols = image.shape
    across, down = (fft.fft(image.sum(axis=1, dtype=float)), fft.rfft(image.sum(axis=0, dtype=float)))
    means: dict[Lines, tuple[FloatArray, FloatArray]] = {
        "rows": (fft.fftfreq(rows), np.square(np.abs(across)) / image.size),
        "columns": (fft.rfftfreq(cols), np.square(np.abs(down)) / image.size),
    }
    if image.size <= 2 * BAND_PIXELS:
        whole = _Powers.of(image)
        powers: dict[Lines, _Powers] = {"rows": whole, "columns": whole}
        level = whole.in_level_band()
    else:
        of_rows, of_cols = middle(rows, BAND_PIXELS // cols), middle(cols, BAND_PIXELS // rows)
        powers = {"rows": _Powers.of(image[of_rows]), "columns": _Powers.of(image[:, of_cols])}
        level = np.concatenate([of.in_level_band() for of in powers.values()])
    return Periodogram(means, powers, max(float(level.mean()), 1e-12), level.size)


def middle(size: int, wanted: int) -> slice:
    """Return the middle `wanted` of `size` lines, and a few more where their transform is faster."""
    count = min(fft.next_fast_len(max(wanted, 2), real=True), size)
    return slice((size - count) // 2, (size - count) // 2 + count)


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
