"""The chain of decisions for one side: locate, score, search, weigh, and describe what is left without a name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lab.diagnose.inference.discrepancy import (
    Discrepancy,
    likeliest_discrepancy,
    no_discrepancy,
    predictive_discrepancy,
)
from lab.diagnose.inference.held_out import VetoedCandidate, held_out_mismatches, predicts_held_out, vetoed
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.outlying import OutlyingLevel, freed, outlying_levels
from lab.diagnose.inference.places import Slice
from lab.diagnose.inference.refit import Fit, is_of_usual_size, log_likelihood, profile_interval, refit, refit_alone
from lab.diagnose.inference.score import prototype_changes, signatures, signatures_of
from lab.diagnose.inference.search import ModelSet, Search
from lab.diagnose.inference.shown_in_means import shown_in_means
from lab.diagnose.inference.weigh import UNKNOWN, Candidate, closes_somewhere, explained, weigh
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect
from sim.effects.library import candidates
from sim.effects.library import effects as library
from sim.spectrum import FloatArray

# --- families --------------------------------------------------------------------------------------------------------
# Families: what is named where recordings show which physics is missing, and no single law of it.
#
# A family is claimed for a candidate whose own name doesn't hold. Given that the cause is one of the weighed effects,
# with a discrepancy beside each, the family has to hold `family_probability`, and the nearest law has to explain
# `family_least_share` of the excess chi2 in the measurements that it acts on. A family is also told in place of a name
# that holds where other members fit about as well.


def family_claim(search: Search, named: Sequence[Candidate], candidate: Candidate) -> Candidate | None:
    """Return a candidate without a name as one that its family is named for, with the likeliest law fitted beside what
    is named; None where no family holds it."""
    model, policy = search.model, search.policy
    others = tuple(c.effect for c in named)
    if not candidate.among_listed or candidate.remark:  # what wrong metadata would explain as well is no claim
        return None
    kind = library()[candidate.among_listed[0][0]]
    members = tuple((name, p) for name, p in candidate.among_listed if library()[name].family is kind.family)
    probability = sum(p for _, p in members)
    if probability < policy.family_probability or kind.name in {e.name for e in others}:
        return None
    start = candidate.effect if isinstance(candidate.effect, kind) else _start(search, others, kind)
    if start is None:
        return None
    without = search.fitted(others, converged=True)
    fit = search.fitted((*others, start), converged=True)
    log_odds = fit.log_posterior - without.log_posterior
    if log_odds < search.needed_log_odds:
        return None
    share, is_closed = explained(model, fit, without, model.affected_blocks(start), policy)
    if share < policy.family_least_share:
        return None
    at = fit.names.index(kind.name)
    # a law whose name was given up for what it leaves isn't exact; one that others of its family fit as well may be
    is_tie = members[0][1] < policy.family_probability
    return replace(
        candidate,
        effect=fit.effects[at],
        std=fit.std[at],
        probability=probability,
        rivals=tuple((name, p) for name, p in candidate.among_listed if library()[name].family is not kind.family),
        log_odds=log_odds,
        explained_share=share,
        is_closed=is_closed and is_tie,
        members=members,
    )


def _start(search: Search, others: tuple[Effect, ...], kind: type[Effect]) -> Effect | None:
    """Return where a fit of an effect beside others begins; None where nothing shows it."""
    scores = signatures(search.model, search.model.camera, others, [kind]).scores()
    return scores[0].start if scores else None


def tied_family(candidate: Candidate, policy: DecisionPolicy) -> Candidate:
    """Return the candidate as its family where the recordings can't tell its members apart: no member reaches
    `family_probability`, and all together do."""
    if candidate.members or candidate.probability >= policy.family_probability:
        return candidate
    family = type(candidate.effect).family
    members = [(candidate.effect.name, candidate.probability)]
    members += [(n, p) for n, p in candidate.rivals if n in library() and library()[n].family is family]
    members = [(n, p) for n, p in members if p >= policy.least_rival_probability]
    together = sum(p for _, p in members)
    if len(members) < 2 or together < policy.family_probability:
        return candidate
    outside = tuple((n, p) for n, p in candidate.rivals if n not in dict(members))
    return replace(candidate, probability=together, rivals=outside, members=tuple(sorted(members, key=lambda m: -m[1])))


# --- naming ----------------------------------------------------------------------------------------------------------
# Which members of the best set are named: each has to hold against rivals, an unknown cause and the other members.


def named_members(
    search: Search, best: Fit, report: Callable[[str], None], barred: Collection[frozenset[str]] = ()
) -> tuple[list[Candidate], list[Candidate]]:
    """Return the members of a set whose names hold, and those that were given up, in that order. `barred`: sets that
    aren't returned to, by their effects' names.

    One at a time: the weakest member that is too weak for any name; then the member for which a rival is likelier; then
    members that one discrepancy replaces, or whose name doesn't hold. After each change the rest is fitted and weighed
    again. What was given up and explains nothing isn't told.
    """
    model, policy = search.model, search.policy
    current = best
    given_up: list[Candidate] = []
    weighed = set(barred)
    certain: dict[str, Candidate] = {}
    before = current
    while current.effects:
        weighed.add(frozenset(current.names))
        certain = _still_certain(search, certain, before, current)
        before = current
        index = _too_weak(search, current)
        if index is not None:
            report(f"weighing {current.effects[index].name} against its rivals")
            candidate, better = weigh(search, current, index)
            if better is not None and frozenset(better.names) not in weighed:
                current = search.fitted(better.effects, converged=True)
                continue
            without = search.without(current, index)
            gain, needed = current.log_posterior - without.log_posterior, search.needed_log_odds
            if gain < needed or search.member_log_odds(current, index) >= needed:
                given_up.append(replace(candidate, among_listed=()))  # no claim, of its family neither
            # else it explains no more than what the other members' laws may lack: a mismatch beyond that is located
            # without it
            current = without
            continue
        members, likelier = [], None
        for index, e in enumerate(current.effects):
            if e.name in certain:
                # what is left to explain changes
                without = search.without(current, index)
                share, is_closed = explained(model, current, without, model.affected_blocks(e), policy)
                kept = replace(
                    certain[e.name],
                    effect=e,
                    std=current.std[index],
                    explained_share=share,
                    is_closed=is_closed,
                    is_closed_somewhere=is_closed or closes_somewhere(model, current, index, policy),
                )
                members.append(kept)
                continue
            report(f"weighing {e.name} against its rivals")
            candidate, better = weigh(search, current, index)
            members.append(candidate)
            if candidate.probability > policy.certain_probability and candidate.log_odds > search.threshold:
                certain[e.name] = candidate
            likelier = likelier or better
        if likelier is not None and frozenset(likelier.names) not in weighed:
            current = search.fitted(likelier.effects, converged=True)
            continue
        replaceable = _replaced_by_a_discrepancy(search, current)
        failing = sorted((c for c in members if not holds(c, policy)), key=lambda c: c.log_odds)
        lost = [members[i] for i in replaceable] or failing[:1]
        if not lost:
            return members, [c for c in given_up if c.explained_share > 0.0]
        given_up += lost
        current = search.fitted(tuple(c.effect for c in members if c not in lost), converged=True)
    return [], [c for c in given_up if c.explained_share > 0.0]


def _still_certain(search: Search, certain: dict[str, Candidate], before: Fit, now: Fit) -> dict[str, Candidate]:
    """Return the certain names that stay so when members leave or come: those that share no measurement that shows
    both. What was certain beside an effect which took up what its law lacks has to be weighed again without that."""
    changed = [e for e in (*before.effects, *now.effects) if (e.name in before.names) != (e.name in now.names)]
    if not changed or not certain:
        return certain
    by_name = {e.name: e for e in before.effects}
    measured = {e.name: _shown_blocks(search, e, before if e.name in by_name else now) for e in changed}
    moved = set().union(*measured.values())
    return {n: c for n, c in certain.items() if n in by_name and not moved & _shown_blocks(search, by_name[n], before)}


def _shown_blocks(search: Search, effect: Effect, fit: Fit) -> set[int]:
    """Indices of the blocks that show a member of a fitted set, by `shown_chi2`."""
    others = tuple(e for e in fit.effects if e.name != effect.name)
    model = search.model
    return {i for i in model.affected_blocks(effect) if model.change_chi2(effect, others, i) > search.policy.shown_chi2}


def holds(candidate: Candidate, policy: DecisionPolicy) -> bool:
    """Return whether a name is likely enough and explains enough."""
    is_held = candidate.is_closed or excludes_rivals(candidate, policy)
    least_share = policy.least_explained_share if is_held else policy.least_explained_share_open
    return candidate.probability >= policy.least_probability and candidate.explained_share >= least_share


def excludes_rivals(candidate: Candidate, policy: DecisionPolicy) -> bool:
    """Say whether rivals and an unknown cause are excluded, a discrepancy allowed beside each, and the law holds in a
    measurement that shows it: what another measurement leaves is then told beside the name."""
    first = candidate.among_listed[0] if candidate.among_listed else None
    return (
        candidate.is_closed_somewhere
        and candidate.probability >= policy.certain_probability
        and first is not None
        and first[0] == candidate.effect.name
        and first[1] >= policy.certain_probability
    )


def _too_weak(search: Search, fit: Fit) -> int | None:
    """Return the weakest member that can't be named whatever its rivals: too small a gain, or none in the means that it
    must show in. Tested before anything is weighed, as that fits every rival of every member."""
    log_odds = [search.member_log_odds(fit, i) for i in range(len(fit.effects))]
    weak = [
        odds
        for i, (odds, e) in enumerate(zip(log_odds, fit.effects, strict=True))
        if odds < search.needed_log_odds
        or not shown_in_means(search.model, e, fit.effects, search.without(fit, i).effects, search.policy)
    ]
    return log_odds.index(min(weak)) if weak else None


def _replaced_by_a_discrepancy(search: Search, fit: Fit) -> list[int]:
    """Indices of two or more members that change the same block most, where one discrepancy in their place is
    likelier."""
    model, policy = search.model, search.policy
    by_block: dict[int, list[int]] = {}
    for i, e in enumerate(fit.effects):
        by_block.setdefault(model.strongest_block(e, fit.effects), []).append(i)

    def log_posterior(one: Fit, index: int) -> float:
        gaussian = model.seen_gaussian(one.effects)
        return one.log_posterior + likeliest_discrepancy(model, gaussian, index, policy).log_odds

    for index, members in by_block.items():
        if len(members) < 2:
            continue
        fewer = search.fitted(tuple(e for i, e in enumerate(fit.effects) if i not in members), converged=True)
        if log_posterior(fewer, index) > log_posterior(fit, index):
            return members
    return []


# --- decide ------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """What one side shows.

    `before`, `after`: mismatches of the baseline, and with the named effects. `named`: most significant first.
    `abstained`: candidates that weren't named. `discrepancies`: of the blocks that have a mismatch left. `held_out`:
    measurements whose held-out numbers contradict the model with the named effects, of those that have no other
    mismatch. `vetoed`: names that held-out numbers contradict. `outlying`: captures whose levels aren't those of what
    is stated, by the block that they alone disturb. `models`: sets of effects with their probabilities.
    """

    model: MeasurementModel
    threshold: float
    top_score: float
    before: tuple[Slice, ...]
    named: tuple[Candidate, ...]
    abstained: tuple[Candidate, ...]
    after: tuple[Slice, ...]
    discrepancies: tuple[Discrepancy, ...]
    held_out: tuple[Slice, ...] = ()
    vetoed: tuple[VetoedCandidate, ...] = ()
    outlying: Mapping[int, tuple[OutlyingLevel, ...]] = field(default_factory=dict)
    models: ModelSet = field(default_factory=ModelSet)

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
    without: Collection[str] = (),
) -> Verdict:
    """Return the whole chain on one side's measurement model; deterministic for a given generator. `least_threshold` of
    the scores: from drawn healthy cameras, where there are any (`bootstrap.py`). `without`: names that aren't
    considered."""
    known = tuple(kind for kind in candidates() if kind.name not in without)
    changes = prototype_changes(model, model.camera, (), known)
    first = signatures_of(model, (), changes)
    drawn = first.threshold(rng, 1.0 - policy.false_alarm_rate, policy.threshold_draws)
    threshold = max(drawn, least_threshold)
    scores = first.scores()
    top = scores[0].value if scores else 0.0
    before = mismatches(model, model.gaussian(), policy)
    search = Search(model, known, changes, threshold, policy, above_noise=max(least_threshold - drawn, 0.0))
    named, abstained = named_members(search, search.best(report), report)
    if top > threshold + policy.lone_score_margin and not named and not before and not abstained:
        abstained.append(Candidate(scores[0].start, {}, 0.0, ((UNKNOWN, 1.0),), 0.5 * top))
    refused: list[VetoedCandidate] = []
    vetoed_sets: set[frozenset[str]] = set()
    while True:
        named.sort(key=lambda c: -c.log_odds)
        losing = next((v for c in reversed(named) for v in (_veto(search, named, c),) if v is not None), None)
        if losing is not None:
            refused.append(losing)
            named, lost = _weighed_anew(search, named, losing.candidate, vetoed_sets, report)
            abstained += lost
            continue
        named = _of_any_size(model, named, policy)
        effects = tuple(c.effect for c in named)
        after = mismatches(model, model.gaussian(effects), policy)
        left = list(dict.fromkeys(model.blocks.index(s.block) for s in after))
        if abstained and not left:
            left = [model.strongest_block(abstained[0].effect, effects)]
        gaussian = model.seen_gaussian(effects)
        likeliest = [likeliest_discrepancy(model, gaussian, i, policy) for i in left]
        parts = [
            c
            for c in named
            if after and not c.holds_a_remainder and _is_part_of_unknown(model, c, effects, likeliest, policy)
        ]
        claims = [] if parts else [(c, f) for c in abstained if (f := family_claim(search, named, c)) is not None]
        if claims:
            strongest, claimed = max(claims, key=lambda claim: claim[1].log_odds)
            abstained.remove(strongest)
            named = _refitted(search, [*named, claimed])
            continue
        if not parts:
            sized = [(c, _with_a_size(model, c, effects, policy)) for c in named]
            sizeless = [c for c, told in sized if told is None]
            if sizeless:
                # what it explains is told where it is a mismatch without it
                named = _refitted(search, named, sizeless[-1])
                continue
            named = [told for _, told in sized if told is not None]
            effects = tuple(c.effect for c in named)
            told = tuple(
                _with_equal_choices(
                    model, _with_every_mode(model, tied_family(c, policy), effects, policy), effects, policy
                )
                for c in named
            )
            plain = Verdict(model, threshold, top, before, told, tuple(abstained), after, (), models=search.models())
            return _verdict(plain, left, refused, policy)
        # the weakest goes first: without it, what is left may be within the other laws' tolerances
        abstained.append(parts[-1])
        named = _refitted(search, named, parts[-1])


def _verdict(told: Verdict, left: Sequence[int], refused: Sequence[VetoedCandidate], policy: DecisionPolicy) -> Verdict:
    """Return the verdict with what is left without a name, in the blocks `left` and where held-out numbers contradict
    the
    model: single captures that are outlying, or a discrepancy that predicts held-out captures."""
    model, effects = told.model, told.effects
    gaussian = model.seen_gaussian(effects)
    outlying = {i: found for i in left for found in (outlying_levels(model, i, effects, policy),) if found}
    discrepancies = []
    for index in left:
        one = no_discrepancy(model.blocks[index], index)
        if index not in outlying:
            likely = predictive_discrepancy(model, gaussian, index, policy)
            one = likely if predicts_held_out(model, effects, index, likely.kernel) else one
        discrepancies.append(one)
    kernels = {d.index: d.kernel for d in discrepancies if d.log_odds > 0}
    contradicting = held_out_mismatches(freed(model, outlying), effects, kernels, policy)
    held_out = tuple(s for s in contradicting if model.blocks.index(s.block) not in left)
    for part in held_out:
        index = model.blocks.index(part.block)
        discrepancies.append(no_discrepancy(part.block, index))
        found = outlying_levels(model, index, effects, policy)
        if found:
            outlying[index] = found
    return replace(
        told, discrepancies=tuple(discrepancies), held_out=held_out, vetoed=tuple(refused), outlying=outlying
    )


def _refitted(search: Search, named: Sequence[Candidate], gone: Candidate | None = None) -> list[Candidate]:
    """Return the named candidates, without one of them, fitted again."""
    rest = search.fitted(tuple(c.effect for c in named if c is not gone), converged=True)
    kept = {c.effect.name: c for c in named}
    return [replace(kept[e.name], effect=e, std=s) for e, s in zip(rest.effects, rest.std, strict=True)]


def _weighed_anew(
    search: Search,
    named: Sequence[Candidate],
    vetoed_one: Candidate,
    barred: set[frozenset[str]],
    report: Callable[[str], None],
) -> tuple[list[Candidate], list[Candidate]]:
    """Return what stood beside a vetoed name, weighed again with the vetoed effect among the rivals, and what lost by
    that. `barred`: sets whose names were vetoed; they aren't returned to, and the set at hand is added."""
    names = frozenset(c.effect.name for c in named)
    without = _refitted(search, named, vetoed_one)
    if not without or names in barred:
        return without, []
    barred.add(names)
    rest = search.fitted(tuple(c.effect for c in without), converged=True)
    return named_members(search, rest, report, barred)


