"""Lines through measured points, weighted: dark means against exposure, EMVA 1288's linearity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from sim.spectrum import FloatArray


@dataclass(frozen=True)
class DarkLine:
    """Mean of a dark frame against exposure: black + rate t (DN, DN/s), with covariance; `rate` None with one exposure."""

    black: float
    rate: float | None
    covariance: FloatArray

    def at(self, exposure_s: float) -> float:
        return self.black + (self.rate or 0.0) * exposure_s


def dark_line(exposure_s: FloatArray, mean: FloatArray, std: FloatArray) -> DarkLine:
    """Weighted straight line through dark means; its covariance is scaled up where the means scatter beyond `std`."""
    if np.ptp(exposure_s) <= 1e-6 * np.max(exposure_s, initial=1e-12):
        weight = 1.0 / std**2
        value = float(np.sum(weight * mean) / np.sum(weight))
        return DarkLine(value, None, np.array([[1.0 / np.sum(weight), 0.0], [0.0, 0.0]]))
    basis = np.stack([np.ones_like(exposure_s), exposure_s], axis=1)
    solution, covariance, chi2 = least_squares(basis, mean, std)
    return DarkLine(float(solution[0]), float(solution[1]), covariance * inflation(chi2, len(mean) - 2))


def least_squares(basis: FloatArray, values: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Weighted least squares: solution, covariance, chi2."""
    scale = np.linalg.norm(basis / std[:, None], axis=0)
    design = basis / std[:, None] / scale
    solution, *_ = np.linalg.lstsq(design, values / std, rcond=None)
    covariance = np.linalg.pinv(design.T @ design) / np.outer(scale, scale)
    return solution / scale, covariance, float(np.sum((values / std - design @ solution) ** 2))


def inflation(chi2: float, freedom: int, p: float = 0.01) -> float:
    """Factor on a covariance: chi2 per degree of freedom where chance explains it with less than `p`, else 1."""
    if freedom < 1 or special.chdtrc(freedom, chi2) > p:
        return 1.0
    return max(1.0, chi2 / freedom)


@dataclass(frozen=True)
class Linearity:
    """EMVA's linearity line: offset + slope light, deviations in percent of the line, and their mean modulus."""

    offset: float
    slope: float
    slope_std: float
    deviation_percent: FloatArray
    error_percent: float
    error_percent_std: float


def linearity(light: FloatArray, signal: FloatArray, signal_std: FloatArray) -> Linearity:
    """The line through (light, signal) that minimises the relative deviations, and the linearity error: the mean modulus of
    the relative deviations in percent (EMVA 1288 release 4.0). All points are used: give those within 5..95 % of saturation.

    The uncertainty holds the points' noise and, since a modulus of noise isn't zero, what that adds on average.
    """
    basis = np.stack([np.ones_like(light), light], axis=1)
    solution, covariance, chi2 = least_squares(basis, signal, signal)
    model = basis @ solution
    deviation = 100.0 * (signal - model) / model
    std = 100.0 * signal_std / model
    error = np.abs(deviation)
    z = error / np.maximum(std, 1e-12)
    folded = std * np.sqrt(2.0 / np.pi) * np.exp(-0.5 * z**2) + error * (1.0 - 2.0 * special.ndtr(-z))
    scatter = chi2 / max(len(light) - 2, 1)
    return Linearity(
        float(solution[0]),
        float(solution[1]),
        float(np.sqrt(covariance[1, 1] * scatter)),
        deviation,
        float(error.mean()),
        float(np.hypot(np.sqrt(np.sum(std**2)) / len(std), np.mean(folded - error))),
    )


def root(square: float, square_std: float) -> tuple[float, float]:
    """Square root of a variance that noise may have made negative, with a standard uncertainty of which twice reaches the roots of
    the variance's own two standard uncertainties: far from 0 that is std / (2 value), near 0 it takes 0 in."""
    above = max(square, 0.0)
    value = float(np.sqrt(above))
    upper, lower = np.sqrt(above + 2.0 * square_std), np.sqrt(max(above - 2.0 * square_std, 0.0))
    return value, float(max(upper - value, value - lower)) / 2.0
