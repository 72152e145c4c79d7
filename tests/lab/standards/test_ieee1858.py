"""Acutance: integrals in closed form, limits, and intervals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gamma

from lab.standards.ieee1858 import PRINT, SCREEN, acutance, contrast_sensitivity

FREQUENCY = np.linspace(0.0, 1.0, 101)


def test_contrast_sensitivity_integrates_to_its_closed_form() -> None:
    """The integral of f^0.8 exp(-0.2 f) is gamma(1.8) / 0.2^1.8."""
    f = np.linspace(0.0, 200.0, 200001)
    expected = 75.0 / 34.05 * gamma(1.8) / 0.2**1.8
    # trapezoids of 1 mcy/deg err by about step^1.8 where f^0.8 starts
    assert np.trapezoid(contrast_sensitivity(f), f) == pytest.approx(expected, rel=1e-5)
    assert f[np.argmax(contrast_sensitivity(f))] == pytest.approx(0.8 / 0.2, abs=2e-3)


def test_perfect_camera_with_small_pixels_has_an_acutance_of_1() -> None:
    """200 pixels a degree: the eye's sensitivity beyond 100 cycles a degree is 1e-7 of the whole."""
    value, std = acutance(FREQUENCY, np.ones(101), np.zeros((101, 101)), 200.0)
    assert value == pytest.approx(1.0, abs=1e-4)
    assert std == 0.0


def test_halved_response_halves_the_acutance() -> None:
    mtf = np.exp(-3.0 * FREQUENCY)
    whole, half = (acutance(FREQUENCY, share * mtf, np.zeros((101, 101)), 40.0)[0] for share in (1.0, 0.5))
    assert half == pytest.approx(0.5 * whole, rel=1e-12)


def test_intervals_hold() -> None:
    """The acutance is linear in the response: its intervals are exact for normal errors."""
    rng = np.random.default_rng(4)
    mtf = np.exp(-3.0 * FREQUENCY)
    factor = 0.01 * np.exp(-((FREQUENCY[:, None] - FREQUENCY[None, :]) ** 2) / 0.02)
    covariance = factor @ factor.T
    truth = acutance(FREQUENCY, mtf, covariance, 40.0)[0]
    held = 0
    for _ in range(100):
        value, std = acutance(FREQUENCY, mtf + factor @ rng.standard_normal(101), covariance, 40.0)
        held += abs(value - truth) < 1.96 * std
    assert 90 <= held <= 99


def test_viewing_conditions() -> None:
    """At 600 mm a degree spans 10.47 mm, 41.9 pixels of 0.25 mm; a print of 100 mm holds all rows."""
    assert SCREEN.pixels_per_degree(1000) == pytest.approx(600.0 * np.pi / 180.0 / 0.25, rel=1e-4)
    assert PRINT.pixels_per_degree(2000) == pytest.approx(2.0 * PRINT.pixels_per_degree(1000), rel=1e-12)
