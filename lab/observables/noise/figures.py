"""First estimates of black level, dark current, gain, read noise and PRNU, and of the repeatability of levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, special

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.formats.results import NoiseFit
from lab.observables.codes.rounding import (
    QUANTISATION_DN2,
    rounding_std_dn,
    rounding_waves_dn,
    variance_before_rounding,
)
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.noise.repeats import RepeatedSetting, drifts_of
from lab.observables.plane_means import channel_pixels
from sim.sensor import mosaic
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.observables.dataset import Dataset

# --- repeatability ---------------------------------------------------------------------------------------------------
# Repeatability of levels: the scatter of repeats of one setting beyond the noise of pixels.
#
# It is measured, as no data sheet states it, and is a tolerance of every level. A capture whose shutter or light isn't
# as stated mustn't widen that tolerance: settings whose scatter is out of line with the others are left out (`steady`),
# and stay a departure for the diagnosis to find.


LAMP_FLOOR = 1.0e-4  # least relative standard deviation of a level, common to the channels of a capture
#: False-alarm probability, over all settings, of calling one out of line; and the largest share of settings out of
#: line: with more, the scatter is taken as the light's.
OUT_OF_LINE_PROBABILITY, OUT_OF_LINE_SHARE = 1.0e-3, 0.25
#: Efficiency of the median of squares relative to their mean, by which degrees of freedom are multiplied.
MEDIAN_EFFICIENCY = 0.37
#: Weight of the common repeatability against that of a single setting, in degrees of freedom.
COMMON_REPEATS = 4


@dataclass(frozen=True)
class RepeatedMeans:
    """The n repeats of one setting."""

    captures: tuple[Capture, ...]
    away: FloatArray  # (n,): levels less their mean
    elapsed_s: FloatArray  # (n,): times less their mean
    noise: float  # variance of a level by the noise of pixels
    signal_dn: float = 0.0  # mean level where these are relative to it; 0: they are in DN


def repeated_levels(dataset: Dataset, black: float, gain: float, read_dn: float) -> list[RepeatedMeans]:
    """Return the repeats of every flat setting: levels over all unclipped channels, relative to their mean. Frames that
    may hold image lag of another level are left out (`Dataset.settled`). `black` in DN, `gain` in DN/e."""
    found = []
    for group in map(dataset.settled, dataset.flat_levels()):
        planes = [c for c in dataset.channels if all(dataset.levels(k).mean[c] is not None for k in group)]
        if len(group) < 2 or not planes:
            continue
        size = np.array([dataset.levels(group[0]).pixels[c] for c in planes], float)
        levels = np.array([[dataset.levels(k).mean[c] or 0.0 for c in planes] for k in group]) - black
        total = levels @ size
        if total.mean() <= 0:
            continue
        noise = float(((gain * np.maximum(levels.mean(0), 0.0) + read_dn**2) * size).sum()) / total.mean() ** 2
        elapsed = np.array([dataset.elapsed_s(k) for k in group])
        signal_dn = float(total.mean() / size.sum())
        found.append(
            RepeatedMeans(tuple(group), total / total.mean() - 1.0, elapsed - elapsed.mean(), noise, signal_dn)
        )
    return found


def steady(repeats: Sequence[RepeatedMeans]) -> list[RepeatedMeans]:
    """Return the settings whose scatter is in line with that of the others.

    Setting g with n_g repeats has S_g = sum((a - b t)^2), b the common trend with time (weighted median of the
    settings' slopes). It is distributed as (s_g^2 + s^2) chi2_f with f = n_g - 1 degrees of freedom and s_g^2 the
    variance by the noise of pixels. The common variance s^2 is the one at which the median over settings of S_g /
    (s_g^2 + s^2) / median(chi2_f) is 1. A setting is out of line where S_g / f / (s_g^2 + s^2) exceeds the quantile of
    the F distribution at `OUT_OF_LINE_PROBABILITY` / number of settings. Where more than `OUT_OF_LINE_SHARE` of the
    settings are, or where there are fewer than four, all are returned."""
    if len(repeats) * OUT_OF_LINE_SHARE < 1.0:
        return list(repeats)
    noise = np.array([r.noise for r in repeats])
    free = np.array([len(r.away) - 1 for r in repeats], float)
    size = np.array([float(r.elapsed_s @ r.elapsed_s) for r in repeats])
    slope = np.array([float(r.elapsed_s @ r.away) for r in repeats]) / np.where(size > 0, size, 1.0)
    trend = weighted_median(slope, size / (noise + LAMP_FLOOR**2)) if size.any() else 0.0
    square = np.array([float(np.sum(np.square(r.away - trend * r.elapsed_s))) for r in repeats])
    usual = square / special.chdtri(free, 0.5)

    def excess(variance: float) -> float:
        return float(np.median(usual / np.maximum(noise + variance, 1e-30))) - 1.0

    common = optimize.brentq(excess, 0.0, float(usual.max())) if usual.max() > 0 and excess(0.0) > 0 else 0.0
    ratio = square / free / (noise + max(common, LAMP_FLOOR**2))
    worth = MEDIAN_EFFICIENCY * (free.sum() - free)
    limit = special.fdtri(free, worth, 1.0 - OUT_OF_LINE_PROBABILITY / len(repeats))
    out = ratio > limit
    if out.sum() > OUT_OF_LINE_SHARE * len(repeats):
        return list(repeats)
    return [r for r, is_out in zip(repeats, out, strict=True) if not is_out]


def weighted_median(value: FloatArray, weight: FloatArray) -> float:
    """Return the value up to which half of the weight lies."""
    order = np.argsort(value)
    below = np.cumsum(weight[order])
    return float(value[order][int(np.searchsorted(below, 0.5 * below[-1]))])


def level_repeatability(repeats: Sequence[RepeatedMeans]) -> float:
    """Relative standard deviation of repeated levels beyond the noise of pixels and a common drift with time, over the
    settings in line. Settings are weighted by the inverse variance of their noise. 0 without repeats."""
    repeats = steady(repeats)
    weight = np.array([1.0 / (r.noise + LAMP_FLOOR**2) for r in repeats])
    moved = sum(w * float(r.elapsed_s @ r.elapsed_s) for w, r in zip(weight, repeats, strict=True))
    trend = 0.0
    if moved > 0:
        trend = sum(w * float(r.elapsed_s @ r.away) for w, r in zip(weight, repeats, strict=True)) / moved
    left = [float(np.sum(np.square(r.away - trend * r.elapsed_s))) - (len(r.away) - 1) * r.noise for r in repeats]
    free = float(sum(w * (len(r.away) - 1) for w, r in zip(weight, repeats, strict=True)))
    return float(np.sqrt(max(float(weight @ left) / free, 0.0))) if free > 0 else 0.0


def level_std(dataset: Dataset, groups: list[list[Any]]) -> FloatArray:
    """Relative standard deviation (groups,) of a frame's level: the common one, or a setting's own where that is
    larger, as in a flickering light that short exposures don't average. A setting out of line has the common one."""
    noise = dataset.noise
    found = np.full(len(groups), noise.jitter_lamp)
    place = {c.id: i for i, group in enumerate(groups) for c in group}
    for repeats in steady(repeated_levels(dataset, noise.black, noise.gain, noise.read_dn)):
        moved = float(repeats.elapsed_s @ repeats.elapsed_s)
        left, free = repeats.away, len(repeats.away) - 1
        if free > 1 and moved > 0:  # without a linear trend with time
            left, free = left - float(repeats.elapsed_s @ left) / moved * repeats.elapsed_s, free - 1
        elif moved > 0:
            continue
        own = max(float(np.sum(np.square(left))) / free - repeats.noise, 0.0)
        pooled = (COMMON_REPEATS * noise.jitter_lamp**2 + free * own) / (COMMON_REPEATS + free)
        found[place[repeats.captures[0].id]] = np.sqrt(max(pooled, noise.jitter_lamp**2))
    return found


# --- pixel outliers --------------------------------------------------------------------------------------------------
# Outlying pixels of dark frames, and robust statistics that leave them out.


Image = NDArray[np.float32]

if TYPE_CHECKING:
    from lab.observables.dataset import Dataset

CLIP = 4.5  # standard deviations at which pixels are clipped in robust statistics
MEDIAN_OF = 5  # most frames whose median shows defective pixels
SMOOTH_PX, LOCAL_PX = 9, 33  # sides of the boxes for the local mean and the local variance of a pixel's surroundings
#: Standard deviations of the fixed pattern from which on a pixel counts as defective and is left out of the frames'
#: means.
DEFECTIVE = 10.0


def sound_pixels(dataset: Dataset) -> NDArray[np.bool_]:
    """Mask (rows, cols) of the pixels that aren't defective.

    A defective pixel departs by more than `DEFECTIVE` standard deviations from its surroundings in the median of
    repeated dark frames, at the longest exposure or at the highest temperature. In a small frame, a single hot pixel of
    3000 e/s would dominate the noise of the mean, and one that saturates would make it nonlinear.
    """
    groups = dataset.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db))
    sound = np.ones((dataset.camera.rows, dataset.camera.cols), bool)
    if not groups:
        return sound
    longest = max(groups, key=lambda g: g[0].exposure_s)
    warmest = max(groups, key=lambda g: (g[0].temperature_c or 0.0, g[0].exposure_s))
    for group in (longest, warmest) if longest is not warmest else (longest,):
        frames = [dataset.recordings.frame(c).astype(np.float32) for c in group[:MEDIAN_OF]]
        away, local = from_surroundings([f - np.float32(f.mean(dtype=np.float64)) for f in frames], dataset.step_dn)
        sound &= np.abs(away) <= DEFECTIVE * local
    return sound


