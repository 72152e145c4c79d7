"""The chain for one side: locate, score, search, weigh against rivals and the unknown, hold against what wasn't seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lab.diagnose.evidence import Evidence
from lab.diagnose.locate import SLACK, Slice, look
from lab.diagnose.refit import Fit, likelihood
from lab.diagnose.score import signatures
from lab.diagnose.search import RIVAL_FROM, SCREENED, Search
from lab.diagnose.unknown import Discrepancy, discrepancy
from sim.effects.base import Effect
from sim.effects.library import effects as library

FALSE_ALARM_RATE = 0.01
#: A name isn't given where something unknown holds more than this share of the probability,
UNKNOWN_UP_TO = 0.4
#: nor where the name's own share, its rivals' taken off, is less than this.
NAMED_FROM = 0.35
#: Of the excess chi2 in the measurements that an effect acts on, what its name has to explain where something significant is left.
CAUSE_FROM = 0.8
#: The same where what is left is more than the law's own tolerance allows: a name that nearly fits isn't the cause.
OPEN_CAUSE_FROM = 0.95
#: A score that no slice and no refit bears out has to exceed the threshold by so much, for what a covariance doesn't hold.
LONE_SCORE = 10.0
#: A probability from which on a name isn't weighed again.
CERTAIN = 0.99
#: Of what a name gains, in nats: the score from which on a rival that it declares is fitted in its place.
DECLARED_FROM = 0.3
#: Nats by which a rival lags that no discrepancy beside it brings back.
HOPELESS = 30.0
#: What an effect has to gain of what a stronger one beside it does to the same measurement: less may be an error of that one's law.
COMPANION_SHARE = 0.03


@dataclass(frozen=True)
class Candidate:
    """One effect that was named, with the probability of its name and of its rivals."""

    effect: Effect
    std: dict[str, float | None]
    probability: float
    rivals: tuple[tuple[str, float], ...]
    gain: float  # nats over the same set without it
    explains: float = 1.0  # share of the excess chi2 in the measurements it acts on
    closed: bool = True  # whether what is left there is within noise and the law's tolerance

    @property
    def unknown(self) -> float:
        """Probability that nothing of the library is meant."""
        return dict(self.rivals).get("unknown", 0.0)


@dataclass(frozen=True)
class Verdict:
    """What one side shows."""

    evidence: Evidence
    threshold: float
    top_score: float
    before: tuple[Slice, ...]  # significant slices under the baseline
    named: tuple[Candidate, ...]  # most significant first
    abstained: tuple[Candidate, ...]
    after: tuple[Slice, ...]  # significant slices with the named effects
    unknown: tuple[Discrepancy, ...]

    @property
    def effects(self) -> tuple[Effect, ...]:
        return tuple(c.effect for c in self.named)


def decide(evidence: Evidence, rng: np.random.Generator, report: Callable[[str], None] = lambda _: None) -> Verdict:
    """The whole chain on one side's evidence. Deterministic for a given generator."""
    known = tuple(effect for effect in library().values() if effect.shown_by)
    first = signatures(evidence, evidence.camera, (), known)
    threshold = first.threshold(rng, 1.0 - FALSE_ALARM_RATE)
    scores = first.scores()
    top = scores[0].value if scores else 0.0
    before = tuple(s for s in look(evidence, evidence.gaussian()) if s.significant)
    search = Search(evidence, known, threshold)
    named, abstained = _believed(search, search.best(report), report)
    named.sort(key=lambda c: -c.gain)
    effects = tuple(c.effect for c in named)
    if top > threshold + LONE_SCORE and not named and not before and not abstained:
        # something is off that no effect fits any better than nothing does
        abstained.append(Candidate(scores[0].start, {}, 0.0, (("unknown", 1.0),), 0.5 * top))
    after = tuple(s for s in look(evidence, evidence.gaussian(effects)) if s.significant)
    unexplained = {id(s.block): evidence.blocks.index(s.block) for s in after}
    for c in abstained:
        if not unexplained:
            touched = max(
                (i for i, b in enumerate(evidence.blocks) if b.touched_by(type(c.effect))),
                key=lambda i: evidence.shown(c.effect, effects, i),
            )
            unexplained[id(evidence.blocks[touched])] = touched
    unknown = tuple(discrepancy(evidence, evidence.seen_gaussian(effects), i) for i in unexplained.values())
    return Verdict(evidence, threshold, top, before, tuple(named), tuple(abstained), after, unknown)