def _of_any_size(model: MeasurementModel, named: list[Candidate], policy: DecisionPolicy) -> list[Candidate]:
    """Return the named candidates with values that aren't drawn towards usual ones, where one lies far from those."""
    effects = tuple(c.effect for c in named)
    if is_of_usual_size(effects, model.camera):
        return named
    found = refit(model, effects, policy, of_any_size=True)
    return [replace(c, effect=e, std=s) for c, e, s in zip(named, found.effects, found.std, strict=True)]


def _veto(search: Search, named: Sequence[Candidate], candidate: Candidate) -> VetoedCandidate | None:
    """Return the held-out captures' veto on one of the named candidates."""
    without = search.fitted(tuple(c.effect for c in named if c is not candidate), converged=True)
    return vetoed(search.model, candidate, tuple(c.effect for c in named), without.effects, search.policy)


def _with_a_size(
    model: MeasurementModel, candidate: Candidate, effects: tuple[Effect, ...], policy: DecisionPolicy
) -> Candidate | None:
    """Return the candidate as the recordings tell its size where every parameter is compatible with absence by its
    standard deviation, or None where the likelihood doesn't exclude absence either.

    Of several sizes that the recordings don't tell apart (a quadratic and a cubic bend), one by itself is told where
    that fits as well, the likeliest. A size that no normal distribution describes, as it is tied to a shape (a
    flicker's modulation to its frequency) or small in number (one hot pixel of a few hundred), is told by the interval
    of its profile likelihood."""
    if not candidate.is_compatible_with_absence(policy.least_size_sigma):
        return candidate
    at, sizes = effects.index(candidate.effect), candidate.sizes
    if len(sizes) > 1:
        alone = [refit_alone(model, effects, at, name, sizes, policy) for name in sizes]
        best = max(alone, key=lambda fit: fit.log_posterior)
        told = replace(candidate, effect=best.effects[at], std=best.std[at])
        if not told.is_compatible_with_absence(policy.least_size_sigma):
            return told
    whole, rest = (
        model.seen_gaussian(effects, 1.0),
        refit(model, (*effects[:at], *effects[at + 1 :]), policy, tolerance=0.0),
    )
    if 2.0 * (whole.log_likelihood(model.seen_value) - rest.log_likelihood) < policy.least_size_sigma**2:
        return None
    intervals = {name: profile_interval(model, effects, at, name, policy) for name in sizes}
    return replace(candidate, std=candidate.std | dict.fromkeys(sizes), intervals=intervals)


