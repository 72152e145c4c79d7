"""Laplace's approximation of an evidence, with bounds and heavy-tailed priors.

About the mode u of a set, with residual r (n,) and Jacobian J (n, p) in whitened coordinates, A = J'J and b = J'r:

    log integral exp(b'd - 1/2 d'A d) p(u + d) dd    over the bounds of u + d

The normal part is integrated in closed form and cut to the bounds (several by Genz' separation of variables); the tails
of each size's prior by quadrature along its coordinate; one amplitude near its bound by quadrature of the prediction
itself over its profile (`correct_along`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import lsq_linear
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri
from scipy.stats import qmc

from lab.inference.hypotheses import Coordinate
from sim.spectrum import FloatArray

#: A bound further than this from the mean, in standard deviations, cuts nothing.
FAR = 6.0
#: A coordinate at its bound is integrated by itself, the others where they are, where the slope is this many times the
#: root of the curvature, and the mode within this many decay lengths of the bound.
STEEP, AT_BOUND = 6.0, 0.5
#: Precision of a coordinate that nothing determines, in squared ranges: its integral over the range is exact to 1e-4.
_FLAT = 1e-4
#: Points of Gauss-Legendre quadrature along one coordinate; of predictions along one.
_ALONG, PREDICTED = 48, 9
#: They are closer to where a prior may be narrow, as sinh(4 t): by a factor of 27.
_SINH = 4.0
#: Points of the separation of variables.
_LATTICE = 9  # 2^9


@dataclass(frozen=True)
class Laplace:
    """`log_integral`; and the normal distribution that was cut: mean d and covariance about the mode."""

    log_integral: float
    mean: FloatArray
    covariance: FloatArray


def integrate(
    a: FloatArray, b: FloatArray, coords: Sequence[Coordinate], u: FloatArray, skip: frozenset[int] = frozenset()
) -> Laplace:
    """Integrate about u. `skip`: coordinates whose tails aren't corrected."""
    p = len(u)
    if p == 0:
        return Laplace(0.0, np.zeros(0), np.zeros((0, 0)))
    low, high = bounds(coords)
    slope, precision = np.array([c.slope_and_precision(float(x)) for c, x in zip(coords, u, strict=True)]).T
    pull = b + slope
    steep = np.sqrt(np.maximum(np.diag(a) + precision, 1e-300)) * STEEP
    pinned = ((pull < -steep) & (u - low < AT_BOUND / np.maximum(-pull, 1e-300))) | (
        (pull > steep) & (high - u < AT_BOUND / np.maximum(pull, 1e-300))
    )
    free = np.flatnonzero(~pinned)
    log_prior = sum(float(c.log_prior(float(x))) for c, x in zip(coords, u, strict=True))
    total = log_prior
    for k in np.flatnonzero(pinned):
        total += _at_bound(float(a[k, k]), float(b[k]), float(pull[k]), coords[int(k)], float(u[k]))
    mean, covariance = np.zeros(p), np.diag(np.where(pinned, np.square(1.0 / np.where(pull == 0, 1.0, pull)), 0.0))
    if len(free):
        within, mean[free], covariance[np.ix_(free, free)] = _normal(
            a[np.ix_(free, free)], pull[free], slope[free], precision[free], [coords[int(k)] for k in free], u[free],
            np.array([k in skip for k in free]),
        )  # fmt: skip
        total += within
    return Laplace(total, mean, covariance)


def _normal(
    a: FloatArray, pull: FloatArray, slope: FloatArray, precision: FloatArray, coords: Sequence[Coordinate],
    u: FloatArray, skip: FloatArray,
) -> tuple[float, FloatArray, FloatArray]:  # fmt: skip
    """Log of the integral over the bounds, without the prior's density at u; mean and covariance."""
    low, high = bounds(coords)
    p = len(u)
    ranges = zip(coords, low, high, strict=True)
    width = np.array([h - lo if np.isfinite(h - lo) else c.unit for c, lo, h in ranges])
    hessian = a + np.diag(precision)
    hessian[np.diag_indices(p)] = np.maximum(np.diag(hessian), _FLAT / width**2)
    size = np.sqrt(np.diag(hessian))
    inner = hessian / np.outer(size, size)
    inner[np.diag_indices(p)] += 1e-10
    inverse = np.linalg.inv(inner) / np.outer(size, size)
    mean = inverse @ pull
    log_det = float(np.linalg.slogdet(inner)[1]) + 2.0 * float(np.log(size).sum())
    total = 0.5 * float(pull @ mean) + 0.5 * p * np.log(2.0 * np.pi) - 0.5 * log_det
    total += log_box(mean, inverse, low - u, high - u)
    for k, c in enumerate(coords):
        if c.is_shape or skip[k]:
            continue
        std = float(np.sqrt(inverse[k, k]))
        d, weight = _along(float(mean[k]), std, low[k] - u[k], high[k] - u[k], split=c.centre - u[k])
        total += float(logsumexp(np.minimum(_prior_ratio(c, float(u[k]), d), 50.0), b=weight))
    return total, mean, inverse


