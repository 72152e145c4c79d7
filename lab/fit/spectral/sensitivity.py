"""`estimate_sensitivity`: the sensitivities of channels from their signals under known lights.

How far signals scatter beyond their stated standard deviations is found by maximum marginal likelihood
(`scatter_evidence`). Signals C = A S (1 + g) (1 + h) + noise: g is common to the channels in one light, as a lamp that
flickers or a reading of its power is; h is each channel's own. The curves S have the curvature prior of the fit, of
free strength, and straight lines are integrated out (restricted likelihood; Patterson and Thompson, 1971), so that
neither structure of the curves nor their number of parameters is taken for scatter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize

from lab.fit.spectral.curve_prior import (
    CurvePrior,
    LowerBounds,
    averaging_matrix,
    likeliest_prior,
    local_roughness,
    posterior_under_prior,
    signal_covariance,
    straight_lines,
    within_bounds,
)
from lab.observables.spectra.light_readings import RADIOMETER_STD
from sim.spectrum import FloatArray

LEAST_OWN_SHARE = 1e-6  # of a channel's highest signal: the least standard deviation that is its own

#: ln of the likelihood ratio from which on scatter of several channels is counted (Akaike's for one parameter; what the
#: channels share shows what isn't structure of a curve), and from which on it is told, or counted for a channel alone:
#: twice it is chi2 of two parameters at their bounds at most, which exceeds 13.8 in one recording of a thousand that
#: has none.
COUNTED_LOG_RATIO, CLEAR_LOG_RATIO = 1.0, 6.9
#: Largest relative scatter. Its variance goes with the measured signals; above it, a curve of zero would explain them
#: all by scatter.
MOST_SCATTER = 0.2
#: Prior of ln(relative scatter), normal: one per cent, within a factor of ten. It bounds what the signals don't
#: determine.
_PRIOR_LOG, _PRIOR_STD = np.log(0.01), np.log(10.0)
_STRENGTH_RANGE = 8.0  # of ln(strength^2) about the start

COVERAGE_FACTOR = 2.0  # times the standard deviation: a band of about 95 %
ROUGHNESS_FLOORS = (0.02, 0.05, 0.15, 0.4, 1.0, 3.0)  # of the maximum of the local scale; 3: nearly the same everywhere
NEGATIVE_LIGHT = 0.05  # of the maximum of a light: negative values by the noise of the radiometer
SCATTER_STEPS = 4  # at most, of curves and scatter in turn
SCATTER_AGREEMENT = 0.05  # relative change of the scatter below which it has settled
MIN_SPECTRA = 3  # lights that differ: a curve with curvature has three points
DETERMINED_SHARE = 0.25  # of the maximum of the curve: largest standard deviation of a determined value


@dataclass(frozen=True)
class Scatter:
    """Relative standard deviations of signals beyond the stated ones: `common` to the channels in one light, as the
    lamp and the reading of its power are, and `independent` from channel to channel. `log_ratio`: ln of the
    likelihood ratio to none.
    """

    common: float = 0.0
    independent: float = 0.0
    log_ratio: float = 0.0

    @property
    def total(self) -> float:
        """Return the relative standard deviation of one signal by both."""
        return float(np.hypot(self.common, self.independent))


@dataclass(frozen=True, eq=False)
class ChannelSignals:
    """Signals of one channel and the operator on its sensitivity.

    `operator` (n, m), `value`, `std` (n,): e/s, or relative. `light` (n,): names of the lights; two channels share the
    error of a light. `saturated` (k, m), `limit` (k,): operator and lower limits of saturated signals.
    """

    operator: FloatArray
    value: FloatArray
    std: FloatArray
    light: tuple[str, ...]
    saturated: FloatArray
    limit: FloatArray

    @property
    def has_gaps(self) -> bool:
        """Tell whether lights saturate."""
        return self.limit.size > 0

    def with_scatter(self, scatter: Scatter) -> ChannelSignals:
        """Return the signals with the standard deviation that `scatter` adds."""
        return replace(self, std=np.hypot(self.std, scatter.total * self.value))

    def without_shared_error(self, scatter: Scatter) -> ChannelSignals:
        """Return the signals with `scatter`, and without the radiometer's repeatability, which the channels share."""
        square = self.std**2 - (RADIOMETER_STD * self.value) ** 2
        least = LEAST_OWN_SHARE * float(np.max(np.abs(self.value)))
        return replace(self, std=np.sqrt(np.maximum(square, least**2))).with_scatter(scatter)


