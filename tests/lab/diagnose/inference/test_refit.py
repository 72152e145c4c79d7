"""A refit's intervals cover the truth."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose.inference.refit import _standard_deviations, coordinates, refit
from lab.diagnose.policy import DecisionPolicy
from sim.effects.library import effect
from sim.effects.light_flicker import LightFlicker
from tests.lab.diagnose.inference.made_up import contrast_model


def test_refit_covers_the_truth() -> None:
    """40 draws: pulls have mean 0 within 3 / sqrt(40) and a standard deviation in 0.6..1.35.

    The form tolerance (1 %) is in the intervals and not in the draws, so that they may be too wide and not too narrow.
    """
    kind = effect("optical_low_pass_filter")
    truth = kind(displacement_x_um=1.5, displacement_y_um=1.2)
    pulls = []
    for seed in range(40):
        fit = refit(
            contrast_model(np.random.default_rng(100 + seed), (truth,)),
            (kind(displacement_x_um=1.0, displacement_y_um=1.0),),
            DecisionPolicy(),
        )
        std = fit.std[0]["displacement_x_um"]
        assert std is not None
        pulls.append((fit.effects[0].displacement_x_um - 1.5) / std)
    assert abs(np.mean(pulls)) < 3.0 / np.sqrt(40)
    assert 0.6 < np.std(pulls) < 1.35


def test_a_logarithmic_parameter_is_fitted_as_its_logarithm() -> None:
    """u = ln p, within ln of the bounds; the standard deviation of p is p times that of u."""
    by_name = {c.name: c for c in coordinates((LightFlicker(),))}
    frequency = by_name["frequency_hz"]
    assert frequency.to_u(100.0) == pytest.approx(np.log(100.0))
    assert frequency.to_value(frequency.to_u(120.0)) == pytest.approx(120.0)
    assert frequency.bounds == pytest.approx((np.log(0.1), np.log(1e6)))
    assert frequency.to_value(99.0) == 1e6
    jacobian, prior_std = np.array([[10.0]]), np.array([np.inf])
    std = _standard_deviations(jacobian, [frequency], np.array([np.log(100.0)]), prior_std, 1)
    assert std == [{"frequency_hz": pytest.approx(10.0)}]
