"""Which members of the best set are named: each has to hold against rivals, an unknown cause and the other members."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lab.diagnose.inference.discrepancy import likeliest_discrepancy
from lab.diagnose.inference.refit import Fit
from lab.diagnose.inference.search import Search
from lab.diagnose.inference.shown_in_means import shown_in_means
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
        index = _too_weak(search, current)
        if index is not None:
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
    least_share = policy.least_explained_share if candidate.is_closed else policy.least_explained_share_open
    return candidate.probability >= policy.least_probability and candidate.explained_share >= least_share


def _too_weak(search: Search, fit: Fit) -> int | None:
    """The weakest member that can't be named whatever its rivals: too small a gain, or none in the means that it must show in. Tested before anything is weighed, as that fits every rival of every
    member."""
    without = [search.without(fit, i) for i in range(len(fit.effects))]
    log_odds = [fit.log_posterior - one.log_posterior for one in without]
    weak = [
        odds
        for odds, e, one in zip(log_odds, fit.effects, without, strict=True)
        if odds < search.needed_log_odds or not shown_in_means(search.model, e, fit.effects, one.effects, search.policy)
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