def light_errors(signals: Mapping[str, ChannelSignals]) -> dict[str, FloatArray]:
    """Return the changes (n, lights) of each channel's signals by the relative errors of all lights, which the channels
    share.

    >>> none = np.zeros((0, 3)), np.zeros(0)
    >>> signal = ChannelSignals(np.eye(2, 3), np.array([5.0, 7.0]), np.ones(2), ("400", "500"), *none)
    >>> light_errors({"G": signal})["G"].tolist()
    [[5.0, 0.0], [0.0, 7.0]]
    """
    lights = np.array(
        list(dict.fromkeys(name for channel_signals in signals.values() for name in channel_signals.light))
    )
    return {
        c: (np.array(channel_signals.light)[:, None] == lights) * channel_signals.value[:, None]
        for c, channel_signals in signals.items()
    }


def joint_covariance(at: FloatArray, solved: Mapping[str, Sensitivity]) -> FloatArray:
    """Return the covariance (channels x k, channels x k) of the curves of all channels, channel after channel, at the
    wavelengths to which `at` (k, m) interpolates. Between channels it is that of what they share.
    """
    return np.block(
        [
            [
                at @ (first.covariance if c == d else first.common @ second.common.T) @ at.T
                for d, second in solved.items()
            ]
            for c, first in solved.items()
        ]
    )


@dataclass(frozen=True)
class ScatterEvidence:
    """`log_evidence`: ln of the marginal likelihood at the likeliest `scatter`. `strength` (channels,): ln of the
    squared strengths of the priors there. The likelihood of no scatter is taken at strengths of its own.
    """

    log_evidence: float
    scatter: Scatter
    strength: FloatArray


def scatter_evidence(
    wave: FloatArray,
    signals: Sequence[ChannelSignals],
    prior: Sequence[FloatArray],
    start: FloatArray,
    scatter: Scatter,
) -> ScatterEvidence:
    """Find the likeliest scatter of `signals`, all channels at once, from a `start` of ln(strength^2) (channels,) and a
    first `scatter`.

    `prior`: of each channel the covariance (n, n) of its signals by the curvature of its curve, at strength 1. Of one
    channel all scatter is its own and stands as `common`.
    """
    rest = [linalg.qr(s.operator @ straight_lines(wave))[0][:, 2:] for s in signals]  # lines are integrated out
    turn = linalg.block_diag(*rest)
    value = np.concatenate([s.value for s in signals])
    light = np.concatenate([np.array(s.light) for s in signals])
    several = len(signals) > 1
    read = RADIOMETER_STD if several else 0.0  # part of the stated standard deviations, common to the channels
    variance = np.maximum(
        np.concatenate([s.std for s in signals]) ** 2 - (read * value) ** 2, 1e-20 * float(np.max(value**2))
    )
    y = turn.T @ value
    noise = (turn.T * variance) @ turn
    alone = (turn.T * value**2) @ turn
    shared = turn.T @ ((light[:, None] == light) * np.outer(value, value)) @ turn if several else alone
    curve = [r.T @ p @ r for r, p in zip(rest, prior, strict=True)]
    ends = np.cumsum([0, *(len(c) for c in curve)])
    count = len(signals)

    def loss(strength: FloatArray, trial: Scatter) -> float:
        covariance = noise + (read**2 + trial.common**2) * shared + trial.independent**2 * alone
        for k in range(count):
            at = slice(ends[k], ends[k + 1])
            covariance[at, at] += np.exp(strength[k]) * curve[k]
        try:
            root = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return 1e12
        z = linalg.solve_triangular(root, y, lower=True, check_finite=False)
        return 0.5 * float(z @ z) + float(np.log(np.diag(root)).sum())

    def penalise(x: FloatArray) -> float:
        weak = 0.5 * float(np.sum(((x[count:] - _PRIOR_LOG) / _PRIOR_STD) ** 2))
        return loss(x[:count], _scatter_of(x[count:])) + weak

    without, _ = _least(lambda x: loss(x, Scatter()), start)
    first = [max(scatter.common, 0.003), *([max(scatter.independent, 0.001)] if several else [])]
    _, x = _least(penalise, np.concatenate([start, np.log(first)]))
    likeliest = _scatter_of(x[count:])
    log_evidence = -loss(x[:count], likeliest)
    return ScatterEvidence(log_evidence, replace(likeliest, log_ratio=log_evidence + without), x[:count])


