"""The error of rounding to whole codes, or to multiples of a step of several DN, in means and in variances.

Rounding of normal values of mean m and standard deviation s adds a saw-tooth of m, damped by exp(-2 pi^2 k^2 s^2) in
its k-th harmonic, and 1/12 DN^2 to the variance. Noise of half a code dithers both; quiet cameras of few bits don't
dither. Codes of a step of s DN have s times these errors, at 1/s^2 of their variance before rounding.
"""

from __future__ import annotations

import numpy as np

from sim.spectrum import FloatArray

QUANTISATION_DN2 = 1.0 / 12.0  # of a step of 1 DN, as all variances here
HIDDEN_DN2 = 0.30  # after rounding; a normal variable of less than 0.45 DN may have any variance below this
ROUNDING_HARMONICS, WAVE_HARMONICS = 16, 4  # of the saw-tooth
LEAST_ROUNDING_DN = 1e-3


def variance_before_rounding(variance: FloatArray | float, step_dn: float = 1.0) -> FloatArray:
    """Return the variance before rounding to a step of `step_dn`, DN^2: less 1/12 of its square, and 0 below
    `HIDDEN_DN2` of it. A constant value half way between two codes has 1/4 after rounding.
    """
    square = step_dn**2
    hidden = np.asarray(variance) < HIDDEN_DN2 * square
    return np.asarray(np.where(hidden, 0.0, np.subtract(variance, QUANTISATION_DN2 * square)))


def _rounding_harmonics_dn(variance_dn2: FloatArray | float, count: int) -> FloatArray:
    """Return the root mean squares (count, ...), DN, of the first harmonics of the saw-tooth: exp(-2 pi^2 k^2 s^2) /
    (pi k sqrt 2).
    """
    spread = np.maximum(np.asarray(variance_dn2, float), 0.0)
    k = np.arange(1, count + 1).reshape(-1, *(1,) * spread.ndim)
    return np.asarray(np.exp(-2.0 * (np.pi * k) ** 2 * spread) / (np.pi * k * np.sqrt(2.0)))


def rounding_std_dn(variance_dn2: FloatArray | float, step_dn: float = 1.0) -> FloatArray:
    """Return the standard deviation of the error of a mean of many pixels by rounding to `step_dn`, over all levels. Of
    a step of 1 DN: 0.29 DN without noise, 0.004 DN for s = 0.45 DN.
    """
    scaled = np.divide(variance_dn2, step_dn**2)
    return np.asarray(step_dn * np.linalg.norm(_rounding_harmonics_dn(scaled, ROUNDING_HARMONICS), axis=0))


def rounding_waves_dn(level_dn: FloatArray, variance_dn2: FloatArray, step_dn: float = 1.0) -> list[FloatArray]:
    """Return the errors that rounding to `step_dn` may leave in means at the levels `level_dn` (n,), for variances
    `variance_dn2` (n,): (n,) each, one standard deviation.

    They are the cosines and sines of the first harmonics, as a level is hardly known to a fraction of a code. Empty
    where noise dithers.
    """
    found: list[FloatArray] = []
    for k, size in enumerate(_rounding_harmonics_dn(variance_dn2 / step_dn**2, WAVE_HARMONICS), 1):
        if size.max(initial=0.0) < LEAST_ROUNDING_DN:
            break
        phase = 2.0 * np.pi * k * level_dn / step_dn
        found += [step_dn * size * np.cos(phase), step_dn * size * np.sin(phase)]
    return found


def variance_rounding_std(temporal: float, spatial: float, step_dn: float = 1.0) -> float:
    """Return the standard deviation, DN^2, of the error that rounding to `step_dn` may leave in a mean temporal
    variance, beside 1/12 of the step's square.

    With temporal and spatial standard deviations s and t of normal values: (4 s^2 + 1 / pi^2) exp(-2 pi^2 (s^2 + t^2))
    cos(2 pi mean).
    """
    square = step_dn**2
    true = variance_before_rounding(temporal / square)
    size = (4.0 * true + 1.0 / np.pi**2) * np.exp(-2.0 * np.pi**2 * (true + max(spatial / square, 0.0)))
    return float(square * size / np.sqrt(2.0))
