"""Shot noise: Poisson variables, exact at every mean, for arrays of means. A module of its own, as numba is slow to
import."""

# mypy: disallow-untyped-decorators=False

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import special

from sim.spectrum import FloatArray

Float32Array = NDArray[np.float32]

#: From this mean on the normal variable with its correction, below it tables.
FROM_NORMAL = 10.0

#: Entries of the distribution function's table at each whole mean (beyond 63 electrons lie 1e-30 of a mean of 9), and
#: of its guide.
_COUNTS, _GUIDE = 64, 256


def draw_poisson(mean: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Poisson variables (float32, shape of `mean`) of means >= 0.

    From a mean of 10: Ahrens and Dieter's algorithm PD (ACM Trans. Math. Softw. 8, 163, 1982), which takes the whole
    part of a normal variable and corrects the few that need it: exact to rounding, 19 ns each (numpy's own, 30 to 55).
    Below: the sum of a variable of the mean's whole part, from a table of its distribution function, and one of the
    remainder.
    """
    flat = np.array(mean, np.float32).ravel()
    drawn = np.empty_like(flat)
    _fill(flat, drawn, rng, *_tables())
    return drawn.reshape(np.shape(mean))


@cache
def _tables() -> tuple[FloatArray, NDArray[np.int64]]:
    """Distribution functions of Poisson variables of means 0..9, (10, counts), and for each 1/256 of a probability the
    first count whose distribution function lies above it, (10, 256).
    """
    share = special.pdtr(np.arange(_COUNTS), np.arange(float(FROM_NORMAL))[:, None])
    share[:, -1] = 1.0
    guide = np.stack([np.searchsorted(row, np.arange(_GUIDE) / _GUIDE, side="right") for row in share])
    return share, guide


@njit(cache=True, nogil=True)
def _fill(
    mean: Float32Array, drawn: Float32Array, rng: np.random.Generator, share: FloatArray, guide: NDArray[np.int64]
) -> None:
    for i in range(mean.size):
        mu = float(mean[i])
        if mu < FROM_NORMAL:
            drawn[i] = _few(mu, rng.random(), rng.random(), share, guide)
            continue
        # Steps N, I and S of PD; here, as handing the generator to a function costs as much as the variable.
        s = math.sqrt(mu)
        k = math.floor(mu + s * rng.standard_normal())
        if k < math.floor(mu - 1.1484):
            u, below = rng.random(), mu - k
            if k < 0 or 6.0 * mu * mu * u < below * below * below:
                k = _correct_candidate(mu, s, k, u, rng)
        drawn[i] = k


@njit(cache=True)
def _few(mu: float, u: float, v: float, share: FloatArray, guide: NDArray[np.int64]) -> int:
    """Return a variable of mean below 10, from two uniform variables."""
    whole = int(mu)
    count = guide[whole, int(u * _GUIDE)]
    while u >= share[whole, count]:
        count += 1
    rest = mu - whole
    if v < 1.0 - rest:  # which is below exp(-rest)
        return count
    probability, k = math.exp(-rest), 0
    while v >= probability and k < 40:  # 1e-48 of a mean below 1 lies beyond
        v -= probability
        k += 1
        probability *= rest / k
    return count + k


@njit(cache=True)
def _correct_candidate(mu: float, s: float, k: int, u: float, rng: np.random.Generator) -> int:
    """Steps P, Q, E and H of PD: accept the candidate, or draw from a double exponential hat over the difference to
    the normal density."""
    if k >= 0:
        log_p, p, log_n, n = _densities(mu, s, k)
        if n * (1.0 - u) <= p * math.exp(log_p - log_n):
            return k
    while True:
        e = -math.log(1.0 - rng.random())
        u = 2.0 * rng.random() - 1.0
        t = 1.8 + math.copysign(e, u)
        if t > -0.6744:
            k = math.floor(mu + s * t)
            log_p, p, log_n, n = _densities(mu, s, k)
            if 0.1069 / mu * abs(u) <= p * math.exp(log_p + e) - n * math.exp(log_n + e):
                return k


@njit(cache=True)
def _densities(mu: float, s: float, k: int) -> tuple[float, float, float, float]:
    """Poisson probability of k as p exp(log_p), and that of the whole part of the normal variable as n exp(log_n)
    (procedure F).
    """
    b1 = 1.0 / (24.0 * mu)
    b2 = 0.3 * b1 * b1
    c3 = b1 * b2 / 7.0
    c2 = b2 - 15.0 * c3
    c1 = b1 - 6.0 * b2 + 45.0 * c3
    c0 = 1.0 - b1 + 3.0 * b2 - 15.0 * c3
    x = (0.5 - (mu - k)) / s
    xx = x * x
    n = (((c3 * xx + c2) * xx + c1) * xx + c0) / (math.sqrt(2.0 * math.pi) * s)
    if k < 10:
        return -mu, mu**k / math.gamma(k + 1.0), -0.5 * xx, n
    stirling = 1.0 / (12.0 * k) - 1.0 / (360.0 * k * k * k)
    log_p = k * math.log1p((mu - k) / k) - (mu - k) - stirling
    return log_p, 1.0 / math.sqrt(2.0 * math.pi * k), -0.5 * xx, n
