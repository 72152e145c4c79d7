"""Coloured line noise: its variance, its power law, and lines in which the noise isn't."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.coloured_line_noise import ColouredLineNoise
from sim.stages import signal_of
from tests.sim.effects.test_sensor_effects import CAMERA

LINES, FRAMES = 256, 3000


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5])
def test_drawn_lines_have_the_stated_power(exponent: float) -> None:
    """At frequencies of many cycles a frame, over which the window leaks little: the mean of 3000 frames is good to
    1 / sqrt(3000) a frequency, 4.5 of which over a band of 20 is 2 %; leakage of a steep law adds up to 3 %.
    """
    (law,) = signal_of(CAMERA, (ColouredLineNoise(noise_e=4.0, exponent=exponent),)).lines
    rng = np.random.default_rng(17)
    drawn = np.array([law.draw((LINES, 8), rng)[:, 0] for _ in range(FRAMES)])
    window = np.hanning(LINES)
    power = np.mean(np.abs(np.fft.rfft(drawn * window, axis=1)) ** 2, axis=0) / np.sum(window**2)
    frequency = np.fft.rfftfreq(LINES)
    stated = law.spectrum_e2(frequency, fixed=False)
    for low, high in ((10, 30), (40, 60), (100, 120)):
        assert power[low:high].mean() == pytest.approx(stated[low:high].mean(), rel=0.05)
    slope = np.log(stated[100] / stated[50]) / np.log(frequency[100] / frequency[50])
    assert slope == pytest.approx(-exponent, abs=1e-3)


def test_the_variance_is_that_of_a_line() -> None:
    """The power's mean over all frequencies. Slow parts have few draws a frame: 5 % over 3000 frames."""
    (law,) = signal_of(CAMERA, (ColouredLineNoise(noise_e=4.0, exponent=1.0),)).lines
    rng = np.random.default_rng(18)
    drawn = np.array([law.draw((LINES, 8), rng) for _ in range(FRAMES)])
    assert drawn.var() == pytest.approx(law.variance_e2((LINES, 8)), rel=0.05)
    fine = np.geomspace(1e-6, 0.5, 40001)
    whole = 2.0 * np.trapezoid(law.spectrum_e2(fine, fixed=False), fine)
    assert whole == pytest.approx(16.0, rel=5e-3)


def test_columns_share_it_along_columns() -> None:
    (law,) = signal_of(CAMERA, (ColouredLineNoise(noise_e=4.0, lines="columns"),)).lines
    assert law.draw((6, 9), np.random.default_rng(1)).shape == (1, 9)
