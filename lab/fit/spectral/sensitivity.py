"""`estimate_sensitivity`: the sensitivity of one channel from its signals under known lights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.fit.spectral.bounds import LowerBounds, within_bounds
from lab.fit.spectral.curvature_prior import averaging_matrix, local_roughness
from lab.fit.spectral.tikhonov import posterior_under_prior
from sim.spectrum import FloatArray

COVERAGE_FACTOR = 2.0  # times the standard deviation: a band of about 95 %
RADIOMETER_RELATIVE_STD = 0.003  # repeatability of a measured spectrum
ROUGHNESS_FLOORS = (0.02, 0.05, 0.15, 0.4, 1.0, 3.0)  # of the maximum of the local scale; 3: nearly the same everywhere
NEGATIVE_LIGHT = 0.05  # of the maximum of a light: negative values by the noise of the radiometer
MIN_SPECTRA = 3  # lights that differ: a curve with curvature has three points
DETERMINED_SHARE = 0.25  # of the maximum of the curve: largest standard deviation of a determined value


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """A sensitivity on the wavelengths (m,) of the lights.

    `std`: its standard deviation; `coverage_factor` times it is a band of about 95 %. `covariance` (m, m): before
    positivity, which only reduces it. `gain` (m, n): Jacobian of the curve by the signals; it propagates what the
    signals of several channels share.
    """

    sensitivity: FloatArray
    std: FloatArray
    coverage_factor: float
    covariance: FloatArray
    gain: FloatArray

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(m,): where the lights determine the curve, with a standard deviation below a quarter of its maximum."""
        return self.std < DETERMINED_SHARE * max(float(self.sensitivity.max()), 1e-300)


def estimate_sensitivity(
    wavelength_nm: ArrayLike, lights: ArrayLike, signal: ArrayLike, signal_std: ArrayLike
) -> Sensitivity:
    """Sensitivity S(w) from signals C_i = integral L_i(w) S(w) dw + noise.

    `wavelength_nm` (m,), ascending; `lights` (n, m), photons (or power) per nm; `signal`, `signal_std` (n,). S is in
    signal per photon (or energy), on `wavelength_nm`; integrals are by the trapezoidal rule. Where no light shines,
    `std` is large and `determined` False. Raises ValueError where shapes don't fit, values aren't finite, a light is
    negative by more than noise, a standard deviation isn't above 0, or fewer than 3 lights differ. The method:
    `lab.fit.spectral`.
    """
    wave, light, value, std = (np.asarray(a, float) for a in (wavelength_nm, lights, signal, signal_std))
    _refuse_unusable(wave, light, value, std)
    return solved_sensitivity(wave, light * trapezoid_weights(wave), value, std)


def _refuse_unusable(wave: FloatArray, light: FloatArray, value: FloatArray, std: FloatArray) -> None:
    """Raise ValueError for the arguments that `estimate_sensitivity` names."""
    if wave.ndim != 1 or light.shape != (value.size, wave.size) or std.shape != value.shape:
        raise ValueError(
            f"{wave.size} wavelengths, lights {light.shape}, {value.size} signals, {std.size} standard deviations: "
            "lights are (signals, wavelengths)"
        )
    if np.any(np.diff(wave) <= 0):
        raise ValueError("wavelengths must ascend: sort them")
    if value.size < 3:
        raise ValueError(f"{value.size} lights, 3 needed: a sensitivity with a second difference has 3 points")
    if not all(np.all(np.isfinite(a)) for a in (light, value, std)) or np.any(std <= 0):
        raise ValueError("lights and signals must be finite, standard deviations above 0 and finite")
    if not np.all(np.any(light > 0, axis=1)):
        raise ValueError(f"light {int(np.argmin(np.any(light > 0, axis=1)))} is dark at all wavelengths: leave it out")
    negative = light.min(axis=1) < -NEGATIVE_LIGHT * light.max(axis=1)
    if negative.any():
        at = int(np.argmax(negative))
        raise ValueError(
            f"light {at} is negative, {light[at].min():.3g} at {wave[np.argmin(light[at])]:g} nm where its maximum is "
            f"{light[at].max():.3g}: measure it again, with the radiometer's dark subtracted"
        )
    if (different := different_spectra(light)) < MIN_SPECTRA:
        raise ValueError(
            f"{value.size} lights, of {different} different spectra, {MIN_SPECTRA} needed: add other lights"
        )


def different_spectra(light: FloatArray) -> int:
    """Number of spectra (n, wavelengths) that differ by more than the repeatability of the radiometer.

    It is the number of singular values of the normalised lights above it. A light taken twice, or at two levels,
    counts once.
    """
    unit = light / np.linalg.norm(light, axis=1, keepdims=True)
    return int(np.sum(np.linalg.svd(unit, compute_uv=False) > np.sqrt(2.0) * RADIOMETER_RELATIVE_STD))


def trapezoid_weights(wave: FloatArray) -> FloatArray:
    """Weights (m,) of the trapezoidal rule."""
    half = np.diff(wave) / 2.0
    return np.append(half, 0.0) + np.append(0.0, half)


def solved_sensitivity(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    bounds: LowerBounds | None = None,
    fine_share: float = 0.0,
) -> Sensitivity:
    """Solve value = operator S + noise within bounds in two passes: with uniform roughness, then with the local one
    and fine structure.

    `operator` (n, m), `value`, `std` (n,). `bounds`: lower limits beside positivity. `fine_share`: see `rough_root`.
    """
    mean, covariance = posterior_under_prior(wave, operator, value, std, [np.ones_like(wave)])
    average = averaging_matrix(wave)
    for _ in range(2):
        local = local_roughness(wave, mean, average)
        if local is None:
            break
        mean, covariance = posterior_under_prior(
            wave, operator, value, std, [local + floor for floor in ROUGHNESS_FLOORS], fine_share
        )
    everywhere = LowerBounds(np.eye(wave.size), np.zeros(wave.size))
    if bounds is not None:
        everywhere = LowerBounds(
            np.concatenate([everywhere.operator, bounds.operator]), np.append(everywhere.limit, bounds.limit)
        )
    return Sensitivity(
        within_bounds(mean, covariance, everywhere),
        np.sqrt(np.clip(np.diag(covariance), 0.0, None)),
        COVERAGE_FACTOR,
        covariance,
        (covariance @ operator.T) / std**2,
    )
