"""Defective pixels in dark frames: numbers of pixels that depart in every frame, and of pixels that flicker from frame
to frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import betainc, chdtrc, chdtri, gammaln, ndtr, xlogy

from lab.observables.darks.frames import (
    DEFECTS,
    TAIL_EDGES,
    DarkPattern,
    DarkStatistics,
    by_part,
    captures_of,
    contrast_weights,
    dark_frames,
    fine_conditions,
)
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import PARTICLES
from sim.effects.base import Effects
from sim.sensor.particles import Particles
from sim.spectrum import FloatArray
from sim.uniform import Uniform

LEAST_COUNTED_DN = 0.6  # temporal noise of a pixel below which codes are too coarse for the tails of its distribution
#: Lower edges of the bins of temporal variance, over the first one, which a healthy pixel passes with the probability
#: `FLICKER_CHANCE`.
FLICKER_EDGES = 1.0, 1.6, 2.6, 5.0, 12.0
FLICKER_CHANCE = 1e-5
#: Telegraph noise: draws of the frames in which a pixel is at its higher level, and the shares of such frames.
JUMPS, HIGH_SHARES = 400, (0.5, 0.15, 0.5, 0.85)
#: Standard deviation of a rooted count beside chance (about 1 for large counts): one more defective pixel is no
#: finding.
COUNT_STD = 0.6
#: A pixel that is `FAR` standard deviations off in each of several frames is neither a distribution's tail nor a
#: particle. Whether there is any counts as `PRESENCE` more, nearly seven of `COUNT_STD`.
FAR, PRESENCE = 20.0, 4.0


def rooted_counts(counts: FloatArray) -> FloatArray:
    """Anscombe transform 2 sqrt(n + 3/8) of Poisson counts: standard deviation 1 except for small ones (Anscombe
    1948)."""
    return np.asarray(2.0 * np.sqrt(counts + 0.375))


def _count_covariance(expected: FloatArray, uncertain: FloatArray | float = 0.0) -> FloatArray:
    """Covariance of `rooted_counts`: their exact variance for Poisson counts of mean `expected`, `COUNT_STD`, and
    `uncertain`, the standard deviation of the expected counts."""
    number = np.arange(60.0)
    mean = np.minimum(expected, 20.0)[:, None]
    share = np.exp(xlogy(number, mean) - mean - gammaln(number + 1.0))
    chance = share @ np.square(rooted_counts(number)) - np.square(share @ rooted_counts(number))
    return np.diag(chance + COUNT_STD**2 + np.square(rooted_counts(expected + uncertain) - rooted_counts(expected)))


def measure_defective_pixels(dataset: Dataset) -> Observable:
    """Anscombe-transformed numbers of pixels by their deviation from their surroundings in the median of repeats, by
    exposure.

    The bins are `TAIL_EDGES`, in standard deviations of single pixels. Hot pixels are the same in every frame, and as
    bright as the exposure is long. Telegraph noise is predicted where the temporal noise exceeds `LEAST_COUNTED_DN`:
    with less, all repeats of a pixel have one code. That any pixel is far off in several frames, where none is
    expected, counts as `PRESENCE` more. Raises NotDetermined without dark captures."""
    frames = [f for f in dataset.once(dark_frames) if f.fixed]
    points = [(f, out, part) for f in frames for out, part in f.fixed.items()]
    low = np.array([*TAIL_EDGES, -TAIL_EDGES[0], -TAIL_EDGES[1]])
    far = [(low >= FAR) & (part.of_median > 1) for *_, part in points]

    def rooted(counts: FloatArray, present: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Roots of counts (points x bins,); in a point's first bin that is far off, whether any pixel is, too."""
        found = rooted_counts(counts)
        for number, is_far in enumerate(far):
            if is_far.any():
                first = number * len(low)
                anywhere = counts[first : first + len(low)][is_far].sum()
                found[first + int(np.argmax(is_far))] += PRESENCE * present(anywhere)
        return found

    value = rooted(np.concatenate([part.counts for *_, part in points]), np.sign)
    size = dataset.camera.rows * dataset.camera.cols
    bins = len(points[0][2].counts)
    own = [_pixel_noise(dataset, f, part) for f, _, part in points]

    def expected(effects: Effects, times: float = 1.0) -> FloatArray:
        found = []
        for (f, _, part), (moving, fixed) in zip(points, own, strict=True):
            classes = _defect_classes(Uniform(dataset.camera, effects), dataset.noise.gain, f.condition.exposure_s)
            if moving < LEAST_COUNTED_DN * dataset.step_dn:
                classes = [c for c in classes if c.jump_dn == 0.0]
            skew = times * part.skewness * (part.spread_dn / moving) ** 3
            found.append(
                size * _tail_shares(classes, moving, fixed, part.of_median, part.spread_dn, dataset.noise.gain, skew)
            )
        return np.concatenate(found)

    labels = tuple(
        Label(float(low[b]), "all", f.condition.name, part.captures, out)
        for f, out, part in points
        for b in range(bins)
    )

    def predict(effects: Effects) -> Prediction:
        return Prediction(rooted(expected(effects), lambda number: -np.expm1(-number)), {})

    base = expected(())
    # the skewness of most pixels doesn't determine the far tail
    uncertain = np.abs(expected((), 2.0) - expected((), 0.0)) + 0.2 * base
    return Observable(
        measurement=DEFECTIVE_PIXELS, reach=1.0, value=value,
        covariance=_count_covariance(base, uncertain), labels=labels, reads=DEFECTS,
        predict=predict, scale=np.full(len(value), 10.0),
        along=np.tile(np.sign(low) * np.log(np.abs(low)), len(points)),
    )  # fmt: skip


