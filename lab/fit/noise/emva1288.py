"""EMVA Standard 1288, release 4.0 (linear model): the quantities by their definitions, of one plane of the mosaic.

The letter of the standard: unweighted lines, every pixel counted, no shading subtracted, one figure by one formula.
The physical fit of `photon_transfer` is less biased where a camera isn't linear. Two things are added to the letter:
standard deviations (by the noise of the recordings, and by these rows, columns and pixels as a sample of the camera),
and temporal variances over any number of repeats, of which the pair of images of the standard is the smallest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from lab.formats.results import Emva1288, Emva1288Points
from lab.formats.results.words import format_value
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.noise.frame_sums import BoolArray
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.stack import SpatialVariance
from lab.observables.weighted_lines import DarkLine, chi2_factor, dark_line, linearity, root
from sim.spectrum import FloatArray

HIDDEN_DN2 = 0.24  # temporal variance below which rounding hides the noise, of a step of the codes of 1 DN
HIDDEN_DN = 0.40  # the limit that is stated then
LEAST_SIGNAL = 0.01  # of the range of the line: below, the variance is that of the dark
EXCESS_CHANCE = 0.01  # probability below which variances aren't on a straight line
SIGNIFICANT_SIGMA = 3.0  # standard deviations by which two slopes of one line differ
LINE_LIMIT = 0.7  # of saturation: range of responsivity and system gain
LINEARITY_RANGE = (0.05, 0.95)  # of saturation
#: Highest less lowest irradiance over its mean that the standard allows.
LARGEST_NONUNIFORMITY_PERCENT = 3.0
#: Standard deviations of what rows or columns share, from which on it is reported: of 8 such numbers (four planes),
#: one is beyond by chance in 0.03 % of all cameras.
LINE_SIGMA = 4.0
LEAST_PEAK = 0.3  # of the largest variance, from which on a maximum is that of saturation
SPATIAL_IMAGES = 16  # with fewer, the row and column parts contain temporal noise; the standard asks for more


@dataclass(frozen=True)
class EmvaInput:
    """What `emva1288_figures` needs.

    `darks`: of one temperature; `flats`: the level series, of one lamp in ascending light, two or more of each;
    `spatial`: levels that the spatial figures may come from, all flats where it is empty. `in_photons`: `light` counts
    photons per pixel. `saturation_dn`: signal above dark taken for saturation where the flats don't reach it.
    `variance_error`, `lamp_error`: relative errors of a temporal variance beyond sampling, and of a mean.
    `gain_dn_per_e`: by which a drift of a dark's charge changes its variance.
    """

    plane: str
    darks: tuple[MeasuredLevel, ...]
    flats: tuple[MeasuredLevel, ...]
    in_photons: bool
    wavelength_nm: float | None
    saturation_dn: float
    variance_error: float = 0.0
    lamp_error: float = 0.0
    spatial: tuple[MeasuredLevel, ...] = ()
    gain_dn_per_e: float = 0.0


@dataclass(frozen=True)
class Measured:
    """A number with its standard deviation."""

    value: float
    std: float

    def divide_by(self, divisor: Measured) -> Measured:
        """Return the quotient of independent numbers."""
        quotient = self.value / divisor.value
        return Measured(quotient, math.hypot(self.std / divisor.value, quotient * divisor.std / divisor.value))


class EmvaLevels:
    """Means and variances by level, and the same less dark, (levels,) each; `step_dn`: step of the codes."""

    def __init__(self, given: EmvaInput) -> None:
        self.given = given
        self.flats = [level for level in given.flats if level.repeats > 1]
        bright = [level.plane[given.plane] for level in self.flats]
        self.darks = [level for level in given.darks if level.repeats > 1]
        dark = [level.plane[given.plane] for level in self.darks]
        self.step_dn = max((plane.step_dn for plane in (*bright, *dark)), default=1.0)
        self.dark_exposure = np.array([level.exposure_s for level in self.darks])
        self.dark_variance = np.array([plane.temporal_variance for plane in dark])
        drift_dn = np.array([level.drift_std_dn for level in self.darks])
        self.dark_variance_std = np.hypot(
            np.array([plane.temporal_variance_std for plane in dark]), given.gain_dn_per_e * drift_dn
        )
        self.dark_mean = np.array([plane.mean for plane in dark])
        self.dark_mean_std = np.hypot(mean_std(self.darks, given.plane), drift_dn)
        self.mean_line = dark_line(self.dark_exposure, self.dark_mean, self.dark_mean_std)
        self.variance_line = dark_line(self.dark_exposure, self.dark_variance, np.maximum(self.dark_variance_std, 1e-9))
        self.exposure = np.array([level.exposure_s for level in self.flats])
        self.light = np.array([level.light for level in self.flats])
        self.mean = np.array([plane.mean for plane in bright])
        self.variance = np.array([plane.temporal_variance for plane in bright])
        self.variance_std = np.hypot(
            np.array([plane.temporal_variance_std for plane in bright]), given.variance_error * self.variance
        )
        # The dark of the same exposure where there is one, else the line through all darks
        self.source = [self._find_dark(level.exposure_s) for level in self.flats]
        self.below_mean = self.dark_at_levels(self.dark_mean, self.mean_line)
        self.below_variance = self.dark_at_levels(self.dark_variance, self.variance_line)
        self.signal = self.mean - self.below_mean
        lamp_error = np.maximum(given.lamp_error, [level.light_std for level in self.flats])
        self.light_mean_std = np.hypot([plane.mean_std for plane in bright], lamp_error * self.signal)
        self.signal_std = np.hypot(self.light_mean_std, self.dark_at_levels(self.dark_mean_std, None))

    def _find_dark(self, exposure_s: float) -> int | None:
        if not self.dark_exposure.size:
            return None
        nearest = int(np.argmin(np.abs(self.dark_exposure - exposure_s)))
        return nearest if abs(self.dark_exposure[nearest] - exposure_s) <= 1e-6 * exposure_s else None

    def dark_at_levels(self, stack_of: FloatArray, line: DarkLine | None) -> FloatArray:
        """Return the dark value at the exposure of each level; where none was taken, that of the line, or (None) the
        smallest of all.
        """
        return np.array(
            [
                stack_of[source]
                if source is not None
                else (line.at(float(exposure)) if line is not None else float(stack_of.min()))
                for source, exposure in zip(self.source, self.exposure, strict=True)
            ]
        )

    def signal_covariance(self) -> FloatArray:
        """Return the covariance of the signals (levels, levels), DN^2: levels share the error of a dark that both are
        less.
        """
        covariance = np.diag(self.light_mean_std**2)
        for number, std in enumerate(self.dark_mean_std):
            shared = np.array([source == number for source in self.source], float)
            covariance += std**2 * np.outer(shared, shared)
        line = np.array([source is None for source in self.source], float)
        gradient = line[:, None] * np.stack([np.ones_like(self.exposure), self.exposure], axis=1)
        return covariance + gradient @ self.mean_line.covariance @ gradient.T

    def gain(self, used: BoolArray) -> Measured:
        """Return the system gain K: slope through the origin of the variance against the signal, over the levels `used`
        (levels,).
        """
        x = np.where(used, self.signal, 0.0)
        norm = float(np.sum(x * x))
        excess = self.variance - self.below_variance
        value = float(np.sum(x * excess)) / norm
        square = float(np.sum((x * self.variance_std) ** 2))
        # The error of a dark is common to all levels that it is subtracted from
        for number, std in enumerate(self.dark_variance_std):
            square += (float(np.sum(x[[source == number for source in self.source]])) * std) ** 2
        on_line = x[[source is None for source in self.source]]
        if on_line.size:
            lines = self.variance_line.covariance
            t = self.exposure[[source is None for source in self.source]]
            gradient = np.array([on_line.sum(), float(np.sum(on_line * t))])
            square += float(gradient @ lines @ gradient)
        return Measured(value, math.sqrt(square) / norm)


def mean_std(levels: Sequence[MeasuredLevel], name: str) -> FloatArray:
    """Return the standard deviations of the means of a plane: temporal noise and rounding, increased where repeats
    differ by more than by a drift.
    """
    noise, excess, freedom = [], 0.0, 0
    planes = [level.plane[name] for level in levels]
    for level, plane in zip(levels, planes, strict=True):
        least = QUANTISATION_DN2 * plane.step_dn**2
        variance = plane.temporal_variance if np.isfinite(plane.temporal_variance) else least
        noise.append(math.sqrt(max(variance, least) / plane.pixels))
        if plane.repeats > 1:
            rest, free = level.scatter(np.array(plane.frame_means))
            excess += float(np.sum(rest**2)) / noise[-1] ** 2
            freedom += free
    widened = np.array(noise) * math.sqrt(chi2_factor(excess, freedom))
    repeats = np.sqrt([plane.repeats for plane in planes])
    return np.hypot(widened / repeats, [plane.mean_rounding_std for plane in planes])


def mean_ratio(x: FloatArray, y: FloatArray, std: FloatArray, slope: Measured) -> float | None:
    """Return the mean of y / x, where it or the single levels contradict the line y = `slope` x; None where they don't.

    x, y : (levels,)
    std : standard deviations of y by noise, (levels,)
    slope : fitted to the same levels, weighted by noise

    It is the slope of the same line with equal relative weights: where y is proportional to x, both are the same.

    >>> x = np.array([1.0, 2.0, 3.0, 4.0])
    >>> mean_ratio(x, 0.5 * x, np.full(4, 0.01), Measured(0.5, 0.01)) is None
    True
    """
    chosen = x > LEAST_SIGNAL * np.max(x, initial=0.0)
    if np.count_nonzero(chosen) < 3:
        return None
    x, y, std = x[chosen], y[chosen], std[chosen]
    chi2 = float(np.sum(((y - slope.value * x) / std) ** 2))
    ratio = float(np.mean(y / x))
    ratio_std = float(np.sqrt(np.sum((std / x) ** 2))) / x.size
    alike = abs(ratio - slope.value) < SIGNIFICANT_SIGMA * math.hypot(ratio_std, slope.std)
    return None if alike and special.chdtrc(x.size - 1, chi2) > EXCESS_CHANCE else ratio


Figures = dict[str, Measured]


def emva1288_figures(given: EmvaInput) -> Emva1288 | str:
    """Return the figures of one plane, or the reason why there are none."""
    if not any(level.repeats > 1 for level in given.darks):
        return (
            "no repeated darks: EMVA 1288 compares bright with dark pairs; capture two darks at each of the flats' "
            "exposures"
        )
    at = EmvaLevels(given)
    remarks: list[str] = []
    saturation, top = _saturation(at, given, remarks)
    used = at.signal <= LINE_LIMIT * saturation
    if np.count_nonzero(used) < 3:
        return (
            f"{np.count_nonzero(used)} levels of one lamp with repeats up to 70 % of saturation: EMVA 1288 needs "
            "three at least and "
            "asks for fifty; capture more"
        )
    gain = at.gain(used)
    if not gain.value > 3.0 * gain.std:
        return "the temporal variance doesn't grow with the signal: no system gain"
    gain = _widen_gain(at, used, gain, remarks)
    if at.signal.size < 50:
        remarks.append(f"{at.signal.size} levels; the standard asks for 50")
    missing = sum(source is None for source in at.source)
    if missing:
        remarks.append(
            f"{missing} of {at.signal.size} levels have no dark of their exposure: a line through the darks stands "
            "for it"
        )
    figures: Figures = {}
    if given.in_photons:
        figures |= _responsivity(at, used, gain, remarks)
    dark, limit_e = _dark_noise(at, gain, remarks)
    figures |= dark
    figures |= _sensitivity(at, top, gain, figures)
    lines, deviation = _linearity(at, saturation, remarks)
    figures |= lines
    figures |= _dark_current(at, gain, remarks)
    stacks = _stacks(given, at, saturation, remarks)
    figures |= _spatial(given.plane, stacks, gain)
    figures |= _evenness(given.plane, stacks, figures, remarks)
    values_of = {name: value.value for name, value in figures.items()}
    values_of |= {f"{name}_std": value.std for name, value in figures.items()}
    values_of |= _calibration(at, figures, remarks)
    return Emva1288(
        **values_of,
        system_gain_dn_per_e=gain.value,
        system_gain_dn_per_e_std=gain.std,
        temporal_dark_noise_limit_e=limit_e,
        wavelength_nm=given.wavelength_nm if given.in_photons else None,
        points=_plot_points(at, given, deviation, stacks),
        remarks=tuple(remarks),
    )


def _calibration(at: EmvaLevels, figures: Figures, remarks: list[str]) -> dict[str, float]:
    """Return what the calibration of the reference that measured the light adds: a factor common to all numbers of
    photons."""
    relative = max((level.light_calibration_std for level in at.flats), default=0.0)
    if not relative or "quantum_efficiency" not in figures:
        return {}
    remarks.append(
        f"the photodiode's calibration has a standard uncertainty of {100.0 * relative:.2g} %: it is a factor common "
        "to all numbers of photons, "
        "and in none of the standard deviations beside them"
    )
    return {
        "photons_systematic_std_percent": 100.0 * relative,
        "quantum_efficiency_systematic_std": relative * figures["quantum_efficiency"].value,
    }


def _saturation(at: EmvaLevels, given: EmvaInput, remarks: list[str]) -> tuple[float, int | None]:
    """Signal at the level of the largest variance, and its index; None where the flats don't exceed it.

    The search goes from the brightest level down to the first maximum that two darker levels confirm, and that is no
    scatter of levels beyond saturation, whose variance is that of the read-out at most.
    """
    best, index, least = -np.inf, 0, LEAST_PEAK * float(at.variance.max())
    for number in range(at.variance.size - 1, -1, -1):
        if at.variance[number] >= best:
            best, index = float(at.variance[number]), number
        elif at.variance[max(number - 1, 0)] < best and best > least:
            break
    beyond = at.variance[index + 1 :]
    if beyond.size and beyond.min() < at.variance[index] - 3.0 * at.variance_std[index]:
        return float(at.signal[index]), index
    remarks.append(
        "no flat lies beyond the largest temporal variance: the saturation capacity isn't determined, and the ranges "
        "are of "
        f"{given.saturation_dn:.4g} DN above dark"
    )
    return given.saturation_dn, None


def _widen_gain(at: EmvaLevels, used: BoolArray, gain: Measured, remarks: list[str]) -> Measured:
    """Return the system gain with what its line leaves of the variances in its standard deviation."""
    std = np.hypot(at.variance_std, at.dark_at_levels(at.dark_variance_std, None))
    signal = at.signal[used]
    ratio = mean_ratio(signal, (at.variance - at.below_variance)[used], std[used], gain)
    if ratio is None:
        return gain
    # Of a variance K x (1 + a x), the line has K (1 + a A) and the mean ratio K (1 + a B), with A and B the means of x
    # that each weighs: the line's distance from the gain at zero signal is A / (A - B) times that of the two.
    high = signal > LEAST_SIGNAL * np.max(signal)
    line_at, ratio_at = float(np.sum(signal**3) / np.sum(signal**2)), float(np.mean(signal[high]))
    error = (gain.value - ratio) * line_at / max(line_at - ratio_at, 1e-9 * line_at)
    remarks.append(
        "the temporal variances don't lie on the standard's straight line by more than noise: the line has "
        f"{gain.value:.4g} DN/e, the mean of variance over signal {ratio:.4g} DN/e, a parabola at zero signal "
        f"{gain.value - error:.4g} DN/e; the line's difference from that is in the uncertainties of K and of what is "
        "divided by it"
    )
    return Measured(gain.value, math.hypot(gain.std, error))


def _responsivity(at: EmvaLevels, used: BoolArray, gain: Measured, remarks: list[str]) -> Figures:
    light = np.where(used, at.light, 0.0)
    norm = float(np.sum(light * light))
    if norm <= 0:
        return {}
    std = math.sqrt(float(np.sum((light * at.signal_std) ** 2))) / norm
    responsivity = Measured(float(np.sum(light * at.signal)) / norm, std)
    ratio = mean_ratio(at.light[used], at.signal[used], at.signal_std[used], responsivity)
    if ratio is not None:
        remarks.append(
            "the signals aren't proportional to the light within noise: the standard's line has "
            f"{responsivity.value:.5g} DN/photon, the "
            f"mean of signal over light {ratio:.5g} DN/photon; the difference is in the uncertainties of R and of the "
            "quantum efficiency"
        )
        responsivity = Measured(responsivity.value, math.hypot(std, ratio - responsivity.value))
    return {"responsivity_dn_per_photon": responsivity, "quantum_efficiency": responsivity.divide_by(gain)}


def _dark_noise(at: EmvaLevels, gain: Measured, remarks: list[str]) -> tuple[Figures, float | None]:
    """Temporal dark noise at zero exposure, and the limit (e) that is stated where rounding hides it."""
    if np.unique(at.dark_exposure).size >= 3:
        square = Measured(at.variance_line.black, math.sqrt(float(at.variance_line.covariance[0, 0])))
    else:
        shortest = int(np.argmin(at.dark_exposure))
        square = Measured(float(at.dark_variance[shortest]), float(at.dark_variance_std[shortest]))
    hidden_dn2 = HIDDEN_DN2 * at.step_dn**2
    if square.value < hidden_dn2:
        limit_e = HIDDEN_DN * at.step_dn / gain.value
        remarks.append(
            f"the dark variance is {max(square.value, 0.0):.2g} DN^2, below {hidden_dn2:.3g}, where rounding hides "
            f"it: the temporal dark noise is below {limit_e:.3g} e"
        )
        return {}, limit_e
    noise_dn = math.sqrt(square.value)
    noise_e = math.sqrt(square.value - QUANTISATION_DN2 * at.step_dn**2)
    return {
        "temporal_dark_noise_dn": Measured(noise_dn, square.std / (2.0 * noise_dn)),
        "temporal_dark_noise_e": Measured(noise_e, square.std / (2.0 * noise_e)).divide_by(gain),
    }, None


def _sensitivity(at: EmvaLevels, top: int | None, gain: Measured, figures: Figures) -> Figures:
    """Threshold, saturation capacity, largest SNR and dynamic range; in photons where the quantum efficiency is
    known.
    """
    given: Figures = {}
    responsivity = figures.get("responsivity_dn_per_photon")
    efficiency = figures.get("quantum_efficiency")
    dark = figures.get("temporal_dark_noise_dn")
    if dark is not None:
        dark_e = dark.divide_by(gain)
        inner = math.sqrt(dark_e.value**2 + 0.25)
        given["sensitivity_threshold_e"] = Measured(inner + 0.5, dark_e.value * dark_e.std / inner)
        if responsivity is not None:
            # (sqrt(sigma^2 + K^2 / 4) + K / 2) / R hardly depends on K
            photons = (inner + 0.5) * gain.value / responsivity.value
            parts = (
                dark_e.value / inner * dark.std / responsivity.value,
                (0.5 + 0.25 / inner) * gain.std / responsivity.value,
                photons * responsivity.std / responsivity.value,
            )
            given["sensitivity_threshold_photons"] = Measured(photons, math.hypot(*parts))
    if top is None:
        return given
    # The largest variance lies between the neighbours of this level
    step = float(np.abs(np.diff(at.signal[max(top - 1, 0) : top + 2])).mean()) / math.sqrt(12.0)
    signal = Measured(float(at.signal[top]), step)
    if efficiency is not None:
        light = Measured(float(at.light[top]), float(at.light[top]) * step / signal.value)
        full = Measured(
            light.value * efficiency.value,
            math.hypot(light.std * efficiency.value, light.value * efficiency.std),
        )
        given["saturation_capacity_photons"] = light
        if "sensitivity_threshold_photons" in given:
            given["dynamic_range"] = light.divide_by(given["sensitivity_threshold_photons"])
    else:
        full = signal.divide_by(gain)
        if dark is not None:
            threshold_dn = math.sqrt(dark.value**2 + gain.value**2 / 4.0) + gain.value / 2.0
            given["dynamic_range"] = signal.divide_by(Measured(threshold_dn, math.hypot(dark.std, gain.std)))
    given["saturation_capacity_e"] = full
    given["snr_max"] = Measured(math.sqrt(full.value), full.std / (2.0 * math.sqrt(full.value)))
    return given


def _linearity(at: EmvaLevels, saturation: float, remarks: list[str]) -> tuple[Figures, FloatArray]:
    """LE, and each level's deviation from the line (percent; NaN outside its range)."""
    deviation = np.full(at.signal.size, np.nan)
    low, high = LINEARITY_RANGE
    chosen = (at.signal >= low * saturation) & (at.signal <= high * saturation)
    if np.unique(at.light[chosen]).size < 4:
        remarks.append("fewer than four levels between 5 and 95 % of saturation: no linearity error")
        return {}, deviation
    line = linearity(at.light[chosen], at.signal[chosen], at.signal_covariance()[np.ix_(chosen, chosen)])
    deviation[chosen] = line.deviation_percent
    return {"linearity_error_percent": Measured(line.error_percent, line.error_percent_std)}, deviation


