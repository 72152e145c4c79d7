"""The chain of decisions for one side: locate, score, search, weigh, and describe what is left without a name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.diagnose.inference.discrepancy import Discrepancy, likeliest_discrepancy, predictive_discrepancy
from lab.diagnose.inference.locate import Slice, mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.naming import named_members
from lab.diagnose.inference.refit import log_likelihood
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.search import Search
from lab.diagnose.inference.weigh import UNKNOWN, Candidate
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect
from sim.effects.library import candidates
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class Verdict:
    """What one side shows.

    `before`, `after`: mismatches of the baseline, and with the named effects. `named`: most significant first.
    `abstained`: candidates that weren't named. `discrepancies`: of the blocks that have a mismatch left.
    """

    model: MeasurementModel
    threshold: float
    top_score: float
    before: tuple[Slice, ...]
    named: tuple[Candidate, ...]
    abstained: tuple[Candidate, ...]
    after: tuple[Slice, ...]
    discrepancies: tuple[Discrepancy, ...]

    @property
    def kernels(self) -> dict[int, FloatArray]:
        """Covariances of the discrepancies that are likelier than none, by block."""
        return {d.index: d.kernel for d in self.discrepancies if d.log_odds > 0}

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The named effects."""
        return tuple(c.effect for c in self.named)


def decide(
    model: MeasurementModel,
    rng: np.random.Generator,
    policy: DecisionPolicy,
    report: Callable[[str], None] = lambda _: None,
    *,
    least_threshold: float = 0.0,
) -> Verdict:
    """The whole chain on one side's measurement model; deterministic for a given generator. `least_threshold` of the
    scores: from drawn healthy cameras, where there are any (`bootstrap.py`)."""
    known = candidates()
    first = signatures(model, model.camera, (), known)
    threshold = max(first.threshold(rng, 1.0 - policy.false_alarm_rate, policy.threshold_draws), least_threshold)
    scores = first.scores()
    top = scores[0].value if scores else 0.0
    before = mismatches(model, model.gaussian(), policy)
    search = Search(model, known, threshold, policy)
    named, abstained = named_members(search, search.best(report), report)
    if top > threshold + policy.lone_score_margin and not named and not before and not abstained:
        abstained.append(Candidate(scores[0].start, {}, 0.0, ((UNKNOWN, 1.0),), 0.5 * top))
    while True:
        named.sort(key=lambda c: -c.log_odds)
        effects = tuple(c.effect for c in named)
        after = mismatches(model, model.gaussian(effects), policy)
        left = list(dict.fromkeys(model.blocks.index(s.block) for s in after))
        if abstained and not left:
            left = [model.strongest_block(abstained[0].effect, effects)]
        gaussian = model.seen_gaussian(effects)
        likeliest = [likeliest_discrepancy(model, gaussian, i, policy) for i in left]
        parts = [c for c in named if after and _is_part_of_unknown(model, c, effects, likeliest, policy)]
        if not parts:
            told = tuple(_with_either_sign(model, c, effects, policy) for c in named)
            discrepancies = tuple(predictive_discrepancy(model, gaussian, i, policy) for i in left)
            return Verdict(model, threshold, top, before, told, tuple(abstained), after, discrepancies)
        # the weakest goes first: without it, what is left may be within the other laws' tolerances
        abstained.append(parts[-1])
        rest = search.fitted(tuple(c.effect for c in named if c is not parts[-1]), converged=True)
        kept = {c.effect.name: c for c in named}
        named = [replace(kept[e.name], effect=e, std=s) for e, s in zip(rest.effects, rest.std, strict=True)]


def _with_either_sign(
    model: MeasurementModel, candidate: Candidate, effects: tuple[Effect, ...], policy: DecisionPolicy
) -> Candidate:
    """The candidate with standard deviations about the value told that hold both signs of parameters that act by their
    square, where the recordings don't tell the sign: sqrt(s^2 + (2 v)^2 / 2)."""
    effect = candidate.effect
    both = {
        name: float(getattr(effect, name))
        for name, q in type(effect).quantities().items()
        if q.linear_power == 2 and (q.lower is None or q.lower < 0.0)
    }
    if not both:
        return candidate
    mirrored = effect.having(**{n: -v for n, v in both.items()})
    others = tuple(e for e in effects if e is not effect)
    if log_likelihood(model, (*others, mirrored)) < log_likelihood(model, effects) - policy.equal_sign_log_odds:
        return candidate
    std = {
        n: s if s is None or n not in both else float(np.hypot(s, np.sqrt(2.0) * both[n]))
        for n, s in candidate.std.items()
    }
    return replace(candidate, std=std)


def _is_part_of_unknown(
    model: MeasurementModel,
    candidate: Candidate,
    effects: Sequence[Effect],
    discrepancies: Iterable[Discrepancy],
    policy: DecisionPolicy,
) -> bool:
    """Whether the frames in which an effect shows most hold a discrepancy that is strong beside it: both may have one
    unknown cause."""
    strongest = model.strongest_block(candidate.effect, effects)
    frames = _frames(model, strongest)

    def is_strong(one: Discrepancy) -> bool:
        share = policy.own_remainder_share if one.index == strongest else policy.remainder_share
        return one.log_odds > max(share * candidate.log_odds, policy.remainder_log_odds)

    def shares_frames(index: int) -> bool:
        other = _frames(model, index)
        return 2 * len(frames & other) > min(len(frames), len(other))

    return any(shares_frames(d.index) for d in discrepancies if is_strong(d))


def _frames(model: MeasurementModel, index: int) -> set[str]:
    """Ids of a block's captures."""
    return {name for label in model.blocks[index].labels for name in label.captures}
