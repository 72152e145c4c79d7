"""Cubic splines for the edge-spread function: values, Gram matrices over samples, and the Fourier transform of the
derivative.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Spline:
    """Cubic spline over ascending `knot_px`, constant beyond the first and the last knot.

    The value there is the first or the last coefficient: B-splines with fourfold end knots.
    """

    knot_px: Array

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.knot_px) + 2

    @property
    def _all_knots(self) -> Array:
        return np.concatenate([[self.knot_px[0]] * 3, self.knot_px, [self.knot_px[-1]] * 3])

    def design(self, distance_px: Array) -> sparse.csr_array:
        """Matrix (n, size) from the coefficients to the values at `distance_px` (n,)."""
        inside = np.clip(distance_px, self.knot_px[0], self.knot_px[-1])
        return BSpline.design_matrix(inside, self._all_knots, 3)

    def values(self, coefficients: Array, distance_px: Array) -> Array:
        """Values (n,) at `distance_px` (n,): `design(distance_px) @ coefficients`, without the matrix."""
        inside = np.clip(distance_px, self.knot_px[0], self.knot_px[-1])
        return np.asarray(BSpline(self._all_knots, coefficients, 3)(inside))

    def derivative(self, coefficients: Array, distance_px: Array) -> Array:
        """First derivative (n,), per px, at `distance_px`; 0 beyond the ends."""
        value = BSpline(self._all_knots, coefficients, 3)(distance_px, nu=1, extrapolate=True)
        outside = (distance_px < self.knot_px[0]) | (distance_px > self.knot_px[-1])
        return np.where(outside, 0.0, value)

    @cached_property
    def pieces(self) -> Array:
        """Polynomials of the basis, (intervals, 4, 4).

        In each interval four basis functions differ from zero. `pieces[i, k, j]` is the coefficient of t^k, t = 0..1
        within interval i, of basis function i + j.
        """
        knots, intervals = self._all_knots, len(self.knot_px) - 1
        at = np.arange(intervals) + 3  # of the knot at the beginning of each interval
        width = np.diff(self.knot_px)
        lower = np.zeros((intervals, 4, 4))
        lower[:, 0, 0] = 1.0
        # The recursion of Cox and de Boor; basis function at - degree + j of each degree stands in column j
        for degree in (1, 2, 3):
            higher = np.zeros_like(lower)
            for j in range(degree + 1):
                i = at - degree + j
                if j > 0:  # times (x - knots[i]) / (knots[i + degree] - knots[i]), x = knots[at] + width t
                    share = lower[:, :, j - 1] / (knots[i + degree] - knots[i])[:, None]
                    higher[:, :, j] += (knots[at] - knots[i])[:, None] * share
                    higher[:, 1:, j] += width[:, None] * share[:, :-1]
                if j < degree:  # times (knots[i + degree + 1] - x) / (knots[i + degree + 1] - knots[i + 1])
                    share = lower[:, :, j] / (knots[i + degree + 1] - knots[i + 1])[:, None]
                    higher[:, :, j] += (knots[i + degree + 1] - knots[at])[:, None] * share
                    higher[:, 1:, j] -= width[:, None] * share[:, :-1]
            lower = higher
        return lower

    def roughness(self, strength: float) -> Array:
        """Penalty matrix (size, size), `strength` times the sum of squared third differences. It bridges knots without
        samples.
        """
        differences = np.diff(np.eye(self.size), 3, axis=0)
        return np.asarray(strength * differences.T @ differences)

    def transfer_operator(self, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """Matrix (frequencies, size) from the coefficients to the Fourier transform of the derivative.

        Exact: between knots the derivative is a parabola in t = 0..1. Its transform is a sum of the moments of exp(-2
        pi i f width t).
        """
        turn = -2j * np.pi * np.asarray(frequency_cy_per_px, dtype=float)[:, None]
        width, which = np.unique(np.diff(self.knot_px), return_inverse=True)  # most intervals are of one width
        moments = _exponential_moments(turn * width)[:, :, which] * np.exp(turn * self.knot_px[:-1])
        out = np.zeros((len(turn), self.size), dtype=complex)
        derivatives = self.pieces[:, 1:] * np.array([1.0, 2.0, 3.0])[:, None]
        for basis in range(4):
            out[:, basis : basis + len(derivatives)] += np.einsum("kfi,ik->fi", moments, derivatives[:, :, basis])
        return out


def _exponential_moments(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Integrals of t^k exp(z t) over t = 0..1 for k = 0, 1, 2: (3, ...).

    By a power series where |z| < 1, else by integration by parts.
    """
    out = np.empty((3, *z.shape), dtype=complex)
    far = np.abs(z) >= 1.0
    end = np.exp(z[far])
    out[0, far] = (end - 1.0) / z[far]
    out[1, far] = (end - out[0, far]) / z[far]
    out[2, far] = (end - 2.0 * out[1, far]) / z[far]
    small = z[~far]
    for k in range(3):
        term, total = np.ones_like(small), np.full_like(small, 1.0 / (k + 1))
        for n in range(1, 16):
            term = term * small / n
            total += term / (n + k + 1)
        out[k, ~far] = total
    return out


