"""The closed form: evidences of further hypotheses about a fitted set, with the prediction linear in them.

With the whitened residual r and the whitened signatures G, z = G'r and R = G'G give

    log p(y | A + k) / p(y | A) = log integral exp(c'z - c'R c / 2) p(c) dc

over the coefficients c of the signatures of k. The groups of small physics are projected out of z and R at given
scales; the ratio is averaged over these scales. The same integrals give the distribution of p(nothing) over healthy
draws (`HealthyDraws`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from lab.inference.hypotheses import (
    Coordinate,
    Hypothesis,
    SetPrior,
    log_size_prior,
    size_precision,
    symmetric,
)
from lab.inference.laplace import integrate
from lab.inference.model import Model, ScaleIntegral
from sim.spectrum import FloatArray

#: Gain of log evidence up to which the recordings say little of a set beyond its nearest refitted subset: the closed
#: form is as good as a refit there, and the evidences of such members multiply.
SILENT = 1.0
#: Standard deviations of an amplitude above which it is integrated about its mode.
STRONG = 6.0
#: Largest signal of several amplitudes that are integrated one after the other, in standard deviations.
_WEAK = 3.0
#: Points of a table of one amplitude's log odds over z, and of its size.
_TABLE, _SIZES = 17, 64
#: Most steps towards the mode of amplitudes with heavy-tailed priors.
_MODE_STEPS = 40
_HERMITE = np.polynomial.hermite_e.hermegauss(9)
_HERMITE = (_HERMITE[0], _HERMITE[1] / _HERMITE[1].sum())
#: Distance from the mode beyond which an amplitude is integrated along with those near 0: that of the last point.
_BEYOND = 4.5


@dataclass(frozen=True)
class Signature:
    """An alternative's changes of the prediction (n, k), given no other hypothesis. `is_whole`, `log_share`: as of the
    alternative."""

    owner: str
    index: int  # of the alternative
    raw: FloatArray
    coordinates: tuple[Coordinate, ...]  # of the coefficients
    columns: tuple[int, ...]  # in the stacked table
    points: tuple[tuple[int, int | None], ...]  # of each column, the alternative's points of positive and negative sign
    is_whole: bool = False
    log_share: float = 0.0

    def of_points(self, c: FloatArray, count: int) -> FloatArray:
        """Return the coefficients (>= 0) of all points of the alternative, given those of the columns."""
        found = np.zeros(count)
        for (plus, minus), one in zip(self.points, c, strict=True):
            if one >= 0.0 or minus is None:
                found[plus] = max(one, 0.0)
            else:
                found[minus] = -one
        return found


def signatures_of(model: Model, hypotheses: Mapping[str, Hypothesis]) -> tuple[Signature, ...]:
    """Return the signatures of all alternatives that change the prediction at all."""
    base = model.mean({})
    found: list[Signature] = []
    at = 0
    for name, hypothesis in hypotheses.items():
        for index, alternative in enumerate(hypothesis.alternatives):
            raw = np.column_stack([model.mean({name: p}) - base for p in alternative.points])
            if not raw.any():
                continue
            points = _merge_opposite(raw, alternative.scales)
            raw = raw[:, [plus for plus, _ in points]]
            smaller = min((c.smaller for c in hypothesis.coordinates if not c.is_shape), default=1.0)
            coords = tuple(
                Coordinate("c", alternative.scales[plus], lower=0.0 if minus is None else -np.inf, smaller=smaller)
                for plus, minus in points
            )
            columns = tuple(range(at, at + raw.shape[1]))
            found.append(
                Signature(name, index, raw, coords, columns, points, alternative.is_whole, alternative.log_share)
            )
            at += raw.shape[1]
    return tuple(found)


def _merge_opposite(raw: FloatArray, scales: Sequence[float]) -> tuple[tuple[int, int | None], ...]:
    """Return which columns stand for which of the points: two of opposite sign are one column."""
    found: dict[int, int | None] = {}
    size = np.linalg.norm(raw, axis=0)
    for k in range(raw.shape[1]):
        opposite = [
            j for j, other in found.items()
            if other is None and raw[:, j] @ raw[:, k] < -0.98 * size[j] * size[k]
            and abs(scales[j] - scales[k]) < 1e-9 * scales[k]
        ]  # fmt: skip
        if opposite:
            found[opposite[0]] = k
        else:
            found[k] = None
    return tuple(found.items())


def project_groups(gram: FloatArray, amplitude: FloatArray) -> FloatArray:
    """Return the Gram matrix of all columns after the first R with these marginalised, whose coefficients have the
    standard deviations `amplitude` (R,)."""
    there = np.concatenate([amplitude > 0.0, np.ones(len(gram) - len(amplitude), bool)])
    gram, amplitude = gram[np.ix_(there, there)], amplitude[amplitude > 0.0]
    at = len(amplitude)
    inner = np.eye(at) + amplitude[:, None] * gram[:at, :at] * amplitude
    across = amplitude[:, None] * gram[:at, at:]
    solved = cho_solve(cho_factor(inner, lower=True, check_finite=False), across, check_finite=False)
    return np.asarray(gram[at:, at:] - across.T @ solved)


def integrate_set(z: FloatArray, gram: FloatArray, members: Sequence[Signature]) -> tuple[float, FloatArray]:
    """Log evidence ratio of some signatures together over none, and the coefficients at the mode."""
    own = [k for s in members for k in s.columns]
    coords = [c for s in members for c in s.coordinates]
    a, b = gram[np.ix_(own, own)], z[own]
    low = np.array([c.lower for c in coords])
    scale, smaller = np.array([c.scale for c in coords]), np.array([c.smaller for c in coords])
    whole = np.array([s.is_whole for s in members for _ in s.columns], bool)
    c = whole.astype(float)
    free = np.flatnonzero(~whole)
    for _ in range(_MODE_STEPS):
        before = c.copy()
        weight = size_precision(c / scale, smaller) / np.square(scale)
        for k in free:
            c[k] = max((b[k] - a[k] @ c + a[k, k] * c[k]) / (a[k, k] + weight[k]), low[k])
        if np.all(np.abs(c - before) < 1e-4 * scale):
            break
    slope = b - a @ c
    found = integrate(a[np.ix_(free, free)], slope[free], [coords[int(k)] for k in free], c[free])
    return float(b @ c - 0.5 * c @ a @ c) + found.log_integral, c


def integrate_each(z: FloatArray, gram: FloatArray, signatures: Sequence[Signature]) -> list[tuple[float, FloatArray]]:
    """Return `integrate_set` of each signature by itself; those of one amplitude together, by quadrature."""
    found: list[tuple[float, FloatArray]] = [(0.0, np.zeros(0))] * len(signatures)
    ones = [i for i, s in enumerate(signatures) if len(s.columns) == 1 and not s.is_whole]
    if ones:
        own = np.array([signatures[i].columns[0] for i in ones])
        coords = [signatures[i].coordinates[0] for i in ones]
        b, a = z[own], np.maximum(gram[own, own], 1e-300)
        low, scale = np.array([c.lower for c in coords]), np.array([c.scale for c in coords])
        smaller = np.array([c.smaller for c in coords])
        odds = amplitude_log_odds(b, a, scale, np.isfinite(low), smaller)
        mode = np.zeros(len(ones))
        for _ in range(_MODE_STEPS):
            weight = size_precision(mode / scale, smaller) / np.square(scale)
            before, mode = mode, np.maximum(b / (a + weight), low)
            if np.all(np.abs(mode - before) < 1e-4 * scale):
                break
        for i, value, c in zip(ones, odds.tolist(), mode, strict=True):
            found[i] = value, np.array([c])
    for i in set(range(len(signatures))) - set(ones):
        found[i] = integrate_set(z, gram, [signatures[i]])
    return found


def amplitude_log_odds(
    z: FloatArray, square: FloatArray, scale: FloatArray, positive: np.ndarray, smaller: FloatArray
) -> FloatArray:
    """Return the log evidence ratios log integral exp(z c - square c^2 / 2) p(c) dc of single amplitudes, all (m,).

    p is the prior of sizes (`log_size_prior`) of this scale, of c > 0 where `positive`. In x = c sqrt(square) the
    data's part has unit width; its points lie closer towards 0, where the prior may be narrower. Amplitudes above
    `STRONG` standard deviations are integrated about the data's mode, which the prior bends little."""
    root = np.sqrt(np.maximum(square, 1e-300))
    signal, width = z / root, scale * root
    size = np.abs(signal)
    strong = np.where(positive, signal, size) > STRONG
    least = np.minimum(width * smaller, 1.0 / np.maximum(size, 1.0))
    x, weight = _sizes(least, np.where(strong, size - _BEYOND, STRONG + 6.0))
    prior = log_size_prior(x / width[:, None], smaller[:, None])
    fall = prior - np.log(width)[:, None] + np.log(weight) - 0.5 * x * x
    odds = logsumexp(fall + signal[:, None] * x, axis=1)
    odds = np.where(positive, odds + np.log(2.0), np.logaddexp(odds, logsumexp(fall - signal[:, None] * x, axis=1)))
    if strong.any():
        about = size[strong, None] + _HERMITE[0]
        prior = log_size_prior(about / width[strong, None], smaller[strong, None])
        peak = logsumexp(prior + np.log(_HERMITE[1]), axis=1)
        peak += 0.5 * np.square(size[strong]) - np.log(width[strong]) + 0.5 * np.log(2.0 * np.pi)
        odds[strong] = np.logaddexp(odds[strong], peak + np.where(positive[strong], np.log(2.0), 0.0))
    return np.asarray(odds)


