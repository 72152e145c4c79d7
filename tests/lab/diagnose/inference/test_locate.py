"""Slices: nothing in noise, and the place of what is there."""

from __future__ import annotations

import numpy as np

from lab.diagnose.inference.locate import mismatches
from lab.diagnose.policy import DecisionPolicy
from tests.lab.diagnose.inference.made_up import FREQUENCY, contrast_model


def test_slices_find_nothing_in_noise_and_the_place_of_a_bump() -> None:
    healthy = 0
    for seed in range(100):
        model = contrast_model(np.random.default_rng(seed))
        healthy += bool(mismatches(model, model.gaussian(), DecisionPolicy()))
    assert healthy <= 3  # 0.5 % allowed, SLACK beside it
    bump = 0.03 * np.exp(-0.5 * ((FREQUENCY - 0.7) / 0.05) ** 2)
    model = contrast_model(np.random.default_rng(7), (), bump)
    top = mismatches(model, model.gaussian(), DecisionPolicy())[0]
    low, high = (float(x) for x in top.where.split(" ")[0].split(".."))
    assert low < 0.75
    assert high > 0.65