def from_surroundings(frames: list[Image], step_dn: float = 1.0) -> tuple[Image, Image]:
    """Departures (rows, cols) of the pixels of the frames' lower median from their local mean, without the means of
    rows and columns; and their local standard deviation, DN. `step_dn`: step of the codes."""
    level = [f - row_means(f, step_dn)[:, None] for f in frames]
    median: Image = np.sort(np.array(level), axis=0)[(len(frames) - 1) // 2]

    std = robust_std(median, step_dn)
    flat, _ = without_lines(median, np.clip(median, -CLIP * std, CLIP * std))
    step = 2
    for r in range(step):
        for c in range(step):
            phase = flat[r::step, c::step]
            phase -= np.float32(np.mean(np.clip(phase, -CLIP * std, CLIP * std)))
    around = ndimage.uniform_filter(np.clip(flat, -CLIP * std, CLIP * std), SMOOTH_PX, mode="mirror")
    steep = np.clip(flat - around, -CLIP * std, CLIP * std)
    # a second pass, so that hot pixels in a glow don't shift the mean around them
    around += ndimage.uniform_filter(steep, SMOOTH_PX, mode="mirror")
    away = flat - around
    local = np.sqrt(np.maximum(local_variance(np.square(away), 1), 0.25 * step_dn**2)) * np.sqrt(
        SMOOTH_PX**2 / (SMOOTH_PX**2 - 1.0)
    )
    return away, local


def robust_std(image: Image, step_dn: float = 1.0) -> float:
    """Standard deviation of the pixels within five standard deviations of 0, by iteration; at least a quarter of the
    step of the codes."""
    low, high = np.quantile(image.ravel()[:: max(image.size // 200_000, 1)], [0.02, 0.98])
    std = max(float(high - low) / 4.107, 0.3 * step_dn)
    for _ in range(3):
        inside = image[np.abs(image) < 5.0 * std]
        std = max(float(inside.std(dtype=np.float64)), 0.25 * step_dn)
    return std


def row_means(image: Image, step_dn: float = 1.0) -> Image:
    """Means (rows,) of the rows, pixels clipped at `CLIP` standard deviations."""
    std = robust_std(image, step_dn)
    return np.asarray(np.clip(image, -CLIP * std, CLIP * std).mean(axis=1))


def without_lines(image: Image, cut: Image) -> tuple[Image, dict[Lines, float]]:
    """Return an image less the means of the rows and columns of `cut`, the clipped image; and the variance of these
    means beyond that of independent pixels, by lines. It is taken from differences of neighbouring lines, in which
    smooth structure cancels."""
    rows, cols = cut.mean(axis=1, dtype=np.float64), cut.mean(axis=0, dtype=np.float64)
    own = float(np.var(np.diff(cut, axis=1), dtype=np.float64)) / 2.0
    spare: dict[Lines, float] = {
        "rows": float(np.var(np.diff(rows))) / 2.0 - own / cut.shape[1],
        "columns": float(np.var(np.diff(cols))) / 2.0 - own / cut.shape[0],
    }
    mean = float(cut.mean(dtype=np.float64))
    return (image - (rows - mean)[:, None].astype(np.float32) - cols[None, :].astype(np.float32)), spare


def local_variance(squares: Image, freedom: int) -> Image:
    """Local variance (rows, cols): mean of `squares` over `LOCAL_PX` x `LOCAL_PX` pixels, outliers clipped, over the
    degrees of freedom of a pixel's sum of squares."""
    usual = float(np.mean(np.minimum(squares, 16.0 * freedom * np.median(squares) / 0.45)))
    cap = np.float32(64.0 * usual)
    rough = ndimage.uniform_filter(np.minimum(squares, cap), LOCAL_PX, mode="mirror")
    cap_here = 16.0 * rough if freedom == 1 else (1.0 + 12.0 / np.sqrt(freedom)) * rough
    fine = ndimage.uniform_filter(np.minimum(squares, cap_here), LOCAL_PX, mode="mirror")
    return np.asarray(np.maximum(fine / np.float32(freedom), np.float32(1e-3)))


# --- noise figures ------------------------------------------------------------


STATED_BLACK_SHARE, STATED_BLACK_DN = 0.03, 2.0  # standard deviation of a stated black level, relative and absolute
# of codes of a step of 1 DN; codes of a larger step have as many steps
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
    step_dn: float = 1.0  # of the codes
    #: The same as `jitter_dn` about a trend, a decay or a step of the repeats in time; None where they have none.
    white_jitter_dn: float | None = None

    @property
    def dark_jitter_dn(self) -> float:
        """Standard deviation of a dark frame's mean by what the order of its repeats doesn't tell, DN."""
        return self.jitter_dn if self.white_jitter_dn is None else self.white_jitter_dn

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
    first = _from_darks(dataset, _as_stated(dataset))
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
        return replace(first, prnu=prnu, jitter_lamp=max(lamp, LAMP_FLOOR))
    return replace(first, gain=gain, gain_is_known=True, prnu=prnu, jitter_lamp=max(lamp, LAMP_FLOOR))


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
        jitter_lamp=max(level_repeatability(repeated_levels(dataset, black, gain, first.read_dn)), LAMP_FLOOR),
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
        jitter_dn=BLACK_FLOOR_DN * dataset.step_dn, jitter_freedom=0.0, jitter_lamp=USUAL_LAMP, black_std=black_std,
        dark_std=max(expected * (stated.conversion_gain_dn_per_e or 1.0), 0.5), step_dn=dataset.step_dn,
    )  # fmt: skip


def _from_darks(dataset: Dataset, stated: NoiseFigures) -> NoiseFigures:
    """Return black level, dark current, read noise and repeatability by the dark captures; as stated where there are
    none.

    They are of one temperature, that of most captures: the baseline's dark current doesn't depend on it.
    """
    recordings = dataset.recordings
    darks = dataset.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db))
    if not darks:
        return stated
    off = [
        0.0
        if dataset.temperature_c is None or g[0].temperature_c is None
        else abs(g[0].temperature_c - dataset.temperature_c)
        for g in darks
    ]
    sound = dataset.once(sound_pixels)
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
    jitter, freedom = _jitter(dataset, darks, frames_mean, own_dn2)
    white_dn = _white_jitter(dataset, darks, frames_mean, own_dn2)
    return replace(
        stated, black=black, dark_dn_per_s=dark, dark_c=dark_c, read_dn=read,
        jitter_dn=max(jitter, BLACK_FLOOR_DN * dataset.step_dn),
        jitter_freedom=freedom,
        black_std=black_std, dark_std=dark_std,
        white_jitter_dn=None if white_dn is None else max(white_dn, BLACK_FLOOR_DN * dataset.step_dn),
    )  # fmt: skip


def _transfer_points(dataset: Dataset, black: float) -> tuple[list[float], list[float], float]:
    """Signal (DN) and temporal variance (DN^2) of repeated flats by level and channel; and the PRNU, of the last plane
    whose signal is between 0.3 and 0.8 of saturation."""
    step, prnu = mosaic.step(dataset.camera.cfa), USUAL_PRNU
    signal, variance = [], []
    for group in dataset.flat_levels():
        if len(group) < 2:
            continue
        evened = {
            channel: TemporalVariance()
            for channel in dataset.channels
            if all(dataset.levels(c).mean[channel] is not None for c in group)
        }
        if not evened:
            continue
        total = np.zeros((dataset.camera.rows, dataset.camera.cols))
        for capture in group:
            frame = dataset.recordings.frame(capture)
            total += frame
            even = _even_rows(frame, step)  # without flicker of the light
            for channel, repeats in evened.items():
                repeats.add(channel_pixels(even, dataset.camera.cfa, channel))
        for channel, repeats in evened.items():
            signal.append(float(np.mean([dataset.levels(c).whole[channel] for c in group])) - black)
            variance.append(repeats.variance_dn2 / (1.0 - step / dataset.camera.cols))
            if 0.3 < signal[-1] / (dataset.saturation_dn - black) < 0.8:
                row, col = mosaic.phases(dataset.camera.cfa)[channel][0]
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


def _even_rows(frame: Any, step: int) -> FloatArray:
    """Return a frame whose rows have the same mean in each plane of the mosaic."""
    even = np.array(frame, float)
    for row in range(step):
        for col in range(step):
            plane = even[row::step, col::step]
            plane -= plane.mean(axis=1, keepdims=True) - plane.mean()
    return even


def _jitter(
    dataset: Dataset, groups: Sequence[Sequence[Capture]], means: Sequence[FloatArray], own_dn2: float
) -> tuple[float, float]:
    """Standard deviation of the repeats' means (DN) about a linear drift with time that all groups have in common, and
    its degrees of freedom.

    Settings out of line are left out (`steady`). With few repeats it is shrunk towards the usual: the variance
    `USUAL_JITTER_DN`^2 + `own_dn2`, that of a frame's mean by its pixels' noise, counts as `USUAL_JITTER_FREEDOM`
    degrees of freedom."""
    repeats = []
    usual_dn2 = (USUAL_JITTER_DN * dataset.step_dn) ** 2 + own_dn2
    for group, mean in zip(groups, means, strict=True):
        if len(group) > 1:
            time = np.array([dataset.elapsed_s(c) for c in group])
            repeats.append(RepeatedMeans(tuple(group), mean - mean.mean(), time - time.mean(), usual_dn2))
    repeats = steady(repeats)
    freedom = sum(len(r.away) - 1 for r in repeats)
    if freedom == 0:
        return UNKNOWN_JITTER_DN * dataset.step_dn, 0.0
    rest, elapsed = np.concatenate([r.away for r in repeats]), np.concatenate([r.elapsed_s for r in repeats])
    if freedom > 2 and np.any(elapsed):
        rest = rest - elapsed * float(elapsed @ rest) / float(elapsed @ elapsed)
        freedom -= 1
    total = freedom + USUAL_JITTER_FREEDOM
    usual = USUAL_JITTER_FREEDOM * usual_dn2
    return float(np.sqrt((rest @ rest + usual) / total)), total


def _white_jitter(
    dataset: Dataset, groups: Sequence[Sequence[Capture]], means: Sequence[FloatArray], own_dn2: float
) -> float | None:
    """Standard deviation of the repeats' means (DN) about what their order in time shows
    (`lab.observables.noise.repeats`): a trend, a decay or a step of a setting isn't scatter but a mismatch. None where
    no setting has one.

    It is pooled over all settings with `USUAL_JITTER_FREEDOM` degrees of freedom of the usual variance."""
    place = {capture.id: number for number, capture in enumerate(dataset.in_time_order)}
    settings: list[RepeatedSetting] = []
    for group, mean in zip(groups, means, strict=True):
        if len(group) < 2:
            continue
        order = sorted(range(len(group)), key=lambda k, group=group: place[group[k].id])  # type: ignore[misc]
        captures = tuple(group[k] for k in order)
        elapsed = np.array([dataset.elapsed_s(c) for c in captures])
        is_timed = bool(np.all(np.diff(elapsed) > 0.0))
        numbers = np.array([place[c.id] for c in captures])
        settings.append(
            RepeatedSetting(
                captures=captures,
                elapsed=elapsed - elapsed[0] if is_timed else np.arange(len(captures), dtype=float),
                is_timed=is_timed,
                run=np.concatenate([[0], np.cumsum(np.diff(numbers) > 1)]),
                mean_dn=mean[order],
                measure_noise_dn=lambda: float(np.sqrt(own_dn2)),
            )
        )
    drifts = {drift.captures: drift for drift in drifts_of(settings) if drift.is_of_one_setting}
    if not drifts:
        return None
    usual_dn2 = (USUAL_JITTER_DN * dataset.step_dn) ** 2 + own_dn2
    squares, freedom = USUAL_JITTER_FREEDOM * usual_dn2, USUAL_JITTER_FREEDOM
    for setting in settings:
        drift = drifts.get(tuple(c.id for c in setting.captures))
        curve = setting.mean_dn.mean() if drift is None else np.array(drift.curve_dn)
        taken = 1 if drift is None else 2 if drift.steady_dn is None else 3
        squares += float(np.sum(np.square(setting.mean_dn - curve)))
        freedom += max(len(setting.captures) - taken, 0)
    return float(np.sqrt(squares / freedom))


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
