"""The photon-transfer curve: exact without noise, its error, and the straight line."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.noise.photon_transfer import fit_transfer


def test_transfer_is_exact_without_noise() -> None:
    x = np.linspace(0, 3000, 20)
    v = 2.0 + 0.4 * x - 5e-6 * x**2
    fit = fit_transfer(x, v, 1e-3 * v, np.zeros(20, int), x > 0, 4000.0)
    # The prior on the curvature (5 sigma from c x_sat / K = 0.05) pulls by less than 1e-4 at a noise of 1e-3.
    assert fit.gain == pytest.approx(0.4, rel=1e-4)
    assert fit.curvature == pytest.approx(-5e-6, rel=0.01)
    assert fit.floor[0] == pytest.approx(2.0, rel=1e-3)


def with_model_error(relative: float, bend: float, seed: int) -> tuple[np.ndarray, ...]:
    """Points of a camera of K = 0.4 whose flats have a `relative` error beyond their sampling noise of 0.3 %; bend at
    4000 DN."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([np.zeros(5), np.linspace(100, 3500, 40)])
    v = (2.0 + 0.4 * x * (1.0 + bend * x / 4000.0)) * (1.0 + 0.003 * rng.standard_normal(x.size))
    v *= 1.0 + np.where(x > 0, relative, 0.0) * rng.standard_normal(x.size)
    return x, v, 0.003 * v, np.zeros(x.size, int), x > 0


def test_residuals_beyond_sampling_are_an_error_of_the_model() -> None:
    fit = fit_transfer(*with_model_error(0.02, 0.0, 6), 4000.0)
    # 37 levels: the error is known to 1 / sqrt(74) = 12 %; three of these.
    assert fit.model_error == pytest.approx(0.02, rel=0.35)
    assert fit.dark_error == 0.0
    assert abs(fit.gain - 0.4) < 3.0 * fit.gain_std
    calm = fit_transfer(*with_model_error(0.0, 0.0, 6), 4000.0)
    assert calm.model_error == 0.0
    assert not calm.by_line


def test_a_bend_is_believed_only_against_the_models_error() -> None:
    unsure = fit_transfer(*with_model_error(0.015, -0.05, 7), 4000.0)
    assert unsure.by_line
    assert unsure.gain == unsure.line_gain
    # Line and curve are both within what is stated.
    assert abs(unsure.curve_gain - 0.4) < 2.0 * unsure.curve_gain_std
    assert abs(unsure.gain - 0.4) < 2.5 * unsure.gain_std
    sure = fit_transfer(*with_model_error(0.004, -0.05, 7), 4000.0)
    assert not sure.by_line
    assert abs(sure.gain - 0.4) < 2.0 * sure.gain_std
    assert abs(sure.line_gain - 0.4) > 5.0 * sure.gain_std / 3.0


def test_a_straight_line_starts_below_the_darks_own_shot_noise() -> None:
    """Darks with dark current aren't the floor: 2 DN^2 here, where their mean variance is 4.4."""
    x, v, _, plane, light = with_model_error(0.015, -0.05, 7)
    x[:5] = (0.0, 3.0, 6.0, 9.0, 12.0)
    v[:5] = (2.0 + 0.4 * x[:5]) * v[:5] / 2.0  # each with the error that it had
    fit = fit_transfer(x, v, 0.003 * v, plane, light, 4000.0)
    assert fit.by_line
    # Sampling 0.3 % of 2..7 DN^2 over five darks, and the line's gain, off by as much as its uncertainty says, times 3
    # DN.
    assert abs(float(fit.floor[0]) - 2.0) < 3.0 * float(np.sqrt(fit.covariance[2, 2]))
    assert np.sqrt(fit.covariance[2, 2]) < 0.1
