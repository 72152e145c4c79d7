"""First estimates of black level, dark current, gain, read noise and PRNU, and of the repeatability of levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.results import NoiseFit
from lab.measure.pixel_outliers import sound_pixels
from lab.measure.plane_means import channel_pixels
from lab.measure.repeatability import (
    LAMP_FLOOR,
    RepeatedMeans,
    level_repeatability,
    repeated_levels,
    steady,
)
from lab.measure.rounding import variance_before_rounding
from lab.measure.stated_light import most_frequent_gain_db
from sim.sensor import mosaic
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.measure.study import Study

STATED_BLACK_SHARE, STATED_BLACK_DN = 0.03, 2.0  # standard deviation of a stated black level, relative and absolute
BLACK_FLOOR_DN = 0.01  # standard deviation of a frame's mean beside noise
USUAL_JITTER_DN = 0.02  # usual standard deviation of a dark frame's mean, from repeat to repeat
USUAL_JITTER_FREEDOM = 2.0  # degrees of freedom that count for the usual one
UNKNOWN_JITTER_DN = 0.05  # where no dark frames are repeated
USUAL_PRNU = 0.008  # where no flats tell
USUAL_LAMP = 3e-4  # relative standard deviation of a flat frame's mean, where no flats are repeated
#: Local mean of a plane of the mosaic: side of the box and width of the border that is left out, px. The wide one is
#: used in planes of at least `WIDE_PLANE_PX` a side. In planes below `LEAST_PLANE_PX` PRNU isn't measured.
WIDE_WINDOW_PX, NARROW_WINDOW_PX = (9, 6), (3, 1)
WIDE_PLANE_PX, LEAST_PLANE_PX = 24, 6
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
    jitter_dn: float  # standard deviation of a dark frame's mean, from repeat to repeat
    jitter_freedom: float  # its degrees of freedom, the usual one's included; 0: no dark frames are repeated
    jitter_lamp: float  # relative standard deviation of a flat frame's mean, from repeat to repeat
    black_std: float  # standard deviation of `black`
    dark_std: float  # standard deviation of `dark_dn_per_s`

    def spread_dn2(self, signal_dn: FloatArray) -> FloatArray:
        """Variance (DN^2) of pixels at a signal before rounding: shot noise, read noise (0 where rounding hides it),
        PRNU."""
        return np.asarray(
            self.gain * signal_dn + variance_before_rounding(self.read_dn**2) + (self.prnu * signal_dn) ** 2
        )


def noise_figures(study: Study) -> NoiseFigures:
    """Return the noise fit's gain, black level, dark current and PRNU where there is a fit; else first estimates from
    dark and flat captures. The read noise is that of the dark frames as recorded, rounding included. What these don't
    determine is taken from the data sheet, else a usual value.

    Without a fit, the gain is the slope of temporal variance over signal of repeated flats, else the stated one, else
    that of any repeats."""
    first = _from_darks(study, _as_stated(study))
    fitted = study.fitted
    if fitted is not None and fitted.conversion_gain_dn_per_e is not None:
        return _as_fitted(study, first, fitted, fitted.conversion_gain_dn_per_e)
    signal, variance, prnu = _transfer_points(study, first.black)
    gain, lamp = study.stated.conversion_gain_dn_per_e, USUAL_LAMP
    if len(signal) > 1:
        s, v = np.array(signal), np.array(variance)
        low = s < 0.5 * (study.saturation_dn - first.black)
        use = low if low.sum() > 2 else np.ones_like(low)
        gain = _transfer_slope(s[use], v[use], first.read_dn)
        lamp = level_repeatability(repeated_levels(study, first.black, gain, first.read_dn))
    elif gain is None:
        gain = _scene_gain(study, first.black, first.read_dn)
    if gain is None or gain <= 0:
        return replace(first, prnu=prnu, jitter_lamp=max(lamp, LAMP_FLOOR))
    return replace(first, gain=gain, gain_is_known=True, prnu=prnu, jitter_lamp=max(lamp, LAMP_FLOOR))


def _as_fitted(study: Study, first: NoiseFigures, fitted: NoiseFit, gain_at_0_db: float) -> NoiseFigures:
    """Return the noise fit's figures in the place of first estimates. The fit states its gain for 0 dB, and its read
    noise without
    rounding: that of the dark frames stays."""
    flats = study.recordings.captures(FlatCapture, study.side)
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
        jitter_lamp=max(level_repeatability(repeated_levels(study, black, gain, first.read_dn)), LAMP_FLOOR),
    )


def _as_stated(study: Study) -> NoiseFigures:
    """Return what the data sheet states, with usual values in the place of what it doesn't."""
    stated = study.stated
    black, black_std = 0.0, 0.05 * study.camera.white_level_dn
    if stated.black_level_dn is not None:
        black = stated.black_level_dn
        black_std = max(STATED_BLACK_DN, STATED_BLACK_SHARE * black)
    # without dark frames: a dark current as stated, or of some tens of electrons
    expected = stated.dark_current_e_per_s if stated.dark_current_e_per_s is not None else 50.0
    return NoiseFigures(
        black=black, dark_dn_per_s=0.0, dark_c=study.temperature_c, gain=1.0, gain_is_known=False, read_dn=1.0,
        prnu=USUAL_PRNU,
        jitter_dn=BLACK_FLOOR_DN, jitter_freedom=0.0, jitter_lamp=USUAL_LAMP, black_std=black_std,
        dark_std=max(expected * (stated.conversion_gain_dn_per_e or 1.0), 0.5),
    )  # fmt: skip


