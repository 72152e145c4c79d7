"""Families: what is named where recordings show which physics is missing, and no single law of it.

A family is claimed for a candidate whose own name doesn't hold. Given that the cause is one of the weighed effects,
with a discrepancy beside each, the family has to hold `family_probability`, and the nearest law has to explain
`family_least_share` of the excess chi2 in the measurements that it acts on. A family is also told in place of a name
that holds where other members fit about as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.search import Search
from lab.diagnose.inference.weigh import Candidate, explained
from lab.diagnose.policy import DecisionPolicy
from sim.effects.base import Effect
from sim.effects.library import effects as library


def family_claim(search: Search, named: Sequence[Candidate], candidate: Candidate) -> Candidate | None:
    """A candidate without a name as one that its family is named for, with the likeliest law fitted beside what is
    named; None where no family holds it."""
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
    """Where a fit of an effect beside others begins; None where nothing shows it."""
    scores = signatures(search.model, search.model.camera, others, [kind]).scores()
    return scores[0].start if scores else None


def tied_family(candidate: Candidate, policy: DecisionPolicy) -> Candidate:
    """The candidate as its family where the recordings can't tell its members apart: no member reaches
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