def _dark_current(at: EmvaLevels, gain: Measured, remarks: list[str]) -> Figures:
    """From the mean and from the variance, against exposure (three exposures or more)."""
    if np.unique(at.dark_exposure).size < 3:
        remarks.append("darks of fewer than three exposures: no dark current")
        return {}
    figures: Figures = {}
    mean, variance = at.mean_line, at.variance_line
    hidden = float(at.dark_variance.min()) < HIDDEN_DN2 * at.step_dn**2
    if hidden and mean.rate is not None and abs(mean.rate) < 3.0 * math.sqrt(float(mean.covariance[1, 1])):
        remarks.append("rounding hides the dark current, which the means of the darks don't show")
    elif mean.rate is not None:
        rate = Measured(mean.rate, math.sqrt(float(mean.covariance[1, 1])))
        figures["dark_current_from_mean_e_per_s"] = rate.divide_by(gain)
    if variance.rate is not None and not hidden:
        rate = Measured(variance.rate, math.sqrt(float(variance.covariance[1, 1])))
        square = Measured(gain.value**2, 2.0 * gain.value * gain.std)
        figures["dark_current_from_variance_e_per_s"] = rate.divide_by(square)
    return figures


@dataclass(frozen=True)
class _Stacks:
    """The dark and the bright stack of the spatial figures; None: there isn't one."""

    dark: MeasuredLevel | None
    bright: MeasuredLevel | None