def _pixel_noise(dataset: Dataset, frames: DarkStatistics, part: DarkPattern) -> tuple[float, float]:
    """(temporal, fixed) standard deviation of single pixels, DN. fixed^2 = spread^2 of the median frame - its temporal
    variance. Of a single frame, all counts as temporal."""
    moving = next((c.pixel_dn2 for c in frames.changing.values()), None)
    left, least = _order_moments(part.of_median)[1], 0.05 * dataset.step_dn
    if moving is None:
        return max(part.spread_dn, least), 0.0
    return max(float(np.sqrt(moving)), least), float(np.sqrt(max(part.spread_dn**2 - left * moving, 0.0)))


def _order_moments(n: int) -> tuple[float, float]:
    """Mean and variance of the lower median of n <= 5 standard normal numbers."""
    return {1: (0.0, 1.0), 2: (-0.5642, 0.6817), 3: (0.0, 0.4487), 4: (-0.2970, 0.3605), 5: (0.0, 0.2868)}[n]


@dataclass(frozen=True)
class _DefectClass:
    """Defective pixels of one size."""

    share: float  # of all pixels
    more_dn: float  # additional dark signal
    jump_dn: float  # distance of the two levels of telegraph noise, 0 without
    high_share: float = 0.5  # share of the frames at the higher level
    spread_dn: float = 0.0  # standard deviation of the additional dark signal, which a pixel has in all frames


def _defect_classes(model: Uniform, gain: float, exposure_s: float) -> list[_DefectClass]:
    """Return the defective pixels of a model's effects, by the nodes of their distributions of size. Each stands for
    a part of it: nodes alone would lie farther apart than the noise is wide, and counts in a bin jump where one
    passes its edge."""
    found = []
    for hot in model.hot:
        to_dn = gain * exposure_s
        found += [
            _DefectClass(float(s), to_dn * float(x), 0.0, spread_dn=to_dn * float(w))
            for s, x, w in zip(*hot.nodes(), hot.node_std(), strict=True)
        ]
    for jumps in model.telegraph:
        found += [
            _DefectClass(float(s), 0.0, gain * float(x), jumps.high_share) for s, x in zip(*jumps.nodes(), strict=True)
        ]
    return found


