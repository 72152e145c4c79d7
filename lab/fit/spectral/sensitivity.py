"""`estimate_sensitivity`: the sensitivity of one channel from its signals under known lights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lab.fit.spectral.bounds import LowerBounds, within_bounds
from lab.fit.spectral.channel_signals import RADIOMETER_RELATIVE_STD, ChannelSignals, Scatter, light_errors
from lab.fit.spectral.curvature_prior import averaging_matrix, local_roughness, signal_covariance
from lab.fit.spectral.scatter import CLEAR_LOG_RATIO, COUNTED_LOG_RATIO, scatter_evidence
from lab.fit.spectral.tikhonov import CurvePrior, likeliest_prior, posterior_under_prior
from sim.spectrum import FloatArray

COVERAGE_FACTOR = 2.0  # times the standard deviation: a band of about 95 %
ROUGHNESS_FLOORS = (0.02, 0.05, 0.15, 0.4, 1.0, 3.0)  # of the maximum of the local scale; 3: nearly the same everywhere
NEGATIVE_LIGHT = 0.05  # of the maximum of a light: negative values by the noise of the radiometer
SCATTER_STEPS = 4  # at most, of curves and scatter in turn
SCATTER_AGREEMENT = 0.05  # relative change of the scatter below which it has settled
MIN_SPECTRA = 3  # lights that differ: a curve with curvature has three points
DETERMINED_SHARE = 0.25  # of the maximum of the curve: largest standard deviation of a determined value


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """A sensitivity on the wavelengths (m,) of the lights.

    `std`: its standard deviation; `coverage_factor` times it is a band of about 95 %. `covariance` (m, m): before
    positivity, which only reduces it. `common` (m, lights): the curve's change by a standard deviation of each error that
    the channels share.
    """

    sensitivity: FloatArray
    std: FloatArray
    coverage_factor: float
    covariance: FloatArray
    common: FloatArray

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
    names = tuple(str(k) for k in range(value.size))
    none = np.zeros((0, wave.size)), np.zeros(0)
    one = ChannelSignals(light * trapezoid_weights(wave), value, std, names, *none)
    return solved_sensitivities(wave, {"": one})[0][""]


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


def solved_sensitivities(
    wave: FloatArray, signals: Mapping[str, ChannelSignals], fine_share: float = 0.0
) -> tuple[dict[str, Sensitivity], Scatter]:
    """The sensitivities of all channels, and the scatter of their signals beyond the stated standard deviations, which is in theirs.

    Where there is none to be seen (`scatter_evidence`), channels are solved one by one. Else curves and scatter are found in turn, since the
    prior's local scale follows from a curve, and a curve from its signals' standard deviations; and what the channels share of it is
    estimated light by light, from all channels at once.
    """
    scatter = Scatter()
    priors = {c: _prior(wave, s, fine_share) for c, s in signals.items()}
    for _ in range(SCATTER_STEPS):
        roughness = [
            signal_covariance(wave, signals[c].operator, prior.shape, fine_share) for c, prior in priors.items()
        ]
        start = np.array([2.0 * np.log(prior.strength) for prior in priors.values()])
        likely = scatter_evidence(wave, list(signals.values()), roughness, start, scatter)
        if likely.scatter.log_ratio < (COUNTED_LOG_RATIO if len(signals) > 1 else CLEAR_LOG_RATIO):
            break
        settled = abs(likely.scatter.total - scatter.total) < SCATTER_AGREEMENT * scatter.total
        scatter = likely.scatter
        priors = {
            c: replace(prior, strength=float(np.exp(0.5 * log)))
            for (c, prior), log in zip(priors.items(), likely.strength, strict=True)
        }
        if settled:
            break
        priors = {c: _prior(wave, s.scattered(scatter), fine_share) for c, s in signals.items()}
    if scatter.total > 0.0 and len(signals) > 1:
        return _solved_together(wave, signals, priors, scatter), scatter
    errors = light_errors(signals)
    curves = {}
    for c, prior in priors.items():
        own = signals[c].scattered(scatter)
        one = posterior_under_prior(wave, own.operator, own.value, own.std, prior)
        common = RADIOMETER_RELATIVE_STD * one.gain @ errors[c]
        curves[c] = _within(wave, own, one.mean, one.covariance, common)
    return curves, scatter


def _solved_together(
    wave: FloatArray, signals: Mapping[str, ChannelSignals], priors: Mapping[str, CurvePrior], scatter: Scatter
) -> dict[str, Sensitivity]:
    """The sensitivities of channels that share a relative error of each light.

    With errors g of the lights and curves S_c = S_c(0) - G_c D_c g, the channels' signals D_c g + (what the priors and their own noise allow, of
    precision R_c) give g the precision sum(D_c^T R_c D_c) + 1 / std^2. D_c: signals by lights; G_c: curve by signals.
    """
    errors = light_errors(signals)
    own = {c: s.unshared(Scatter(own=scatter.own)) for c, s in signals.items()}
    found = {c: posterior_under_prior(wave, s.operator, s.value, s.std, priors[c]) for c, s in own.items()}
    shared = float(np.hypot(RADIOMETER_RELATIVE_STD, scatter.common))
    precision = np.sum([errors[c].T @ one.precision @ errors[c] for c, one in found.items()], axis=0)
    covariance = np.linalg.inv(precision + np.eye(len(precision)) / shared**2)
    error = covariance @ np.sum([errors[c].T @ one.precision @ own[c].value for c, one in found.items()], axis=0)
    root = np.linalg.cholesky(covariance)
    curves = {}
    for c, one in found.items():
        moved = one.gain @ errors[c]
        common = moved @ root
        curves[c] = _within(wave, own[c], one.mean - moved @ error, one.covariance + common @ common.T, common)
    return curves


def _prior(wave: FloatArray, signals: ChannelSignals, fine_share: float) -> CurvePrior:
    """The prior of a curve in two passes: with uniform roughness, then with the local one and fine structure."""
    data = signals.operator, signals.value, signals.std
    prior = likeliest_prior(wave, *data, [np.ones_like(wave)])
    average = averaging_matrix(wave)
    for _ in range(2):
        local = local_roughness(wave, posterior_under_prior(wave, *data, prior).mean, average)
        if local is None:
            break
        prior = likeliest_prior(wave, *data, [local + floor for floor in ROUGHNESS_FLOORS], fine_share)
    return prior


def _within(
    wave: FloatArray, signals: ChannelSignals, mean: FloatArray, covariance: FloatArray, common: FloatArray
) -> Sensitivity:
    """The most probable curve that isn't below zero nor below what saturated signals say."""
    bounds = LowerBounds(
        np.concatenate([np.eye(wave.size), signals.saturated]), np.append(np.zeros(wave.size), signals.limit)
    )
    std = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    return Sensitivity(within_bounds(mean, covariance, bounds), std, COVERAGE_FACTOR, covariance, common)
