"""The chain for one side: locate, score, search, weigh against rivals and the unknown, hold against what wasn't seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from operator import and_

import numpy as np

from lab.diagnose.inference.evidence import Evidence
from lab.diagnose.inference.locate import SLACK, Slice, look
from lab.diagnose.inference.refit import Fit, likelihood
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.search import FURTHER, RIVAL_FROM, SCREENED, Search
from lab.diagnose.inference.unknown import Discrepancy, discrepancy, predictive
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.effects.other_f_number import OtherFNumber
from sim.spectrum import FloatArray

FALSE_ALARM_RATE = 0.01
#: A name isn't given where something unknown holds more than this share of the probability,
UNKNOWN_UP_TO = 0.4
#: nor where the name's own share, its rivals' taken off, is less than this.
NAMED_FROM = 0.35
#: Of the excess chi2 in the measurements that an effect acts on, what its name has to explain where something significant is left.
CAUSE_FROM = 0.8
#: The same where what is left is more than the law's own tolerance allows: a name that nearly fits isn't the cause.
OPEN_CAUSE_FROM = 0.98
#: From which share on a name needn't be all but sure, and how sure it has to be below that.
WELL_EXPLAINED, SURE = 0.95, 0.8
#: Of an effect's gain: what something unexplained in the same frames may have, or the effect is but a part of what that is.
REMAINDER_SHARE = 0.1
#: The same of what it leaves in the measurement that shows it most, or of anything from so many nats on: no law's error is as sure.
OWN_REMAINDER_SHARE, SURE_REMAINDER_NATS = 0.02, 1000.0
#: Of a name's probability: from which on a rival takes its place.
LIKELIER = 1.1
#: Nats that a remainder may have in any case.
REMAINDER_NATS = 3.0
#: Of a stronger effect's gain: below that, what acts on the same measurement is taken for an error of its law.
LEAST_SHARE = 1e-4
#: A score that no slice and no refit bears out has to exceed the threshold by so much, for what a covariance doesn't hold.
LONE_SCORE = 10.0
#: A probability from which on a name isn't weighed again.
CERTAIN = 0.99
#: Of what a name gains, in nats: the score from which on a rival that it declares is fitted in its place.
DECLARED_FROM = 0.6
#: Nats below which a member's gain isn't believed before the others were fitted once more, from where they stand beside it.
CLOSE = 100.0
#: Nats within which two signs of a quantity are as good as each other.
SAME = 2.0
#: Nats by which a rival lags that no discrepancy beside it brings back.
HOPELESS = 30.0
#: As far behind a name a rival may lie after a rough fit to be fitted to convergence: a share of what the name gains, but no more than
#: so many nats and so many times what the rival's next step promises.
ROUGH_SHARE, ROUGH_NATS, ROUGH_STEPS = 0.05, 100.0, 10.0
#: What an effect has to gain of what a stronger one beside it does to the same measurement: less may be an error of that one's law.
COMPANION_SHARE = 0.03
#: Nats by which it is less likely that an f-number or a pitch is stated wrongly than that a model lacks an effect; the least factor by
#: which numbers are misstated, and where its search begins.
MISSTATED_NATS, MISSTATED_FROM, OTHER_RATIOS = 10.0, 1.1, (0.75, 1.35)
SURE_NATS = 30.0  # by which they have to be likelier than a name, so that its rivals aren't weighed any more


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
    remark: str = ""  # what it looks like that isn't physics

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
    def processes(self) -> dict[int, FloatArray]:
        """Covariances of what has no name, by their block."""
        return {gap.index: gap.kernel for gap in self.unknown if gap.gain > 0}

    @property
    def effects(self) -> tuple[Effect, ...]:
        return tuple(c.effect for c in self.named)


def decide(
    evidence: Evidence,
    rng: np.random.Generator,
    report: Callable[[str], None] = lambda _: None,
    *,
    least_threshold: float = 0.0,
) -> Verdict:
    """The whole chain on one side's evidence. Deterministic for a given generator. `least_threshold`: of the scores, where more is
    known of healthy cameras than the covariance says (`bootstrap.py`)."""
    known = tuple(effect for effect in library().values() if effect.shown_by)
    first = signatures(evidence, evidence.camera, (), known)
    threshold = max(first.threshold(rng, 1.0 - FALSE_ALARM_RATE), least_threshold)
    scores = first.scores()
    top = scores[0].value if scores else 0.0
    before = tuple(s for s in look(evidence, evidence.gaussian()) if s.significant)
    search = Search(evidence, known, threshold)
    named, abstained = _believed(search, search.best(report), report)
    if top > threshold + LONE_SCORE and not named and not before and not abstained:
        # something is off that no effect fits any better than nothing does
        abstained.append(Candidate(scores[0].start, {}, 0.0, (("unknown", 1.0),), 0.5 * top))
    while True:
        named.sort(key=lambda c: -c.gain)
        effects = tuple(c.effect for c in named)
        after = tuple(s for s in look(evidence, evidence.gaussian(effects)) if s.significant)
        unexplained = list(dict.fromkeys(evidence.blocks.index(s.block) for s in after))
        if abstained and not unexplained:
            unexplained = [evidence.seat(abstained[0].effect, effects)]
        unknown = tuple(discrepancy(evidence, evidence.seen_gaussian(effects), i) for i in unexplained)
        parts = [c for c in named if after and _is_part(evidence, c, effects, unknown)]
        if not parts:
            told = tuple(_either_sign(evidence, c, effects) for c in named)
            unnamed = tuple(predictive(evidence, evidence.seen_gaussian(effects), i) for i in unexplained)
            return Verdict(evidence, threshold, top, before, told, tuple(abstained), after, unnamed)
        # weakest first: with it gone, what is left may be no more than another one's law allows
        abstained.append(parts[-1])
        rest = search.fitted(tuple(c.effect for c in named if c is not parts[-1]), final=True)
        kept = {c.effect.name: c for c in named}
        named = [replace(kept[e.name], effect=e, std=s) for e, s in zip(rest.effects, rest.std, strict=True)]


def _either_sign(evidence: Evidence, candidate: Candidate, effects: tuple[Effect, ...]) -> Candidate:
    """The same with uncertainties that hold both signs of quantities that act by their square, where the recordings don't tell them
    apart: root mean square distances from the value told."""
    effect = candidate.effect
    both = {
        name: float(getattr(effect, name))
        for name, q in type(effect).quantities().items()
        if q.slope_power == 2 and (q.lower is None or q.lower < 0.0)
    }
    if not both:
        return candidate
    mirrored = effect.having(**{n: -v for n, v in both.items()})
    others = tuple(e for e in effects if e is not effect)
    if likelihood(evidence, (*others, mirrored)) < likelihood(evidence, effects) - SAME:
        return candidate
    std = {
        n: s if s is None or n not in both else float(np.hypot(s, np.sqrt(2.0) * both[n]))
        for n, s in candidate.std.items()
    }
    return replace(candidate, std=std)


def _is_part(
    evidence: Evidence, candidate: Candidate, effects: Sequence[Effect], unknown: Iterable[Discrepancy]
) -> bool:
    """Whether the frames in which a name shows most hold something unexplained that is strong beside it: both may be one."""
    seat = evidence.seat(candidate.effect, effects)
    frames = _frames(evidence, seat)

    def is_strong(gap: Discrepancy) -> bool:
        own = gap.index == seat or gap.gain > SURE_REMAINDER_NATS
        return gap.gain > max((OWN_REMAINDER_SHARE if own else REMAINDER_SHARE) * candidate.gain, REMAINDER_NATS)

    strong = [g.index for g in unknown if is_strong(g)]
    return any(2 * len(frames & (seen := _frames(evidence, i))) > min(len(frames), len(seen)) for i in strong)


def _frames(evidence: Evidence, index: int) -> set[str]:
    return {name for label in evidence.blocks[index].labels for name in label.captures}


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
        slight = _slightest(search, current)
        if slight is not None:
            index, is_companion = slight
            if not is_companion:  # the error of a law that is named is nothing unexplained
                report(f"weighing {current.effects[index].name} against its rivals")
                candidate, better = _weighed(search, current, index)
                if better is not None and frozenset(better.names) not in weighed:
                    current = search.fitted(better.effects, final=True)
                    continue
                given_up.append(candidate)
            current = _without(search, current, index)
            continue
        members, likelier = [], None
        for index, e in enumerate(current.effects):
            if e.name in certain:
                # a weaker member that left changes nothing about this one's name, but what is left to explain
                without = _without(search, current, index)
                explains, closed = _explained(evidence, current, without, evidence.acted_on(e))
                kept = replace(certain[e.name], effect=e, std=current.std[index], explains=explains, closed=closed)
                members.append(kept)
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
        lost = [members[i] for i in crowd] or sorted((c for c in members if not _holds(c)), key=lambda c: c.gain)[:1]
        if not lost:
            return members, given_up
        given_up += lost
        current = search.fitted(tuple(c.effect for c in members if c not in lost), final=True)
    return [], given_up


def _slightest(search: Search, fit: Fit) -> tuple[int, bool] | None:
    """The weakest member that is too weak for a name whatever its rivals, and whether it may be no more than the error of
    another's law. Looked at before anything is weighed, as each rival of each other member would be fitted beside it."""
    gains = [fit.weight - _without(search, fit, i).weight for i in range(len(fit.effects))]
    members = [Candidate(e, s, 0.0, (), gain) for e, s, gain in zip(fit.effects, fit.std, gains, strict=True)]
    evidence, threshold = search.evidence, search.threshold
    companions = [c for c in members if _companion(c, members, evidence)]
    weak = companions or [
        c for c in members if 2.0 * c.gain < threshold * (FURTHER if _beside(c, members, evidence) else 1.0)
    ]
    if not weak:
        return None
    return members.index(min(weak, key=lambda c: c.gain)), bool(companions)


