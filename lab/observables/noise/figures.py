"""First estimates of black level, dark current, gain, read noise and PRNU, and of the repeatability of levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.results import NoiseFit
from lab.observables.codes.rounding import (
    QUANTISATION_DN2,
    rounding_std_dn,
    rounding_waves_dn,
    variance_before_rounding,
)
from lab.observables.flats.level_lines import mean_and_std
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.repeatability import (
    USUAL_LAMP,
    RepeatedMeans,
    level_repeatability,
    repeated_levels,
    scatter_beyond_noise,
    steady,
)
from lab.observables.weighted_lines import dark_line
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.observables.dataset import Dataset

STATED_BLACK_SHARE, STATED_BLACK_DN = 0.03, 2.0  # standard deviation of a stated black level, relative and absolute
# of codes of a step of 1 DN; codes of a larger step have as many steps
BLACK_FLOOR_DN = 0.01  # standard deviation of a frame's mean beside noise
USUAL_JITTER_DN = 0.02  # usual standard deviation of a dark frame's mean, from repeat to repeat
USUAL_JITTER_FREEDOM = 2.0  # degrees of freedom that count for the usual one
UNKNOWN_JITTER_DN = 0.05  # where no dark frames are repeated
USUAL_PRNU = 0.008  # where no flats tell
LEAST_SIZE_PX = 8  # least side of frames whose noise is measured
ALIKE_C = 2.0  # dark captures whose temperatures differ by less than this from the nearest count as of one temperature


@dataclass(frozen=True)
class NoiseFigures:
    """First estimates, good to a few per cent. Predictions are linear in the nuisance parameters about these."""

    black: float  # DN
    dark_dn_per_s: float
    dark_c: float | None  # temperature of the sensor that the dark current holds for
    gain: float  # DN/e; 1 where nothing tells it
    gain_is_known: bool
    read_dn: float
    prnu: float  # relative
    jitter_dn: float  # standard deviation of a dark frame's mean, from repeat to repeat, beyond its pixels' noise
    jitter_dn2_std: float  # standard deviation of its square; 0: no dark frames are repeated
    jitter_lamp: float  # relative standard deviation of a flat frame's mean, from repeat to repeat
    black_std: float  # standard deviation of `black`
    dark_std: float  # standard deviation of `dark_dn_per_s`
    step_dn: float = 1.0  # of the codes
    #: The same as `jitter_dn` about a trend, a decay or a step of the repeats in time.
    white_jitter_dn: float = 0.0

    def spread_dn2(self, signal_dn: FloatArray) -> FloatArray:
        """Variance (DN^2) of pixels at a signal before rounding: shot noise, read noise (0 where rounding hides it),
        PRNU."""
        return np.asarray(
            self.gain * signal_dn
            + variance_before_rounding(self.read_dn**2, self.step_dn)
            + (self.prnu * signal_dn) ** 2
        )

    def rounding_std_dn(self, signal_dn: FloatArray) -> FloatArray:
        """Standard deviation (DN) of means of pixels at a signal by rounding to the step of the codes."""
        return rounding_std_dn(self.spread_dn2(signal_dn), self.step_dn)

    def rounding_waves_dn(self, level_dn: FloatArray) -> list[FloatArray]:
        """Errors (DN) that rounding may leave in means at levels above black, one standard deviation each."""
        return rounding_waves_dn(level_dn, self.spread_dn2(level_dn), self.step_dn)

    @property
    def quantisation_dn2(self) -> float:
        """Variance of rounding to the step of the codes, DN^2."""
        return QUANTISATION_DN2 * self.step_dn**2


def noise_figures(dataset: Dataset) -> NoiseFigures:
    """Return the noise fit's gain, black level, dark current and PRNU where there is a fit; else first estimates from
    dark and flat captures. The read noise is that of the dark frames as recorded, rounding included. What these don't
    determine is taken from the data sheet, else a usual value.

    Without a fit, the gain is the slope of temporal variance over signal of repeated flats, else the stated one, else
    that of any repeats."""
    first = _as_stated(dataset)
    if min(dataset.camera.rows, dataset.camera.cols) < LEAST_SIZE_PX:
        return first
    first = _from_darks(dataset, first)
    fitted = dataset.fitted
    if fitted is not None and fitted.conversion_gain_dn_per_e is not None:
        return _as_fitted(dataset, first, fitted, fitted.conversion_gain_dn_per_e)
    signal, variance, prnu = _transfer_points(dataset, first.black)
    gain, lamp = dataset.stated.conversion_gain_dn_per_e, USUAL_LAMP
    if len(signal) > 1:
        s, v = np.array(signal), np.array(variance)
        low = s < 0.5 * (dataset.saturation_dn - first.black)
        use = low if low.sum() > 2 else np.ones_like(low)
        gain = _transfer_slope(s[use], v[use], first.read_dn)
        lamp = level_repeatability(repeated_levels(dataset, first.black, gain, first.read_dn))
    elif gain is None:
        gain = _scene_gain(dataset, first.black, first.read_dn)
    if gain is None or gain <= 0:
        return replace(first, prnu=prnu, jitter_lamp=lamp)
    return replace(first, gain=gain, gain_is_known=True, prnu=prnu, jitter_lamp=lamp)


def _as_fitted(dataset: Dataset, first: NoiseFigures, fitted: NoiseFit, gain_at_0_db: float) -> NoiseFigures:
    """Return the noise fit's figures in the place of first estimates. The fit states its gain for 0 dB, and its read
    noise without
    rounding: that of the dark frames stays."""
    flats = dataset.recordings.captures(FlatCapture, dataset.side)
    gain = gain_at_0_db * 10.0 ** (most_frequent_gain_db(flats) / 20.0)
    black = first.black if fitted.black_level_dn is None else fitted.black_level_dn
    return replace(
        first,
        black=black,
        dark_dn_per_s=first.dark_dn_per_s
        if fitted.dark_current_e_per_s is None
        else max(fitted.dark_current_e_per_s * gain, 0.0),
        dark_c=first.dark_c if fitted.dark_temperature_c is None else fitted.dark_temperature_c,
        gain=gain,
        gain_is_known=True,
        prnu=first.prnu if fitted.prnu_percent is None else 0.01 * fitted.prnu_percent,
        jitter_lamp=level_repeatability(repeated_levels(dataset, black, gain, first.read_dn)),
    )


def _as_stated(dataset: Dataset) -> NoiseFigures:
    """Return what the data sheet states, with usual values in the place of what it doesn't."""
    stated = dataset.stated
    black, black_std = 0.0, 0.05 * dataset.camera.white_level_dn
    if stated.black_level_dn is not None:
        black = stated.black_level_dn
        black_std = max(STATED_BLACK_DN, STATED_BLACK_SHARE * black)
    # without dark frames: a dark current as stated, or of some tens of electrons
    expected = stated.dark_current_e_per_s if stated.dark_current_e_per_s is not None else 50.0
    return NoiseFigures(
        black=black, dark_dn_per_s=0.0, dark_c=dataset.temperature_c, gain=1.0, gain_is_known=False, read_dn=1.0,
        prnu=USUAL_PRNU,
        jitter_dn=BLACK_FLOOR_DN * dataset.step_dn, jitter_dn2_std=0.0, jitter_lamp=USUAL_LAMP, black_std=black_std,
        dark_std=max(expected * (stated.conversion_gain_dn_per_e or 1.0), 0.5), step_dn=dataset.step_dn,
    )  # fmt: skip


