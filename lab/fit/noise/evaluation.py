"""The evaluation of the levels: which serve the lines, what their means scatter, and the state that this leaves for all
figures."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lab.errors import NotDetermined
from lab.formats.recording_set import DataSheet
from lab.formats.results import InconsistentLevel
from lab.observables.flats.level_lines import (
    CLIPPED_LIMIT,
    DarkSignal,
    RobustResponse,
    Saturation,
    dark_lines,
    refuse_light_darks,
    robust_response,
    saturation_of,
)
from lab.observables.noise.levels import LEAST_REACH, MeasuredLevel, RecordedLevels, Remarks
from lab.observables.weighted_lines import least_squares
from sim.spectrum import FloatArray

# --- The photon-transfer curve: conversion gain, curvature and dark variances from temporal variances against means ---


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
    """Conversion gain, curvature and dark variances from points (n,) of all planes.

    `signal`: mean above black, DN. `variance`: temporal variance, DN^2, with the standard deviation of its sampling.
    `plane`: index 0.. . `light`: False for darks. `saturation`: DN above black. All points are taken as unsaturated;
    those above 90 % of saturation are left out. The method: `lab.fit.noise`.
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
        """Weighted least squares of the curve over the points `used` (n,), with a normal prior on its curvature.

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
        """Relative errors of the model in darks and in flats: those for which chi2 has its expected value; 0 where
        sampling explains the residuals, for the flats the usual error where these are too few to tell
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
        """By plane: variance of the darks less the shot noise of their own signal (`gain` times it), its standard
        deviation, and that signal.
        """
        values, stds, signals = [], [], []
        for index in range(int(self.plane.max()) + 1):
            own = ~self.light & (self.plane == index)
            weight = 1.0 / (np.hypot(self.relative[own], error) * self.variance[own]) ** 2
            values.append(float(np.average(self.variance[own] - gain * self.signal[own], weights=weight)))
            signals.append(float(np.average(self.signal[own], weights=weight)))
            stds.append(float(weight.sum() ** -0.5))
        return np.array(values), np.array(stds), np.array(signals)


# --- level consistency ---------------------------------------------------------------------------------------------
# Which flats serve the lines of responsivity, linearity and gain: the level series without what contradicts it.
#
# A level whose stated light (photon number or exposure) contradicts the others is left out of the lines and named. So
# is a spatial stack, of which EMVA 1288 asks for many images at one level: it serves PRNU and DSNU.


STACK_REPEATS = 4  # times the median number of repeats, from which a level is a spatial stack
LEAST_SERIES = 5  # levels that have to remain where the stacks are left out
SEED = 1288  # of the subsets of levels that the robust fit draws


@dataclass(frozen=True)
class LevelConsistency:
    """Flats by what they serve. `inconsistent`: their stated light contradicts the others; `stacks`: spatial stacks;
    `series`: the rest. `scatter`: relative standard deviation of the levels of the main lamp about a smooth response
    beyond noise, 0 where noise explains it; `noise`: their relative rms by noise.
    """

    series: tuple[MeasuredLevel, ...]
    stacks: tuple[MeasuredLevel, ...]
    inconsistent: tuple[InconsistentLevel, ...]
    scatter: float
    noise: float


def level_consistency(
    recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation, remarks: Remarks
) -> LevelConsistency:
    """Judge the flats of each lamp against each other, and report those that contradict the others."""
    found: dict[int, InconsistentLevel] = {}
    scatter, noise, judged = 0.0, 0.0, 0
    for lamp in dict.fromkeys(level.lamp for level in recorded.flats):
        own = [level for level in recorded.flats if level.lamp == lamp]
        laws = _laws(own, [level.light for level in own], recorded, dark, saturation)
        if not laws:
            continue
        if len(own) > judged:
            scatter = float(np.mean([law.scatter for law in laws.values()]))
            noise, judged = float(np.mean([law.noise for law in laws.values()])), len(own)
        votes = np.mean([law.outlier for law in laws.values()], axis=0) >= 0.5
        for number in np.flatnonzero(votes):
            level = own[number]
            found[id(level)] = _described(level, int(number), laws, recorded, dark, lamp)
            sources = _source(own, int(number), recorded, dark, saturation)
            remarks.add(_sentence(found[id(level)], sources))
    rest = [level for level in recorded.flats if id(level) not in found]
    median = float(np.median([level.repeats for level in recorded.flats]))
    series = [level for level in rest if level.repeats < STACK_REPEATS * median]
    if len({level.light for level in series}) < LEAST_SERIES:
        series = rest
    kept = set(map(id, series))
    return LevelConsistency(
        tuple(series),
        tuple(level for level in rest if id(level) not in kept),
        tuple(found.values()),
        scatter,
        noise,
    )