def _sizes(least: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points and weights (m, p) of the integrals from 0 to `end` (m,), at 0 as close as a tenth of `least` (m,)."""
    share, weight = np.polynomial.legendre.leggauss(_SIZES)
    first = 0.1 * np.maximum(least, 1e-6)[:, None]
    last = np.arcsinh(end[:, None] / first)
    t = 0.5 * (share + 1.0) * last
    return np.asarray(first * np.sinh(t)), np.asarray(0.5 * weight * last * first * np.cosh(t))


def signature_log_odds(z: FloatArray, gram: FloatArray, signatures: Sequence[Signature]) -> FloatArray:
    """Return the log evidence ratios (s,) of single signatures, of z (m,) and R (m, m) of all columns.

    Of several columns with weak signals, each is integrated with those before it marginalised, or at 0 where they are
    at their bound; of those with strong ones, all together (`integrate_set`)."""
    found = np.zeros(len(signatures))
    signal = np.abs(z) / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    parts: list[tuple[int, float, float, float, bool, float]] = []
    for i, s in enumerate(signatures):
        own = list(s.columns)
        if s.is_whole:
            found[i] = z[own[0]] - 0.5 * gram[own[0], own[0]]
            continue
        if len(own) > 1 and signal[own].max() > _WEAK:
            found[i] = integrate_set(z, gram, [s])[0]
            continue
        b, a = z[own], gram[np.ix_(own, own)]
        for k, c in enumerate(s.coordinates):
            positive = bool(np.isfinite(c.lower))
            parts.append((i, b[k], max(a[k, k], 1e-9 * gram[own[k], own[k]]), c.scale, positive, c.smaller))
            curvature = a[k, k] + c.scale**-2.0
            if k + 1 < len(own) and not (positive and b[k] <= 0.0):
                share = a[k] / curvature
                b, a = b - share * b[k], a - share[:, None] * a[k]
    if parts:
        index, left, square, scale, positives, smaller = (np.array(column) for column in zip(*parts, strict=True))
        np.add.at(found, index, amplitude_log_odds(left, square, scale, positives, smaller))
    return found


def log_odds_of_draws(z: FloatArray, square: float, coordinate: Coordinate) -> FloatArray:
    """Return `amplitude_log_odds` of many z (D,) of one signature, by a table over z. Between its points the log odds
    bend by 1 / square at most, so that lines are right to 0.03 where z spans eight standard deviations."""
    nodes = np.linspace(z.min(), z.max(), _TABLE)
    root = float(np.sqrt(max(square, 1e-300)))
    width, end = coordinate.scale * root, 6.0 + float(np.abs(nodes).max()) / root
    x, weight = _sizes(np.array([min(width * coordinate.smaller, 0.2)]), np.array([end]))
    prior = log_size_prior(x / width, np.asarray(coordinate.smaller))
    fall = (prior - np.log(width) + np.log(weight) - 0.5 * x * x)[0]
    exponent = fall + nodes[:, None] / root * x
    if not np.isfinite(coordinate.lower):
        exponent = np.concatenate([exponent, fall - nodes[:, None] / root * x], axis=1) - np.log(2.0)
    top = exponent.max(axis=1)
    odds = top + np.log(np.exp(exponent - top[:, None]).sum(axis=1)) + np.log(2.0)
    return np.asarray(np.interp(z, nodes, odds))


def log_mean_exp(values: FloatArray) -> FloatArray:
    """Log of the mean of exp along the first axis."""
    top = values.max(axis=0)
    return np.asarray(top + np.log(np.mean(np.exp(values - top), axis=0)))


@dataclass(frozen=True)
class HealthyDraws:
    """Draws without effects or unlisted physics in whitened coordinates: noise, theta and everyday delta of their
    priors. `gram` (K, K): M of the groups' columns and all signatures; `projected` (K, D): W'r of the draws; `square`
    (D,): r'r."""

    gram: FloatArray
    projected: FloatArray
    square: FloatArray
    scales: ScaleIntegral

    @classmethod
    def of(
        cls, model: Model, signatures: Sequence[Signature], any_unlisted: float, draws: int, rng: np.random.Generator
    ) -> HealthyDraws:
        """Draw."""
        groups = tuple(model.groups)
        sizes = tuple(g.columns.shape[1] for g in groups)
        at, none = sum(sizes), np.zeros(0)
        columns = np.concatenate([*(g.columns for g in groups), *(s.raw for s in signatures)], axis=1)
        white = model.gaussian({}, 0.0).whiten(columns)
        gram = white.T @ white
        tau = np.array([[g.everyday] for g in groups]) * np.abs(rng.standard_normal((len(groups), draws)))
        delta = np.repeat(tau, sizes, axis=0) * rng.standard_normal((at, draws))
        residual = rng.standard_normal((len(white), draws)) + white[:, :at] @ delta
        priors = ScaleIntegral.log_priors(groups, any_unlisted)
        scales = ScaleIntegral(gram[:at, :at], none, sizes, none, groups, priors)
        return cls(gram, white.T @ residual, np.square(residual).sum(axis=0), scales)

    def one(self, d: int) -> tuple[ScaleIntegral, FloatArray]:
        """Return the integral over the scales of one draw, and the Gram matrix of all columns and its residual."""
        own = self.projected[:, d : d + 1]
        whole = np.block([[self.gram, own], [own.T, self.square[d : d + 1, None]]])
        return replace(self.scales, projected=own[: len(self.scales.gram), 0], _known={}), whole

    def screen(
        self, hypotheses: Iterable[str], signatures: Sequence[Signature], prior: SetPrior
    ) -> FloatArray:  # fmt: skip
        """Return p(no effect, nothing unlisted) of all draws, (D,), roughly and mostly too low: the scales of all other
        groups are at their medians, so that effects and flips also take what a group with a larger scale left."""
        groups, draws = self.scales.groups, self.projected.shape[1]
        middle = np.array([float(g.everyday_quantile(np.array(0.5))) for g in groups])
        flips = [np.zeros(draws)]
        more_prior = self.scales.prior_log[1] - self.scales.prior_log[0]
        by_state: dict[str, FloatArray] = {}  # log evidence of the everyday scales of a state over that of their median
        for g, group in enumerate(groups):
            if not group.varies(False):
                continue
            points, other = group.scales(False), group.scales(True) if group.may_be_unlisted else np.zeros(0)
            at = np.concatenate([points, other, middle[g : g + 1]])
            values = self.scales.profiles(g, middle, at, self.projected[: len(self.scales.gram)])
            usual = logsumexp(values[: len(points)] + np.log(group.shares(False))[:, None], axis=0)
            by_state[group.name] = usual - values[-1]
            if group.may_be_unlisted:
                beyond = values[len(points) : -1] + np.log(group.shares(True))[:, None]
                flips.append(logsumexp(beyond, axis=0) - usual + more_prior[g])
        for g, values in self.scales.profiles_of_processes(middle, self.projected[: len(self.scales.gram)]):
            group = groups[g]
            more = logsumexp(values + np.log(group.shares(True))[:, None], axis=0)
            flips.append(more - by_state.get(group.name, np.zeros(draws)) + more_prior[g])
        gains = gains_of(self._odds(middle, signatures), hypotheses, signatures)
        return 1.0 / (np.exp(logsumexp(flips, axis=0)) + others_over_empty(gains, prior))

    def _odds(self, tau: FloatArray, signatures: Sequence[Signature]) -> FloatArray:
        """Log odds of every signature and draw with the groups at these scales, (s, D). Of several columns of a
        signature the likeliest gains, and the others cost what they do by themselves."""
        both = np.concatenate([self.gram, self.projected], axis=1)
        at, draws = len(self.scales.gram), self.projected.shape[1]
        amplitude = np.repeat(tau, self.scales.group_sizes)
        there = np.flatnonzero(amplitude)
        amplitude = amplitude[there]
        inner = np.eye(len(there)) + amplitude[:, None] * self.gram[np.ix_(there, there)] * amplitude
        solved = cho_solve(
            cho_factor(inner, lower=True, check_finite=False), amplitude[:, None] * both[there, at:], check_finite=False
        )
        left = both[at:, at:] - (amplitude[:, None] * self.gram[there, at:]).T @ solved
        split = left.shape[1] - draws
        found = np.empty((len(signatures), draws))
        for i, s in enumerate(signatures):
            if s.is_whole:
                (k,) = s.columns
                found[i] = left[k, split:] - 0.5 * left[k, k]
                continue
            columns = zip(s.columns, s.coordinates, strict=True)
            each = np.array([log_odds_of_draws(left[k, split:], float(left[k, k]), c) for k, c in columns])
            best = each.max(axis=0)
            found[i] = best + np.minimum(each, 0.0).sum(axis=0) - np.minimum(best, 0.0)
        return found


def gains_of(
    ratio: FloatArray, hypotheses: Iterable[str], signatures: Sequence[Signature]
) -> dict[str, FloatArray]:  # fmt: skip
    """Return the log evidence ratios of hypotheses: the mean over their alternatives of those of their signatures (s,)
    or (s, D)."""
    own: dict[str, list[int]] = {}
    for i, s in enumerate(signatures):
        own.setdefault(s.owner, []).append(i)
    share = np.array([s.log_share for s in signatures])
    weighted = ratio + share.reshape(-1, *(1,) * (ratio.ndim - 1))
    return {name: log_mean_exp(weighted[own[name]]) for name in hypotheses if name in own}


def others_over_empty(gains: Mapping[str, FloatArray], prior: SetPrior) -> FloatArray:
    """Return the probability of all other sets over that of the empty one, of the log evidence ratios of single
    hypotheses: of the sets of which at most one member gains more than `SILENT`; the evidences of the others
    multiply."""
    weight = {name: prior.weight[name] * np.exp(np.minimum(gain, 500.0)) for name, gain in gains.items()}
    silent = [np.where(gains[name] <= SILENT, w, 0.0) for name, w in weight.items()]
    loud = np.sum([np.where(gains[name] > SILENT, w, 0.0) for name, w in weight.items()], axis=0)
    sums = symmetric(silent, len(prior.number) - 1)
    total = sum(prior.scale(k) * (sums[k] + loud * sums[k - 1]) for k in range(1, len(prior.number)))
    return np.asarray(total / prior.scale(0))