def _from_darks(dataset: Dataset, stated: NoiseFigures) -> NoiseFigures:
    """Return black level, dark current, read noise and repeatability by the dark captures; as stated where there are
    none.

    They are of one temperature, that of most captures: the baseline's dark current doesn't depend on it.
    """
    levels = dataset.darks.levels
    if not levels:
        return stated
    off = [
        0.0 if dataset.temperature_c is None or level.sensor_c is None else abs(level.sensor_c - dataset.temperature_c)
        for level in levels
    ]
    near = [level for level, away in zip(levels, off, strict=True) if away <= min(off) + ALIKE_C]
    exposure_s = np.array([level.exposure_s for level in near])
    line = dark_line(exposure_s, *mean_and_std(near, list(near[0].plane)))
    dark, dark_c, black_std, dark_std = stated.dark_dn_per_s, stated.dark_c, 1.0, stated.dark_std
    if line.rate is None:
        black_std += dark_std * float(exposure_s[0])
    else:
        dark = max(line.rate, 0.0)
        warm = [level for level in near if level.sensor_c is not None]
        weight = [level.exposure_s * level.repeats for level in warm]
        if sum(weight) > 0.0:  # long exposures determine the dark current
            dark_c = float(np.average([level.sensor_c or 0.0 for level in warm], weights=weight))
        dark_std = max(dark, 0.5)  # an effect such as glow may be all of it
    repeated = [level for level in near if level.repeats > 1]
    shortest = min(repeated, key=lambda level: level.exposure_s, default=None)
    jitter_dn, jitter_dn2_std = _jitter(dataset, [replace(level, drift=None) for level in levels])
    white_jitter_dn, _ = _jitter(dataset, levels)
    return replace(
        stated,
        black=line.black,
        dark_dn_per_s=dark,
        dark_c=dark_c,
        read_dn=stated.read_dn if shortest is None else float(np.sqrt(shortest.pixel_variance_dn2())),
        jitter_dn=jitter_dn,
        jitter_dn2_std=jitter_dn2_std,
        white_jitter_dn=white_jitter_dn,
        black_std=black_std,
        dark_std=dark_std,
    )


