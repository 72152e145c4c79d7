"""Sizes from which effects can be detected, and told apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lab.diagnose.outcome.goodness_of_fit import detectability, detectable
from lab.diagnose.policy import DecisionPolicy
from sim.effects.defocus import Defocus
from tests.lab.diagnose.outcome.filtered_edges import NOISE, filtered_edges


def test_a_detectable_size_is_detected_at_the_stated_rate() -> None:
    """200 000 draws of a squared normal: 3 sigma of the rate are 0.002."""
    size = np.sqrt(detectable(12.0))
    score = np.square(np.random.default_rng(1).standard_normal(200_000) + size)
    assert np.mean(score > 12.0) == pytest.approx(0.9, abs=0.002)


def test_the_detectable_size_has_the_stated_non_centrality() -> None:
    """The change by the effect at that size, whitened: lambda to 5 %, as blurs bend a little beyond the slope at
    zero."""
    verdict = filtered_edges()
    found = {item.effect: item for item in detectability("left", verdict, DecisionPolicy())}
    size = found["defocus"].smallest["defocus_um"]
    model = verdict.model
    change = (model.mean((Defocus(defocus_um=size),)) - model.mean())[model.seen] / NOISE
    assert float(change @ change) == pytest.approx(detectable(12.0), rel=0.05)
    assert 0.9 < found["defocus"].cosine <= 1.0  # all blurs are alike in so few numbers
    assert found["defocus"].told_apart == pytest.approx(
        stats.norm.cdf(0.5 * np.sqrt(detectable(12.0) * (1.0 - found["defocus"].cosine ** 2)))
    )
