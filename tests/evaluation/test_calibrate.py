"""Calibration of decision rules: a policy is compared with the default one, and the differences are listed."""

from __future__ import annotations

import pytest

from evaluation.__main__ import main
from evaluation.calibrate import (
    DEFAULT,
    Answer,
    changed_policy,
    comparison,
    policies_without,
    refuse_proof,
    rule_table,
    tally,
)
from evaluation.case_run import CaseRun
from evaluation.score import BlindScore, score
from evaluation.truth import Seals, Truths, salted, seal
from lab.diagnose import DecisionPolicy
from lab.diagnose.policy import TUNED
from lab.errors import InputError
from lab.formats.results import DiagnosisResult
from tests.evaluation.test_score import HEALTHY, named, truth

TRUTHS = Truths(
    purpose="tuning", seed=1, size="small", cases=2,
    truths={"case-1": salted(truth("single", ("defocus", 80.0))), "case-2": salted(truth("healthy"))},
)  # fmt: skip
SEALS = Seals(seals={name: seal(one) for name, one in TRUTHS.truths.items()})


def _scored(first: DiagnosisResult) -> BlindScore:
    found = {"case-1": first, "case-2": HEALTHY}
    runs = {
        name: CaseRun(case=name, wall_s=1.0, cpu_s=1.0, memory_mib=100.0, diagnosis=diagnosis)
        for name, diagnosis in found.items()
    }
    return score(TRUTHS, SEALS, runs, ())


def test_a_rule_is_changed_by_its_name() -> None:
    policy = changed_policy(("least_probability=0.5", "most_effects=3"))
    assert policy == DecisionPolicy(least_probability=0.5, most_effects=3)


@pytest.mark.parametrize(
    ("rule", "said"), [("luck=1", "no such rule"), ("most_effects=few", "give NAME=VALUE"), ("most_effects",
    "give NAME=VALUE")]
)  # fmt: skip
def test_an_unknown_rule_is_refused(rule: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        changed_policy((rule,))


def test_a_proof_is_not_tuned_on() -> None:
    refuse_proof(TRUTHS)
    with pytest.raises(InputError, match="aren't for tuning"):
        refuse_proof(TRUTHS.model_copy(update={"purpose": "proof"}))


def test_differences_are_listed_by_case() -> None:
    text = comparison(_scored(named("defocus")), _scored(named()))
    assert "1 of 2 cases differ" in text
    assert "case-1, concealed defocus: explained (defocus) -> unexplained (no name)" in text
    assert "case-2" not in text


def test_each_rule_without_a_derivation_has_a_value_at_which_it_does_not_act() -> None:
    tuned = {name for name, rule in DecisionPolicy.rules().items() if TUNED in rule.basis}
    without = policies_without()
    assert set(without) == {DEFAULT} | tuned
    for name in tuned:
        changed = {n for n in DecisionPolicy.model_fields if getattr(without[name], n) != getattr(DecisionPolicy(), n)}
        assert changed == {name}


def _answer(*told: str, mismatch: bool = True) -> Answer:
    return Answer(named=told, mismatch=mismatch, cpu_s=1.5)


CASES = {
    "a": truth("compound", ("defocus", 80.0), ("crosstalk", 90.0)),
    "b": truth("healthy"),
    "c": truth("single", ("adc_ripple", 80.0), accepts=("vignetting",)),
}


def test_answers_are_counted_by_effect_and_by_family() -> None:
    by_default = {
        "a": _answer("crosstalk", "coma"),
        "b": _answer(mismatch=False),
        "c": _answer("converter", "vignetting"),
    }
    without = {"a": _answer("crosstalk", "defocus"), "b": _answer("nonlinearity"), "c": by_default["c"]}
    by_case = {case: {DEFAULT: by_default[case], "exact_share": without[case]} for case in CASES}
    one, other = tally(CASES, by_case, DEFAULT), tally(CASES, by_case, "exact_share")
    # coma is of another family than defocus; the converter's name is right for a ripple, vignetting describes that case
    assert (one.effects, one.families, one.concealed, one.wrong, one.alarms, one.healthy) == (1, 2, 3, 1, 0, 1)
    assert (other.effects, other.families, other.wrong, other.alarms, other.differ, other.cpu_s) == (2, 3, 1, 1, 2, 4.5)


def test_a_table_has_a_row_for_each_rule() -> None:
    by_case = {case: {name: _answer() for name in policies_without()} for case in CASES}
    rows = rule_table(CASES, by_case).splitlines()
    assert len(rows) == 2 + len(policies_without())
    assert "| `covariance_slack` | 0 | 0.15 | 0 of 3 | 0 | 0 | 1 of 1 | 0 of 3 |" in "\n".join(rows)


def test_either_each_rule_or_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "DIR", "--truths", "FILE"]) != 0
    assert "give either --each or --rule" in capsys.readouterr().err