def _from_darks(study: Study, stated: NoiseFigures) -> NoiseFigures:
    """Return black level, dark current, read noise and repeatability by the dark captures; as stated where there are
    none.

    They are of one temperature, that of most captures: the baseline's dark current doesn't depend on it.
    """
    recordings = study.recordings
    darks = study.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db))
    if not darks:
        return stated
    off = [
        0.0
        if study.temperature_c is None or g[0].temperature_c is None
        else abs(g[0].temperature_c - study.temperature_c)
        for g in darks
    ]
    sound = study.once(sound_pixels)
    frames_mean = [np.array([float(recordings.frame(c).mean(where=sound)) for c in g]) for g in darks]
    near = [i for i, away in enumerate(off) if away <= min(off) + ALIKE_C]
    t = np.array([darks[i][0].exposure_s for i in near])
    level = np.array([frames_mean[i].mean() for i in near])
    dark, dark_c, black_std, dark_std = stated.dark_dn_per_s, stated.dark_c, 1.0, stated.dark_std
    if len(t) > 1 and np.ptp(t) > 0:
        dark, black = (float(v) for v in np.polyfit(t, level, 1))
        dark = max(dark, 0.0)
        warm = [c for i in near for c in darks[i] if c.temperature_c is not None]
        if warm:  # long exposures determine the dark current
            dark_c = float(np.average([c.temperature_c for c in warm], weights=[c.exposure_s for c in warm]))
        dark_std = max(dark, 0.5)  # an effect such as glow may be all of it
    else:
        black = float(level[0])
        black_std += dark_std * float(t[0])
    first = min((darks[i] for i in near), key=lambda g: g[0].exposure_s)
    read, own_dn2 = stated.read_dn, 0.0
    if len(first) > 1:
        repeats = TemporalVariance()
        for capture in first[:4]:
            repeats.add(recordings.frame(capture))
        read = float(np.sqrt(repeats.variance_dn2))
        own_dn2 = read**2 / recordings.frame(first[0]).size
    jitter, freedom = _jitter(study, darks, frames_mean, own_dn2)
    return replace(
        stated, black=black, dark_dn_per_s=dark, dark_c=dark_c, read_dn=read, jitter_dn=max(jitter, BLACK_FLOOR_DN),
        jitter_freedom=freedom,
        black_std=black_std, dark_std=dark_std,
    )  # fmt: skip


def _transfer_points(study: Study, black: float) -> tuple[list[float], list[float], float]:
    """Signal (DN) and temporal variance (DN^2) of repeated flats by level and channel; and the PRNU, of the last plane
    whose signal is between 0.3 and 0.8 of saturation."""
    step, prnu = mosaic.step(study.camera.cfa), USUAL_PRNU
    signal, variance = [], []
    for group in study.flat_levels():
        if len(group) < 2:
            continue
        evened = {
            channel: TemporalVariance()
            for channel in study.channels
            if all(study.levels(c).mean[channel] is not None for c in group)
        }
        if not evened:
            continue
        total = np.zeros((study.camera.rows, study.camera.cols))
        for capture in group:
            frame = study.recordings.frame(capture)
            total += frame
            even = _even_rows(frame, step)  # without flicker of the light
            for channel, repeats in evened.items():
                repeats.add(channel_pixels(even, study.camera.cfa, channel))
        for channel, repeats in evened.items():
            signal.append(float(np.mean([study.levels(c).whole[channel] for c in group])) - black)
            variance.append(repeats.variance_dn2 / (1.0 - step / study.camera.cols))
            if 0.3 < signal[-1] / (study.saturation_dn - black) < 0.8:
                row, col = mosaic.phases(study.camera.cfa)[channel][0]
                plane = total[row::step, col::step] / len(group)
                if min(plane.shape) >= LEAST_PLANE_PX:
                    fixed = max(variance_between_pixels(plane) - variance[-1] / len(group), 0.0)
                    prnu = float(np.sqrt(fixed) / signal[-1])
    return signal, variance, prnu


