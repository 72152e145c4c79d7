"""The photon-transfer curve: conversion gain, curvature and dark variances from temporal variances against means."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lab.observables.weighted_lines import least_squares
from sim.spectrum import FloatArray

LINE_LIMIT = 0.7  # of saturation: range of the straight line of EMVA 1288
CURVE_LIMIT = 0.9  # of saturation: range of the curve, whose top levels determine the curvature
CURVATURE_PRIOR = 0.1  # standard deviation of c x_saturation / K; three levels are solvable, twenty don't see it
EXCESS_CHANCE = 1e-3  # probability below which residuals of variances aren't sampling noise
#: Degrees of freedom of the flats below which the test of their scatter misses an error of the model of three times the
#: sampling's (with six it sees that in nine of ten series): the error is then taken as the usual one of real
#: converters, a share of the variance beside the unevenness of the codes over the noise, DN.
LEAST_FREEDOM, USUAL_ERROR, USUAL_CODE_ERROR_DN = 6.0, 0.01, 0.04
SIGNIFICANT_SIGMA = 2.0  # standard deviations, with the error of the model, above which a curvature is used
SECOND_DIFFERENCE_RMS = 12.0**-0.5  # rms of x about its mean over 0..1


@dataclass(frozen=True)
class TransferFit:
    """Photon transfer: v = floor[plane] + gain x + curvature x^2, with x the mean above black, DN, and v the temporal
    variance, DN^2.

    `gain` in DN/e, `curvature` in 1/e per DN, `floor` (planes,). `covariance`: of (gain, curvature, floors...).
    `line_gain`: the straight line of EMVA 1288 through the origin to 70 % of saturation; `by_line`: it was taken for
    `gain`. `curve_gain` and `relative_curvature` (c x_saturation / K) are those of the curve in any case.
    `model_error`, `dark_error`: relative standard deviation of the residuals of the variances of flats and of darks
    beyond sampling. `used` (n,): the points used.
    """

    gain: float
    curvature: float
    floor: FloatArray
    covariance: FloatArray
    chi2: float
    freedom: int
    line_gain: float
    curve_gain: float
    curve_gain_std: float
    relative_curvature: float
    relative_curvature_std: float
    by_line: bool
    model_error: float
    dark_error: float
    used: NDArray[np.bool_]

    @property
    def gain_std(self) -> float:
        """Standard deviation of the gain, DN/e."""
        return float(np.sqrt(self.covariance[0, 0]))


def fit_transfer(
    signal: FloatArray,
    variance: FloatArray,
    variance_std: FloatArray,
    plane: NDArray[np.integer[Any]],
    light: NDArray[np.bool_],
    saturation: float,
) -> TransferFit:
    """Fit conversion gain, curvature and dark variances to photon-transfer points (n,) of all planes.

    signal : mean above black, DN
    variance, variance_std : temporal variance, DN^2, and the standard deviation of its sampling
    plane : index of the plane, 0..
    light : False for darks
    saturation : DN above black; points above 90 % of it are left out, all others are taken as unsaturated

    Source: the photon transfer method of EMVA 1288, section 6; the weights and the curvature: `lab.fit.noise`.

    >>> signal = np.array([0.0, 100.0, 200.0, 300.0, 400.0, 500.0])
    >>> variance = 4.0 + 0.5 * signal
    >>> plane, light = np.zeros(6, int), signal > 0.0
    >>> fit = fit_transfer(signal, variance, 0.01 * variance, plane, light, 1000.0)
    >>> round(fit.gain, 3), round(float(fit.floor[0]), 2)
    (0.5, 4.0)
    """
    points = TransferPoints(signal, variance, variance_std / variance, plane, light, saturation)
    for limit in (CURVE_LIMIT, LINE_LIMIT):
        used = ~light | (signal <= limit * saturation)
        if not used[light].any():  # all flats are in the last tenth
            used = np.ones_like(light)
        curve = points.curve(used, (0.0, 0.0))
        # Near saturation some responses depart from a parabola: then the range is that of EMVA 1288
        if curve.likely or np.sum(light & (signal <= LINE_LIMIT * saturation)) < 4:
            break
    chi2, freedom = curve.chi2, curve.freedom
    errors = points.model_errors(used, curve)
    if any(errors):
        curve = points.curve(used, errors)
    dark_error, model_error = errors
    solution, covariance = curve.solution, curve.covariance
    gain, floor = float(solution[0]), solution[2:]
    # Smooth part of the error of the model: a line in the relative variance with the same rms. At zero signal it is
    # sqrt(3) times its rms; from zero to the end of the range it changes by 1 / SECOND_DIFFERENCE_RMS times its rms.
    highest = float(np.max(signal[used & light], initial=1e-9))
    smooth_gain = np.sqrt(3.0) * model_error * gain
    smooth_curvature = model_error / SECOND_DIFFERENCE_RMS * saturation / highest
    curvature_at_saturation = float(solution[1]) * saturation / gain
    curvature_at_saturation_std = float(np.hypot(np.sqrt(covariance[1, 1]) * saturation / gain, smooth_curvature))
    covariance = covariance.copy()
    covariance[0, 0] += smooth_gain**2
    covariance[1, 1] += (smooth_curvature * gain / saturation) ** 2
    covariance[0, 1] -= smooth_gain * smooth_curvature * gain / saturation
    covariance[1, 0] = covariance[0, 1]
    curve_gain_std = float(np.sqrt(covariance[0, 0]))
    on_line = light & (signal <= LINE_LIMIT * saturation)
    if not on_line.any():
        on_line = light & used
    x, v = signal[on_line], (variance - floor[plane])[on_line]
    line = float(np.sum(x * v) / np.sum(x * x))
    by_line = (
        model_error > 0
        and abs(curvature_at_saturation) < SIGNIFICANT_SIGMA * curvature_at_saturation_std
        and np.unique(plane[~light]).size == floor.size
    )
    curvature = float(solution[1])
    curve_gain = gain
    if by_line:
        for _ in range(3):  # the line begins at the floor; the shot noise of the darks follows from the line
            floor, floor_std, dark_signal = points.dark_variances(dark_error, line)
            v = (variance - floor[plane])[on_line]
            line = float(np.sum(x * v) / np.sum(x * x))
        line_std = float(np.sqrt(np.sum((x * (v - line * x)) ** 2)) / np.sum(x * x))
        # The gain at zero signal is anywhere between those of the line and of the curve, which is uncertain by itself:
        # the mean square of u (curve - line + error) with u uniform in 0..1
        covariance = np.zeros_like(covariance)
        covariance[0, 0] = line_std**2 + ((line - gain) ** 2 + curve_gain_std**2) / 3.0
        covariance[2:, 2:] = np.diag(floor_std**2) + covariance[0, 0] * np.outer(dark_signal, dark_signal)
        covariance[0, 2:] = covariance[2:, 0] = -covariance[0, 0] * dark_signal
        gain, curvature = line, 0.0
    return TransferFit(
        gain=gain,
        curvature=curvature,
        floor=floor,
        covariance=covariance,
        chi2=chi2,
        freedom=freedom,
        line_gain=line,
        curve_gain=curve_gain,
        curve_gain_std=curve_gain_std,
        relative_curvature=curvature_at_saturation,
        relative_curvature_std=curvature_at_saturation_std,
        by_line=bool(by_line),
        model_error=model_error,
        dark_error=dark_error,
        used=used,
    )


@dataclass(frozen=True)
class TransferCurve:
    """A solution of the photon-transfer curve; `residual`, `std`, `fitted` (DN^2) and `leverage` of the points used."""

    solution: FloatArray
    covariance: FloatArray
    chi2: float
    freedom: int
    residual: FloatArray
    std: FloatArray
    fitted: FloatArray
    leverage: FloatArray

    @property
    def likely(self) -> bool:
        """Whether sampling noise explains the residuals."""
        return self.freedom < 1 or bool(special.chdtrc(self.freedom, self.chi2) > EXCESS_CHANCE)


@dataclass(frozen=True)
class TransferPoints:
    """The points (n,) of a photon-transfer curve. `relative`: standard deviation of the sampling of a variance over
    the variance.
    """

    signal: FloatArray
    variance: FloatArray
    relative: FloatArray
    plane: NDArray[np.integer[Any]]
    light: NDArray[np.bool_]
    saturation: float

    def curve(self, used: NDArray[np.bool_], errors: tuple[float, float]) -> TransferCurve:
        """Fit the curve by weighted least squares over the points `used` (n,), with a normal prior on its curvature.

        `errors`: relative errors of the model in darks and in flats, in addition to sampling.
        """
        count = int(self.plane.max()) + 1
        x, v = self.signal[used], self.variance[used]
        basis = np.concatenate([np.stack([x, x**2], axis=1), np.eye(count)[self.plane[used]]], axis=1)
        relative = np.hypot(self.relative, np.where(self.light, errors[1], errors[0]))[used]
        std = relative * v
        prior = np.zeros((1, 2 + count))
        prior[0, 1] = 1.0
        gain = max(float(np.median(np.diff(np.sort(v)) / np.maximum(np.diff(np.sort(x)), 1e-9))), 1e-6)
        for _ in range(4):
            prior_std = np.array([CURVATURE_PRIOR * gain / self.saturation])
            solution, covariance, chi2 = least_squares(
                np.concatenate([basis, prior]), np.append(v, 0.0), np.append(std, prior_std)
            )
            gain = max(float(solution[0]), 1e-6)
            # Weights from the fitted variances: measured ones would bias the fit towards low values
            fitted = np.maximum(basis @ solution, 0.1 * v)
            std = relative * fitted
        leverage = np.einsum("ij,jk,ik->i", basis, covariance, basis) / std**2
        freedom = int(used.sum()) - 2 - count + 1  # the prior counts as one value
        return TransferCurve(solution, covariance, chi2, freedom, v - basis @ solution, std, fitted, leverage)

    def model_errors(self, used: NDArray[np.bool_], curve: TransferCurve) -> tuple[float, float]:
        """Return the relative errors of the model in darks and in flats: those for which chi2 has its expected value; 0
        where sampling explains the residuals, for the flats the usual error where these are too few to tell
        (`LEAST_FREEDOM`).

        Source: Paule and Mandel, J. Res. Natl. Bur. Stand. 87, 377 (1982).
        """
        light = self.light[used]
        squares = [0.0, 0.0]
        least = 0.0
        active = [False, False]
        for index, group in enumerate((~light, light)):
            freedom = float(np.sum(1.0 - curve.leverage[group])) if group.any() else 0.0
            chi2 = float(np.sum((curve.residual[group] / curve.std[group]) ** 2))
            active[index] = freedom >= 1.0 and bool(special.chdtrc(freedom, chi2) < EXCESS_CHANCE)
            if index == 1 and freedom < LEAST_FREEDOM and not active[1] and group.any():
                noise_dn2 = float(np.median(self.variance[used][group]))
                least = USUAL_ERROR**2 + USUAL_CODE_ERROR_DN**2 / noise_dn2
        for _ in range(40):
            before = list(squares)
            for index, group in enumerate((~light, light)):
                if not active[index]:
                    continue
                weighted = (curve.residual[group] / curve.std[group]) ** 2
                excess = float(weighted.sum()) - float(np.sum(1.0 - curve.leverage[group]))
                slope = float(np.sum(weighted * (curve.fitted[group] / curve.std[group]) ** 2))
                squares[index] = max(squares[index] + excess / max(slope, 1e-30), 0.0)
            if np.allclose(squares, before, rtol=1e-3, atol=0.0):
                break
            curve = self.curve(used, (np.sqrt(squares[0]), np.sqrt(squares[1])))
        return float(np.sqrt(squares[0])), float(np.sqrt(max(squares[1], least)))

    def dark_variances(self, error: float, gain: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return, by plane, the variance of the darks less the shot noise of their own signal (`gain` times it), its
        standard deviation, and that signal.
        """
        values, stds, signals = [], [], []
        for index in range(int(self.plane.max()) + 1):
            darks_of_plane = ~self.light & (self.plane == index)
            weight = 1.0 / (np.hypot(self.relative[darks_of_plane], error) * self.variance[darks_of_plane]) ** 2
            values.append(
                float(np.average(self.variance[darks_of_plane] - gain * self.signal[darks_of_plane], weights=weight))
            )
            signals.append(float(np.average(self.signal[darks_of_plane], weights=weight)))
            stds.append(float(weight.sum() ** -0.5))
        return np.array(values), np.array(stds), np.array(signals)
