"""The prior of a curve by its second difference, and the most probable curve under it, within lower bounds.

The second difference of the curve has a normal prior (Tikhonov regularisation), with straight lines free and integrated
out. It is wider where the curve has curvature and is high: its local scale is the geometric mean of curvature and
height of a first solution, smoothed, plus a floor. Strength and floor maximise the marginal likelihood
(`likeliest_prior`). Lower bounds are S >= 0, and limits from saturated signals (`within_bounds`).

Priors are roots R of covariances R R^T on the wavelengths (m,).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize

from sim.spectrum import FloatArray

LOCAL_WIDTH_NM = 10.0  # over which the local roughness is averaged
FINE_LENGTH_NM = 5.0  # correlation length of the fine structure


def averaging_matrix(wave: FloatArray) -> FloatArray:
    """Return the matrix (m, m) of Gaussian averages over `LOCAL_WIDTH_NM`.

    wave : wavelengths (m,), nm

    >>> wave = np.arange(400.0, 701.0, 10.0)
    >>> bool(np.allclose(averaging_matrix(wave) @ np.ones(wave.size), 1.0))
    True
    """
    distance = (wave[:, None] - wave) / LOCAL_WIDTH_NM
    average = np.exp(-0.5 * distance**2)
    average /= average.sum(axis=1, keepdims=True)
    return np.asarray(average)


def local_roughness(wave: FloatArray, curve: FloatArray, average: FloatArray) -> FloatArray | None:
    """Return the roughness (m,) of a curve, maximum 1: the geometric mean of its curvature and its height.

    wave, curve : wavelengths, nm, and values, (m,)
    average : matrix (m, m) by which curvature and height are averaged, as of `averaging_matrix`

    Returns None for a straight line.

    >>> wave = np.arange(400.0, 701.0, 10.0)
    >>> peak = np.exp(-0.5 * ((wave - 550.0) / 30.0) ** 2)
    >>> float(wave[np.argmax(local_roughness(wave, peak, averaging_matrix(wave)))])
    550.0
    """
    if wave.size < 5:
        return None
    curvature = np.sqrt(average @ np.gradient(np.gradient(curve, wave), wave) ** 2)
    height = np.sqrt(average @ np.clip(curve, 0.0, None) ** 2)
    local = np.sqrt(curvature * height)
    return local / local.max() if local.max() > 0 else None


def smooth_root(wave: FloatArray, roughness: FloatArray) -> FloatArray:
    """Return the root (m, m) of the covariance of curves whose second difference is white, up to straight lines.

    wave, roughness : wavelengths, nm, and standard deviations of the second difference, (m,)

    >>> root = smooth_root(np.arange(400.0, 450.0, 10.0), np.ones(5))
    >>> root.shape, float(root[0].max())
    ((5, 5), 0.0)
    """
    return np.clip(wave[:, None] - wave, 0.0, None) * (np.sqrt(np.gradient(wave)) * roughness)


def rough_root(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Return the root (m, m) of `smooth_root` with fine structure added (`fine_covariance`).

    wave, roughness : wavelengths, nm, and standard deviations of the second difference, (m,)
    fine_share : see `fine_covariance`; 0: none

    >>> wave = np.arange(400.0, 450.0, 10.0)
    >>> bool(np.allclose(rough_root(wave, np.ones(5), 0.0), smooth_root(wave, np.ones(5))))
    True
    """
    smooth = smooth_root(wave, roughness)
    if fine_share == 0.0:
        return smooth
    return np.asarray(np.linalg.cholesky(smooth @ smooth.T + fine_covariance(wave, roughness, fine_share)))


