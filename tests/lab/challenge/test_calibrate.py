"""Calibration of decision rules: a policy is compared with the default one, and the differences are listed."""

from __future__ import annotations

import pytest

from lab.challenge.calibrate import changed_policy, comparison, refuse_proof
from lab.challenge.run import CaseRun
from lab.challenge.score import ChallengeScore, score
from lab.challenge.truth import Seals, Truths, salted, seal
from lab.diagnose import DecisionPolicy
from lab.errors import InputError
from lab.formats.results import DiagnosisResult
from tests.lab.challenge.test_score import HEALTHY, named, truth

TRUTHS = Truths(
    purpose="tuning", seed=1, size="small", cases=2,
    truths={"case-1": salted(truth("single", ("defocus", 80.0))), "case-2": salted(truth("healthy"))},
)  # fmt: skip
SEALS = Seals(seals={name: seal(one) for name, one in TRUTHS.truths.items()})


def _scored(first: DiagnosisResult) -> ChallengeScore:
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
    ("rule", "said"), [("luck=1", "no such rule"), ("most_effects=few", "give NAME=VALUE"), ("most_effects", "give NAME=VALUE")]
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
