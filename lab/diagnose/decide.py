"""The chain for one side: locate, score, refit, weigh against rivals and the unknown, hold against what wasn't seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from lab.diagnose.evidence import Evidence
from lab.diagnose.locate import Slice, look
from lab.diagnose.refit import Fit, likelihood, refit
from lab.diagnose.score import Score, signatures
from lab.diagnose.unknown import Discrepancy, discrepancy
from sim.effects.base import Effect
from sim.effects.library import effects as library

FALSE_ALARM_RATE = 0.01
MOST_EFFECTS = 4
SCREENED = 8  # candidates that are refitted in a step
#: A name has to hold this share of the probability against its rivals and the unknown, else the diagnosis abstains.
NAMED_FROM = 0.6
#: Nats by which the unknown has to lag: an effect's law is sharper than a process that fits anything smooth.
UNKNOWN_HANDICAP = 0.0
#: A score that no slice and no refit bears out has to exceed the threshold by so much, for what a covariance doesn't hold.
LONE_SCORE = 10.0
#: A declared rival beside an effect has to gain this share of what that gains: less may be an error of the effect's law.
COMPANION_SHARE = 0.03


@dataclass(frozen=True)
class Candidate:
    """One effect that was named, with the probability of its name and of its rivals."""

    effect: Effect
    std: dict[str, float | None]
    probability: float
    rivals: tuple[tuple[str, float], ...]
    gain: float  # nats over the same set without it


@dataclass(frozen=True)
class Verdict:
    """What one side shows."""

    evidence: Evidence
    threshold: float
    top_score: float
    before: tuple[Slice, ...]  # significant slices under the baseline
    named: tuple[Candidate, ...]
    abstained: tuple[Candidate, ...]
    after: tuple[Slice, ...]  # significant slices with the named effects
    unknown: tuple[Discrepancy, ...]

    @property
    def effects(self) -> tuple[Effect, ...]:
        return tuple(c.effect for c in self.named)


def decide(evidence: Evidence, rng: np.random.Generator, report: Callable[[str], None] = lambda _: None) -> Verdict:
    """The whole chain on one side's evidence. Deterministic for a given generator."""
    known = tuple(effect for effect in library().values() if effect.shown_by)
    current = refit(evidence, ())
    first = signatures(evidence, evidence.camera, (), known)
    threshold = first.threshold(rng, 1.0 - FALSE_ALARM_RATE)
    scores = first.scores()
    top = scores[0].value if scores else 0.0
    before = tuple(s for s in look(evidence, evidence.gaussian()) if s.significant)

    while len(current.effects) < MOST_EFFECTS:
        report(f"looking for {'another' if current.effects else 'an'} effect")
        better = _grown(evidence, current, scores, threshold)
        if better is None:
            break
        current = _pruned(evidence, better, threshold)
        current = _swapped(evidence, current, known)
        scores = signatures(
            evidence, evidence.camera, current.effects, _others(known, current), current.tangents
        ).scores()

    named, abstained = _believed(evidence, current, known, threshold, report)
    effects = tuple(c.effect for c in named)
    if top > threshold + LONE_SCORE and not named and not before and not abstained:
        # something is off that no effect fits any better than nothing does
        abstained.append(Candidate(first.scores()[0].start, {}, 0.0, (("unknown", 1.0),), 0.5 * top))
    model = evidence.gaussian(effects)
    after = tuple(s for s in look(evidence, model) if s.significant)
    unexplained = {id(s.block): evidence.blocks.index(s.block) for s in after}
    for c in abstained:
        if not unexplained:
            touched = max(
                (i for i, b in enumerate(evidence.blocks) if b.touched_by(type(c.effect))),
                key=lambda i: _gain(evidence, c.effect, effects, i),
            )
            unexplained[id(evidence.blocks[touched])] = touched
    unknown = tuple(discrepancy(evidence, model, i) for i in unexplained.values())
    return Verdict(evidence, threshold, top, before, tuple(named), tuple(abstained), after, unknown)


def _gain(evidence: Evidence, effect: Effect, others: tuple[Effect, ...], index: int) -> float:
    at = evidence.slices[index]
    change = evidence.mean((*others, effect))[at] - evidence.mean(others)[at]
    return float(np.sum(np.square(change) / np.diag(evidence.blocks[index].covariance)))


def _others(known: Iterable[type[Effect]], current: Fit) -> list[type[Effect]]:
    return [e for e in known if e.name not in current.names]


def _grown(evidence: Evidence, current: Fit, scores: list[Score], threshold: float) -> Fit | None:
    """The best set with one effect more, or None where none earns its place."""
    likely = [s for s in scores if s.value > threshold][:SCREENED]
    if not likely:
        return None
    fits = [refit(evidence, (*current.effects, s.start), passes=2, evaluations=8) for s in likely]
    fits.sort(key=lambda f: -f.weight)
    final = [refit(evidence, f.effects) for f in fits[:2]]
    best = max(final, key=lambda f: f.weight)
    return best if best.weight - current.weight > 0.5 * threshold else None


def _pruned(evidence: Evidence, fit: Fit, threshold: float) -> Fit:
    """Without the effects that no longer earn their place."""
    while len(fit.effects) > 1:
        without = [
            refit(evidence, (*fit.effects[:i], *fit.effects[i + 1 :]), passes=2) for i in range(len(fit.effects) - 1)
        ]
        best = max(without, key=lambda f: f.weight)
        if fit.weight - best.weight > 0.5 * threshold:
            return fit
        fit = best
    return fit