@dataclass(frozen=True)
class SortedSamples:
    """Samples sorted by the spline interval that they lie in, so that a Gram matrix is one small product per interval.

    `order` (n,) sorts the samples; `starts` (intervals + 1,) are the first sorted sample of each interval and n;
    `powers` (4, n) holds 1, t, t^2, t^3 of the place t = 0..1 within the interval.
    """

    spline: Spline
    order: NDArray[np.int64]
    starts: NDArray[np.int64]
    powers: Array

    @staticmethod
    def of(spline: Spline, distance_px: Array) -> SortedSamples:
        """Sort samples at `distance_px` (n,) by the intervals of `spline`."""
        knots = spline.knot_px
        inside = np.clip(distance_px, knots[0], knots[-1])
        interval = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        order = np.argsort(interval.astype(np.int16), kind="stable")
        counts = np.bincount(interval, minlength=len(knots) - 1)
        starts = np.concatenate([[0], np.cumsum(counts)])
        t = (inside[order] - np.repeat(knots[:-1], counts)) / np.repeat(np.diff(knots), counts)
        powers = np.empty((4, len(t)))
        powers[0] = 1.0
        for k in (1, 2, 3):
            np.multiply(powers[k - 1], t, out=powers[k])
        return SortedSamples(spline, order, starts, powers)

    def _local(self, coefficients: Array) -> Array:
        """Polynomial coefficients (4, intervals) of a spline in each interval, lowest power first."""
        windows = np.lib.stride_tricks.sliding_window_view(coefficients, 4)
        return np.einsum("ikl,il->ki", self.spline.pieces, windows)

    def values(self, coefficients: Array) -> Array:
        """Values (n,) of a spline at the samples, in sorted order."""
        counts, t = np.diff(self.starts), self.powers[1]
        value, *rest = (np.repeat(c, counts) for c in self._local(coefficients)[::-1])
        for c in rest:
            value *= t
            value += c
        return value

    def derivatives(self, coefficients: Array) -> Array:
        """First derivatives (n,) at the samples, per px, in sorted order."""
        counts = np.diff(self.starts)
        _, b, c, d = self._local(coefficients) / np.diff(self.spline.knot_px)
        value, t = np.repeat(3.0 * d, counts), self.powers[1]
        for lower in (2.0 * c, b):
            value *= t
            value += np.repeat(lower, counts)
        return value

    def gram(self, columns: Array, weight: Array | None = None) -> Array:
        """Gram matrix A^T W A, (size + g, size + g): A holds the basis functions, then `columns` (g, n), at the sorted
        samples.

        `weight` (n,) is the diagonal of W, the identity where it is None.
        """
        size, extra = self.spline.size, len(columns)
        parts = np.empty((len(self.starts) - 1, 4, 4 + extra))
        # An interval at a time: its samples fit into the processor's cache
        for part, start, stop in zip(parts, self.starts[:-1].tolist(), self.starts[1:].tolist(), strict=True):
            powers = self.powers[:, start:stop]
            weighted = powers if weight is None else powers * weight[start:stop]
            part[:, :4], part[:, 4:] = weighted @ powers.T, weighted @ columns[:, start:stop].T
        pieces = self.spline.pieces
        core = pieces.transpose(0, 2, 1) @ parts[:, :, :4] @ pieces
        cross = pieces.transpose(0, 2, 1) @ parts[:, :, 4:]
        out = np.zeros((size + extra,) * 2)
        bands = out.reshape(-1)
        for k in range(4):
            out[k : k + len(parts), size:] += cross[:, k]
            for other in range(4):  # the diagonal that begins at (k, other)
                bands[k * len(out) + other :: len(out) + 1][: len(parts)] += core[:, k, other]
        out[size:, :size] = out[:size, size:].T
        out[size:, size:] = (columns if weight is None else columns * weight) @ columns.T
        return out
