"""The edge-spread function as a cubic spline, and the prior of its derivative, the line-spread function.

The spline: values, Gram matrices over samples, and the Fourier transform of its derivative in closed form.

The prior decides what the samples leave open. The masses m of the line-spread function between the knots of the
spline have a Gaussian prior with covariance

    C = G G^T + strength^2 E K E + amplitude^2 T.

G: a Gaussian line spread with free height, place and width, a little skewness and excess kurtosis. E K E: a Gaussian
process; E is an envelope from the estimate itself, K a Matern correlation of distances in blur widths, longer far from
the edge. T: a tail amplitude / distance^2, as any aperture diffracts, nearly equal on both sides; it carries what is
seen of the tail to beyond the samples. Smoothness and length of K, `strength` and `amplitude` are hyperparameters on a
grid. The posterior is an average over them, weighted by the marginal likelihood: its mean lies between theirs, and its
covariance holds how far they differ. Levels and gradients have flat priors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse, special
from scipy.interpolate import BSpline

Array = NDArray[np.floating[Any]]

#: Into the grid of hyperparameters: smoothness, length, strength, amplitude of the tail.
PriorIndex = tuple[int, int, int, int]
KNOT_SPACING_PX = 0.25  # near the edge; a cubic spline of this spacing passes 1 cy/px with an error of 1e-4
PRIOR_LENGTHS = (0.5, 1.2, 3.0)  # blur widths
PRIOR_STRENGTHS = (0.12, 0.25, 0.5, 1.0, 2.0, 4.0)  # of the envelope
TAIL_AMPLITUDES_PX = (0.001, 0.1, 0.3)  # 4 / (pi^3 cutoff) for a diffracting lens
GAUSSIAN_SHAPE_STD = (1.0, 1.0, 1.0, 0.1, 0.1)  # height, place, width, skewness, excess kurtosis
WARP_WIDTHS = 2.0  # blur widths from the edge beyond which the correlation length grows with the distance
LEAST_PRIOR_WEIGHT = 0.01  # hyperparameters of less weight are dropped
LOG_LIKELIHOOD_RANGE = 4.0  # below the maximum, within which hyperparameters are searched
ENVELOPE_WIDTHS, ENVELOPE_FLOOR = 0.8, 1e-3  # blur widths of the smoothing; least value, of the maximum
TAIL_LENGTH, TAIL_SYMMETRY = 4.0, 0.98  # correlation length of the tail in ln(distance); correlation of both sides


@dataclass(frozen=True)
class Spline:
    """Cubic spline over ascending `knot_px`, constant beyond the first and the last knot.

    The value there is the first or the last coefficient: B-splines with fourfold end knots.
    """

    knot_px: Array

    @property
    def size(self) -> int:
        """Return the number of coefficients."""
        return len(self.knot_px) + 2

    @property
    def _all_knots(self) -> Array:
        """Return the knots with both ends fourfold."""
        return np.concatenate([[self.knot_px[0]] * 3, self.knot_px, [self.knot_px[-1]] * 3])

    def design(self, distance_px: Array) -> sparse.csr_array:
        """Return the matrix (n, size) from the coefficients to the values at `distance_px` (n,)."""
        inside = np.clip(distance_px, self.knot_px[0], self.knot_px[-1])
        return BSpline.design_matrix(inside, self._all_knots, 3)

    def values(self, coefficients: Array, distance_px: Array) -> Array:
        """Evaluate the spline at `distance_px` (n,): `design(distance_px) @ coefficients`, without the matrix."""
        inside = np.clip(distance_px, self.knot_px[0], self.knot_px[-1])
        return np.asarray(BSpline(self._all_knots, coefficients, 3)(inside))

    def derivative(self, coefficients: Array, distance_px: Array) -> Array:
        """Return the first derivative (n,), per px, at `distance_px`; 0 beyond the ends."""
        value = BSpline(self._all_knots, coefficients, 3)(distance_px, nu=1, extrapolate=True)
        outside = (distance_px < self.knot_px[0]) | (distance_px > self.knot_px[-1])
        return np.where(outside, 0.0, value)

    @cached_property
    def pieces(self) -> Array:
        """Return the polynomials of the basis, (intervals, 4, 4).

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
        """Return the penalty matrix (size, size), `strength` times the sum of squared third differences. It bridges
        knots without samples.
        """
        differences = np.diff(np.eye(self.size), 3, axis=0)
        return np.asarray(strength * differences.T @ differences)

    def transfer_operator(self, frequency_cy_per_px: Array) -> NDArray[np.complex128]:
        """Return the matrix (frequencies, size) from the coefficients to the Fourier transform of the derivative.

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
    """Integrate t^k exp(z t) over t = 0..1 for k = 0, 1, 2: (3, ...).

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
        """Return the polynomial coefficients (4, intervals) of a spline in each interval, lowest power first."""
        windows = np.lib.stride_tricks.sliding_window_view(coefficients, 4)
        return np.einsum("ikl,il->ki", self.spline.pieces, windows)

    def values(self, coefficients: Array) -> Array:
        """Return the values (n,) of a spline at the samples, in sorted order."""
        counts, t = np.diff(self.starts), self.powers[1]
        value, *rest = (np.repeat(c, counts) for c in self._local(coefficients)[::-1])
        for c in rest:
            value *= t
            value += c
        return value

    def derivatives(self, coefficients: Array) -> Array:
        """Return the first derivatives (n,) at the samples, per px, in sorted order."""
        counts = np.diff(self.starts)
        _, b, c, d = self._local(coefficients) / np.diff(self.spline.knot_px)
        value, t = np.repeat(3.0 * d, counts), self.powers[1]
        for lower in (2.0 * c, b):
            value *= t
            value += np.repeat(lower, counts)
        return value

    def gram(self, columns: Array, weight: Array | None = None) -> Array:
        """Return the Gram matrix A^T W A, (size + g, size + g): A holds the basis functions, then `columns` (g, n), at
        the sorted samples.

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


@dataclass(frozen=True)
class LineSpreadPriors:
    """Covariances of the masses (k,) of the line-spread function between knots.

    `envelope` (k,): E. `warped` (k,): distance from the edge in blur widths, compressed far from it. `gaussian`,
    `tails` (k, k): G G^T and T.
    """

    envelope: Array
    warped: Array
    gaussian: Array
    tails: Array

    @staticmethod
    def of(spline: Spline, coefficients: Array, width: float, reach: float) -> LineSpreadPriors:
        """Make the priors for a spline whose `coefficients` are the current estimate.

        `width`: blur width, px, the standard deviation of a Gaussian with the same 10 % to 90 % distance; `reach`: of
        the samples, px.
        """
        knots = np.concatenate([[spline.knot_px[0]] * 2, spline.knot_px, [spline.knot_px[-1]] * 2])
        place = (knots[:-2] + knots[1:-1] + knots[2:]) / 3.0
        at, pitch = 0.5 * (place[1:] + place[:-1]), np.diff(place)
        scale = max(width, KNOT_SPACING_PX)
        density = np.where(np.abs(at) < reach, np.diff(coefficients) / pitch, 0.0)
        share = pitch * np.exp(-0.5 * ((at[:, None] - at) / (ENVELOPE_WIDTHS * scale)) ** 2)
        local = np.abs(share @ density) / share.sum(axis=1)
        decay = 1.0 / (1.0 + (at / (4.0 * scale)) ** 2)
        envelope = pitch * np.maximum(local * (np.abs(at) < 0.5 * reach), ENVELOPE_FLOOR * local.max() * decay)

        x = place / scale
        bell = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
        shapes = np.stack([special.ndtr(x), bell, x * bell, (x * x - 1.0) * bell, (x**3 - 3.0 * x) * bell])
        columns = np.diff(np.linalg.solve(spline.design(place).toarray(), shapes.T), axis=0) * np.array(
            GAUSSIAN_SHAPE_STD
        )

        side = np.where(np.sign(at)[:, None] == np.sign(at), 1.0, TAIL_SYMMETRY)
        order = np.log(np.maximum(np.abs(at), 1.0))
        far = pitch * at**2 / (at**2 + (3.0 * scale) ** 2) / np.maximum(at**2, 1e-6)
        return LineSpreadPriors(
            envelope=envelope,
            warped=WARP_WIDTHS * np.arcsinh(at / (WARP_WIDTHS * scale)),
            gaussian=columns @ columns.T,
            tails=np.outer(far, far) * side * _matern_3_2(np.abs(order[:, None] - order) / TAIL_LENGTH),
        )

    def near(self, smoothness: int, length: int) -> Array:
        """Return E K E of unit strength, by the indices of smoothness and length."""
        apart = np.abs(self.warped[:, None] - self.warped) / PRIOR_LENGTHS[length]
        return np.outer(self.envelope, self.envelope) * CORRELATIONS[smoothness](apart)

    def at(self, point: PriorIndex) -> Array:
        """Return the whole covariance C at a point of the grid of hyperparameters."""
        smoothness, length, strength, amplitude = point
        near = PRIOR_STRENGTHS[strength] ** 2 * self.near(smoothness, length)
        return near + TAIL_AMPLITUDES_PX[amplitude] ** 2 * self.tails + self.gaussian


def _matern_3_2(apart: Array) -> Array:
    """Return the Matern correlation of order 3/2 at distances in units of its length: once differentiable."""
    return np.asarray((1.0 + np.sqrt(3.0) * apart) * np.exp(-np.sqrt(3.0) * apart))


def _matern_5_2(apart: Array) -> Array:
    """Return the Matern correlation of order 5/2: twice differentiable."""
    return np.asarray((1.0 + np.sqrt(5.0) * apart + 5.0 / 3.0 * apart * apart) * np.exp(-np.sqrt(5.0) * apart))


CORRELATIONS = (_matern_3_2, _matern_5_2)


PRIOR_GRID = (len(CORRELATIONS), len(PRIOR_LENGTHS), len(PRIOR_STRENGTHS), len(TAIL_AMPLITUDES_PX))


def posterior(
    priors: LineSpreadPriors, matrix: Array, right: Array, start: PriorIndex, log_likelihood_range: float
) -> tuple[Array, Array, PriorIndex]:
    """Solve the edge profile under the priors of its line-spread function.

    `matrix` (k + g, k + g) and `right` (k + g,): normal equations of the spline coefficients and the gradients.
    `start`: where the search for hyperparameters begins; `log_likelihood_range`: see `_prior_weights`. Returns the
    inverse of the normal matrix with its prior, the covariance of the solution about the truth (both (k + g, k + g)),
    and the best hyperparameters.
    """
    masses = len(priors.envelope)
    size = masses + 1
    flat = 1 + len(matrix) - size
    # New unknowns: the dark level, the gradients, the masses
    to_coefficients = np.zeros((len(matrix), len(matrix)))
    to_coefficients[:size, 0] = 1.0
    to_coefficients[size:, 1:flat] = np.eye(flat - 1)
    to_coefficients[:size, flat:] = np.tril(np.ones((size, masses)), -1)
    normal, normal_right = to_coefficients.T @ matrix @ to_coefficients, to_coefficients.T @ right
    free_covariance = np.linalg.inv(normal[:flat, :flat])
    elimination = free_covariance @ normal[:flat, flat:]
    power, waves = np.linalg.eigh(normal[flat:, flat:] - normal[flat:, :flat] @ elimination)
    seen = power > 1e-14 * power[-1]
    reduced_right = normal_right[flat:] - elimination.T @ normal_right[:flat]
    # The whitened problem: data = design @ masses + noise of unit variance
    design = np.sqrt(power[seen])[:, None] * waves[:, seen].T
    data = waves[:, seen].T @ reduced_right / np.sqrt(power[seen])

    weights, best = _prior_weights(priors, design, data, start, log_likelihood_range)
    information = design.T @ design
    mixture = np.zeros((masses, masses))
    means = []
    for at, weight in weights.items():
        root = _covariance_root(priors.at(at))
        inner = root.T @ information @ root
        inner.flat[:: masses + 1] += 1.0
        factor, _ = linalg.lapack.dpotrf(inner, lower=1)
        half, _ = linalg.lapack.dtrtrs(factor, root.T, lower=1)
        covariance = half.T @ half
        mixture += weight * covariance
        means.append(covariance @ reduced_right)
    shares = np.array(list(weights.values()))
    apart = (np.array(means) - shares @ np.array(means)) * np.sqrt(shares)[:, None]
    from_masses = to_coefficients @ np.concatenate([-elimination, np.eye(masses)])
    inverse = (
        from_masses @ mixture @ from_masses.T
        + to_coefficients[:, :flat] @ free_covariance @ to_coefficients[:, :flat].T
    )
    apart = apart @ from_masses.T
    return inverse, inverse + apart.T @ apart, best


def _prior_weights(
    priors: LineSpreadPriors, design: Array, data: Array, start: PriorIndex, log_likelihood_range: float
) -> tuple[dict[PriorIndex, float], PriorIndex]:
    """Weigh the hyperparameters by marginal likelihood, sum 1, and find the best ones; data = design @ masses + noise
    of unit variance.

    Coordinate ascent on the grid from `start`, then all connected points whose log marginal likelihood is within
    `log_likelihood_range` of the maximum.
    """
    fixed, far = (design @ part @ design.T for part in (priors.gaussian, priors.tails))
    near: dict[tuple[int, int], Array] = {}
    tried: dict[PriorIndex, float] = {}

    def log_likelihood(at: PriorIndex) -> float:
        """Return the log marginal likelihood, up to a constant; minus infinity beside the grid."""
        if at in tried:
            return tried[at]
        if not all(0 <= i < count for i, count in zip(at, PRIOR_GRID, strict=True)):
            tried[at] = -np.inf
        else:
            smoothness, length, strength, amplitude = at
            if (smoothness, length) not in near:
                near[smoothness, length] = design @ priors.near(smoothness, length) @ design.T
            covariance = (
                PRIOR_STRENGTHS[strength] ** 2 * near[smoothness, length]
                + TAIL_AMPLITUDES_PX[amplitude] ** 2 * far
                + fixed
            )
            covariance.flat[:: len(covariance) + 1] += 1.0
            factor, _ = linalg.lapack.dpotrf(
                covariance.T, lower=1, overwrite_a=1
            )  # symmetric: its transpose isn't copied
            white, _ = linalg.lapack.dtrtrs(factor, data, lower=1)
            tried[at] = float(-0.5 * white @ white - np.log(np.diag(factor)).sum())
        return tried[at]

    best = start
    while True:
        higher = max(_neighbours(best), key=log_likelihood)
        if log_likelihood(higher) <= log_likelihood(best):
            break
        best = higher
    candidates, waiting = {best}, [best]
    while waiting:
        for at in _neighbours(waiting.pop()):
            if at not in candidates and log_likelihood(at) > log_likelihood(best) - log_likelihood_range:
                candidates.add(at)
                waiting.append(at)
    top = max(log_likelihood(at) for at in candidates)
    weights = {at: float(np.exp(log_likelihood(at) - top)) for at in candidates}
    least = LEAST_PRIOR_WEIGHT * sum(weights.values())
    total = sum(weight for weight in weights.values() if weight > least)
    return {at: weight / total for at, weight in weights.items() if weight > least}, best


def _neighbours(at: PriorIndex) -> list[PriorIndex]:
    """Return the eight neighbours on the grid of hyperparameters."""
    a, b, c, d = at
    return [
        (a + 1, b, c, d), (a, b + 1, c, d), (a, b, c + 1, d), (a, b, c, d + 1),
        (a - 1, b, c, d), (a, b - 1, c, d), (a, b, c - 1, d), (a, b, c, d - 1),
    ]  # fmt: skip


def _covariance_root(covariance: Array) -> Array:
    """Return a root R of a covariance R R^T."""
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    correlation.flat[:: len(correlation) + 1] += 1e-12
    factor, _ = linalg.lapack.dpotrf(correlation, lower=1, clean=1)
    return np.asarray(scale[:, None] * factor)
