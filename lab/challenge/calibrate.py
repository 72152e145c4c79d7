"""Calibration of decision rules: scores of tuning cases under a changed policy and under the default one."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import ValidationError

from lab.challenge.score import ChallengeScore
from lab.challenge.truth import Truths
from lab.diagnose.policy import DecisionPolicy
from lab.errors import InputError


def changed_policy(rules: Sequence[str]) -> DecisionPolicy:
    """The default policy with `NAME=VALUE` in place of its own. Raises InputError for what isn't a rule or not a
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


def comparison(default: ChallengeScore, changed: ChallengeScore) -> str:
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
