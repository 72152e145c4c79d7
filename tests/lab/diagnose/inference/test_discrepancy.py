"""Model discrepancies: taken where they are smooth, and kept where they predict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lab.diagnose.inference.discrepancy import likeliest_discrepancy, predictive_discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from tests.lab.diagnose.inference.made_up import CAMERA, FREQUENCY, contrast_model, spectral_model


def test_a_smooth_departure_is_taken_and_noise_is_left() -> None:
    quiet = contrast_model(np.random.default_rng(11))
    assert likeliest_discrepancy(quiet, quiet.seen_gaussian(), 0, DecisionPolicy()).log_odds == 0.0
    wave = contrast_model(np.random.default_rng(12), (), 0.03 * np.sin(6.0 * FREQUENCY))
    found = likeliest_discrepancy(wave, wave.seen_gaussian(), 0, DecisionPolicy())
    assert found.log_odds > 50.0
    assert 0.005 < found.amplitude < 0.1


def test_the_unknown_is_predicted_where_nothing_was_seen() -> None:
    """A smooth departure at wavelengths left out: chi2 falls to their number, as the noise of what was seen averages
    out."""
    model = spectral_model(np.random.default_rng(31), lambda x: 0.1 * np.sin(x / 60.0))
    gap = predictive_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    before, n = model.held_out()
    after, _ = model.held_out(discrepancies={0: gap.kernel})
    assert before > 100 * n
    # the discrepancy's own error adds to the noise at most as much again; the standard deviation of chi2 of n numbers
    # is sqrt(2 n)
    assert after < 2 * (n + 3 * np.sqrt(2 * n))


def test_what_is_irregular_is_not_predicted_elsewhere() -> None:
    """Departures that neighbours don't share: the likeliest discrepancy holds them as they are, and none is better
    left-out captures."""
    rng = np.random.default_rng(32)
    model = spectral_model(rng, lambda x: 0.1 * rng.standard_normal(len(x)))
    assert likeliest_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy()).log_odds > 20.0
    assert predictive_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy()).log_odds == 0.0


def test_repeats_of_what_is_irregular_are_predicted() -> None:
    """Each direction has its own departure, whose repeat is held out: another direction's says nothing of it, its own
    does."""
    rng = np.random.default_rng(33)
    ragged = [0.05 * rng.standard_normal(len(FREQUENCY)) for _ in range(2)]
    model = contrast_model(rng)
    model = MeasurementModel(
        (replace(model.blocks[0], value=model.value + np.concatenate([ragged[0]] * 2 + [ragged[1]] * 2)),), CAMERA
    )
    gap = predictive_discrepancy(model, model.seen_gaussian(), 0, DecisionPolicy())
    before, n = model.held_out()
    after, _ = model.held_out(discrepancies={0: gap.kernel})
    assert before > 20 * n
    # a number is predicted by one other of the same noise: twice the variance
    assert after < 2 * (n + 3 * np.sqrt(2 * n))
