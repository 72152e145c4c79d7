"""Families beside named members of their own."""

from __future__ import annotations

import numpy as np
import pytest

from lab.inference.hypotheses import SetPrior
from lab.inference.posterior import NAMED, read_table
from lab.inference.search import Search
from tests.lab.inference.toys import Toy, linear

NUMBERS = 24


@pytest.mark.parametrize("acts", [True, False])
def test_a_family_with_a_name_is_named_again_for_what_else_of_it_acts(acts: bool) -> None:
    """Two members with one signature can't be told apart: each has half. Where one of them acts beside a named member
    of their family, the family stands for them; where neither does, it doesn't."""
    rng = np.random.default_rng(4)
    first, second = 8.0 * np.eye(NUMBERS)[:2] * np.sqrt(NUMBERS)
    signatures = {"alone": first, "one": second, "other": second}
    changes = {name: (lambda u, own=own: u[0] * own) for name, own in signatures.items()}
    value = first + (second if acts else 0.0) + rng.standard_normal(NUMBERS)
    toy = Toy(value, changes, np.zeros((NUMBERS, 0)), ())
    hypotheses = {name: linear(name, "family", 1.0) for name in signatures}
    posterior = read_table(Search(toy, hypotheses, SetPrior(dict.fromkeys(signatures, "family"))).run(), hypotheses)
    assert [f.name for f in posterior.named] == (["alone", "family"] if acts else ["alone"])
    if acts:
        assert posterior.named[1].probability >= NAMED
        for name in ("one", "other"):
            # more than a half, as both may act; less than what a name needs
            assert 0.45 < posterior.probability("effect", name) < NAMED