def _laws(
    own: Sequence[MeasuredLevel],
    light: Sequence[float],
    recorded: RecordedLevels,
    dark: DarkSignal,
    saturation: Saturation,
) -> dict[str, RobustResponse]:
    """Response of each plane to `light` (levels,)."""
    places = {id(level): number for number, level in enumerate(recorded.flats)}
    found = {}
    for name in recorded.names:
        signal = np.array([level.plane[name].mean - dark.mean_dn(name, level.exposure_s) for level in own])
        noise = np.array([level.plane[name].mean_std for level in own])
        noise = np.where(np.isfinite(noise), noise, np.nanmax(noise, initial=0.0))
        clipped = np.array([saturation.clipped[name][places[id(level)]] for level in own])
        std = np.maximum(np.hypot(noise, _dark_scatter_dn(recorded, dark, name)), 1e-6 * saturation.signal_dn[name])
        law = robust_response(
            np.array(light), signal, std, saturation.signal_dn[name], clipped, np.random.default_rng(SEED)
        )
        if law is not None:
            found[name] = law
    return found


def _dark_scatter_dn(recorded: RecordedLevels, dark: DarkSignal, name: str) -> float:
    """Standard deviation of dark means about their line, DN: each flat has its own dark subtracted."""
    steady = [level for level in recorded.darks if level.drift is None]
    if len(steady) < 4:
        return 0.0
    line = dark.lines[name]
    rest = [level.plane[name].mean - line.at(level.exposure_s) for level in steady]
    return float(np.sqrt(np.sum(np.square(rest)) / (len(rest) - 2)))


def _described(
    level: MeasuredLevel,
    number: int,
    laws: dict[str, RobustResponse],
    recorded: RecordedLevels,
    dark: DarkSignal,
    lamp: Hashable,
) -> InconsistentLevel:
    signal = [level.plane[name].mean - dark.mean_dn(name, level.exposure_s) for name in laws]
    photons = isinstance(lamp, tuple) and len(lamp) > 1 and bool(lamp[1])
    return InconsistentLevel(
        captures=level.captures,
        exposure_s=level.exposure_s,
        light=level.light,
        light_unit="photons" if photons else "s",
        expected_light=float(np.median([law.expected_light[number] for law in laws.values()])),
        signal_dn=float(np.mean(signal)),
        expected_signal_dn=float(np.mean([law.expected_signal[number] for law in laws.values()])),
    )


def _source(
    own: Sequence[MeasuredLevel], number: int, recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation
) -> str:
    """Return what the exposure says where the light is a number of photons of its own."""
    level = own[number]
    if level.light == level.exposure_s:
        return "either the exposure or the frames are of another level"
    exposures = [each.exposure_s for each in own]
    if len(set(exposures)) < LEAST_SERIES:
        return "either the photon number or the frames are of another level"
    laws = _laws(own, exposures, recorded, dark, saturation)
    if not laws:
        return "either the photon number or the frames are of another level"
    if np.mean([law.outlier[number] for law in laws.values()]) >= 0.5:
        return "its exposure contradicts them too, so that the frames may be of another level"
    return "its exposure agrees with them, so that the photon number is wrong"


def _sentence(level: InconsistentLevel, source: str) -> str:
    unit = "photons" if level.light_unit == "photons" else "s"
    named = ", ".join(level.captures[:1]) + (f" .. {level.captures[-1]}" if len(level.captures) > 1 else "")
    which = f"{len(level.captures)} captures {named}" if level.captures else f"exposure {level.exposure_s:g} s"
    return (
        f"one level contradicts the others and is left out of responsivity, linearity and gain: {which}, stated "
        f"{level.light:.6g} {unit}, "
        f"has {level.signal_dn:.4g} DN above dark, where the others have {level.expected_signal_dn:.4g} DN; they have "
        "its signal at "
        f"{level.expected_light:.6g} {unit}; {source}: correct it"
    )


# --- lamp drift ----------------------------------------------------------------------------------------------------
# Drift of the lamp between the repeats of a level.


DRIFT_CHANCE = 1e-4  # probability below which differences of repeats are a drift


@dataclass(frozen=True)
class LampDrift:
    """Differences of the means of repeats from that of their level.

    `relative`: standard deviation beyond noise, relative to the signal; 0 where noise explains it. `std_dn`: standard
    deviation; `noise_dn`: that by noise.
    """

    relative: float
    std_dn: float
    noise_dn: float


