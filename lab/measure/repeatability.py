"""Repeatability of levels: the scatter of repeats of one setting beyond the noise of pixels.

It is measured, as no data sheet states it, and is a tolerance of every level. A capture whose shutter or light isn't as
stated mustn't widen that tolerance: settings whose scatter is out of line with the others are left out (`steady`), and
stay a departure for the diagnosis to find.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import optimize, special

from lab.capture_kinds.base import Capture
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.measure.study import Study

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


def repeated_levels(study: Study, black: float, gain: float, read_dn: float) -> list[RepeatedMeans]:
    """The repeats of every flat setting: levels over all unclipped channels, relative to their mean. Frames that may
    hold image lag of another level are left out (`Study.settled`). `black` in DN, `gain` in DN/e."""
    found = []
    for group in map(study.settled, study.flat_levels()):
        planes = [c for c in study.channels if all(study.levels(k).mean[c] is not None for k in group)]
        if len(group) < 2 or not planes:
            continue
        size = np.array([study.levels(group[0]).pixels[c] for c in planes], float)
        levels = np.array([[study.levels(k).mean[c] or 0.0 for c in planes] for k in group]) - black
        total = levels @ size
        if total.mean() <= 0:
            continue
        noise = float(((gain * np.maximum(levels.mean(0), 0.0) + read_dn**2) * size).sum()) / total.mean() ** 2
        elapsed = np.array([study.elapsed_s(k) for k in group])
        signal_dn = float(total.mean() / size.sum())
        found.append(
            RepeatedMeans(tuple(group), total / total.mean() - 1.0, elapsed - elapsed.mean(), noise, signal_dn)
        )
    return found


def steady(repeats: Sequence[RepeatedMeans]) -> list[RepeatedMeans]:
    """The settings whose scatter is in line with that of the others.

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
    """The value up to which half of the weight lies."""
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


def level_std(study: Study, groups: list[list[Any]]) -> FloatArray:
    """Relative standard deviation (groups,) of a frame's level: the common one, or a setting's own where that is
    larger, as in a flickering light that short exposures don't average. A setting out of line has the common one."""
    noise = study.noise
    found = np.full(len(groups), noise.jitter_lamp)
    place = {c.id: i for i, group in enumerate(groups) for c in group}
    for repeats in steady(repeated_levels(study, noise.black, noise.gain, noise.read_dn)):
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