def fine_covariance(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Return the covariance (m, m) of fine structure: exponential correlation over 5 nm.

    wave, roughness : wavelengths, nm, and standard deviations of the curve's second difference, (m,)
    fine_share : its standard deviation over that of the curvature, accumulated over 10 nm

    The lights hardly determine it; the uncertainty has to include it.

    >>> covariance = fine_covariance(np.array([400.0, 405.0]), np.ones(2), 0.1)
    >>> round(float(covariance[0, 1] / covariance[0, 0]), 4)
    0.3679
    """
    height = fine_share * LOCAL_WIDTH_NM**1.5 * roughness
    return np.asarray(np.outer(height, height) * np.exp(-np.abs(wave[:, None] - wave) / FINE_LENGTH_NM))


def signal_covariance(wave: FloatArray, operator: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """Return the covariance (n, n) of the signals `operator` S of curves S with the prior of `rough_root`, up to
    straight lines.

    wave, roughness : wavelengths, nm, and standard deviations of the second difference, (m,)
    operator : (n, m)
    fine_share : see `fine_covariance`

    >>> wave, operator = np.arange(400.0, 450.0, 10.0), np.ones((2, 5))
    >>> covariance = signal_covariance(wave, operator, np.ones(5), 0.0)
    >>> bool(np.isclose(covariance[0, 0], covariance[0, 1]))  # one light twice
    True
    """
    smooth = operator @ smooth_root(wave, roughness)
    covariance = smooth @ smooth.T
    if fine_share > 0.0:
        covariance = covariance + operator @ fine_covariance(wave, roughness, fine_share) @ operator.T
    return np.asarray(covariance)


def straight_lines(wave: FloatArray) -> FloatArray:
    """Return the constant and the slope, (m, 2): the curves without a second difference.

    wave : wavelengths (m,), nm

    >>> straight_lines(np.array([400.0, 500.0, 600.0])).tolist()
    [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    return np.stack([np.ones_like(wave), 2.0 * (wave - wave.mean()) / np.ptp(wave)], axis=1)


@dataclass(frozen=True, eq=False)
class CurvePrior:
    """The prior of a curve: roughness `shape` (m,) times `strength`, and `fine_share` of fine structure
    (`fine_covariance`).
    """

    shape: FloatArray
    strength: float
    fine_share: float


@dataclass(frozen=True, eq=False)
class CurvePosterior:
    """Posterior `mean` (m,) and `covariance` (m, m) of a curve.

    `gain` (m, n): Jacobian of the mean by the signals; `precision` (n, n): inverse covariance of the signals under the
    prior, whose curves aren't known.
    """

    mean: FloatArray
    covariance: FloatArray
    gain: FloatArray
    precision: FloatArray


def likeliest_prior(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    shapes: Sequence[FloatArray],
    fine_share: float = 0.0,
) -> CurvePrior:
    """Choose, of several prior roughnesses, the one with the largest marginal likelihood at its best strength.

    wave : wavelengths (m,), nm
    operator : (n, m); value = operator S + noise, straight lines free
    value, std : signals and their standard deviations, (n,)
    shapes : the roughnesses, (m,) each
    fine_share : see `fine_covariance`

    >>> wave = np.arange(400.0, 701.0, 10.0)
    >>> low, high = np.where(wave < 550.0, 1.0, 0.01), np.where(wave < 550.0, 0.01, 1.0)
    >>> value = np.exp(-0.5 * ((wave - 450.0) / 20.0) ** 2)
    >>> prior = likeliest_prior(wave, np.eye(31), value, np.full(31, 1e-3), [low, high])
    >>> bool(np.array_equal(prior.shape, low))
    True
    """
    line = operator @ straight_lines(wave)
    misfits = [least_misfit(signal_covariance(wave, operator, s, fine_share), line, value, std) for s in shapes]
    best = min(range(len(shapes)), key=lambda i: misfits[i][0])
    return CurvePrior(shapes[best], misfits[best][1], fine_share)


def posterior_under_prior(
    wave: FloatArray, operator: FloatArray, value: FloatArray, std: FloatArray, prior: CurvePrior
) -> CurvePosterior:
    """Return the posterior of S with value = operator S + noise under a prior, straight lines free.

    wave : wavelengths (m,), nm
    operator : (n, m)
    value, std : signals and their standard deviations, (n,)
    prior : roughness and strength of the curve

    >>> wave = np.arange(400.0, 701.0, 10.0)
    >>> value = 0.5 + 0.001 * (wave - 550.0)  # a straight line
    >>> prior = CurvePrior(np.ones(31), 1e-6, 0.0)
    >>> posterior = posterior_under_prior(wave, np.eye(31), value, np.full(31, 1e-3), prior)
    >>> bool(np.allclose(posterior.mean, value, atol=1e-6))
    True
    """
    line = straight_lines(wave)
    rough = rough_root(wave, prior.shape, prior.fine_share)
    rough = rough - line @ np.linalg.lstsq(line, rough, rcond=None)[0]  # straight lines are free
    # Straight lines have a normal prior a thousand times as wide as the curve is high. Singular values keep well and
    # poorly determined directions apart; differences of covariances lose digits where noise is small.
    height = float(np.max(np.abs(value / operator.sum(axis=1))))
    root = np.concatenate([1e3 * height * line, prior.strength * rough], axis=1)
    left, singular, right = np.linalg.svd(operator @ root / std[:, None], full_matrices=True)
    known = np.append(1.0 / np.sqrt(1.0 + singular**2), np.ones(right.shape[0] - singular.size))
    half = root @ right.T * known
    share = singular / (1.0 + singular**2)
    gain = (root @ right[: singular.size].T * share) @ (left[:, : singular.size] / std[:, None]).T
    unknown = left / std[:, None] / np.sqrt(1.0 + np.append(singular, np.zeros(left.shape[1] - singular.size)) ** 2)
    return CurvePosterior(gain @ value, half @ half.T, gain, unknown @ unknown.T)


def least_misfit(covariance: FloatArray, line: FloatArray, value: FloatArray, std: FloatArray) -> tuple[float, float]:
    """Minimise the negative log marginal likelihood of value = line a + strength u + noise over the strength.

    covariance : of u, (n, n)
    line : (n, 2); a (2,) is free and integrated out
    value, std : signals and their standard deviations, (n,)

    Returns the minimum and the strength.

    >>> rng = np.random.default_rng(1)
    >>> line = np.stack([np.ones(400), np.linspace(-1.0, 1.0, 400)], axis=1)
    >>> value = line @ [3.0, 1.0] + 2.0 * rng.standard_normal(400)
    >>> _, strength = least_misfit(np.eye(400), line, value, np.full(400, 1e-3))
    >>> bool(abs(strength - 2.0) < 3.0 * 2.0 / np.sqrt(2.0 * 400.0))  # of a standard deviation from 400 values
    True
    """
    z, h = value / std, line / std[:, None]
    rest = linalg.qr(h)[0][:, line.shape[1] :]
    eigenvalue, vector = np.linalg.eigh(rest.T @ (covariance / np.outer(std, std)) @ rest)
    eigenvalue = np.clip(eigenvalue, 0.0, None)
    power = (vector.T @ (rest.T @ z)) ** 2

    def loss(log_square: float) -> float:
        variance = np.exp(log_square) * eigenvalue + 1.0
        return 0.5 * float(np.sum(power / variance + np.log(variance)))

    start = -np.log(max(float(eigenvalue.max()), 1e-300))
    grid = start + np.linspace(-2.0, 40.0, 85)
    best = int(np.argmin([loss(g) for g in grid]))
    minimum = optimize.minimize_scalar(
        loss, bounds=(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]), method="bounded"
    )
    return float(minimum.fun), float(np.exp(0.5 * minimum.x))


@dataclass(frozen=True, eq=False)
class LowerBounds:
    """operator (k, m) S >= limit (k,): positivity, and what saturated signals say."""

    operator: FloatArray
    limit: FloatArray


def within_bounds(mean: FloatArray, covariance: FloatArray, bounds: LowerBounds) -> FloatArray:
    """Find the most probable curve (m,) within bounds, of a normal distribution: an active set on its dual, S = mean +
    V G^T multiplier.

    `mean` (m,), `covariance` (m, m) of the normal distribution.
    """
    cross = covariance @ bounds.operator.T
    inner = bounds.operator @ cross
    slack = bounds.operator @ mean - bounds.limit
    ridge = 1e-9 * float(np.mean(np.diag(inner))) + 1e-300
    active = np.zeros(slack.size, bool)
    multiplier = np.zeros(slack.size)
    for _ in range(50):
        now = slack + inner @ multiplier
        worst = np.where(active, np.inf, now)
        # New bounds in batches, as neighbours are violated together; the tolerance is relative to the curve
        entering = worst < -1e-6 * float(np.max(np.abs(mean)))
        if not entering.any():
            break
        active |= entering
        while active.any():
            index = np.flatnonzero(active)
            solved = np.linalg.solve(inner[np.ix_(index, index)] + ridge * np.eye(index.size), -slack[index])
            if np.all(solved >= 0):
                break
            active[index[solved < 0]] = False
        multiplier = np.zeros(slack.size)
        if active.any():
            multiplier[active] = solved
    return np.clip(mean + cross @ multiplier, 0.0, None)
