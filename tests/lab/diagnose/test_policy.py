"""The decision policy: declared in full, stated in the docs and in results, and obeyed."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.special import logit
from scipy.stats import chi2, norm

from lab.diagnose import DecisionPolicy, diagnose, examine
from lab.diagnose.outcome.detectability import detectable
from tests.lab.diagnose.on_blocks import former

DOCS = Path(__file__).parents[3] / "docs"


def test_every_field_is_declared() -> None:
    rules = DecisionPolicy.rules()
    assert list(rules) == list(DecisionPolicy.model_fields)
    assert all(rule.meaning and rule.unit and rule.basis for rule in rules.values())


def test_the_page_is_current() -> None:
    """Else: `python docs/write_tables.py decision-policy`."""
    page = runpy.run_path(str(DOCS / "write_tables.py"))["policy_page"]()
    assert (DOCS / "reference" / "decision-policy.md").read_text(encoding="utf-8") == page


def test_it_is_frozen_and_knows_its_fields_and_bounds() -> None:
    with pytest.raises(ValidationError):
        DecisionPolicy().most_effects = 3  # type: ignore[misc]
    with pytest.raises(ValidationError):
        DecisionPolicy(most_efects=3)  # type: ignore[call-arg]
    for outside in (-0.1, 1.1):
        with pytest.raises(ValidationError):
            DecisionPolicy(false_alarm_rate=outside)


def test_stated_probabilities_follow_from_their_formulas() -> None:
    policy = DecisionPolicy()
    assert norm.cdf(0.5 * np.sqrt(25.0 * (1.0 - policy.rival_cosine**2))) == pytest.approx(0.951, abs=0.001)
    assert norm.cdf(np.sqrt(0.5 * policy.next_capture_distance)) == pytest.approx(0.841, abs=0.001)
    needed = policy.included_log_odds + logit(policy.least_inclusion_probability) + policy.parameter_log_odds
    assert chi2.isf(1.0 / 27000.0, 1) == pytest.approx(2.0 * needed, abs=0.05)
    assert detectable(12.0, policy.detection_probability) == pytest.approx(detectable(12.0))


def test_a_result_states_the_policy_by_which_it_was_decided() -> None:
    """One healthy camera in two has a score beyond the median: the threshold falls with the rate that is asked for."""
    recordings = former(5, kinds=("dark",))
    usual = diagnose(recordings)
    loose = examine(recordings, policy=DecisionPolicy(false_alarm_rate=0.5)).result
    assert {rule.name: rule.value for rule in usual.policy} == DecisionPolicy().model_dump()
    assert {rule.name: rule.value for rule in loose.policy}["false_alarm_rate"] == loose.false_alarm_rate == 0.5
    assert usual.threshold is not None
    assert loose.threshold is not None
    assert loose.threshold < usual.threshold
