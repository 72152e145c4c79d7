"""Calibrating rules of decision: tuning cases scored under a changed policy, beside the default one; and each rule
without a derivation taken out in turn."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from evaluation.score import BlindScore, families_of
from evaluation.truth import CaseTruth, Truths
from lab.diagnose.inference.decide import Verdict, decide
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.side import SEED
from lab.errors import InputError
from lab.formats import recording_set
from lab.one_blas_thread import one_blas_thread
from sim.effects.library import effects as library
from sim.parameters import Frozen

#: What the default policy is called among the others.
DEFAULT = "default"


def changed_policy(rules: Sequence[str]) -> DecisionPolicy:
    """Return the default policy with `NAME=VALUE` in place of its own. Raises InputError for what isn't a rule or not a
    number."""
    known = DecisionPolicy.rules()
    values: dict[str, str] = {}
    for rule in rules:
        name, _, value = rule.partition("=")
        if name not in known:
            raise InputError(f"rule {name!r}: no such rule; docs/reference/decision-policy.md lists them")
        values[name] = value
    try:
        return DecisionPolicy.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"rule {first['loc'][0]}={first['input']}: {first['msg']}; give NAME=VALUE") from error


def refuse_proof(truths: Truths) -> None:
    """Raise InputError for the cases of a proof: rules tuned on them would invalidate it."""
    if truths.purpose == "proof":
        raise InputError(
            f"seed {truths.seed}: a proof's cases aren't for tuning; make others with a seed below 1000000"
        )


def comparison(default: BlindScore, changed: BlindScore) -> str:
    """Every goal under both policies, and the cases whose verdict or names differ, as text."""
    wide = max(len(goal.name) for goal in default.goals)
    lines = [f"{'':{wide}}  {'wanted':>10}  {'default':>24}  {'changed':>24}"]
    for one, other in zip(default.goals, changed.goals, strict=True):
        lines.append(f"{one.name:{wide}}  {one.wanted:>10}  {one.reached:>24}  {other.reached:>24}")
    before = {case.case: case for case in default.case_scores}
    differing = [
        (before[now.case], now)
        for now in changed.case_scores
        if (before[now.case].verdict, before[now.case].named) != (now.verdict, now.named)
    ]
    lines.append(f"{len(differing)} of {len(changed.case_scores)} cases differ in verdict or names")
    for was, now in differing:
        told = (f"{one.verdict} ({', '.join(one.named) or 'no name'})" for one in (was, now))
        lines.append(f"  {now.case}, concealed {', '.join(now.truth) or now.kind}: {' -> '.join(told)}")
    return "\n".join(lines)


# --- each rule in turn ------------------------------------------------------------------------------------------------


class Answer(Frozen):
    """What the diagnosis of one case says under one policy. `named`: effects, or families in place of an effect, most
    significant first; `mismatch`: whether anything is told at all; `cpu_s`: of deciding, the measurements made
    before."""

    named: tuple[str, ...]
    mismatch: bool
    cpu_s: float


def policies_without() -> dict[str, DecisionPolicy]:
    """Return the default policy, and by the name of each rule without a derivation, the policy in which that rule
    doesn't act."""
    rules = DecisionPolicy.rules()
    changed = {name: DecisionPolicy.model_validate({name: r.off}) for name, r in rules.items() if r.off is not None}
    return {DEFAULT: DecisionPolicy(), **changed}


@one_blas_thread
def answers(folder: Path, policies: Mapping[str, DecisionPolicy]) -> dict[str, Answer]:
    """Return what each policy says of one recording set, whose measurements are made once. Without a fit, as
    sealed cases are diagnosed."""
    recordings = recording_set.read(folder)
    models = [measurement_model(recordings, side, None)[0] for side in recordings.sides]
    found: dict[str, Answer] = {}
    for name, policy in (("", DecisionPolicy()), *policies.items()):  # what is computed once is kept by the first
        began_s = time.process_time()
        told = [decide(m, np.random.default_rng(SEED), policy) for m in models if m is not None]
        found[name] = Answer(
            named=tuple(dict.fromkeys(n for verdict in told for n in _told(verdict))),
            mismatch=any(v.named or v.before or v.abstained or v.held_out for v in told),
            cpu_s=time.process_time() - began_s,
        )
    return {name: found[name] for name in policies}


def _told(verdict: Verdict) -> list[str]:
    """Names as a result tells them: the family where no member of it holds by itself."""
    ordered = sorted(verdict.named, key=lambda c: -c.log_odds)
    return [type(c.effect).family.value if c.members else c.effect.name for c in ordered]


def _family(name: str) -> str:
    return library()[name].family.value if name in library() else name


class Tally(Frozen):
    """Of all cases under one policy: concealed listed effects that are named, by their effect or their family; names of
    a family that isn't concealed; healthy cameras of which anything is told; cases answered otherwise than by default;
    CPU time (s)."""

    effects: int
    families: int
    concealed: int
    wrong: int
    alarms: int
    healthy: int
    differ: int
    cpu_s: float


def tally(truths: Mapping[str, CaseTruth], by_case: Mapping[str, Mapping[str, Answer]], policy: str) -> Tally:
    """Return what one policy reaches on all cases."""
    effects = families = concealed = wrong = alarms = healthy = differ = 0
    for case, answered in by_case.items():
        truth, one, default = truths[case], answered[policy], answered[DEFAULT]
        right = [families_of(c) for c in truth.concealed]
        told = {_family(name) for name in one.named}
        accepted = frozenset(_family(name) for name in truth.accepts).union(*right)
        concealed += len(truth.names)
        effects += len(set(truth.names) & set(one.named))
        families += sum(_family(name) in told for name in truth.names)
        wrong += len(told - accepted)
        alarms += truth.kind == "healthy" and one.mismatch
        healthy += truth.kind == "healthy"
        differ += (one.named, one.mismatch) != (default.named, default.mismatch)
    cpu_s = sum(answered[policy].cpu_s for answered in by_case.values())
    return Tally(
        effects=effects, families=families, concealed=concealed, wrong=wrong, alarms=alarms, healthy=healthy,
        differ=differ, cpu_s=cpu_s
    )  # fmt: skip


def rule_table(truths: Mapping[str, CaseTruth], by_case: Mapping[str, Mapping[str, Answer]]) -> str:
    """One row of Markdown for the default policy, and one for each rule that is taken out."""
    rules, default = DecisionPolicy.rules(), DecisionPolicy()
    lines = [
        (
            "| without | at | in place of | effects named | families | wrong names | alarms, healthy | cases that "
            "differ "
            "| CPU, s |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for policy in policies_without():
        one = tally(truths, by_case, policy)
        changed = ("", "") if policy == DEFAULT else (f"{rules[policy].off:g}", f"{getattr(default, policy):g}")
        lines.append(
            f"| {'' if policy == DEFAULT else f'`{policy}`'} | {changed[0]} | {changed[1]} | {one.effects} of "
            f"{one.concealed} | {one.families} "
            f"| {one.wrong} | {one.alarms} of {one.healthy} | {one.differ} of {len(by_case)} | {one.cpu_s:.0f} |"
        )
    return "\n".join(lines)