def _holds(candidate: Candidate) -> bool:
    return (
        candidate.unknown <= UNKNOWN_UP_TO
        and candidate.probability >= (NAMED_FROM if candidate.explains >= WELL_EXPLAINED else SURE)
        and candidate.explains >= (CAUSE_FROM if candidate.closed else OPEN_CAUSE_FROM)
    )


def _beside(candidate: Candidate, members: list[Candidate], evidence: Evidence) -> bool:
    """Whether a stronger effect changes what an effect shows most in."""
    stronger = [c for c in members if c.gain > candidate.gain]
    if not stronger:
        return False
    block = evidence.blocks[evidence.seat(candidate.effect, [c.effect for c in members])]
    return any(block.touched_by(type(c.effect)) for c in stronger)


def _companion(candidate: Candidate, members: list[Candidate], evidence: Evidence) -> bool:
    """Whether an effect may be no more than the error of a stronger one's law: of a declared rival's, or of one that changes
    what the effect is seen in many times as much."""
    others = [c for c in members if c is not candidate]
    if any(
        candidate.effect.name in type(c.effect).rivals and candidate.gain < COMPANION_SHARE * c.gain for c in others
    ):
        return True
    acts = evidence.acts(type(candidate.effect))
    if any(
        candidate.gain < LEAST_SHARE * c.gain and any(map(and_, acts, evidence.acts(type(c.effect)))) for c in others
    ):
        return True
    around = tuple(c.effect for c in others)
    pulls = [evidence.shown(candidate.effect, around, i) if acting else 0.0 for i, acting in enumerate(acts)]
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
        by_block.setdefault(evidence.seat(e, fit.effects), []).append(i)
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
    without, touched = _without(search, fit, index), evidence.acted_on(effect)
    gain = fit.weight - without.weight
    misstated, remark = _misstated(search, fit, index)
    if misstated > fit.weight + SURE_NATS:
        return Candidate(effect, fit.std[index], 0.0, (("unknown", 1.0),), gain, remark=remark), None
    others = [e for e in search.known if e.name not in fit.names]
    likely = signatures(evidence, evidence.camera, without.effects, others, without.tangents).scores()
    pool = [
        s for s in likely if s.value > (DECLARED_FROM if s.effect.name in type(effect).rivals else RIVAL_FROM) * gain
    ]
    fits = {effect.name: fit}
    for score in pool[:SCREENED]:
        start = (*fit.effects[:index], score.start, *fit.effects[index + 1 :])
        rough = search.fitted(start, beside=fit)
        behind = min(ROUGH_SHARE * gain, ROUGH_NATS + ROUGH_STEPS * rough.ahead)
        near = rough.weight > fit.weight - HOPELESS - behind
        fits[score.effect.name] = search.fitted(start, final=True) if near else rough
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
    located = without.weight + sum(discrepancy(evidence, refitted, i).gain for i in touched)
    weights["unknown"] = max(alone, located, misstated)
    top = max(weights.values())
    share = {name: float(np.exp(w - top)) for name, w in weights.items()}
    total = sum(share.values())
    rivals = tuple(
        sorted(((n, s / total) for n, s in share.items() if n != effect.name and s / total > 1e-4), key=lambda r: -r[1])
    )
    explains, closed = _explained(evidence, fit, without, touched)
    first = max((n for n in share if n != "unknown"), key=lambda n: share[n])
    better = fits[first] if share[first] > LIKELIER * share[effect.name] else None
    remark = remark if misstated >= top else ""
    candidate = Candidate(effect, fit.std[index], share[effect.name] / total, rivals, gain, explains, closed, remark)
    return candidate, better