def _at_bound(a: float, b: float, pull: float, c: Coordinate, u: float) -> float:
    """Log of the integral of exp(b d - a d^2 / 2) p(u + d) / p(u) away from a bound, by quadrature over 40 decay
    lengths 1 / |pull|, closer at the bound."""
    start = (c.lower if pull < 0.0 else c.upper) - u
    d, weight = _closer_at(start, start - np.sign(pull) * min(40.0 / abs(pull), c.upper - c.lower))
    exponent = b * d - 0.5 * a * d * d + c.log_prior(u + d) - c.log_prior(u)
    return float(logsumexp(exponent, b=weight))


def correct_along(
    found: Laplace,
    k: int,
    coords: Sequence[Coordinate],
    u: FloatArray,
    approximate: Callable[[FloatArray], float],
    exact: Callable[[FloatArray], float],
) -> float:
    """Return the correction of a log integral by the exact log posterior along coordinate k: the mean, over the cut
    normal distribution of that coordinate, of exact over approximate posterior, the others at their conditional mean
    within their bounds. `exact` and `approximate`: log likelihood at d (p,). Their ratio is smooth, and interpolated
    between few predictions; the prior may be narrow."""
    low, high = bounds(coords)
    std = float(np.sqrt(found.covariance[k, k]))
    ends = float(found.mean[k]), std, float(low[k] - u[k]), float(high[k] - u[k])
    at, _ = _along(*ends, PREDICTED)
    ratio = []
    for one in at:
        vector = found.mean + found.covariance[:, k] * (one - found.mean[k]) / std**2
        vector[k] = one
        ratio.append(exact(np.clip(vector, low - u, high - u)) - approximate(vector))
    d, weight = _along(*ends, split=coords[k].centre - float(u[k]))
    between = PchipInterpolator(at, ratio)(np.clip(d, at[0], at[-1]))
    return float(logsumexp(between + np.minimum(_prior_ratio(coords[k], float(u[k]), d), 50.0), b=weight))


def _prior_ratio(c: Coordinate, u: float, d: FloatArray) -> FloatArray:
    """Log of the prior at u + d over that of the expansion about u."""
    slope, precision = c.slope_and_precision(u)
    return np.asarray(c.log_prior(u + d) - c.log_prior(u) - slope * d + 0.5 * precision * d * d)


def best_within_bounds(
    a: FloatArray, b: FloatArray, coords: Sequence[Coordinate], u: FloatArray
) -> tuple[FloatArray, float]:
    """Return the step d (p,) within the bounds of u + d at which b'd - d'a d / 2 and the prior, normal about u, gain
    most, and that gain."""
    slope, precision = np.array([c.slope_and_precision(float(x)) for c, x in zip(coords, u, strict=True)]).T
    low, high = bounds(coords)
    size = np.sqrt(np.maximum(np.diag(a) + precision, 1e-300))
    inner = (a + np.diag(precision)) / np.outer(size, size) + 1e-10 * np.eye(len(u))
    root = np.linalg.cholesky(inner)
    target = np.linalg.solve(root, (b + slope) / size)
    least, most = np.minimum((low - u) * size, -1e-12), np.maximum((high - u) * size, 1e-12)
    x = lsq_linear(root.T, target, (least, most), method="bvls").x
    return np.asarray(x / size), float(target @ target - np.sum(np.square(root.T @ x - target))) / 2.0


def near_bound(found: Laplace, coords: Sequence[Coordinate], u: FloatArray, sigma: float) -> list[int]:
    """Sizes whose bound lies within `sigma` standard deviations of their mean."""
    low, high = bounds(coords)
    std = np.sqrt(np.diag(found.covariance))
    at = u + found.mean
    return [k for k, c in enumerate(coords) if not c.is_shape and min(at[k] - low[k], high[k] - at[k]) < sigma * std[k]]