def _with_every_mode(
    model: MeasurementModel, candidate: Candidate, effects: tuple[Effect, ...], policy: DecisionPolicy
) -> Candidate:
    """Return the candidate with the posterior's other modes, where the recordings don't tell them apart from the one
    told.

    Parameters that act by their square have such modes: all signs turned, and, where an effect has several, any of them
    in the place of all (a bowed and a tilted image are as far out of focus at one place); those are looked for by a
    refit from each alone. Turned signs are told as a sign that is unknown. Other modes are told beside the one that is
    told; each is a size of its own, so that none is a standard deviation of another.
    """
    effect = candidate.effect
    signed = {
        name: float(getattr(effect, name))
        for name, q in type(effect).quantities().items()
        if q.linear_power == 2 and (q.lower is None or q.lower < 0.0)
    }
    if not signed:
        return candidate
    others = tuple(e for e in effects if e is not effect)
    least = log_likelihood(model, effects, policy) - policy.equal_mode_log_odds
    modes = [effect]
    if len(signed) > 1:
        total = float(np.sqrt(np.sum(np.square(list(signed.values())))))
        alone = [effect.replace_fields(**{n: total if n == name else 0.0 for n in signed}) for name in signed]
        for fit in (refit(model, (*others, start), policy) for start in alone):
            place = np.array([[getattr(one, n) for n in signed] for one in (fit.effects[-1], *modes)], float)
            unsigned_distance = np.minimum(
                np.linalg.norm(place[1:] - place[0], axis=1), np.linalg.norm(place[1:] + place[0], axis=1)
            )
            if np.all(unsigned_distance > policy.same_mode_share * total) and fit.log_likelihood >= least:
                modes.append(fit.effects[-1])
    turned = effect.replace_fields(**{n: -v for n, v in signed.items()})
    is_unsigned = log_likelihood(model, (*others, turned), policy) >= least
    if is_unsigned and max(signed.values(), key=abs) < 0.0:
        effect, candidate = turned, replace(candidate, effect=turned)
    return replace(
        candidate,
        unsigned=frozenset(signed) if is_unsigned else frozenset(),
        modes=tuple({n: float(getattr(one, n)) for n in signed} for one in modes[1:]),
    )