def _tail_shares(
    classes: Sequence[_DefectClass], moving: float, fixed: float, frames: int, spread: float, gain: float, skew: float
) -> FloatArray:
    """Expected shares of all pixels in the bins of `TAIL_EDGES` and the two of dark pixels, (bins,).

    A pixel's value is the lower median of `frames` numbers with the standard deviation `moving` (DN) and the skewness
    `skew`, on a normal fixed deviation of standard deviation `fixed` (DN). It is compared with the edges times `spread`
    (DN)."""
    low = np.array([*TAIL_EDGES, -TAIL_EDGES[0], -TAIL_EDGES[1]]) * spread + _order_moments(frames)[0] * moving
    own = np.hypot(fixed, [0.0, *(c.spread_dn for c in classes)])
    u = np.linspace(-7.5, 7.5, 61) if own.max() > 0.02 * moving else np.zeros(1)
    weight = np.exp(-0.5 * u * u)
    weight /= weight.sum()
    rest = 1.0 - sum(c.share for c in classes)
    share = np.array([max(rest, 0.0), *(c.share for c in classes)])
    more = np.array([0.0, *(c.more_dn for c in classes)])
    jump = np.array([0.0, *(c.jump_dn for c in classes)])
    high = np.array([0.5, *(c.high_share for c in classes)])[:, None, None]
    s = np.sqrt(moving**2 + gain * more)
    at = low[None, :, None] - own[:, None, None] * u[None, None, :] - more[:, None, None]
    low_level, high_level = (
        _upper((at - level * jump[:, None, None]) / s[:, None, None], skew) for level in (-high, 1.0 - high)
    )
    above = np.clip(high * high_level + (1.0 - high) * low_level, 0.0, 1.0)
    # the lower median is above an edge where at least `needed` of the frames are: a binomial tail probability
    needed = frames - (frames - 1) // 2
    if frames > 1:
        above = betainc(needed, frames - needed + 1, above)
    beyond = (above * weight).sum(axis=2)
    up = beyond[:, : len(TAIL_EDGES)]
    up = up - np.concatenate([up[:, 1:], np.zeros((len(share), 1))], axis=1)
    down = 1.0 - beyond[:, len(TAIL_EDGES) :]
    down = np.stack([down[:, 0] - down[:, 1], down[:, 1]], axis=1)
    return np.asarray(share @ np.concatenate([np.maximum(up, 0.0), np.maximum(down, 0.0)], axis=1))


def _upper(z: FloatArray, skew: float) -> FloatArray:
    """Probability that a variable of mean 0, variance 1 and small skewness exceeds z (first term of the Edgeworth
    series)."""
    return np.asarray(ndtr(-z) + np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) * skew / 6.0 * (z * z - 1.0))