def _transfer_points(dataset: Dataset, black: float) -> tuple[list[float], list[float], float]:
    """Signal (DN) and temporal variance (DN^2) of repeated flats by level and channel; and the PRNU, of the last plane
    whose signal is between 0.3 and 0.8 of saturation."""
    signal, variance, prnu = [], [], USUAL_PRNU
    for group in dataset.flat_levels():
        for name, plane in dataset.flat_statistics(group).items() if len(group) > 1 else ():
            if any(dataset.levels(capture).mean[name[0]] is None for capture in group):
                continue
            signal.append(plane.mean - black)
            variance.append(plane.temporal_variance - plane.row_variance)  # without flicker of the light
            if 0.3 < signal[-1] / (dataset.saturation_dn - black) < 0.8:
                prnu = float(np.sqrt(max(plane.pattern_variance, 0.0)) / signal[-1])
    return signal, variance, prnu


def _scene_gain(dataset: Dataset, black: float, read_dn: float) -> float | None:
    """Gain (DN/e) from two repeats of any scene: temporal variance over signal, in eight bins of pixels of similar
    signal. None without repeats."""
    signal, variance = [], []
    for group in dataset.groups(None, lambda c: c.model_dump_json(exclude={"id", "frame", "time", "temperature_c"})):
        if len(group) < 2 or group[0].kind == "dark":
            continue
        one, two = (np.asarray(dataset.recordings.frame(c), float) - black for c in group[:2])
        two = two * one.sum() / max(two.sum(), 1e-9)
        mean, apart = 0.5 * (one + two).ravel(), 0.5 * np.square(one - two).ravel()
        edges = np.quantile(mean, np.linspace(0.0, 1.0, 9))
        for low, high in pairwise(edges):
            alike = (mean >= low) & (mean <= high)
            if alike.sum() > 200 and high < 0.8 * (dataset.saturation_dn - black):
                signal.append(float(mean[alike].mean()))
                variance.append(float(apart[alike].mean()))
    s = np.array(signal)
    return _transfer_slope(s, np.array(variance), read_dn) if np.any(s > 0) else None


def _transfer_slope(signal: FloatArray, variance: FloatArray, read_dn: float) -> float:
    """Gain (DN/e): slope of the temporal variance over signal, of a line through the read noise's variance at signal 0,
    weighted by the inverse variance."""
    weight = 1.0 / np.maximum(variance, 1e-9)
    return float(np.sum(weight * signal * (variance - read_dn**2)) / np.sum(weight * signal**2))


def _jitter(dataset: Dataset, levels: Sequence[MeasuredLevel]) -> tuple[float, float]:
    """Standard deviation of dark frames' means (DN) beyond the noise of their pixels, and that of its square (DN^2).

    It is about the drifts of `levels`, which a trend, a decay or a step of repeats in time are
    (`lab.observables.noise.repeats`), and a linear drift that all settings have in common. Settings out of line are
    left out (`steady`). 0 where the pixels' noise explains the scatter. A variance v of f degrees of freedom stands for
    a true one of about v f / (f - 2), known to sqrt(2 / f) of it; the usual one counts as `USUAL_JITTER_FREEDOM` more.
    """
    repeats = []
    darks = {c.id: c for c in dataset.recordings.captures(DarkCapture, dataset.side)}
    for level in levels:
        rest, freedom = level.scatter(level.frame_means())
        if freedom > 0:
            captures = tuple(darks[name] for name in level.captures)
            elapsed_s = np.array([dataset.elapsed_s(capture) for capture in captures])
            taken = len(rest) - freedom
            repeats.append(
                RepeatedMeans(captures, rest, elapsed_s - elapsed_s.mean(), level.mean_variance_dn2, taken=taken)
            )
    if not repeats:
        return UNKNOWN_JITTER_DN * dataset.step_dn, 0.0
    found = scatter_beyond_noise(steady(repeats))
    free = found.freedom + USUAL_JITTER_FREEDOM
    usual_dn2 = (USUAL_JITTER_DN * dataset.step_dn) ** 2 + float(np.mean([r.noise for r in repeats]))
    whole_dn2 = (found.square + USUAL_JITTER_FREEDOM * usual_dn2) / free
    return float(np.sqrt(found.excess)), whole_dn2 * float(np.sqrt(2.0 / free)) * free / max(free - 2.0, 1.0)