def bounds(coords: Sequence[Coordinate]) -> tuple[FloatArray, FloatArray]:
    """Lower and upper bounds (p,)."""
    return np.array([c.lower for c in coords]), np.array([c.upper for c in coords])


def _along(
    mean: float, std: float, low: float, high: float, points: int = _ALONG, split: float = np.inf
) -> tuple[FloatArray, FloatArray]:
    """Points and weights of the mean over N(mean, std) cut to [low, high]. `split`: where points are closer."""
    if mean < low:  # its tail beyond the bound falls as exp(-(d - low) / scale)
        scale = std / max(1.0, (low - mean) / std)
        begin, end = low, min(high, low + 2.0 * FAR * scale)
    elif mean > high:
        scale = std / max(1.0, (mean - high) / std)
        begin, end = max(low, high - 2.0 * FAR * scale), high
    else:
        begin, end = max(low, mean - FAR * std), min(high, mean + FAR * std)
    x, w = _legendre(points)
    d, width = 0.5 * (begin + end) + 0.5 * (end - begin) * x, w
    if begin <= split <= end:
        parts = [_closer_at(split, other) for other in (begin, end) if other != split]
        d, width = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
    density = -0.5 * np.square((d - mean) / std)
    weight = width * np.exp(density - density.max())
    return d, weight / weight.sum()


def _closer_at(start: float, end: float) -> tuple[FloatArray, FloatArray]:
    """Points and weights of an integral between `start` and `end`, closer at `start`."""
    x, w = _legendre(_ALONG)
    t = _SINH * 0.5 * (x + 1.0)
    scale = (end - start) / np.sinh(_SINH)
    return start + scale * np.sinh(t), 0.5 * abs(scale) * _SINH * w * np.cosh(t)


def log_box(mean: FloatArray, covariance: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Log probability that N(mean, covariance) lies between `low` and `high`."""
    std = np.sqrt(np.diag(covariance))
    cut = [k for k in range(len(mean)) if min(mean[k] - low[k], high[k] - mean[k]) < FAR * std[k]]
    if not cut:
        return 0.0
    below, above = (low[cut] - mean[cut]) / std[cut], (high[cut] - mean[cut]) / std[cut]
    if len(cut) == 1:
        return float(_log_between(below, above)[0])
    inner = covariance[np.ix_(cut, cut)] / np.outer(std[cut], std[cut])
    order = np.argsort(_log_between(below, above))  # the narrowest first
    below, above = below[order], above[order]
    inner = inner[np.ix_(order, order)]
    inner[np.diag_indices_from(inner)] += 1e-9
    lower = np.linalg.cholesky(inner)
    points = _sobol(len(cut))
    x = np.zeros_like(points)
    log_p = np.zeros(len(points))
    for k in range(len(cut)):
        shift = x[:, :k] @ lower[k, :k]
        lo, hi = (below[k] - shift) / lower[k, k], (above[k] - shift) / lower[k, k]
        log_p += _log_between(lo, hi)
        x[:, k] = _between(lo, hi, points[:, k])
    top = log_p.max()
    return float(top + np.log(np.mean(np.exp(log_p - top))))


@cache
def _legendre(points: int) -> tuple[FloatArray, FloatArray]:
    x, w = np.polynomial.legendre.leggauss(points)
    return np.asarray(x), np.asarray(w)


@cache
def _sobol(dimensions: int) -> FloatArray:
    points = qmc.Sobol(dimensions, scramble=True, rng=0).random_base2(_LATTICE)
    return np.asarray(np.clip(points, 1e-9, 1.0 - 1e-9))


def _log_between(low: FloatArray, high: FloatArray) -> FloatArray:
    """Log of Phi(high) - Phi(low), from the tail in which both lie."""
    turned = low > 0.0
    lo, hi = np.where(turned, -high, low), np.where(turned, -low, high)
    upper, less = log_ndtr(hi), log_ndtr(lo)
    with np.errstate(divide="ignore"):
        return np.asarray(upper + np.log1p(-np.exp(np.minimum(less - upper, -1e-15))))


def _between(low: FloatArray, high: FloatArray, share: FloatArray) -> FloatArray:
    """Quantile `share` of the standard normal distribution cut to [low, high]."""
    turned = low > 0.0
    lo, hi = np.where(turned, -high, low), np.where(turned, -low, high)
    x = np.asarray(ndtri(np.maximum(ndtr(lo) + np.where(turned, 1.0 - share, share) * (ndtr(hi) - ndtr(lo)), 1e-300)))
    return np.clip(np.where(turned, -x, x), low, np.maximum(high, low))
