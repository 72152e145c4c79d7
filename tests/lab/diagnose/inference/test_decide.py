"""The chain of decisions: what was put in is named, and what nobody lists isn't."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose.inference.decide import decide
from lab.diagnose.policy import DecisionPolicy
from sim.effects.library import effect
from tests.lab.diagnose.inference.made_up import FREQUENCY, contrast_model


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("optical_low_pass_filter", {"displacement_x_um": 1.6, "displacement_y_um": 1.6}),
        ("defocus", {"defocus_um": 14.0}),
        ("charge_diffusion", {"length_um": 0.8}),
    ],
)
def test_the_chain_names_what_was_put_in(name: str, parameters: dict[str, float]) -> None:
    """One wavelength and one f-number: what tells these apart is the shape over frequency and direction alone."""
    model = contrast_model(np.random.default_rng(21), (effect(name)(**parameters),))
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert [c.effect.name for c in verdict.named] == [name]
    assert not verdict.after


def test_what_nobody_lists_gets_no_name() -> None:
    """A ripple of contrast: located, and left without a name."""
    model = contrast_model(np.random.default_rng(22), (), 0.05 * np.sin(14.0 * FREQUENCY))
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert not verdict.named
    assert verdict.after
    assert verdict.discrepancies


def test_a_name_beside_a_strong_remainder_is_a_family() -> None:
    """A filter, and a ripple that no law has: the nearest name takes 96 % of the excess, and what it leaves isn't
    within its tolerance. The family is named, with the nearest law and a discrepancy beside it."""
    model = contrast_model(
        np.random.default_rng(23),
        (effect("optical_low_pass_filter")(displacement_x_um=1.6, displacement_y_um=1.6),),
        0.03 * np.sin(14.0 * FREQUENCY),
    )
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert [c.told_name for c in verdict.named] == ["isotropic_contrast_loss"]
    assert verdict.named[0].holds_a_remainder
    assert verdict.named[0].members[0][0] == verdict.named[0].effect.name
    assert not verdict.abstained
    assert verdict.discrepancies