def measure_flickering_pixels(dataset: Dataset) -> Observable:
    """Anscombe-transformed numbers of pixels by their temporal variance over that of their surroundings, all dark
    frames together.

    Raises NotDetermined without repeats, and where codes are too coarse.
    """
    fine = fine_conditions("flickering_pixels", dataset.once(dark_frames), LEAST_COUNTED_DN * dataset.step_dn)
    draws = _JumpDraws.of(fine)
    parts = {out: [(k, f) for k, f in enumerate(fine) if out in f.changing] for out in by_part(fine)}
    size = dataset.camera.rows * dataset.camera.cols
    value, labels, sums = [], [], []
    for out, part in parts.items():
        freedom = sum(f.changing[out].contrasts for _, f in part)
        edges = _flicker_edges(freedom)
        total = np.sum([f.changing[out].squares for _, f in part], axis=0)
        value.append(rooted_counts(np.histogram(total, [*edges, np.inf])[0].astype(float)))
        ids = tuple(i for _, f in part for i in captures_of(f, out))
        labels += [Label(float(x), "all", "all exposures", ids, out) for x in edges / freedom]
        sums.append((out, part, freedom, edges))

    def expected(effects: Effects) -> FloatArray:
        model, found = Uniform(dataset.camera, effects), []
        particles = model.particles
        for out, part, freedom, edges in sums:
            shares = _chance_above(np.array([freedom], float), np.zeros(1), edges)[0]
            for hot in model.hot:
                weight, rate = hot.nodes()
                shares = shares + weight @ (_hot_above(dataset, [f for _, f in part], out, rate, edges) - shares)
            for jumps in model.telegraph:
                weight, distance_e = jumps.nodes()
                unit = np.sum([draws.sums[k, out] / f.changing[out].pixel_dn2 for k, f in part], axis=0)
                above = _jump_above(dataset, unit, draws.weights(jumps.high_share), distance_e, edges, freedom)
                shares = shares + weight @ (above - shares)
            for law in particles:
                shares = shares + _hit_above(dataset, law, [f for _, f in part], out, edges, freedom)
            found.append(size * (shares - np.append(shares[1:], 0.0)))
        return np.maximum(np.concatenate(found), 0.0)

    base = expected(())
    position = np.array([label.x for label in labels])
    return Observable(
        measurement=FLICKERING_PIXELS, reach=1.0,
        value=np.concatenate(value), covariance=_count_covariance(base, base), labels=tuple(labels),
        reads=DEFECTS | PARTICLES, predict=lambda effects: Prediction(rooted_counts(expected(effects)), {}),
        scale=np.full(len(base), 10.0), along=np.log(position),
    )  # fmt: skip


def _flicker_edges(freedom: int) -> FloatArray:
    """Edges of the sum of squares over the variance, of `freedom` degrees of freedom."""
    return np.asarray(float(chdtri(freedom, FLICKER_CHANCE)) * np.array(FLICKER_EDGES))


def _chance_above(freedom: FloatArray, noncentral: FloatArray, edges: FloatArray) -> FloatArray:
    """Probability (n, edges) that chi-squared variables, (n,) degrees of freedom and non-centralities, exceed the
    edges: exact where all are central, else their cube root is taken as normal (Abdel-Aty 1954)."""
    if not np.any(noncentral):
        return np.asarray(chdtrc(freedom[:, None], edges[None, :]))
    a = (freedom + noncentral)[:, None]
    b = (noncentral / (freedom + noncentral))[:, None]
    variance = 2.0 * (1.0 + b) / (9.0 * a)
    return np.asarray(ndtr(-(np.cbrt(edges[None, :] / a) - 1.0 + variance) / np.sqrt(variance)))


def _hot_above(
    dataset: Dataset, part: Sequence[DarkStatistics], out: bool, rate: FloatArray, edges: FloatArray
) -> FloatArray:
    """Probability (rates, edges) that the shot noise of hot pixels of `rate` (e/s) takes them above the edges: a scaled
    chi-squared variable with the right first two moments."""
    count = np.array([f.changing[out].contrasts for f in part], float)
    noise = np.array([f.changing[out].pixel_dn2 for f in part])
    charge = dataset.noise.gain**2 * rate[:, None] * np.array([f.condition.exposure_s for f in part])
    factor = 1.0 + charge / noise
    mean, variance = factor @ count, 2.0 * np.square(factor) @ count
    scale = variance / (2.0 * mean)
    freedom = mean / scale
    return np.asarray(chdtrc(freedom[:, None], edges[None, :] / scale[:, None]))


def _hit_above(
    dataset: Dataset, law: Particles, part: Sequence[DarkStatistics], out: bool, edges: FloatArray, freedom: int
) -> FloatArray:
    """Probability (edges,) that a particle's charge takes a pixel above the edges: over all frames in which it may be
    hit."""
    pitch_um = dataset.camera.pixel_pitch_um
    number, charge_e = law.pixels_e(pitch_um)
    found: FloatArray = np.zeros(len(edges))
    for f in part:
        hit = law.expected_number(1, pitch_um, f.condition.exposure_s)
        for weight in np.sum(np.square(contrast_weights(f.condition, out)), axis=0):
            away = np.square(dataset.noise.gain * charge_e) * weight / f.changing[out].pixel_dn2
            found = found + hit * number @ _chance_above(
                np.full(len(away), float(freedom)), np.maximum(away, 1e-9), edges
            )
    return found