def _stacks(given: EmvaInput, at: EmvaLevels, saturation: float, remarks: list[str]) -> _Stacks:
    """Return the level of most images near half of saturation, and the dark of most images nearest to its exposure."""

    every = EmvaLevels(replace(given, flats=given.spatial)) if given.spatial else at

    def half(number: int) -> tuple[int, float]:
        return every.flats[number].repeats, -abs(every.signal[number] / saturation - 0.5)

    near = [k for k in range(every.signal.size) if 0.3 <= every.signal[k] / saturation <= 0.7]
    bright = every.flats[max(near, key=half)] if near else None
    exposure_s = bright.exposure_s if bright is not None else 0.0
    dark = max(at.darks, key=lambda level: (level.repeats, -abs(level.exposure_s - exposure_s)), default=None)
    if bright is None:
        remarks.append("no level between 30 and 70 % of saturation: no PRNU1288")
    least = min((level.repeats for level in (dark, bright) if level is not None), default=0)
    if least < SPATIAL_IMAGES:
        remarks.append(
            f"the spatial stacks have {least} images: the rows' and columns' parts carry more temporal noise than the "
            "standard means"
        )
    if dark is not None and bright is not None and abs(dark.exposure_s - exposure_s) > 1e-3 * exposure_s:
        remarks.append(
            f"the dark stack was exposed for {1e3 * dark.exposure_s:.3g} ms, the bright one for "
            f"{1e3 * exposure_s:.3g} ms; the standard "
            "asks for the same"
        )
    return _Stacks(dark, bright)