def _believed(search: Search, current: Fit, report: Callable[[str], None]) -> tuple[list[Candidate], list[Candidate]]:
    """The effects whose names hold against rivals and the unknown, and those that were given up, least likely first.

    What is given up no longer props up the others: these are fitted and weighed again without it.
    """
    evidence, threshold = search.evidence, search.threshold
    given_up: list[Candidate] = []
    weighed: set[frozenset[str]] = set()
    certain: dict[str, Candidate] = {}
    while current.effects:
        weighed.add(frozenset(current.names))
        members, likelier = [], None
        for index, e in enumerate(current.effects):
            if e.name in certain:  # a weaker member that left changes nothing about this one's name
                members.append(replace(certain[e.name], effect=e, std=current.std[index]))
                continue
            report(f"weighing {e.name} against its rivals")
            candidate, better = _weighed(search, current, index)
            members.append(candidate)
            if candidate.probability > CERTAIN and candidate.gain > threshold:
                certain[e.name] = candidate
            likelier = likelier or better
        if likelier is not None and frozenset(likelier.names) not in weighed:
            current = search.fitted(likelier.effects, final=True)
            continue
        crowd = _crowd(search, current)
        if crowd:
            lost = [members[i] for i in crowd]
        else:
            companions = [c for c in members if _companion(c, members, evidence)]
            weak = companions or [c for c in members if not _holds(c, threshold)]
            lost = sorted(weak, key=lambda c: c.gain)[:1]
        if not lost:
            return members, given_up
        if crowd or not companions:  # the error of a law that is named is nothing unexplained
            given_up += lost
        current = search.fitted(tuple(c.effect for c in members if c not in lost), final=True)
    return [], given_up


def _holds(candidate: Candidate, threshold: float) -> bool:
    return (
        candidate.unknown <= UNKNOWN_UP_TO
        and candidate.probability >= NAMED_FROM
        and 2.0 * candidate.gain >= threshold
        and candidate.explains >= (CAUSE_FROM if candidate.closed else OPEN_CAUSE_FROM)
    )


def _companion(candidate: Candidate, members: list[Candidate], evidence: Evidence) -> bool:
    """Whether an effect may be no more than the error of a stronger one's law: of a declared rival's, or of one that changes
    what the effect is seen in many times as much."""
    others = [c for c in members if c is not candidate]
    if any(
        candidate.effect.name in type(c.effect).rivals and candidate.gain < COMPANION_SHARE * c.gain for c in others
    ):
        return True
    around = tuple(c.effect for c in others)
    pulls = [
        evidence.shown(candidate.effect, around, i) if b.touched_by(type(candidate.effect)) else 0.0
        for i, b in enumerate(evidence.blocks)
    ]
    most = int(np.argmax(pulls))
    for c in others:
        if evidence.blocks[most].touched_by(type(c.effect)):
            without = (candidate.effect, *(o.effect for o in others if o is not c))
            if pulls[most] < COMPANION_SHARE * evidence.shown(c.effect, without, most):
                return True
    return False


def _crowd(search: Search, fit: Fit) -> list[int]:
    """Indices of effects that only together stand for one smooth discrepancy: two or more on one measurement that a process
    without a name replaces at less cost."""
    evidence = search.evidence
    by_block: dict[int, list[int]] = {}
    for i, e in enumerate(fit.effects):
        rest = (*fit.effects[:i], *fit.effects[i + 1 :])
        touched = [k for k, b in enumerate(evidence.blocks) if b.touched_by(type(e))]
        if touched:
            by_block.setdefault(max(touched, key=lambda k, e=e, rest=rest: evidence.shown(e, rest, k)), []).append(i)  # type: ignore[misc]
    full = evidence.seen_gaussian(fit.effects)
    for index, members in by_block.items():
        if len(members) < 2:
            continue
        fewer = search.fitted(tuple(e for i, e in enumerate(fit.effects) if i not in members), final=True)
        bare = evidence.seen_gaussian(fewer.effects)
        if (
            fewer.weight + discrepancy(evidence, bare, index).gain
            > fit.weight + discrepancy(evidence, full, index).gain
        ):
            return members
    return []