def _scatter_of(log: FloatArray) -> Scatter:
    """Return the scatter of the logarithms of `common` and `independent`."""
    return Scatter(*np.exp(np.minimum(log, np.log(MOST_SCATTER))).tolist())


def _least(loss: Callable[[FloatArray], float], start: FloatArray) -> tuple[float, FloatArray]:
    """Minimise `loss` by a simplex about `start`. Returns the least value and its place."""
    simplex = np.concatenate([start[None], start + np.eye(start.size)])
    minimum = optimize.minimize(
        loss,
        start,
        method="Nelder-Mead",
        bounds=[(x - _STRENGTH_RANGE, x + _STRENGTH_RANGE) for x in start],
        options={"xatol": 0.05, "fatol": 0.05, "initial_simplex": simplex},
    )
    return float(minimum.fun), np.asarray(minimum.x)


def scatter_remarks(scatter: Scatter) -> list[str]:
    """Return a line on the scatter of the signals beyond their stated standard deviations, where it is clear.

    >>> scatter_remarks(Scatter())
    []
    """
    if scatter.log_ratio < CLEAR_LOG_RATIO:
        return []
    shares = [
        f"{100.0 * part:.2g} % {whose}"
        for part, whose in ((scatter.common, "common to the channels"), (scatter.independent, "of each channel's own"))
        if part > 0.1 * scatter.total
    ]
    return [
        (
            f"signals scatter beyond their stated standard deviations, by {' and '.join(shares)}: it is in those of "
            "the curves; repeat the light's readings"
        )
    ]


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """A sensitivity on the wavelengths (m,) of the lights.

    `std`: its standard deviation; `coverage_factor` times it is a band of about 95 %. `covariance` (m, m): before
    positivity, which only reduces it. `common` (m, lights): the curve's change by a standard deviation of each error
    that the channels share.
    """

    sensitivity: FloatArray
    std: FloatArray
    coverage_factor: float
    covariance: FloatArray
    common: FloatArray

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Tell (m,) where the lights determine the curve, with a standard deviation below a quarter of its maximum."""
        return self.std < DETERMINED_SHARE * max(float(self.sensitivity.max()), 1e-300)


def estimate_sensitivity(
    wavelength_nm: ArrayLike, lights: ArrayLike, signal: ArrayLike, signal_std: ArrayLike
) -> Sensitivity:
    """Estimate the sensitivity S(w) from signals C_i = integral L_i(w) S(w) dw + noise.

    wavelength_nm : (m,), ascending; integrals are by the trapezoidal rule
    lights : (n, m), photons (or power) per nm
    signal, signal_std : (n,)

    Returns S in signal per photon (or energy) on `wavelength_nm`; where no light shines, its `std` is large and
    `determined` False. Raises ValueError where shapes don't fit, values aren't finite, a light is negative by more than
    noise, a standard deviation isn't above 0, or fewer than 3 lights differ. The method: `lab.fit.spectral`.

    >>> import calibench
    >>> import numpy as np
    >>> wavelength_nm = np.arange(400.0, 701.0, 5.0)
    >>> truth = 0.6 * np.exp(-0.5 * ((wavelength_nm - 550.0) / 40.0) ** 2)
    >>> centres_nm = np.arange(400.0, 701.0, 10.0)
    >>> lights = 1e6 * np.exp(-0.5 * ((wavelength_nm - centres_nm[:, None]) / 5.0) ** 2)
    >>> signal = np.trapezoid(lights * truth, wavelength_nm, axis=1)
    >>> estimate = calibench.estimate_sensitivity(wavelength_nm, lights, signal, np.full(31, 1e3))
    >>> bool(np.abs(estimate.sensitivity - truth).max() < 0.02)
    True
    """
    wave, light, value, std = (np.asarray(a, float) for a in (wavelength_nm, lights, signal, signal_std))
    _refuse_unusable(wave, light, value, std)
    names = tuple(str(k) for k in range(value.size))
    none = np.zeros((0, wave.size)), np.zeros(0)
    single_channel = ChannelSignals(light * trapezoid_weights(wave), value, std, names, *none)
    return solve_sensitivities(wave, {"": single_channel})[0][""]


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
    """Count the spectra that differ by more than the repeatability of the radiometer.

    light : (n, wavelengths)

    It is the number of singular values of the normalised lights above it. A light taken twice, or at two levels, counts
    once.

    >>> different_spectra(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 2.0, 0.0]]))
    2
    """
    unit = light / np.linalg.norm(light, axis=1, keepdims=True)
    return int(np.sum(np.linalg.svd(unit, compute_uv=False) > np.sqrt(2.0) * RADIOMETER_STD))


def trapezoid_weights(wave: FloatArray) -> FloatArray:
    """Return the weights (m,) of the trapezoidal rule.

    wave : places (m,), ascending

    >>> trapezoid_weights(np.array([400.0, 410.0, 430.0])).tolist()
    [5.0, 15.0, 10.0]
    """
    half = np.diff(wave) / 2.0
    return np.append(half, 0.0) + np.append(0.0, half)


def solve_sensitivities(
    wave: FloatArray, signals: Mapping[str, ChannelSignals], fine_share: float = 0.0
) -> tuple[dict[str, Sensitivity], Scatter]:
    """Solve for the sensitivities of all channels, and the scatter of their signals beyond the stated standard
    deviations, which is in theirs.

    Where there is none to be seen (`scatter_evidence`), channels are solved one by one. Else curves and scatter are
    found in turn, since the prior's local scale follows from a curve, and a curve from its signals' standard
    deviations; and what the channels share of it is estimated light by light, from all channels at once.
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
        priors = {c: _prior(wave, s.with_scatter(scatter), fine_share) for c, s in signals.items()}
    if scatter.total > 0.0 and len(signals) > 1:
        return _solve_together(wave, signals, priors, scatter), scatter
    errors = light_errors(signals)
    curves = {}
    for c, prior in priors.items():
        channel_signals = signals[c].with_scatter(scatter)
        posterior = posterior_under_prior(
            wave, channel_signals.operator, channel_signals.value, channel_signals.std, prior
        )
        common = RADIOMETER_STD * posterior.gain @ errors[c]
        curves[c] = _within(wave, channel_signals, posterior.mean, posterior.covariance, common)
    return curves, scatter


