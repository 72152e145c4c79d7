"""Which members of the best set are named: each has to hold against rivals, an unknown cause and the other members."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from lab.diagnose.inference.discrepancy import likeliest_discrepancy
from lab.diagnose.inference.locate import mismatches
from lab.diagnose.inference.refit import Fit
from lab.diagnose.inference.search import Search
from lab.diagnose.inference.weigh import Candidate, explained, weigh
from lab.diagnose.policy import DecisionPolicy


def named_members(search: Search, best: Fit, report: Callable[[str], None]) -> tuple[list[Candidate], list[Candidate]]:
    """The members of a set whose names hold, and those that were given up, in that order.

    One at a time: the weakest member that is too weak for any name; then the member for which a rival is likelier; then
    members that one discrepancy replaces, or whose name doesn't hold. After each change the rest is fitted and weighed
    again. What was given up and explains nothing isn't told.
    """
    model, policy = search.model, search.policy
    current = best
    given_up: list[Candidate] = []
    weighed: set[frozenset[str]] = set()
    certain: dict[str, Candidate] = {}
    while current.effects:
        weighed.add(frozenset(current.names))
        weakest = _too_weak(search, current)
        if weakest is not None:
            index, is_companion = weakest
            if not is_companion:  # the error of a named law is no unknown cause
                report(f"weighing {current.effects[index].name} against its rivals")
                candidate, better = weigh(search, current, index)
                if better is not None and frozenset(better.names) not in weighed:
                    current = search.fitted(better.effects, converged=True)
                    continue
                given_up.append(replace(candidate, among_listed=()))  # no claim, of its family neither
            current = search.without(current, index)
            continue
        members, likelier = [], None
        for index, e in enumerate(current.effects):
            if e.name in certain:
                # when a weaker member leaves, this name stays as certain; what is left to explain changes
                share, is_closed = explained(
                    model, current, search.without(current, index), model.affected_blocks(e), policy
                )
                kept = replace(
                    certain[e.name], effect=e, std=current.std[index], explained_share=share, is_closed=is_closed
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


def holds(candidate: Candidate, policy: DecisionPolicy) -> bool:
    """Whether a name is likely enough and explains enough."""
    is_exact = candidate.explained_share >= policy.exact_share
    least_probability = policy.least_probability if is_exact else policy.least_probability_inexact
    least_share = policy.least_explained_share if candidate.is_closed else policy.least_explained_share_open
    return (
        candidate.unknown_probability <= policy.most_unknown_probability
        and candidate.probability >= least_probability
        and candidate.explained_share >= least_share
    )


def _too_weak(search: Search, fit: Fit) -> tuple[int, bool] | None:
    """The weakest member that can't be named whatever its rivals, and whether it may be no more than the error of
    another member's law. Tested before anything is weighed, as that fits every rival of every member."""
    policy = search.policy
    log_odds = [fit.log_posterior - search.without(fit, i).log_posterior for i in range(len(fit.effects))]
    members = [Candidate(e, s, 0.0, (), odds) for e, s, odds in zip(fit.effects, fit.std, log_odds, strict=True)]
    companions = [c for c in members if _is_companion(c, members, search)]
    companions = [c for c in companions if not _settles(search, fit, members.index(c))]

    def needed(candidate: Candidate) -> float:
        factor = policy.added_threshold_factor if _is_beside_stronger(candidate, members, search) else 1.0
        return search.threshold * factor

    weak = companions or [c for c in members if 2.0 * c.log_odds < needed(c)]
    if not weak:
        return None
    return members.index(min(weak, key=lambda c: c.log_odds)), bool(companions)


def _settles(search: Search, fit: Fit, index: int) -> bool:
    """Whether nothing departs from the set, within its laws' tolerances, and something does without one member: that is no error of the
    others' laws."""
    model, policy = search.model, search.policy
    without = search.without(fit, index)
    return not mismatches(model, model.gaussian(fit.effects), policy) and bool(
        mismatches(model, model.gaussian(without.effects), policy)
    )


def _is_beside_stronger(candidate: Candidate, members: Sequence[Candidate], search: Search) -> bool:
    """Whether a stronger member acts on the block that the candidate changes most."""
    stronger = [c for c in members if c.log_odds > candidate.log_odds]
    if not stronger:
        return False
    model = search.model
    block = model.blocks[model.strongest_block(candidate.effect, [c.effect for c in members])]
    return any(block.touched_by(type(c.effect)) for c in stronger)


def _is_companion(candidate: Candidate, members: Sequence[Candidate], search: Search) -> bool:
    """Whether a member may be no more than the error of a stronger one's law.

    It may where its log odds are below `companion_share` of a rival's; and where, in the block that it changes most,
    its change is below `companion_share` of another member's.
    """
    model, policy = search.model, search.policy
    others = [c for c in members if c is not candidate]
    rivals = search.rivals[candidate.effect.name]
    if any(c.effect.name in rivals and candidate.log_odds < policy.companion_share * c.log_odds for c in others):
        return True
    acts = model.acts(type(candidate.effect))
    around = tuple(c.effect for c in others)
    changes = [model.change_chi2(candidate.effect, around, i) if acting else 0.0 for i, acting in enumerate(acts)]
    most = int(np.argmax(changes))
    for c in others:
        if model.blocks[most].touched_by(type(c.effect)):
            without = (candidate.effect, *(o.effect for o in others if o is not c))
            if changes[most] < policy.companion_share * model.change_chi2(c.effect, without, most):
                return True
    return False


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
