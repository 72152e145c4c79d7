"""Excess noise: the variance by McIntyre's law, and the distribution of multiplied electrons."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from sim.effects.excess_noise import ExcessNoise
from sim.frame import Exposure, expected_electrons, moments, sample
from sim.scene.scenes import UniformField
from sim.sensor.electrons import Multiplication
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

FLAT = Exposure(UniformField(LIGHT), 0.002)


def test_the_mean_stays_and_the_shot_noise_grows() -> None:
    """K^2 e of the variance becomes K^2 e F^2; read noise and rounding stay."""
    plain, noisy = (moments(CAMERA, FLAT, acting) for acting in ((), (ExcessNoise(excess_percent=80.0),)))
    np.testing.assert_allclose(noisy[0], plain[0], rtol=1e-9)
    e = expected_electrons(CAMERA, FLAT)
    gain = CAMERA.conversion_gain_dn_per_e
    np.testing.assert_allclose(noisy[1] - plain[1], 0.8 * gain**2 * e, rtol=1e-6)


def test_frames_have_that_noise_and_its_skewness() -> None:
    """Third central moment of a compound Poisson variable: e E g^3, of a gamma variable g of mean 1 and variance v
    e (1 + v) (1 + 2 v). N = 768 x 40 numbers: their skewness has a standard deviation of sqrt(6 / N) where it is
    small; that of the variance is sqrt(2 / N). Four of each."""
    camera = CAMERA.model_copy(update={"read_noise_e": 0.1, "prnu_percent": 0.0})
    rng, one = np.random.default_rng(5), (ExcessNoise(excess_percent=100.0),)
    frames = np.array([sample(camera, FLAT, rng, one) for _ in range(40)], float)
    away = (frames - moments(camera, FLAT, one)[0]) / camera.conversion_gain_dn_per_e
    e = expected_electrons(camera, FLAT)
    size = away.size
    assert np.mean(away**2) / (2.0 * e.mean()) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / size) + 0.01)
    skewness = np.mean(away**3) / np.mean(away**2) ** 1.5
    # over pixels of unequal mean the moments are means
    assert skewness == pytest.approx(6.0 * e.mean() / (2.0 * e.mean()) ** 1.5, abs=4.0 * np.sqrt(6.0 / size) + 0.01)


def test_a_single_electron_is_multiplied_exponentially_at_two() -> None:
    """Mean 1, variance 1, and exp(-1) of them above 1; N = 200,000."""
    drawn = Multiplication(2.0).draw(np.ones(200_000, np.float32), np.random.default_rng(6))
    assert drawn.mean() == pytest.approx(1.0, abs=4.0 / np.sqrt(2e5))
    assert np.mean(drawn > 1.0) == pytest.approx(np.exp(-1.0), abs=4.0 * 0.48 / np.sqrt(2e5))


def test_a_registers_gain_setting_is_that_of_the_law() -> None:
    """F^2 = 2 - 1/M: 1.5 at M = 2, 1.75 at M = 4, which is 6.02 dB more; an amplifier after it changes nothing."""
    register = ExcessNoise(excess_percent=50.0, gain_setting="of the multiplication")
    assert register.factor(0.0) == pytest.approx(1.5)
    assert register.factor(20.0 * np.log10(2.0)) == pytest.approx(1.75)
    assert register.factor(-20.0 * np.log10(2.0)) == pytest.approx(1.0)
    assert ExcessNoise(excess_percent=50.0).factor(12.0) == pytest.approx(1.5)


@pytest.mark.parametrize("distribution", ["geometric", "gamma"])
def test_either_distribution_has_its_moments(distribution: Literal["geometric", "gamma"]) -> None:
    """Of N = 200,000 single electrons at F^2 = 1.5: mean 1, variance 0.5, E g^3 = 1.5^2 x skewness, 3 of a gamma and
    3.25 of a geometric number (M = 2: E n (n + 1)(n + 2) = 6 M^3, by which E n^3 = 26, over 2^3). The standard
    deviation of the mean cube is sqrt(E g^6 / N), E g^6 below 150 of both."""
    law = Multiplication(1.5, distribution)
    drawn = law.draw(np.ones(200_000, np.float32), np.random.default_rng(7)).astype(float)
    assert drawn.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(0.5 / 2e5))
    third = {"geometric": 3.25, "gamma": 3.0}[distribution]
    assert 1.5**2 * law.skewness == pytest.approx(third, rel=1e-12)
    assert np.mean(drawn**3) == pytest.approx(third, abs=4.0 * np.sqrt(150.0 / 2e5))


def test_without_multiplication_nothing_is_skewed() -> None:
    assert Multiplication().skewness == 1.0
    assert Multiplication(1.0, "gamma").skewness == 1.0
