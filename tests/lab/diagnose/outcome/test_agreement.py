"""Whether held-out captures agree is decided by the probability of their chi2, which is stated."""

from __future__ import annotations

import pytest

from lab.diagnose.outcome.merge_sides import _agreement
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import HeldOut


@pytest.mark.parametrize(
    ("chi2", "n", "words"),
    [
        (13.0, 8, ", and held-out captures agree (chi2 13 of 8 numbers, p = 0.11)"),
        (36.0, 12, ", but held-out captures do not agree with it (chi2 36 of 12 numbers, p = 0.00032)"),
        (400.0, 300, ", but held-out captures do not agree with it (chi2 400 of 300 numbers, p = 9.7e-05)"),
    ],
)
def test_the_probability_of_chi2_decides(chi2: float, n: int, words: str) -> None:
    held_out = HeldOut(captures=("a",), chi2_before=chi2, chi2_after=chi2, n=n)
    assert _agreement(held_out, DecisionPolicy()) == words
