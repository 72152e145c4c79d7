"""Noise that all pixels of a row or of a column share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim.spectrum import FloatArray

#: Lines of pixels that may share a disturbance.
Lines = Literal["rows", "columns"]
#: Below this frequency a power law is level, cycles a line: no read-out's noise grows without end.
KNEE_CY_PER_LINE = 1e-3
#: Lines of a power law's noise that are drawn for each one that is read.
FOLDED = 4
#: What makes the fixed offsets of rows and of columns different draws of one seed.
_STREAM = {"columns": 3, "rows": 4}
#: The same of their gains.
_GAIN_STREAM = {"columns": 5, "rows": 6}


@dataclass(frozen=True)
class LineNoise:
    """Electrons that all pixels of a row (or column) share: a normal variable in every frame, of which lines n apart
    have `correlation`^n in common, or, with an `exponent` above 0, of power f^-exponent at f cycles a line, level
    below `KNEE_CY_PER_LINE`; fixed offsets drawn once by `seed`, of mean 0 over the lines; a step from even to
    odd lines.
    """

    lines: Lines
    temporal_e: float = 0.0
    correlation: float = 0.0
    fixed_e: float = 0.0
    odd_even_e: float = 0.0
    seed: int = 0
    exponent: float = 0.0

    def _axis_shape(self, shape: tuple[int, ...]) -> tuple[int, int]:
        return (shape[0], 1) if self.lines == "rows" else (1, shape[1])

    def draw(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Electrons of one frame, (rows, 1) or (1, columns)."""
        along = self._axis_shape(shape)
        total = np.broadcast_to(np.asarray(self.mean_e(shape), float), along)
        if self.temporal_e > 0.0:
            total = total + self.temporal_e * self._colour(rng, along)
        return total

    def _colour(self, rng: np.random.Generator, along: tuple[int, int]) -> FloatArray:
        """Draw noise of variance 1 along the lines."""
        if self.exponent == 0.0:
            return _correlate(rng.standard_normal(along), self.correlation)
        count = FOLDED * max(along)  # a part of a longer line: its ends have nothing in common
        power = _power_law(np.asarray(np.fft.rfftfreq(count), np.float64), self.exponent)
        wave = np.fft.irfft(np.fft.rfft(rng.standard_normal(count)) * np.sqrt(power), count)
        return np.asarray(wave[: max(along)]).reshape(along)

    def mean_e(self, shape: tuple[int, ...]) -> FloatArray | float:
        """Return the fixed part, of the same shape; 0 for none."""
        if self.fixed_e == 0.0 and self.odd_even_e == 0.0:
            return 0.0
        along = self._axis_shape(shape)
        offset = np.random.default_rng([self.seed, _STREAM[self.lines]]).standard_normal(along)
        odd = np.arange(max(along)).reshape(along) % 2 - 0.5
        return self.fixed_e * (offset - offset.mean()) + self.odd_even_e * odd

    def variance_e2(self, shape: tuple[int, ...]) -> float:
        """Temporal variance of a pixel."""
        return self.temporal_e**2

    def spectrum_e2(self, frequency_cy_per_px: FloatArray, fixed: bool) -> FloatArray:
        """Power spectrum across the lines of what they share anew in every frame or, `fixed`, in all, without the step
        from even to odd lines; e^2, its mean over -0.5..0.5 cy/px is the variance.
        """
        even = np.ones(np.shape(frequency_cy_per_px))
        if fixed:
            return self.fixed_e**2 * even
        if self.exponent != 0.0:
            return self.temporal_e**2 * _power_law(np.asarray(frequency_cy_per_px, float), self.exponent)
        c = self.correlation
        turn = np.cos(2.0 * np.pi * np.asarray(frequency_cy_per_px))
        return np.asarray(self.temporal_e**2 * (1.0 - c * c) / (1.0 - 2.0 * c * turn + c * c))


@dataclass(frozen=True)
class LineGains:
    """Factors on what is read of rows (or columns), drawn once by `seed`: normal, independent, of mean 1 over the
    lines."""

    lines: Lines
    relative_std: float
    seed: int = 0

    def factors(self, shape: tuple[int, int]) -> FloatArray:
        """Return the factors, (rows, 1) or (1, columns)."""
        along = (shape[0], 1) if self.lines == "rows" else (1, shape[1])
        drawn = np.random.default_rng([self.seed, _GAIN_STREAM[self.lines]]).standard_normal(along)
        return np.asarray(1.0 + self.relative_std * (drawn - drawn.mean()))


def _correlate(white: FloatArray, correlation: float) -> FloatArray:
    """White noise of variance 1 along its longer axis as a stationary autoregressive process of first order, of
    variance 1.
    """
    if correlation == 0.0:
        return white
    from scipy.signal import lfilter  # here: the library takes a while to load

    line = white.ravel()
    fresh = np.sqrt(1.0 - correlation**2)
    filtered = lfilter([fresh], [1.0, -correlation], np.concatenate([line[:1] / fresh, line[1:]]))
    return np.asarray(filtered).reshape(white.shape)


def _power_law(frequency_cy_per_px: FloatArray, exponent: float) -> FloatArray:
    """Power (f^2 + knee^2)^(-exponent / 2), of mean 1 over -0.5..0.5 cy/px."""

    def law(f: FloatArray) -> FloatArray:
        return np.asarray((np.square(f) + KNEE_CY_PER_LINE**2) ** (-0.5 * exponent))

    grid = np.geomspace(1e-3 * KNEE_CY_PER_LINE, 0.5, 2001)
    return law(frequency_cy_per_px) / (2.0 * np.trapezoid(law(grid), grid))