def lamp_drift(recorded: RecordedLevels, dark: DarkSignal, saturation: Saturation) -> LampDrift:
    """Differences of the means of repeated flats, over all unsaturated levels and planes."""
    relative, square, expected, chi2, freedom = 0.0, 0.0, 0.0, 0.0, 0
    for level in recorded.flats:
        own = [n for n in recorded.names if not saturation.clipped[n][recorded.flats.index(level)]]
        if level.repeats < 2 or not own:
            continue
        planes = [level.plane[n] for n in own]
        pixels = np.array([plane.pixels for plane in planes], float)
        frames = np.average([plane.frame_means for plane in planes], axis=0, weights=pixels)
        variance = float(np.average([plane.temporal_variance for plane in planes], weights=pixels))
        rounding = max(plane.mean_rounding_std for plane in planes)
        noise = max(variance, recorded.quantisation_dn2) / pixels.sum() + rounding**2
        signal = float(
            np.average([p.mean - dark.lines[n].black for p, n in zip(planes, own, strict=True)], weights=pixels)
        )
        rest = float(np.sum((frames - frames.mean()) ** 2))
        square += rest
        expected += noise * (len(frames) - 1)
        chi2 += rest / noise
        relative += (rest - noise * (len(frames) - 1)) / max(signal, 1.0) ** 2
        freedom += len(frames) - 1
    if freedom == 0:
        return LampDrift(0.0, 0.0, 0.0)
    chance = float(special.chdtrc(freedom, chi2))
    if chance > DRIFT_CHANCE or relative <= 0:
        relative = 0.0
    return LampDrift(
        float(np.sqrt(relative / freedom)), float(np.sqrt(square / freedom)), float(np.sqrt(expected / freedom))
    )


# --- evaluation ----------------------------------------------------------------------------------------------------
# The state of a noise fit once its photon transfer is solved: what all figures rest on.


MIN_LEVELS = 3


@dataclass(frozen=True)
class Evaluation:
    """One photon transfer and what it rests on; `points` are its (level, plane), in the order of `transfer.used`."""

    levels: RecordedLevels
    dark: DarkSignal
    saturation: Saturation
    consistency: LevelConsistency
    transfer: TransferFit
    points: list[tuple[MeasuredLevel, str]]
    remarks: Remarks

    @cached_property
    def plane_index(self) -> dict[str, int]:
        """Index of each plane in `transfer.floor`."""
        present = {name for _, name in self.points}
        return {name: index for index, name in enumerate(name for name in self.levels.names if name in present)}

    @cached_property
    def drift(self) -> LampDrift:
        """Drift of the lamp between repeats."""
        return lamp_drift(self.levels, self.dark, self.saturation)

    @cached_property
    def dark_drift_dn(self) -> float:
        """Standard deviation of the means of repeated dark frames about that of their level, DN."""
        return self.dark_scatter_dn(self.levels.darks)

    def dark_scatter_dn(self, darks: Sequence[MeasuredLevel]) -> float:
        """Return the standard deviation of the means of repeated frames of `darks` about that of their level, DN."""
        rests = [
            np.array(level.plane[name].frame_means) - level.plane[name].mean
            for level in darks
            for name in self.levels.names
            if level.repeats > 1
        ]
        freedom = sum(rest.size - 1 for rest in rests)
        return float(np.sqrt(sum(float(rest @ rest) for rest in rests) / freedom)) if freedom else 0.0

    @cached_property
    def reach(self) -> float:
        """Highest level of the photon transfer, as a share of saturation."""
        return max(
            (
                (level.plane[name].mean - self.dark.lines[name].black) / self.saturation.signal_dn[name]
                for (level, name), used in zip(self.points, self.transfer.used, strict=True)
                if used and level.lamp != "dark"
            ),
            default=0.0,
        )

    @property
    def reaches_saturation(self) -> bool:
        """Whether figures at saturation can be given (`LEAST_REACH`)."""
        return self.reach >= LEAST_REACH

    @property
    def light_scatter(self) -> float:
        """Relative standard deviation of a level's mean beyond noise: between its repeats, or about a smooth
        response."""
        return max(self.drift.relative, self.consistency.scatter)


def evaluate(
    darks: Sequence[MeasuredLevel],
    flats: Sequence[MeasuredLevel],
    camera: DataSheet,
    gain_db: float,
    defects: int,
    names: tuple[str, ...],
) -> Evaluation:
    """Solve the photon transfer of the planes `names`. Raises `NotDetermined` where the levels don't determine it."""
    remarks = Remarks()
    recorded = RecordedLevels.of(darks, flats, camera, gain_db, defects, names, remarks)
    dark = DarkSignal(recorded.darks, dark_lines(recorded, remarks))
    refuse_light_darks(recorded, dark)
    saturation = saturation_of(recorded, dark)
    consistency = level_consistency(recorded, dark, saturation, remarks)
    # the mean of repeats that drift isn't that of the charge behind their variance
    steady = tuple(level for level in recorded.darks if level.drift is None)
    transfer, points = transfer_of(recorded, dark, saturation, steady or recorded.darks, consistency.series)
    evaluation = Evaluation(recorded, dark, saturation, consistency, transfer, points, remarks)
    _remark_on_transfer(evaluation)
    return evaluation