def _swapped(evidence: Evidence, fit: Fit, known: Iterable[type[Effect]]) -> Fit:
    """With any of the earlier effects replaced by a declared rival, where that fits better."""
    if len(fit.effects) < 2:
        return fit
    for i in range(len(fit.effects) - 1):
        for other in known:
            if other.name in type(fit.effects[i]).rivals and other.name not in fit.names:
                start = _start_like(evidence, other, fit.effects, i)
                if start is None:
                    continue
                tried = refit(evidence, (*fit.effects[:i], start, *fit.effects[i + 1 :]), passes=1, evaluations=8)
                if tried.weight > fit.weight + 1.0:
                    fit = refit(evidence, tried.effects)
    return fit


def _start_like(evidence: Evidence, other: type[Effect], effects: tuple[Effect, ...], index: int) -> Effect | None:
    """Where a refit of a rival in an effect's place begins: its prototypes' best combination for what the effect explains."""
    rest = (*effects[:index], *effects[index + 1 :])
    found = signatures(evidence, evidence.camera, rest, [other]).scores()
    return found[0].start if found else None


def _believed(
    evidence: Evidence, current: Fit, known: Iterable[type[Effect]], threshold: float, report: Callable[[str], None]
) -> tuple[list[Candidate], list[Candidate]]:
    """The effects whose names hold against rivals and the unknown, and those that were given up, least likely first.

    What is given up no longer props up the others: these are fitted and weighed again without it.
    """
    given_up: list[Candidate] = []
    while current.effects:
        members = []
        for index, e in enumerate(current.effects):
            report(f"weighing {e.name} against its rivals")
            members.append(_weighed(evidence, current, index, known))
        crowd = _crowd(evidence, current)
        if crowd:
            lost = [members[i] for i in crowd]
        else:
            worst = min(members, key=lambda c: (not _companion(c, members), c.probability))
            weak = worst.probability < NAMED_FROM or 2.0 * worst.gain < threshold or _companion(worst, members)
            lost = [worst] if weak else []
        if not lost:
            return members, given_up
        given_up += lost
        left = tuple(c.effect for c in members if c not in lost)
        current = refit(evidence, left, passes=2)
    return [], given_up


def _companion(candidate: Candidate, members: list[Candidate]) -> bool:
    """Whether an effect may be no more than the error of a stronger one's law."""
    return any(
        candidate.effect.name in type(other.effect).rivals and candidate.gain < COMPANION_SHARE * other.gain
        for other in members
        if other is not candidate
    )


def _crowd(evidence: Evidence, fit: Fit) -> list[int]:
    """Indices of effects that only together stand for one smooth discrepancy: two or more on one measurement that a process
    without a name replaces at less cost."""
    by_block: dict[int, list[int]] = {}
    for i, e in enumerate(fit.effects):
        rest = (*fit.effects[:i], *fit.effects[i + 1 :])
        touched = [k for k, b in enumerate(evidence.blocks) if b.touched_by(type(e))]
        if touched:
            by_block.setdefault(max(touched, key=lambda k, e=e, rest=rest: _gain(evidence, e, rest, k)), []).append(i)  # type: ignore[misc]
    full = evidence.gaussian(fit.effects)
    for index, members in by_block.items():
        if len(members) < 2:
            continue
        fewer = refit(evidence, tuple(e for i, e in enumerate(fit.effects) if i not in members), passes=2)
        bare = evidence.gaussian(fewer.effects)
        if (
            fewer.weight + discrepancy(evidence, bare, index).gain
            > fit.weight + discrepancy(evidence, full, index).gain
        ):
            return members
    return []


def _weighed(evidence: Evidence, fit: Fit, index: int, known: Iterable[type[Effect]]) -> Candidate:
    """Probabilities of an effect's name, of its rivals in its place, and of something unknown."""
    effect = fit.effects[index]
    rest = (*fit.effects[:index], *fit.effects[index + 1 :])
    without = refit(evidence, rest, passes=2)
    weights = {effect.name: fit.weight}
    likely = signatures(evidence, evidence.camera, without.effects, _others(known, fit), without.tangents).scores()
    declared = type(effect).rivals
    pool = [s for s in likely if s.effect.name in declared or s.value > 0.3 * likely[0].value]
    for score in pool[:SCREENED]:
        if score.value < 0.3 * 2.0 * (fit.weight - without.weight) and score.effect.name not in declared:
            continue
        if score.value <= 0:
            continue
        tried = refit(
            evidence, (*fit.effects[:index], score.start, *fit.effects[index + 1 :]), passes=2, evaluations=10
        )
        weights[score.effect.name] = tried.weight
    touched = [i for i, b in enumerate(evidence.blocks) if b.touched_by(type(effect))]
    with_effect, bare, refitted = (evidence.gaussian(e) for e in (fit.effects, rest, without.effects))
    for name in list(weights):
        if name == effect.name:
            weights[name] += sum(discrepancy(evidence, with_effect, i).gain for i in touched)
    alone = (
        likelihood(evidence, rest)
        + (fit.weight - fit.log_likelihood)
        + sum(discrepancy(evidence, bare, i).gain for i in touched)
    )
    unknown = max(alone, without.weight + sum(discrepancy(evidence, refitted, i).gain for i in touched))
    weights["unknown"] = unknown - UNKNOWN_HANDICAP
    top = max(weights.values())
    share = {name: float(np.exp(w - top)) for name, w in weights.items()}
    total = sum(share.values())
    rivals = tuple(
        sorted(((n, s / total) for n, s in share.items() if n != effect.name and s / total > 1e-4), key=lambda r: -r[1])
    )
    return Candidate(effect, fit.std[index], share[effect.name] / total, rivals, fit.weight - without.weight)