def variance_between_pixels(plane: FloatArray) -> float:
    """Variance (DN^2) between the pixels of a plane (rows, cols), about the local mean over w x w pixels.

    The local mean holds 1 / w^2 of the pixel itself: the variance is divided by 1 - 1 / w^2. Planes below
    `WIDE_PLANE_PX` get the narrow window.
    """
    width, border = WIDE_WINDOW_PX if min(plane.shape) >= WIDE_PLANE_PX else NARROW_WINDOW_PX
    rough = (plane - ndimage.uniform_filter(plane, width))[border:-border, border:-border]
    return float(rough.var() / (1.0 - 1.0 / width**2))


def _scene_gain(study: Study, black: float, read_dn: float) -> float | None:
    """Gain (DN/e) from two repeats of any scene: temporal variance over signal, in eight bins of pixels of similar
    signal. None without repeats."""
    signal, variance = [], []
    for group in study.groups(None, lambda c: c.model_dump_json(exclude={"id", "frame", "time", "temperature_c"})):
        if len(group) < 2 or group[0].kind == "dark":
            continue
        one, two = (np.asarray(study.recordings.frame(c), float) - black for c in group[:2])
        two = two * one.sum() / max(two.sum(), 1e-9)
        mean, apart = 0.5 * (one + two).ravel(), 0.5 * np.square(one - two).ravel()
        edges = np.quantile(mean, np.linspace(0.0, 1.0, 9))
        for low, high in pairwise(edges):
            alike = (mean >= low) & (mean <= high)
            if alike.sum() > 200 and high < 0.8 * (study.saturation_dn - black):
                signal.append(float(mean[alike].mean()))
                variance.append(float(apart[alike].mean()))
    s = np.array(signal)
    return _transfer_slope(s, np.array(variance), read_dn) if np.any(s > 0) else None


def _transfer_slope(signal: FloatArray, variance: FloatArray, read_dn: float) -> float:
    """Gain (DN/e): slope of the temporal variance over signal, of a line through the read noise's variance at signal 0,
    weighted by the inverse variance."""
    weight = 1.0 / np.maximum(variance, 1e-9)
    return float(np.sum(weight * signal * (variance - read_dn**2)) / np.sum(weight * signal**2))


def _even_rows(frame: Any, step: int) -> FloatArray:
    """A frame whose rows have the same mean in each plane of the mosaic."""
    even = np.array(frame, float)
    for row in range(step):
        for col in range(step):
            plane = even[row::step, col::step]
            plane -= plane.mean(axis=1, keepdims=True) - plane.mean()
    return even


def _jitter(
    study: Study, groups: Sequence[Sequence[Capture]], means: Sequence[FloatArray], own_dn2: float
) -> tuple[float, float]:
    """Standard deviation of the repeats' means (DN) about a linear drift with time that all groups have in common, and
    its degrees of freedom.

    Settings out of line are left out (`steady`). With few repeats it is shrunk towards the usual: the variance
    `USUAL_JITTER_DN`^2 + `own_dn2`, that of a frame's mean by its pixels' noise, counts as `USUAL_JITTER_FREEDOM`
    degrees of freedom."""
    repeats = []
    for group, mean in zip(groups, means, strict=True):
        if len(group) > 1:
            time = np.array([study.elapsed_s(c) for c in group])
            repeats.append(
                RepeatedMeans(tuple(group), mean - mean.mean(), time - time.mean(), USUAL_JITTER_DN**2 + own_dn2)
            )
    repeats = steady(repeats)
    freedom = sum(len(r.away) - 1 for r in repeats)
    if freedom == 0:
        return UNKNOWN_JITTER_DN, 0.0
    rest, elapsed = np.concatenate([r.away for r in repeats]), np.concatenate([r.elapsed_s for r in repeats])
    if freedom > 2 and np.any(elapsed):
        rest = rest - elapsed * float(elapsed @ rest) / float(elapsed @ elapsed)
        freedom -= 1
    total = freedom + USUAL_JITTER_FREEDOM
    usual = USUAL_JITTER_FREEDOM * (USUAL_JITTER_DN**2 + own_dn2)
    return float(np.sqrt((rest @ rest + usual) / total)), total


class TemporalVariance:
    """Temporal variance of a pixel from repeats, which are added one by one and not kept: mean over pixels of the
    sample variance, after each frame's mean is subtracted.

    The squares about the repeats' mean are summed by Welford's recursion (Technometrics 4, 419, 1962).
    """

    def __init__(self) -> None:
        self._mean: FloatArray = np.zeros(0)
        self._count, self._squares = 0, 0.0  # DN^2, mean over pixels

    def add(self, frame: Any) -> None:
        """Add a repeat, DN, of the shape of those before it."""
        away = np.array(frame, float)
        away -= away.mean()
        self._count += 1
        if self._count == 1:
            self._mean = away
            return
        away -= self._mean
        self._squares += float(np.mean(np.square(away))) * (self._count - 1) / self._count
        self._mean += away / self._count

    @property
    def variance_dn2(self) -> float:
        """The variance, DN^2; 0 for a single frame."""
        return self._squares / (self._count - 1) * (1.0 + 1.0 / max(self._mean.size, 1)) if self._count > 1 else 0.0