def _misstated(search: Search, fit: Fit, index: int) -> tuple[float, str]:
    """Weight of the set with the lens at another f-number in the place of an effect that blurs, less what that is unlikelier by, and what
    it looks like; -inf where it is as stated to `MISSTATED_FROM`. It is nothing that a model lacks, and easily taken for a blur."""
    evidence, effect = search.evidence, fit.effects[index]
    if type(effect).transfer is Effect.transfer:
        return -np.inf, ""
    rest = (*fit.effects[:index], *fit.effects[index + 1 :])
    starts = [(*rest, OtherFNumber(ratio=ratio)) for ratio in OTHER_RATIOS]
    tried = search.fitted(max(starts, key=lambda s: likelihood(evidence, s)), beside=fit)
    if tried.weight < fit.weight - HOPELESS:
        return -np.inf, ""
    tried = search.fitted(tried.effects, final=True)
    ratio = next(e.ratio for e in tried.effects if isinstance(e, OtherFNumber))
    if abs(np.log(ratio)) <= np.log(MISSTATED_FROM):
        return -np.inf, ""
    stated, pitch = evidence.camera.lens.f_number, evidence.camera.pixel_pitch_um
    return (
        tried.weight - MISSTATED_NATS,
        f"as if the lens worked at f/{stated * ratio:.3g} in place of f/{stated:.3g}, or the pixels' pitch were {pitch / ratio:.3g} um in place of {pitch:.3g}",
    )


def _without(search: Search, fit: Fit, index: int) -> Fit:
    """The set fitted without one of its effects."""
    rest = (*fit.effects[:index], *fit.effects[index + 1 :])
    without = search.fitted(rest, final=True)
    if rest and fit.weight - without.weight < CLOSE:
        without = search.fitted(rest, final=True, again=True)
    return without


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
    if after - n < 3.0 * np.sqrt(2.0 * n):
        return 1.0, closed
    return max(before - after, 0.0) / max(before - n, 1e-9), closed
