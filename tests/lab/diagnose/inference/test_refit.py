"""A refit's intervals cover the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import (
    _standard_deviations,
    _wide_residual,
    _wide_slope,
    is_of_usual_size,
    profile_interval,
    refit,
    size_covariance,
)
from lab.diagnose.policy import DecisionPolicy
from lab.inference.coordinates import coordinates
from lab.observables.observable import Label, Observable, Prediction
from sim.effects.base import Effect
from sim.effects.library import effect
from sim.effects.light_flicker import LightFlicker
from sim.effects.source_drift import SourceDrift
from sim.optics.filters import birefringent_displacement_um
from sim.stages import light_of
from tests.lab.diagnose.inference.made_up import CAMERA, FREQUENCY, contrast_model
from tests.lab.diagnose.on_blocks import declared


def test_refit_covers_the_truth() -> None:
    """40 draws: pulls have mean 0 within 3 / sqrt(40) and a standard deviation in 0.6..1.35.

    The plate's dispersion is drawn from its prior: a standard normal multiple of quartz's, from 589 nm to the model's
    550 nm. The form tolerance (0.2 %) is in the intervals and not in the draws, so that they may be too wide and not
    too narrow."""
    kind = effect("optical_low_pass_filter")
    quartz = float(birefringent_displacement_um(1.0, 550.0) / birefringent_displacement_um(1.0)) - 1.0
    pulls = []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        dispersed = 1.0 + quartz * rng.standard_normal()
        truth = kind(displacement_x_um=1.5 * dispersed, displacement_y_um=1.2 * dispersed)
        start = kind(displacement_x_um=1.0, displacement_y_um=1.0)
        fit = refit(contrast_model(rng, (truth,)), (start,), DecisionPolicy())
        std = fit.std[0]["displacement_x_um"]
        assert std is not None
        pulls.append((fit.effects[0].displacement_x_um - 1.5) / std)
    assert abs(np.mean(pulls)) < 3.0 / np.sqrt(40)
    assert 0.6 < np.std(pulls) < 1.35


@pytest.mark.parametrize(("departure", "is_exact"), [(0.0, True), (0.02, False)])
def test_a_law_that_holds_better_than_declared_is_no_less_likely(departure: float, is_exact: bool) -> None:
    """Of a sinusoidal movement (5 % declared), a part of the tolerance is likelier; where the numbers leave the law's
    form, the whole is kept. The amplitude's standard deviation holds the whole either way: the change goes as its
    square, and half of 2.5 % is left by averaging over frequencies at most.
    """
    kind = effect("vibration_blur")
    shape = departure * np.sin(20.0 * FREQUENCY)
    model = contrast_model(np.random.default_rng(3), (kind(amplitude_x_um=1.3),), extra=shape)
    fit = refit(model, (kind(amplitude_x_um=1.3),), DecisionPolicy())
    declared_tolerance = model.seen_gaussian(fit.effects).log_likelihood(model.seen_value)
    assert (fit.log_likelihood > declared_tolerance + 2.0) == is_exact
    assert is_exact or fit.log_likelihood == declared_tolerance
    std = fit.std[0]["amplitude_x_um"]
    assert std is not None
    assert std > 0.5 * 0.025 * 1.3


def test_a_logarithmic_parameter_is_fitted_as_its_logarithm() -> None:
    """u = ln p, within ln of the bounds; the standard deviation of p is p times that of u."""
    by_name = {c.name: c for c in coordinates((LightFlicker(),), CAMERA)}
    frequency = by_name["frequency_hz"]
    assert frequency.to_u(100.0) == pytest.approx(np.log(100.0))
    assert frequency.to_value(frequency.to_u(120.0)) == pytest.approx(120.0)
    assert frequency.bounds == pytest.approx((np.log(0.1), np.log(1e6)))
    assert frequency.to_value(99.0) == 1e6
    jacobian, prior_std = np.array([[10.0]]), np.array([np.inf])
    std = _standard_deviations(jacobian, [frequency], np.array([np.log(100.0)]), prior_std, 1)
    flat = 12.0 / np.log(1e7) ** 2  # 1 / variance of ln p anywhere between the bounds
    assert std == [{"frequency_hz": pytest.approx(100.0 / np.sqrt(100.0 + flat))}]


def _timed_model(rng: np.random.Generator, drift: float, noise: float) -> MeasurementModel:
    """30 levels within a minute in a drifting light; white noise."""
    minutes = np.linspace(0.0, 1.0, 30)
    labels = tuple(Label(float(t), "Y", "", (f"flat-{i}",), False) for i, t in enumerate(minutes))

    def levels(effects: Sequence[Effect]) -> np.ndarray:
        light = light_of(CAMERA, effects)
        return np.array([light.source(60.0 * t) for t in minutes])

    value = levels((SourceDrift(drift_percent_per_min=drift),)) + noise * rng.standard_normal(len(minutes))
    block = Observable(
        measurement=declared("photon_transfer", "level", "DN"), reach=1.0, value=value,
        covariance=noise**2 * np.eye(len(minutes)),
        labels=labels, reads=frozenset({"light.level"}), predict=lambda acting: Prediction(levels(acting), {}),
        scale=np.ones(len(minutes)),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


def test_a_size_far_from_the_usual_is_recovered() -> None:
    """A drift of 5 %/min, usual 0.3, that the numbers tell to s = 0.5: 20 draws, pulls of mean 0 within 3 / sqrt(20) +
    s / 5, which the slope of -ln(size) leaves. A normal prior of 0.9 would pull by 5 s / (s^2 + 0.81) = 2.4."""
    drift, noise = 5.0, 0.5e-2 * np.sqrt(np.sum(np.linspace(0.0, 1.0, 30) ** 2))
    start, pulls = (SourceDrift(drift_percent_per_min=0.1),), []
    for seed in range(20):
        model = _timed_model(np.random.default_rng(300 + seed), drift, noise)
        fit = refit(model, start, DecisionPolicy(), of_any_size=True)
        assert not is_of_usual_size(fit.effects, CAMERA)
        assert "settling_min" not in fit.std[0]  # a minute doesn't tell how the drift ends
        std = fit.std[0]["drift_percent_per_min"]
        assert std is not None
        pulls.append((fit.effects[0].drift_percent_per_min - drift) / std)  # type: ignore[attr-defined]
    assert abs(np.mean(pulls)) < 3.0 / np.sqrt(20) + 0.1


def test_the_prior_is_normal_near_its_centre_and_logarithmic_beyond() -> None:
    t = np.array([-3.0, -1.0, 0.0, 0.4, 1.0, 7.0])
    wanted = np.where(np.abs(t) <= 1.0, 0.5 * t**2, 0.5 + np.log(np.maximum(np.abs(t), 1.0)))
    np.testing.assert_allclose(0.5 * np.square(_wide_residual(t)), wanted)
    step = 1e-6
    slope = (_wide_residual(t + step) - _wide_residual(t - step)) / (2.0 * step)
    np.testing.assert_allclose(
        _wide_slope(t), slope, atol=2.0 * step
    )  # where the pieces meet, the second derivative jumps by 2


def test_what_the_numbers_do_not_tell_has_no_standard_deviation() -> None:
    """Nothing measured and no prior: none, in place of 0. Between two bounds: their distance over sqrt(12)."""
    drift, settling = coordinates((SourceDrift(drift_percent_per_min=1.0),), CAMERA)
    flat = replace(drift, quantity=replace(drift.quantity, lower=None))
    std = _standard_deviations(np.zeros((1, 2)), [flat, settling], np.array([1.0, 8.0]), np.array([np.inf, np.inf]), 1)
    low, high = settling.bounds
    assert std == [{"drift_percent_per_min": None, "settling_min": pytest.approx((high - low) / np.sqrt(12.0))}]


def test_an_aperture_stays_within_the_pitch() -> None:
    """Contrast that falls further than a wider aperture than the pitch explains, at a fill factor of 0.9: the fit ends
    at the pitch."""
    wider = effect("pixel_aperture")(side_change_um=1.0)
    fit = refit(
        contrast_model(np.random.default_rng(7), (wider,)), (type(wider)(side_change_um=0.05),), DecisionPolicy()
    )
    pitch_um = CAMERA.pixel_pitch_um
    assert fit.effects[0].side_change_um == pytest.approx(pitch_um * (1.0 - np.sqrt(0.9)), rel=1e-3)  # type: ignore[attr-defined]


def test_a_profile_interval_is_that_of_a_normal_likelihood() -> None:
    """A drift in white noise is linear in its size: four standard deviations, within 10 % as the law's tolerance grows
    with the size. By noise alone the deviation is s / sqrt(sum(t^2))."""
    minutes, noise = np.linspace(0.0, 1.0, 30), 0.004
    model = _timed_model(np.random.default_rng(5), 2.0, noise)
    fit = refit(model, (SourceDrift(drift_percent_per_min=2.0),), DecisionPolicy(), tolerance=0.0)
    low, high = profile_interval(model, fit.effects, 0, "drift_percent_per_min", DecisionPolicy())
    std = fit.std[0]["drift_percent_per_min"]
    assert std is not None
    assert std > 100.0 * noise / np.sqrt(np.sum(minutes**2))
    assert high - low == pytest.approx(4.0 * std, rel=0.1)


def test_profile_intervals_cover_a_weak_blur() -> None:
    """40 draws of a diffusion whose square is some two standard deviations from absence: at least 34 of the 95 %
    intervals hold it, which fewer do with a probability of 0.3 %, and some but not all reach absence."""
    kind = effect("charge_diffusion")
    intervals = []
    for seed in range(40):
        model = contrast_model(np.random.default_rng(500 + seed), (kind(length_um=0.1),))
        fit = refit(model, (kind(length_um=0.1),), DecisionPolicy())
        intervals.append(profile_interval(model, fit.effects, 0, "length_um", DecisionPolicy()))
    assert sum(low <= 0.1 <= high for low, high in intervals) >= 34
    assert 0 < sum(low == 0.0 for low, _ in intervals) < 40


def test_the_covariance_of_sizes_is_that_of_their_standard_deviations() -> None:
    """Of a member with one size, the square root of its element; of two directions of a filter, the diagonal."""
    kind = effect("optical_low_pass_filter")
    model = contrast_model(np.random.default_rng(5), (kind(displacement_x_um=2.0),))
    fit = refit(model, (kind(displacement_x_um=2.0),), DecisionPolicy())
    coords, away, covariance = size_covariance(model, fit.effects, 0)
    assert [c.name for c in coords] == [name for name in fit.std[0] if name not in kind.shapes]
    for c, u, variance in zip(coords, away, np.diag(covariance), strict=True):
        value = float(getattr(fit.effects[0], c.name))
        assert u == pytest.approx(c.to_u(value))
        std, su = fit.std[0][c.name], np.sqrt(variance)
        assert std == pytest.approx(min(su / max(2.0 * abs(value), 1e-12), np.sqrt(su)), rel=1e-3)
