"""The credible sets of effects that the search found, as a result and in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lab.diagnose.inference.search import ModelSet
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import EffectSet, IncludedEffect, NamedEffect, SideModels, Unexplained
from sim.camera import Side

#: Sets that a sentence lists.
LISTED_SETS = 5


def side_models(side: Side, found: ModelSet, policy: DecisionPolicy) -> SideModels:
    """Return the sets of effects of one side, as a result."""
    return SideModels(
        side=side,
        share=policy.model_set_share,
        sets=tuple(EffectSet(effects=m.effects, probability=m.probability, refitted=m.refitted) for m in found.models),
        inclusion=tuple(IncludedEffect(name=n, probability=p) for n, p in found.inclusion),
        not_weighed=found.not_weighed,
    )


def set_sentences(
    models: Sequence[SideModels],
    effects: Sequence[NamedEffect],
    unexplained: Sequence[Unexplained],
    policy: DecisionPolicy,
) -> Iterator[str]:
    """Sentences about effects that may be present, though they are neither named nor rivals of a name; and about sets
    that the budget left unweighed.

    The former are given only where the names explain everything: listed effects fit an unlisted cause badly.
    """
    for one in models:
        named = [e for e in effects if one.side in e.sides]
        told = {n for e in named for n in (e.name, *e.alternatives)}
        is_whole = named and all(u.side != one.side for u in unexplained)
        untold = {n for s in one.sets for n in s.effects} - told
        if is_whole and any(sum(s.probability for s in one.sets if n in s.effects) > 1.0 - one.share for n in untold):
            sets = ", ".join(f"{_words(s.effects)} ({100 * s.probability:.0f} %)" for s in one.sets[:LISTED_SETS])
            more = f" and {len(one.sets) - LISTED_SETS} more" if len(one.sets) > LISTED_SETS else ""
            yield (
                f"For the {one.side} camera, if every cause is a listed effect, these sets of effects hold "
                f"{100 * one.share:.0f} % together: "
                f"{sets}{more}."
            )
        if one.not_weighed:
            sets = "; ".join(_words(s) for s in one.not_weighed[:LISTED_SETS])
            more = f"; and {len(one.not_weighed) - LISTED_SETS} more" if len(one.not_weighed) > LISTED_SETS else ""
            yield (
                f"The search for the {one.side} camera ended when its {policy.search_cpu_s:g} s of CPU time were "
                f"spent. Not weighed: {sets}{more}; "
                "a name may have rivals among these."
            )


def _words(effects: Sequence[str]) -> str:
    return " with ".join(effects) if effects else "none"
