"""Which members of the best set are named: each has to hold against rivals, an unknown cause and the other members."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

from lab.diagnose.inference.discrepancy import likeliest_discrepancy
from lab.diagnose.inference.refit import Fit
from lab.diagnose.inference.search import Search
from lab.diagnose.inference.shown_in_means import shown_in_means
from lab.diagnose.inference.weigh import Candidate, closes_somewhere, explained, weigh
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect


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
    """Whether a name is likely enough and explains enough."""
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
    """The weakest member that can't be named whatever its rivals: too small a gain, or none in the means that it must
    show in. Tested before anything is weighed, as that fits every rival of every member."""
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
