"""Held-out captures have a veto: on names, on discrepancies, and on the verdict that nothing departs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.discrepancy import likeliest_discrepancy
from lab.diagnose.inference.held_out import held_out_mismatches, predicts_held_out, vetoed
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import refit
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.mismatches import located, vetoed_names
from lab.diagnose.policy import DecisionPolicy
from lab.observables.observable import Prediction
from sim.effects.base import Effects
from sim.effects.charge_diffusion import ChargeDiffusion
from tests.lab.diagnose.inference.made_up import CAMERA, NOISE, contrast_model, spectral_model


def _with_held_out_of(model: MeasurementModel, other: MeasurementModel) -> MeasurementModel:
    """The seen numbers of one model and the held-out ones of another."""
    block = replace(model.blocks[0], value=np.where(model.seen, model.value, other.value))
    return MeasurementModel((block,), CAMERA)


def test_held_out_numbers_contradict_at_the_stated_rate() -> None:
    """300 healthy draws at a rate of 10 %: 0.1 +- 3 sqrt(0.1 0.9 / 300) = 0.1 +- 0.052."""
    policy = DecisionPolicy(covariance_slack=0.0, held_out_false_alarm_rate=0.1)
    rng = np.random.default_rng(1)
    found = [bool(held_out_mismatches(contrast_model(rng), (), {}, policy)) for _ in range(300)]
    assert np.mean(found) == pytest.approx(0.1, abs=0.052)


def test_held_out_captures_that_disagree_are_a_mismatch_without_a_name() -> None:
    rng = np.random.default_rng(2)
    model = _with_held_out_of(contrast_model(rng), contrast_model(rng, (), 6.0 * NOISE))
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert not verdict.before
    assert not verdict.named
    assert [d.index for d in verdict.discrepancies] == [0]
    (told,) = located("left", verdict)
    assert told.captures == ("edge-1", "edge-3")
    assert "held-out" in told.where


def test_a_name_that_held_out_captures_contradict_is_a_remark() -> None:
    """Diffusion in the seen edges alone: by its name chi2 of the held-out ones rises."""
    rng = np.random.default_rng(3)
    model = _with_held_out_of(contrast_model(rng, (ChargeDiffusion(length_um=0.8),)), contrast_model(rng))
    verdict = decide(model, np.random.default_rng(0), DecisionPolicy())
    assert not verdict.named
    (told,) = vetoed_names("left", verdict)
    assert told.name == "charge_diffusion"
    assert told.chi2_after > told.chi2_before
    assert "is not named" in told.statement


def test_a_right_name_is_seldom_vetoed() -> None:
    """A weak diffusion, fitted to the seen edges of 60 draws: at 1 % a draw, 4 or more vetoes have a probability of 0.3
    %."""
    policy, rng = DecisionPolicy(), np.random.default_rng(4)
    vetoes = 0
    for _ in range(60):
        model = contrast_model(rng, (ChargeDiffusion(length_um=0.25),))
        fit = refit(model, (ChargeDiffusion(length_um=0.25),), policy)
        log_odds = fit.log_likelihood - refit(model, (), policy).log_likelihood
        candidate = Candidate(fit.effects[0], fit.std[0], 1.0, (), log_odds)
        vetoes += vetoed(model, candidate, fit.effects, (), policy) is not None
    assert vetoes < 4


@pytest.mark.parametrize(("over", "is_vetoed"), [(1.0, False), (1.8, True)])
def test_a_familys_nearest_law_has_to_predict_as_well_as_a_discrepancy(over: float, is_vetoed: bool) -> None:
    """A law that fits the seen edges, and changes the held-out ones `over` times as much as they do: by 1.8, chi2 still
    falls to (1.8 - 1)^2 = 64 % of what it is without, but a discrepancy alone predicts them within their noise."""
    policy, law = DecisionPolicy(), ChargeDiffusion(length_um=0.8)
    model = contrast_model(np.random.default_rng(8), (law,))
    block = model.blocks[0]

    def predict(acting: Effects) -> Prediction:
        mean = block.predict(()).mean
        return Prediction(mean + np.where(model.seen, 1.0, over) * (block.predict(acting).mean - mean), {})

    model = MeasurementModel((replace(block, predict=predict),), CAMERA)
    gain = 0.5 * (model.seen_gaussian().chi2(model.seen_value) - model.seen_gaussian((law,)).chi2(model.seen_value))
    members = ((law.name, 1.0),)
    candidate = Candidate(law, {}, 1.0, (), gain, is_closed=False, members=members)
    before, after = model.held_out(())[0], model.held_out((law,))[0]
    assert after < before
    found = vetoed(model, candidate, (law,), (), policy)
    assert (found is not None) == is_vetoed
    assert vetoed(model, replace(candidate, members=()), (law,), (), policy) is None


def test_a_discrepancy_that_held_out_captures_lack_is_dropped() -> None:
    def bump(x: np.ndarray) -> np.ndarray:
        return np.asarray(0.05 * np.exp(-0.5 * np.square((x - 550.0) / 40.0)))

    policy = DecisionPolicy()
    everywhere = spectral_model(np.random.default_rng(5), bump)
    seen_alone = _with_held_out_of(everywhere, spectral_model(np.random.default_rng(6), np.zeros_like))
    for model, is_kept in ((everywhere, True), (seen_alone, False)):
        found = likeliest_discrepancy(model, model.seen_gaussian(), 0, policy)
        assert found.log_odds > 0
        assert predicts_held_out(model, (), 0, found.kernel) == is_kept
    verdict = decide(seen_alone, np.random.default_rng(0), policy)
    assert verdict.discrepancies
    assert not verdict.kernels