def _solve_together(
    wave: FloatArray, signals: Mapping[str, ChannelSignals], priors: Mapping[str, CurvePrior], scatter: Scatter
) -> dict[str, Sensitivity]:
    """Solve for the sensitivities of channels that share a relative error of each light.

    With errors g of the lights and curves S_c = S_c(0) - G_c D_c g, the channels' signals D_c g + (what the priors and
    their own noise allow, of precision R_c) give g the precision sum(D_c^T R_c D_c) + 1 / std^2. D_c: signals by
    lights; G_c: curve by signals.
    """
    errors = light_errors(signals)
    independent_signals = {
        c: s.without_shared_error(Scatter(independent=scatter.independent)) for c, s in signals.items()
    }
    posteriors = {
        c: posterior_under_prior(wave, s.operator, s.value, s.std, priors[c]) for c, s in independent_signals.items()
    }
    shared = float(np.hypot(RADIOMETER_STD, scatter.common))
    precision = np.sum([errors[c].T @ posterior.precision @ errors[c] for c, posterior in posteriors.items()], axis=0)
    covariance = np.linalg.inv(precision + np.eye(len(precision)) / shared**2)
    error = covariance @ np.sum(
        [errors[c].T @ posterior.precision @ independent_signals[c].value for c, posterior in posteriors.items()],
        axis=0,
    )
    root = np.linalg.cholesky(covariance)
    curves = {}
    for c, posterior in posteriors.items():
        moved = posterior.gain @ errors[c]
        common = moved @ root
        curves[c] = _within(
            wave,
            independent_signals[c],
            posterior.mean - moved @ error,
            posterior.covariance + common @ common.T,
            common,
        )
    return curves


def _prior(wave: FloatArray, signals: ChannelSignals, fine_share: float) -> CurvePrior:
    """Find the prior of a curve in two passes: with uniform roughness, then with the local one and fine structure."""
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
    """Find the most probable curve that isn't below zero nor below what saturated signals say.

    `mean` (m,), `covariance` (m, m) without bounds; `common` (m, lights): see `Sensitivity`.
    """
    bounds = LowerBounds(
        np.concatenate([np.eye(wave.size), signals.saturated]), np.append(np.zeros(wave.size), signals.limit)
    )
    std = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    return Sensitivity(within_bounds(mean, covariance, bounds), std, COVERAGE_FACTOR, covariance, common)