def _weighed(search: Search, fit: Fit, index: int) -> tuple[Candidate, Fit | None]:
    """Probabilities of an effect's name, of its rivals in its place, and of something unknown; and the set with a rival that is
    likelier, now that both may leave something unknown behind."""
    evidence, effect = search.evidence, fit.effects[index]
    rest = (*fit.effects[:index], *fit.effects[index + 1 :])
    without = search.fitted(rest, final=True)
    others = [e for e in search.known if e.name not in fit.names]
    likely = signatures(evidence, evidence.camera, without.effects, others, without.tangents).scores()
    gain = fit.weight - without.weight
    pool = [
        s for s in likely if s.value > (DECLARED_FROM if s.effect.name in type(effect).rivals else RIVAL_FROM) * gain
    ]
    fits = {effect.name: fit}
    for score in pool[:SCREENED]:
        start = (*fit.effects[:index], score.start, *fit.effects[index + 1 :])
        rough = search.fitted(start)
        near = rough.weight > fit.weight - HOPELESS - 0.3 * gain
        fits[score.effect.name] = search.fitted(start, final=True) if near else rough
    touched = [i for i, b in enumerate(evidence.blocks) if b.touched_by(type(effect))]
    weights = {}
    for name, tried in fits.items():
        weights[name] = tried.weight
        if tried.weight > fit.weight - HOPELESS:
            # what each leaves where both act may be unknown; where only this one acts, a rival leaves it unexplained
            model, kind = evidence.seen_gaussian(tried.effects), library()[name]
            common = [i for i in touched if evidence.blocks[i].touched_by(kind)]
            weights[name] += sum(discrepancy(evidence, model, i).gain for i in common)
    bare, refitted = evidence.seen_gaussian(rest), evidence.seen_gaussian(without.effects)
    alone = (
        likelihood(evidence, rest)
        + (fit.weight - fit.log_likelihood)
        + sum(discrepancy(evidence, bare, i).gain for i in touched)
    )
    weights["unknown"] = max(alone, without.weight + sum(discrepancy(evidence, refitted, i).gain for i in touched))
    top = max(weights.values())
    share = {name: float(np.exp(w - top)) for name, w in weights.items()}
    total = sum(share.values())
    rivals = tuple(
        sorted(((n, s / total) for n, s in share.items() if n != effect.name and s / total > 1e-4), key=lambda r: -r[1])
    )
    explains, closed = _explained(evidence, fit, without, touched)
    first = max((n for n in share if n != "unknown"), key=lambda n: share[n])
    better = fits[first] if share[first] > 2.0 * share[effect.name] else None
    return Candidate(effect, fit.std[index], share[effect.name] / total, rivals, gain, explains, closed), better


def _explained(evidence: Evidence, fit: Fit, without: Fit, touched: list[int]) -> tuple[float, bool]:
    """Share of the excess chi2 that an effect takes where it acts, 1 where what is left is within three sigmas of noise; and
    whether that is within five of noise and the named laws' tolerances.

    The share's covariance is the baseline's: a law's own tolerance doesn't count as an explanation.
    """
    if not touched:
        return 1.0, True
    where = np.zeros(len(evidence.value), bool)
    for i in touched:
        where[evidence.slices[i]] = True
    where &= evidence.seen
    n = int(where.sum())
    left = evidence.gaussian(fit.effects, where).chi2(evidence.value[where]) / (1.0 + SLACK) ** 2
    closed = left - n < 5.0 * np.sqrt(2.0 * n)
    model = evidence.gaussian((), where)
    after, before = (
        float(np.sum(np.square(model.white((evidence.value - evidence.mean(f.effects))[where]))))
        for f in (fit, without)
    )
    if after - n < 3.0 * np.sqrt(2.0 * n) or before <= after:
        return 1.0, closed
    return (before - after) / max(before - n, 1e-9), closed
