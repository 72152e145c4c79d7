"""Noise of the read-out in the order in which pixels are read: 1/f noise, and what alternates from column to column."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sim.sensor.alternating_rows import AlternatingRows
from sim.spectrum import FloatArray

#: Pixels that are drawn for each one that is read: the ends of a frame have nothing in common.
FOLDED = 2
#: Frequencies of the grid of covariances.
GRID = 2**17


@dataclass(frozen=True)
class PowerLaw:
    """Power (f^2 + knee^2)^(-exponent / 2), of mean 1 over -0.5..0.5 cy/px."""

    exponent: float
    knee_cy_per_px: float

    def _bare(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        return np.asarray((np.square(frequency_cy_per_px) + self.knee_cy_per_px**2) ** (-0.5 * self.exponent))

    @cached_property
    def _whole(self) -> float:
        grid = np.geomspace(1e-3 * self.knee_cy_per_px, 0.5, 4001)
        return float(2.0 * (np.trapezoid(self._bare(grid), grid) + grid[0] * self._bare(grid[:1])[0]))

    def power(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        """Return the power at frequencies from 0 to 0.5."""
        return self._bare(frequency_cy_per_px) / self._whole


@dataclass(frozen=True)
class OrderedNoise:
    """A stationary normal disturbance in the order of the pixels, row after row, a `Disturbance`: of power f^-exponent
    at f cycles a pixel, level below `knee_cy_per_px`, and standard deviation `noise_e`; and the same of `alternating_e`
    by two amplifiers that take turns, of even and of odd columns (an even number in all), each at its own pixels.
    """

    noise_e: float
    alternating_e: float = 0.0
    exponent: float = 1.0
    knee_cy_per_px: float = 1e-6

    @property
    def _shape(self) -> PowerLaw:
        return PowerLaw(self.exponent, self.knee_cy_per_px)

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Electrons (rows, cols) of one frame."""
        total = self._wave((shape[0], shape[1]), rng, self.noise_e)
        for first in (0, 1):
            columns = total[:, first::2]
            columns += self._wave((columns.shape[0], columns.shape[1]), rng, self.alternating_e)
        return total

    def _wave(self, shape: tuple[int, int], rng: np.random.Generator, std: float) -> FloatArray:
        if std == 0.0:
            return np.zeros(shape)
        size = shape[0] * shape[1]
        count = fft.next_fast_len(FOLDED * size, real=True)
        power = _average_power(count, self._shape)
        wave = fft.irfft(fft.rfft(rng.standard_normal(count)) * np.sqrt(power), count)
        return np.asarray(std * wave[:size].reshape(shape))

    def mean_e(self, shape: tuple[int, ...]) -> float:
        """None."""
        return 0.0

    def variance_e2(self, shape: tuple[int, ...]) -> float:
        """Return the variance of a pixel."""
        return self.noise_e**2 + self.alternating_e**2

    def _mixed(self, response: FloatArray) -> FloatArray:
        """What noise shows, from the responses (2, ...) to the common and to the alternating kind of 1 e each."""
        return np.asarray(self.noise_e**2 * response[0] + self.alternating_e**2 * response[1])

    def spectrum_e2(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        """Power at frequencies in reading order, e^2; its mean over -0.5..0.5 cy/px is the variance."""
        return self._mixed(_spectrum(self._shape, np.asarray(frequency_cy_per_px, float)))

    def plane_e2(self, shape: tuple[int, int], across_cy_per_px: FloatArray, down_cy_per_px: FloatArray) -> FloatArray:
        """Expected periodogram |FFT|^2 / pixels of a frame (rows, cols) at frequencies across the columns and down the
        rows, which broadcast.

        A wave of f cycles a pixel has f cols cycles a row down the rows, of which whole ones aren't seen: at d cycles a
        row it is one of (d + m) / cols, m = 0..cols - 1. Across, a row shows it through its Dirichlet kernel. Down the
        rows the spectrum is smooth but at its poles, which leak (`_leaking`).
        """
        across, down = np.broadcast_arrays(np.asarray(across_cy_per_px, float), np.asarray(down_cy_per_px, float))
        return self._mixed(_plane(self._shape, shape, across.tobytes(), down.tobytes(), across.shape))

    def along_rows_e2(self, shape: tuple[int, int], across_cy_per_px: FloatArray) -> FloatArray:
        """Mean over all rows of their expected periodograms, at frequencies across the columns: the transform of the
        covariance in a row, of which 1 - |lag| / cols pairs are there."""
        return self._mixed(_along_rows(self._shape, shape[1], np.asarray(across_cy_per_px, float).tobytes()))

    def along_columns_e2(self, shape: tuple[int, int], down_cy_per_px: FloatArray) -> FloatArray:
        """Mean over the waves across the columns, of 1 to cols / 2 cycles, of a frame's periodogram at frequencies down
        the rows."""
        cols = shape[1]
        down = np.asarray(down_cy_per_px, float)
        whole = self._mixed(_down_rows(self._shape, shape, down.tobytes()))
        # waves across and back are one but for those of no and of cols / 2 cycles
        still, alternating = (self.plane_e2(shape, np.full(len(down), across), down) for across in (0.0, 0.5))
        return np.asarray((whole - still + alternating) / cols)

    def covariance_e2(self, apart_px: NDArray[np.int_]) -> FloatArray:
        """Covariance of two pixels that are read as many pixels apart, up to half of `GRID`."""
        return self._mixed(_covariances(self._shape)[:, np.abs(apart_px)])

    def departures_e2(self, shape: tuple[int, int], period: int, phase: int, down: int, right: int) -> float:
        """Covariance of a pixel of a column of `phase` in the mosaic's `period` with the one `down` and `right` of it,
        after the means of rows and columns were taken out of each plane of the mosaic."""
        return float(self._mixed(_departures(self._shape, shape, period, phase, down, right)))

    def departures_apart_e2(self, shape: tuple[int, int], period: int, apart: int, turned: bool) -> float:
        """Mean covariance of pixels in one row that are `apart` columns apart, or, `turned`, as far from a border on
        either side, 1 to `apart` columns; after the means of rows and columns were taken out of each plane."""
        return float(self._mixed(_departures_apart(self._shape, shape, period, apart, turned)))


#: Noise of the read-out that depends on the place of a pixel in the order in which pixels are read.
ReadOutNoise = OrderedNoise | AlternatingRows


# Responses (2, ...) to the common and to the alternating noise of 1 e. A fit moves both sizes much more often than the
# law, so they are kept by law.


def _spectrum(law: PowerLaw, frequency_cy_per_px: FloatArray) -> FloatArray:
    f = _from_whole(frequency_cy_per_px)
    return np.stack([law.power(away) for away in (f, _from_whole(2.0 * f))])


def _shown(law: PowerLaw, waves_cy_per_px: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """The spectrum as frames show it, which end: near a pole, with what leaks down the rows."""
    rows, cols = shape
    f = _from_whole(waves_cy_per_px)
    powers = []
    for away, across in ((f, cols), (_from_whole(2.0 * f), cols // 2)):
        near = _leaking((rows, across), law)
        cycles = away * across * rows  # a frame, or its even or odd columns
        smooth = law.power(np.maximum(cycles, 0.5) / (rows * across))
        powers.append(np.where(cycles < 0.5 * rows, np.interp(cycles, np.arange(len(near)), near), smooth))
    return np.stack(powers)


@lru_cache(maxsize=256)
def _plane(law: PowerLaw, frame: tuple[int, int], across: bytes, down: bytes, shape: tuple[int, ...]) -> FloatArray:
    cols = frame[1]
    size = int(np.prod(shape))
    make = _kept_row_waves if size * cols <= KEPT_WAVES else _row_waves
    waves, kernel = make(across, down, shape, cols)
    return np.asarray(np.sum(kernel * _shown(law, waves, frame), axis=-1))


@lru_cache(maxsize=256)
def _along_rows(law: PowerLaw, cols: int, across: bytes) -> FloatArray:
    lag = np.arange(1, cols)
    covariances = _covariances(law)[:, :cols]
    pairs = 2.0 * (1.0 - lag / cols) * covariances[:, 1:]
    turn = np.cos(2.0 * np.pi * lag[:, None] * np.frombuffer(across))
    return np.asarray(covariances[:, :1] + pairs @ turn)


@lru_cache(maxsize=64)
def _down_rows(law: PowerLaw, shape: tuple[int, int], down: bytes) -> FloatArray:
    """Sum over all waves across the columns, at frequencies down the rows (doubles)."""
    cols = shape[1]
    waves = (np.frombuffer(down)[:, None] + np.arange(cols)) / cols
    return np.asarray(_shown(law, waves, shape).sum(axis=-1))


@lru_cache(maxsize=16)
def _covariances(law: PowerLaw) -> FloatArray:
    consecutive = fft.irfft(_average_power(GRID, law), GRID)[: GRID // 2]
    apart = np.zeros(len(consecutive))
    apart[::2] = consecutive[: len(consecutive) // 2]
    return np.stack([consecutive, apart])


@lru_cache(maxsize=1024)
def _departures(law: PowerLaw, shape: tuple[int, int], period: int, phase: int, down: int, right: int) -> FloatArray:
    """Response of `OrderedNoise.departures_e2`. What two rows' means have in common is the mean over pairs of their
    columns of both phases; on average over the columns, a pixel has as much of the other's mean."""
    cols = shape[1]
    first, second = (np.arange(cols) % period == (phase + more) % period for more in (0, right))
    pairs = np.rint(np.correlate(second.astype(float), first.astype(float), mode="full"))
    covariances = _covariances(law)
    common = covariances[:, np.abs(down * cols + np.arange(1 - cols, cols))] @ pairs / pairs.sum()
    apart = abs(down * cols + right)
    covariance = covariances[:, apart] if apart < GRID // 2 else np.zeros(2)
    return np.asarray(covariance - common - _column_means(law, shape, period, down, right))


@lru_cache(maxsize=64)
def _departures_apart(law: PowerLaw, shape: tuple[int, int], period: int, apart: int, turned: bool) -> FloatArray:
    if not turned:
        return np.asarray(
            np.mean([_departures(law, shape, period, phase, 0, apart) for phase in range(period)], axis=0)
        )
    right = 2 * np.arange(apart) + 1
    lost = np.mean([_column_means(law, shape, period, 0, int(lag)) for lag in right[:: max(apart // 64, 1)]], axis=0)
    covariances = _covariances(law)
    nearest = _departures(law, shape, period, 0, 0, 1) + _column_means(law, shape, period, 0, 1)
    common = covariances[:, 1] - nearest  # of rows' means in all columns an odd number apart
    return np.asarray(covariances[:, right].mean(axis=1) - common - lost)


@lru_cache(maxsize=64)
def _across_rows(law: PowerLaw, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Powers (2, cols) of the waves of 0 to cols - 1 cycles a row as frames show them, and of those half a cycle a row
    between them."""
    cols = shape[1]
    k = np.arange(cols)
    between = 0.5 * (_spectrum(law, (k + 0.5) / cols) + _spectrum(law, (k - 0.5) / cols))
    return _shown(law, k / cols, shape), between


@lru_cache(maxsize=1024)
def _column_means(law: PowerLaw, shape: tuple[int, int], period: int, down: int, right: int) -> FloatArray:
    """Covariance of the means of columns, without those of the rows, that two pixels lose: of means over all rows, and,
    in a mosaic, of what rows of both phases differ by."""
    rows, cols = shape
    k = np.arange(cols)
    use = (k * period) % cols != 0
    turn = np.cos(2.0 * np.pi * k * right / cols) * use
    shown, between = _across_rows(law, shape)
    power = shown @ turn
    if period == 2:  # half a cycle a row lies between two waves
        power = power + (-1.0) ** down * (between @ turn)
    return np.asarray(power / (rows * cols))


def _from_whole(cycles: FloatArray) -> FloatArray:
    """Distance from the nearest whole number."""
    return np.asarray(np.abs(cycles - np.rint(cycles)))


def _dirichlet2(frequency_cy_per_px: FloatArray, count: int) -> FloatArray:
    """Square of the mean of `count` waves exp(2 pi i f n)."""
    turn = np.pi * _from_whole(frequency_cy_per_px)
    return np.square(np.sinc(count * turn / np.pi) / np.sinc(turn / np.pi))


def _row_waves(across: bytes, down: bytes, shape: tuple[int, ...], cols: int) -> tuple[FloatArray, FloatArray]:
    """The waves of a row, cycles a pixel, and what a row shows of each (..., cols), at frequencies across the columns
    and down the rows (`shape` of doubles): no parameter of the noise enters."""
    at, to = (np.frombuffer(values).reshape(shape) for values in (across, down))
    waves = (to[..., None] + np.arange(cols)) / cols
    return waves, _dirichlet2(at[..., None] - waves, cols)


#: Numbers of one result of `_row_waves` up to which it is kept.
KEPT_WAVES = 200_000
_kept_row_waves = lru_cache(maxsize=64)(_row_waves)


@lru_cache(maxsize=8)
def _average_power(count: int, law: PowerLaw) -> FloatArray:
    """The power law at the frequencies of a line of `count` pixels, of mean 1 over all: that at 0 is the mean within
    half a cycle."""
    power = law.power(np.asarray(fft.rfftfreq(count), float))
    grid = np.geomspace(1e-6 * 0.5 / count, 0.5 / count, 2001)
    power[0] = 2.0 * count * (np.trapezoid(law.power(grid), grid) + grid[0] * law.power(grid[:1])[0])
    both = 2.0 * power.sum() - power[0] - (power[-1] if count % 2 == 0 else 0.0)
    return np.asarray(power * (count / both))


#: Cycles a frame up to which a slow wave's leakage is taken in full, waves from which it leaks, and points of a cycle.
NEAR, SLOW, FINE = 32, 16, 32


@lru_cache(maxsize=64)
def _leaking(shape: tuple[int, int], law: PowerLaw) -> FloatArray:
    """The power law about its pole as the rows of a frame show it at 0, 1, ... rows / 2 cycles a frame: with what its
    waves leak through the rows' Fejer kernel, F(x) = sin^2(pi rows x) / (rows sin^2(pi x))."""
    rows, cols = shape
    size = rows * cols
    cycles = np.arange(rows // 2 + 1)
    far = min(2 * NEAR, rows // 2)
    fine = np.concatenate([np.geomspace(1e-4, 0.5 / FINE, 200), np.arange(1, FINE * far + 1) / FINE])
    power = law.power(fine / size)

    def leaked(at: FloatArray, upto: int) -> FloatArray:
        use = fine <= upto
        both = _fejer((at[:, None] - fine[use]) / rows, rows) + _fejer((at[:, None] + fine[use]) / rows, rows)
        return np.asarray(np.trapezoid(power[use] * both, fine[use], axis=1) / rows)

    shown = law.power(np.maximum(cycles, 0.5) / size)
    near = min(NEAR, len(cycles))
    shown[:near] = leaked(cycles[:near].astype(float), far)
    shown[0] += 2.0 * fine[0] * power[0]
    if near < len(cycles):
        shown[near:] += leaked(cycles[near:].astype(float), SLOW)
    return np.asarray(shown)


def _fejer(frequency_cy_per_px: FloatArray, count: int) -> FloatArray:
    return count * _dirichlet2(frequency_cy_per_px, count)
