"""Repeatability of levels: the scatter of repeats of one setting beyond the noise of pixels.

It is measured, as no data sheet states it, and is a tolerance of every level. A capture whose shutter or light isn't as
stated mustn't widen that tolerance: settings whose scatter is out of line with the others are left out (`steady`), and
stay a departure for the diagnosis to find. Scatter that the noise of pixels explains counts as no tolerance.
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
    from lab.observables.dataset import Dataset

USUAL_LAMP = 3e-4  # relative standard deviation of a flat frame's mean, where no flats are repeated
LAMP_FLOOR = 1.0e-4  # least relative standard deviation of a level, common to the channels of a capture
#: False-alarm probability, over all settings, of calling one out of line; and the largest share of settings out of
#: line: with more, the scatter is taken as the light's.
OUT_OF_LINE_PROBABILITY, OUT_OF_LINE_SHARE = 1.0e-3, 0.25
#: Probability by chance above which a scatter counts as noise, or as the common one.
EXPLAINED = 0.01
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
    taken: int = 1  # degrees of freedom that their mean, and a drift that was subtracted, take

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter."""
        return len(self.away) - self.taken


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
    free = np.array([r.freedom for r in repeats], float)
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


@dataclass(frozen=True)
class RepeatScatter:
    """The scatter of repeats: variance beyond the noise of pixels, sum of squares, and degrees of freedom."""

    excess: float
    square: float
    freedom: float


def scatter_beyond_noise(repeats: Sequence[RepeatedMeans]) -> RepeatScatter:
    """Return the scatter of repeats about a drift with time that all settings have in common.

    The excess is 0 where the noise explains the scatter: chi2 of a probability above `EXPLAINED`. Settings are weighted
    by the inverse variance of their noise.
    """
    weight = np.array([1.0 / max(r.noise, 1e-30) for r in repeats])
    freedom = np.array([r.freedom for r in repeats], float)
    free, trend = float(freedom.sum()), 0.0
    moved = sum(w * float(r.elapsed_s @ r.elapsed_s) for w, r in zip(weight, repeats, strict=True))
    if moved > 0 and free > 2:
        trend = sum(w * float(r.elapsed_s @ r.away) for w, r in zip(weight, repeats, strict=True)) / moved
        free -= 1.0
    square = np.array([float(np.sum(np.square(r.away - trend * r.elapsed_s))) for r in repeats])
    if free < 1 or special.chdtrc(free, float(weight @ square)) > EXPLAINED:
        return RepeatScatter(0.0, float(square.sum()), free)
    own = free / freedom.sum() * freedom  # degrees of freedom less the trend's
    noise = np.array([r.noise for r in repeats])
    excess = float(weight @ (square - own * noise)) / float(weight @ own)
    return RepeatScatter(max(excess, 0.0), float(square.sum()), free)


def level_repeatability(repeats: Sequence[RepeatedMeans]) -> float:
    """Return the relative standard deviation of repeated levels beyond the noise of pixels, over the settings in
    line; the usual one without repeats."""
    found = scatter_beyond_noise(steady(repeats))
    return float(np.sqrt(found.excess)) if found.freedom >= 1 else USUAL_LAMP


def level_std(dataset: Dataset, groups: list[list[Any]]) -> FloatArray:
    """Relative standard deviation (groups,) of a frame's level: the common one, or a setting's own where that is
    larger, as in a flickering light that short exposures don't average. A setting out of line has the common one."""
    noise = dataset.noise
    found = np.full(len(groups), noise.jitter_lamp)
    place = {c.id: i for i, group in enumerate(groups) for c in group}
    for repeats in steady(repeated_levels(dataset, noise.black, noise.gain, noise.read_dn)):
        moved = float(repeats.elapsed_s @ repeats.elapsed_s)
        left, free = repeats.away, repeats.freedom
        if free > 1 and moved > 0:  # without a linear trend with time
            left, free = left - float(repeats.elapsed_s @ left) / moved * repeats.elapsed_s, free - 1
        elif moved > 0:
            continue
        square = float(np.sum(np.square(left)))
        if special.chdtrc(free, square / (repeats.noise + noise.jitter_lamp**2)) > EXPLAINED:
            continue
        own = max(square / free - repeats.noise, 0.0)
        pooled = (COMMON_REPEATS * noise.jitter_lamp**2 + free * own) / (COMMON_REPEATS + free)
        found[place[repeats.captures[0].id]] = np.sqrt(max(pooled, noise.jitter_lamp**2))
    return found