@dataclass(frozen=True)
class _JumpDraws:
    """`JUMPS` draws, always the same, of the frames in which a pixel with telegraph noise is at its higher level.

    They are drawn with the shares `HIGH_SHARES` in turn. For any other share, draws are weighted by their likelihood
    under it over the sum of their likelihoods under `HIGH_SHARES`, so that means over draws change smoothly with the
    share (multiple importance sampling, Veach and Guibas 1995).
    """

    sums: dict[
        tuple[int, bool], FloatArray
    ]  # (condition, held out) -> sums of squared contrasts (JUMPS,), levels 1 apart
    ones: FloatArray  # (JUMPS,): number of frames at the higher level
    frames: int

    @staticmethod
    def of(parts: Sequence[DarkStatistics]) -> _JumpDraws:
        share = np.resize(HIGH_SHARES, JUMPS)[:, None]
        rng = np.random.default_rng([len(f.condition.captures) for f in parts])
        sums: dict[tuple[int, bool], FloatArray] = {}
        ones, frames = np.zeros(JUMPS), 0
        for number, f in enumerate(parts):
            n, seen = len(f.condition.captures), len(f.condition.seen)
            state = (rng.random((JUMPS, n)) < share).astype(float)
            sums |= {(number, out): np.zeros(JUMPS) for out in (False, True)}
            mean = np.zeros(JUMPS)
            for k in range(n):
                if k:
                    sums[number, k >= seen] += (state[:, k] - mean) ** 2 * k / (k + 1.0)
                mean += (state[:, k] - mean) / (k + 1.0)
            ones, frames = ones + state.sum(axis=1), frames + n
        return _JumpDraws(sums, ones, frames)

    def weights(self, high_share: float) -> FloatArray:
        """Weights (JUMPS,) of the draws for a share of frames at the higher level; their sum is 1."""

        def log_chance(share: float) -> FloatArray:
            return np.asarray(self.ones * np.log(share) + (self.frames - self.ones) * np.log1p(-share))

        drawn = np.logaddexp.reduce([log_chance(share) for share in HIGH_SHARES], axis=0)
        weight = np.exp(log_chance(high_share) - drawn)
        return np.asarray(weight / weight.sum())


def _jump_above(
    dataset: Dataset,
    unit: FloatArray,
    weight: FloatArray,
    amplitude_e: FloatArray,
    edges: FloatArray,
    freedom: int,
) -> FloatArray:
    """Probability (amplitudes, edges) that telegraph noise takes pixels above the edges: mean over draws with the
    weights `weight`. `unit` (draws,): the non-centrality of an amplitude of 1 DN."""
    found = []
    for amplitude in amplitude_e:
        away = np.square(dataset.noise.gain * amplitude) * unit
        found.append(weight @ _chance_above(np.full(len(away), float(freedom)), np.maximum(away, 1e-9), edges))
    return np.array(found)


DEFECTIVE_PIXELS = Measurement(
    "defective_pixels",
    title="defective pixels",
    order=190,
    axis="deviation",
    unit="standard deviations",
    make=measure_defective_pixels,
    quantity="number of pixels, 2 sqrt(n + 3/8), 4 more where any lies far off",
    conditions="exposure and temperature",
)


FLICKERING_PIXELS = Measurement(
    "flickering_pixels",
    title="flickering pixels",
    order=195,
    axis="variance",
    unit="times their surroundings'",
    make=measure_flickering_pixels,
    quantity="number of pixels, 2 sqrt(n + 3/8)",
)