def _spatial(plane: str, stacks: _Stacks, gain: Measured) -> Figures:
    figures: Figures = {}
    dark = stacks.dark.plane[plane].every_pixel if stacks.dark is not None else None
    if dark is None:
        return figures
    for name, square in _parts(dark).items():
        figures[f"dsnu{name}_e"] = Measured(*root(square.value, square.std)).divide_by(gain)
    bright = stacks.bright.plane[plane].every_pixel if stacks.bright is not None else None
    if bright is None or stacks.bright is None or stacks.dark is None:
        return figures
    signal = stacks.bright.plane[plane].mean_of_all - stacks.dark.plane[plane].mean_of_all
    below = _parts(dark)
    for name, square in _parts(bright).items():
        # Both stacks contain the same dark pattern: only the uncertainty of its measurement counts
        root_dn = Measured(*root(square.value - below[name].value, math.hypot(square.std, below[name].std)))
        figures[f"prnu{name}_percent"] = Measured(100.0 * root_dn.value / signal, 100.0 * root_dn.std / signal)
    return figures


def _evenness(plane: str, stacks: _Stacks, figures: Figures, remarks: list[str]) -> Figures:
    """Split the nonuniformity of the bright stack into the smooth surface and what rows and columns share without it,
    and report light that is more uneven than the standard asks for, and gains of rows and columns."""
    if stacks.bright is None or stacks.dark is None or "prnu_percent" not in figures:
        return {}
    bright, dark = stacks.bright.plane[plane], stacks.dark.plane[plane]
    if bright.pattern is None or dark.pattern is None or bright.every_pixel is None:
        return {}
    signal = bright.mean_of_all - dark.mean_of_all
    span, span_std = bright.shading_span
    uneven = Measured(100.0 * span / signal, 100.0 * span_std / signal)
    smooth_dn = Measured(*root(bright.every_pixel.total - bright.pattern.total, bright.every_pixel.total_std))
    shading = Measured(100.0 * smooth_dn.value / signal, 100.0 * smooth_dn.std / signal)
    more = {"light_nonuniformity_percent": uneven, "shading_percent": shading}
    if uneven.value - SIGNIFICANT_SIGMA * uneven.std > LARGEST_NONUNIFORMITY_PERCENT:
        rest = _without_dark(bright.pattern.total, dark.pattern.total)
        remarks.append(
            f"the light is uneven by {format_value(uneven.value, uneven.std, '%')} (highest less lowest over the "
            f"mean), above the standard's limit of {LARGEST_NONUNIFORMITY_PERCENT:g} %: PRNU1288 of "
            f"{figures['prnu_percent'].value:.3g} % is {shading.value:.3g} % of shading and "
            f"{100.0 * rest / signal:.4g} % without it; light the sensor evenly, without a lens"
        )
    for line in ("row", "column"):
        bright_variance, dark_variance = getattr(bright.pattern, f"{line}s"), getattr(dark.pattern, f"{line}s")
        std = math.hypot(getattr(bright.pattern, f"{line}s_std"), getattr(dark.pattern, f"{line}s_std"))
        gains = Measured(*(100.0 * part / signal for part in root(bright_variance - dark_variance, std)))
        more[f"{line}_gain_percent"] = gains
        if bright_variance - dark_variance > LINE_SIGMA * std:
            remarks.append(
                f"the gains of {line}s differ by {format_value(gains.value, gains.std, '%')} (standard deviation, "
                f"shading removed), {(bright_variance - dark_variance) / std:.0f} standard deviations above what "
                "independent pixels give: "
                f"amplifiers or converters of the {line}s; correct each {line} by its own flat field"
            )
    return more