def transfer_of(
    recorded: RecordedLevels,
    dark: DarkSignal,
    saturation: Saturation,
    darks: Sequence[MeasuredLevel],
    series: Sequence[MeasuredLevel],
) -> tuple[TransferFit, list[tuple[MeasuredLevel, str]]]:
    """Photon transfer of `darks` and the unsaturated flats with repeats of the `series`, and its points (level, plane).

    Raises `NotDetermined` where fewer than three unsaturated flat levels have repeats, or where the variance doesn't
    grow with the signal.
    """
    points: list[tuple[MeasuredLevel, str]] = []
    x, v, s, plane, light = [], [], [], [], []
    for level in (*darks, *series):
        bright = level.lamp != "dark"
        for index, name in enumerate(recorded.names):
            own = level.plane[name]
            if own.repeats < 2 or own.temporal_variance <= 0:
                continue
            if bright and (saturation.clipped[name][recorded.flats.index(level)] or own.zero_share > CLIPPED_LIMIT):
                continue
            points.append((level, name))
            x.append(own.mean - dark.lines[name].black)
            v.append(own.temporal_variance)
            s.append(own.temporal_variance_std)
            plane.append(index)
            light.append(bright)
    bright_levels = {level.light for level, _ in points if level.lamp != "dark"}
    if len(bright_levels) < MIN_LEVELS:
        repeated = sum(level.repeats > 1 for level in recorded.flats)
        alike = [
            level
            for level in recorded.flats
            if level.repeats > 1 and all(level.plane[name].temporal_variance == 0 for name in recorded.names)
        ]
        if len(alike) == repeated > 0:
            raise NotDetermined(
                "noise",
                f"the repeats of all {repeated} flat levels are alike, pixel by pixel: give frames that were captured "
                "one by one, not "
                "copies, or raise the gain until noise shows",
            )
        raise NotDetermined(
            "noise",
            f"{len(bright_levels)} unsaturated flat levels with repeats (of {len(recorded.flats)} levels, {repeated} "
            "with repeats), "
            f"{MIN_LEVELS} needed: capture two frames or more at each of several exposures below saturation",
        )
    # Planes without points (all flats clip, no darks) have no floor
    present = sorted(set(plane))
    compact = np.searchsorted(present, plane)
    transfer = fit_transfer(
        np.array(x), np.array(v), np.array(s), compact, np.array(light), max(saturation.signal_dn.values())
    )
    if transfer.gain <= 0 or transfer.gain < 3.0 * transfer.gain_std:
        raise NotDetermined(
            "noise",
            "the temporal variance doesn't grow with the signal: capture repeats of flats that are steady and "
            "unprocessed",
        )
    return transfer, points


def _remark_on_transfer(e: Evaluation) -> None:
    """Report an error of the model, a straight line taken for the gain, and a significant curvature."""
    t = e.transfer
    if t.model_error > 0:
        e.remarks.add(
            f"the variances of the flats depart from their curve by {100 * t.model_error:.2g} % (rms) beyond what "
            "sampling explains "
            "(an uneven converter does that): it is in the uncertainties"
        )
    share = 1.0 if e.reaches_saturation else e.reach
    at = "at saturation" if e.reaches_saturation else f"at the highest level, {100 * e.reach:.2g} % of saturation"
    bend, bend_std = 100 * share * t.relative_curvature, 100 * share * t.relative_curvature_std
    if not e.reaches_saturation:
        e.remarks.add(
            f"the highest level of the photon transfer is {100 * e.reach:.2g} % of saturation, "
            f"{100 * LEAST_REACH:.0f} % are needed: curvatures at "
            "saturation aren't given; expose longer, or correct bit_depth or white_level_dn"
        )
    if t.by_line:
        e.remarks.add(
            f"the bend of the variances ({bend:+.1f} +- {bend_std:.1f} % {at}) isn't "
            "significant against that: the conversion gain is EMVA's straight line to 70 % of saturation; at zero "
            "signal "
            f"the curve has {t.curve_gain:.4g} +- {t.curve_gain_std:.2g} DN/e"
        )
    elif abs(t.relative_curvature) > 4.0 * t.relative_curvature_std:
        e.remarks.add(
            f"the variance bends by {bend:+.1f} +- {bend_std:.1f} % of its line {at} "
            "(nonlinear response or brighter-fatter); the conversion gain is that at zero signal"
        )


def in_electrons(e: Evaluation, value: float, std: float) -> tuple[float, float]:
    """Return a `value` in DN with its standard deviation in electrons, with that of the gain."""
    gain = e.transfer.gain
    return value / gain, float(np.hypot(std / gain, value * e.transfer.gain_std / gain**2))
