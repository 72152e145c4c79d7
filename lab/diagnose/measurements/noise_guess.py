"""First guesses of black level, dark current, gain, read noise and fixed pattern, and how repeatable levels are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from lab.capture_kinds.base import Capture
from lab.diagnose.measurements.pixel_outliers import sound_pixels
from lab.diagnose.measurements.repeatability import (
    LAMP_FLOOR,
    RepeatedMeans,
    level_repeatability,
    repeated_levels,
    steady,
)
from lab.diagnose.measurements.saturation import CLIPPED_SHARE
from lab.fit.rounding import unrounded
from sim.sensor import mosaic
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.diagnose.measurements.study import Study

STATED_BLACK_SHARE, STATED_BLACK_DN = 0.03, 2.0  # of a stated black level: what a data sheet may be off by
BLACK_FLOOR_DN = 0.01  # of a frame's mean: rounding of a quiet camera
USUAL_JITTER_DN = 0.02  # of a dark frame's mean, from repeat to repeat
USUAL_PRNU = 0.008
#: Local mean of a plane of the mosaic: box and border left out, px, and the plane's least side from which the box is taken. In smaller planes than
#: LEAST_PLANE_PX the pixels' own response can't be told.
WIDE_WINDOW_PX, NARROW_WINDOW_PX = (9, 6), (3, 1)
WIDE_PLANE_PX, LEAST_PLANE_PX = 24, 6
ALIKE_C = 2.0  # dark captures whose temperatures are that close count as of one


@dataclass(frozen=True)
class NoiseGuess:
    """First guesses, good to a few per cent: nuisance parameters are linear about these."""

    black: float
    dark_dn_per_s: float
    dark_c: float | None  # the sensor's temperature at which the dark current holds
    gain: float  # 1 where nothing tells it
    gain_is_known: bool
    read_dn: float
    prnu: float
    jitter_dn: float  # of a dark frame's mean
    jitter_lamp: float  # of a flat frame's mean, relative
    black_std: float  # of the guess
    dark_std: float  # DN/s, of the guess

    def spread_dn2(self, signal_dn: FloatArray) -> FloatArray:
        """Variance of pixels at a signal before rounding; read noise that rounding hides counts for nothing."""
        return np.asarray(self.gain * signal_dn + unrounded(self.read_dn**2) + (self.prnu * signal_dn) ** 2)


def noise_guess(study: Study) -> NoiseGuess:
    recordings, stated = study.recordings, study.stated
    black = stated.black_level_dn if stated.black_level_dn is not None else 0.0
    dark, read, jitter = 0.0, 1.0, BLACK_FLOOR_DN
    dark_c = study.temperature_c
    # the dark current is anything: within reason, what a data sheet says or some tens of electrons
    expected = stated.dark_current_e_per_s if stated.dark_current_e_per_s is not None else 50.0
    dark_std = max(expected * (stated.conversion_gain_dn_per_e or 1.0), 0.5)
    black_std = 0.05 * study.camera.white_level_dn
    if stated.black_level_dn is not None:
        black_std = max(STATED_BLACK_DN, STATED_BLACK_SHARE * black)
    darks = study.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db))
    if darks:
        # at one temperature, at which most captures were taken: what the others change isn't the baseline's
        off = [0.0 if study.temperature_c is None or g[0].temperature_c is None else abs(g[0].temperature_c - study.temperature_c) for g in darks]  # fmt: skip
        sound = study.once(sound_pixels)
        frames_mean = [np.array([float(recordings.frame(c).mean(where=sound)) for c in g]) for g in darks]
        near = [i for i, away in enumerate(off) if away <= min(off) + ALIKE_C]
        t = np.array([darks[i][0].exposure_s for i in near])
        level = np.array([frames_mean[i].mean() for i in near])
        black_std = 1.0
        if len(t) > 1 and np.ptp(t) > 0:
            dark, black = (float(v) for v in np.polyfit(t, level, 1))
            dark = max(dark, 0.0)
            warm = [c for i in near for c in darks[i] if c.temperature_c is not None]
            if warm:  # the longest ones tell
                dark_c = float(np.average([c.temperature_c for c in warm], weights=[c.exposure_s for c in warm]))
            dark_std = max(dark, 0.5)  # effects (a glow) may be all of it
        else:
            black = float(level[0])
            black_std += dark_std * float(t[0])
        first = min((darks[i] for i in near), key=lambda g: g[0].exposure_s)
        if len(first) > 1:
            read = float(np.sqrt(pair_variance([recordings.frame(c) for c in first[:4]])))
        own_dn2 = read**2 / recordings.frame(first[0]).size if len(first) > 1 else 0.0
        jitter = max(_jitter(study, darks, frames_mean, own_dn2), BLACK_FLOOR_DN)
    gain, lamp = stated.conversion_gain_dn_per_e, 3e-4
    signal, variance, prnu = _transfer_points(study, black)
    if len(signal) > 1:
        s, v = np.array(signal), np.array(variance)
        low = s < 0.5 * (study.saturation_dn - black)
        use = low if low.sum() > 2 else np.ones_like(low)
        gain = _transfer_slope(s[use], v[use], read)
        lamp = level_repeatability(repeated_levels(study, black, gain, read))
    elif gain is None:
        gain = _scene_gain(study, black, read)
    known = gain is not None and gain > 0
    gain = gain if gain is not None and known else 1.0
    return NoiseGuess(black, dark, dark_c, gain, known, read, prnu, jitter, max(lamp, LAMP_FLOOR), black_std, dark_std)


def _transfer_points(study: Study, black: float) -> tuple[list[float], list[float], float]:
    """Signal and temporal variance (DN, DN^2) of repeated flats by level and channel; PRNU from what is between them and saturation."""
    step, prnu = mosaic.step(study.camera.cfa), USUAL_PRNU
    signal, variance = [], []
    for group in study.flat_levels():
        if len(group) < 2:
            continue
        frames = [study.recordings.frame(c) for c in group]
        evened = [_even_rows(f, step) for f in frames]  # a light that flickers is no shot noise
        freedom = 1.0 - step / frames[0].shape[1]
        for channel in study.channels:
            planes = [study.pixels_of(f, channel) for f in frames]
            if any(np.mean(p >= study.saturation_dn) >= CLIPPED_SHARE for p in planes):
                continue
            signal.append(float(np.mean([p.mean() for p in planes])) - black)
            variance.append(pair_variance([study.pixels_of(f, channel) for f in evened]) / freedom)
            if 0.3 < signal[-1] / (study.saturation_dn - black) < 0.8:
                row, col = mosaic.phases(study.camera.cfa)[channel][0]
                plane = np.mean(frames, axis=0)[row::step, col::step]
                if min(plane.shape) >= LEAST_PLANE_PX:
                    fixed = max(variance_between_pixels(plane) - variance[-1] / len(frames), 0.0)
                    prnu = float(np.sqrt(fixed) / signal[-1])
    return signal, variance, prnu


def variance_between_pixels(plane: FloatArray) -> float:
    """Variance (DN^2) of a plane (rows, cols) about its local mean over w x w pixels, in which each pixel has a share of 1 / w^2: that much of the
    variance is put back. Planes too small for the wide window get the narrow one."""
    width, border = WIDE_WINDOW_PX if min(plane.shape) >= WIDE_PLANE_PX else NARROW_WINDOW_PX
    rough = (plane - ndimage.uniform_filter(plane, width))[border:-border, border:-border]
    return float(rough.var() / (1.0 - 1.0 / width**2))


def _scene_gain(study: Study, black: float, read_dn: float) -> float | None:
    """DN/e by repeats of whatever was seen: temporal variance over signal, of pixels alike in signal; None without repeats."""
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
    """DN/e: of the line from the read noise through temporal variances over signal, each by its own size."""
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


def _jitter(study: Study, groups: Sequence[Sequence[Capture]], means: Sequence[FloatArray], own_dn2: float) -> float:
    """Standard deviation of the repeats' means, less what changes evenly with time in all groups alike: that is a drift.

    Settings that scatter out of line don't count (`steady`). Of few repeats it is pulled towards what is usual: `USUAL_JITTER_DN` beside
    the pixels' own noise, whose variance in a frame's mean is `own_dn2`, counts as two repeats.
    """
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
        return 0.05
    rest, elapsed = np.concatenate([r.away for r in repeats]), np.concatenate([r.elapsed_s for r in repeats])
    if freedom > 2 and np.any(elapsed):
        rest = rest - elapsed * float(elapsed @ rest) / float(elapsed @ elapsed)
        freedom -= 1
    return float(np.sqrt((rest @ rest + 2.0 * (USUAL_JITTER_DN**2 + own_dn2)) / (freedom + 2.0)))


def pair_variance(frames: Sequence[Any]) -> float:
    """Temporal variance from repeats: mean over pixels of the sample variance, frames' means taken out."""
    stack = np.stack([np.asarray(f, np.float32) - np.float32(np.mean(f, dtype=float)) for f in frames])
    n = len(frames)
    return (
        float(np.mean(stack.var(axis=0, ddof=1, dtype=np.float64))) * (1.0 + 1.0 / max(stack[0].size, 1))
        if n > 1
        else 0.0
    )