def _without_dark(bright_dn2: float, dark_dn2: float) -> float:
    """Return the standard deviation, DN, of a pattern less that of the dark."""
    return math.sqrt(max(bright_dn2 - dark_dn2, 0.0))


def _parts(split: SpatialVariance) -> dict[str, Measured]:
    return {
        "": Measured(split.total, split.total_std),
        "_row": Measured(split.rows, split.rows_std),
        "_column": Measured(split.columns, split.columns_std),
        "_pixel": Measured(split.pixels, split.pixels_std),
    }


def _plot_points(at: EmvaLevels, given: EmvaInput, deviation: FloatArray, stacks: _Stacks) -> Emva1288Points:
    def values_of(values: FloatArray) -> tuple[float, ...]:
        return tuple(float(value) for value in values)

    dark, bright = stacks.dark, stacks.bright
    return Emva1288Points(
        light_unit="photons" if given.in_photons else "s",
        light=values_of(at.light),
        exposure_s=values_of(at.exposure),
        mean_dn=values_of(at.mean),
        variance_dn2=values_of(at.variance),
        dark_mean_dn=values_of(at.below_mean),
        dark_variance_dn2=values_of(at.below_variance),
        linearity_deviation_percent=tuple(None if np.isnan(value) else float(value) for value in deviation),
        signal_dn_std=values_of(at.signal_std),
        excess_variance_dn2_std=values_of(np.hypot(at.variance_std, at.dark_at_levels(at.dark_variance_std, None))),
        dark_exposure_s=values_of(at.dark_exposure),
        dark_exposure_mean_dn=values_of(at.dark_mean),
        dark_exposure_mean_dn_std=values_of(at.dark_mean_std),
        dark_exposure_variance_dn2=values_of(at.dark_variance),
        dark_exposure_variance_dn2_std=values_of(at.dark_variance_std),
        stack_dark_exposure_s=dark.exposure_s if dark is not None else None,
        stack_dark_images=dark.repeats if dark is not None else None,
        stack_light=bright.light if bright is not None else None,
        stack_exposure_s=bright.exposure_s if bright is not None else None,
        stack_images=bright.repeats if bright is not None else None,
    )
