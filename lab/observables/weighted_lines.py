"""Weighted least squares, and the straight lines that use it: dark means against exposure, linearity of EMVA 1288."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from sim.spectrum import FloatArray


@dataclass(frozen=True)
class DarkLine:
    """Mean of a dark frame against exposure t: black + rate t (DN, DN/s), with covariance (2, 2); `rate` is None with
    one exposure.
    """

    black: float
    rate: float | None
    covariance: FloatArray

    def at(self, exposure_s: float) -> float:
        """Return the dark mean at an exposure, DN."""
        return self.black + (self.rate or 0.0) * exposure_s


def dark_line(exposure_s: FloatArray, mean: FloatArray, std: FloatArray) -> DarkLine:
    """Fit a weighted line through dark means `mean` +- `std` (n,); the covariance is scaled by `chi2_factor`.

    `exposure_s`, `mean`, `std` (n,): s, DN, DN.
    """
    if np.ptp(exposure_s) <= 1e-6 * np.max(exposure_s, initial=1e-12):
        weight = 1.0 / std**2
        value = float(np.sum(weight * mean) / np.sum(weight))
        return DarkLine(value, None, np.array([[1.0 / np.sum(weight), 0.0], [0.0, 0.0]]))
    basis = np.stack([np.ones_like(exposure_s), exposure_s], axis=1)
    solution, covariance, chi2 = least_squares(basis, mean, std)
    return DarkLine(float(solution[0]), float(solution[1]), covariance * chi2_factor(chi2, len(mean) - 2))


def least_squares(basis: FloatArray, values: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Solve basis (n, p) solution = values (n,) +- std (n,) by weighted least squares: solution (p,), covariance (p,
    p), chi2.
    """
    scale = np.linalg.norm(basis / std[:, None], axis=0)
    design = basis / std[:, None] / scale
    solution, *_ = np.linalg.lstsq(design, values / std, rcond=None)
    covariance = np.linalg.pinv(design.T @ design) / np.outer(scale, scale)
    return solution / scale, covariance, float(np.sum((values / std - design @ solution) ** 2))


def chi2_factor(chi2: float, freedom: int, p: float = 0.01) -> float:
    """Return the factor on a covariance (Birge ratio squared): chi2 per degree of freedom where its probability by
    chance is below `p`, else 1.
    """
    if freedom < 1 or special.chdtrc(freedom, chi2) > p:
        return 1.0
    return max(1.0, chi2 / freedom)


@dataclass(frozen=True)
class Linearity:
    """The linearity line of EMVA 1288: offset + slope light.

    `deviation_percent` (n,): deviations from the line, relative to it. `error_percent`: their mean modulus.
    `error_noise_percent`: its standard deviation from recording to recording. `error_bias_percent`: by how much noise
    raises it on average, as a modulus has no sign.
    """

    offset: float
    slope: float
    slope_std: float
    deviation_percent: FloatArray
    error_percent: float
    error_noise_percent: float
    error_bias_percent: float

    @property
    def error_percent_std(self) -> float:
        """Return the root mean square error of `error_percent` about that of the response without noise."""
        return float(np.hypot(self.error_noise_percent, self.error_bias_percent))


def linearity(light: FloatArray, signal: FloatArray, covariance_dn2: FloatArray) -> Linearity:
    """Fit the line through (light, signal), each (n,), of least relative deviations, and its linearity error (EMVA 1288
    release 4.0).

    The error is the mean modulus of the relative deviations in percent. All points are used: give those within 5..95 %
    of saturation. Its uncertainty holds the noise of the points, of `covariance_dn2` (n, n), less what the line takes
    of it, and what that noise adds to a modulus on average (`_mean_modulus_errors`).
    """
    basis = np.stack([np.ones_like(light), light], axis=1)
    solution, covariance, chi2 = least_squares(basis, signal, signal)
    model = basis @ solution
    deviation = 100.0 * (signal - model) / model
    # The line takes two degrees of freedom of the relative noise
    directions, _ = np.linalg.qr(basis / signal[:, None])
    rest = np.eye(light.size) - directions @ directions.T
    noise, bias = _mean_modulus_errors(deviation, rest @ (1e4 * covariance_dn2 / np.outer(model, model)) @ rest)
    reduced_chi2 = chi2 / max(len(light) - 2, 1)
    return Linearity(
        float(solution[0]),
        float(solution[1]),
        float(np.sqrt(covariance[1, 1] * reduced_chi2)),
        deviation,
        float(np.abs(deviation).mean()),
        noise,
        bias,
    )


def _mean_modulus_errors(values: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return the standard deviation of mean |x|, and its bias, for normal x (n,) of `covariance` (n, n), drawn once as
    `values`.

    The mean of |x| for x ~ N(m, s^2) is m (2 Phi(m / s) - 1) + 2 s phi(m / s) (the folded normal distribution), and
    the covariance of two moduli, after Price's theorem, the series of c^k / k! times the means of their k-th
    derivatives, of which the first two orders are taken. m isn't known. `values` stand for it, scaled to the part of
    their mean square that noise doesn't explain, less one standard deviation of that part: so noise isn't taken for
    a departure, and what it adds to the modulus isn't understated.
    """
    square = float(values @ values)
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    excess = max(square - float(std @ std), 0.0)
    scaled = values * np.sqrt(excess / max(square, 1e-300))
    excess -= float(np.sqrt(2.0 * np.sum(covariance**2) + 4.0 * scaled @ covariance @ scaled))
    mean = values * np.sqrt(max(excess, 0.0) / max(square, 1e-300))
    z = mean / std
    first = 2.0 * special.ndtr(z) - 1.0
    second = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * z**2) / std
    folded = mean * first + std**2 * second
    of_moduli = np.outer(first, first) * covariance + 0.5 * np.outer(second, second) * covariance**2
    np.fill_diagonal(of_moduli, np.maximum(mean**2 + std**2 - folded**2, 0.0))
    noise = float(np.sqrt(max(of_moduli.sum(), 0.0))) / values.size
    return noise, float(np.mean(folded - np.abs(mean)))


def root(square: float, square_std: float) -> tuple[float, float]:
    """Return the square root of a variance that noise may have made negative, with its standard deviation.

    Far from 0 the standard deviation is square_std / (2 root). Near 0 it covers 0: twice it reaches the roots of
    square +- 2 square_std.
    """
    above = max(square, 0.0)
    value = float(np.sqrt(above))
    upper, lower = np.sqrt(above + 2.0 * square_std), np.sqrt(max(above - 2.0 * square_std, 0.0))
    return value, float(max(upper - value, value - lower)) / 2.0