def _with_equal_choices(
    model: MeasurementModel, candidate: Candidate, effects: tuple[Effect, ...], policy: DecisionPolicy
) -> Candidate:
    """Return the candidate with those other choices among its prototypes by which the recordings are as likely, all
    parameters as they are."""
    kind = type(candidate.effect)
    names = kind.told_choices()
    if not names:
        return candidate
    others = tuple(e for e in effects if e.name != candidate.effect.name)
    told = tuple(getattr(candidate.effect, n) for n in names)
    every = dict.fromkeys(tuple(getattr(p, n) for n in names) for group in kind.prototypes(model.camera) for p in group)
    least = log_likelihood(model, (*others, candidate.effect), policy) - policy.equal_mode_log_odds
    tried = [candidate.effect.model_copy(update=dict(zip(names, v, strict=True))) for v in every if v != told]
    return replace(candidate, alike=tuple(e for e in tried if log_likelihood(model, (*others, e), policy) >= least))


def _is_part_of_unknown(
    model: MeasurementModel,
    candidate: Candidate,
    effects: Sequence[Effect],
    discrepancies: Iterable[Discrepancy],
    policy: DecisionPolicy,
) -> bool:
    """Say whether the measurement that an effect changes most holds a discrepancy that is strong beside it: both may
    have one unknown cause. An effect whose rivals are excluded, and whose law holds in another measurement, has no part
    in what one measurement leaves."""
    if excludes_rivals(candidate, policy):
        return False
    strongest = model.strongest_block(candidate.effect, effects)
    least = max(policy.remainder_share * candidate.log_odds, policy.remainder_log_odds)
    return any(d.index == strongest and d.log_odds > least for d in discrepancies)
