"""Coloured read noise: the correlations of drawn frames, an unchanged variance, and shot noise that stays white."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.coloured_read_noise import ColouredReadNoise
from sim.frame import Darkness, Exposure, read_out
from sim.sensor.electrons import sample_from
from sim.stages import signal_of
from tests.sim.effects.test_sensor_effects import CAMERA

FREQUENCY = np.fft.fftfreq(1024)


def autocorrelation(effect: ColouredReadNoise) -> np.ndarray:
    """Correlations by distance in pixels, from the stated power."""
    power = signal_of(CAMERA, (effect,)).read_power(FREQUENCY)
    return np.real(np.fft.ifft(power))


@pytest.mark.parametrize(("correlation", "decay"), [(-0.03, 0.0), (0.2, 0.2), (-0.2, -0.3), (0.1, 0.7)])
def test_neighbours_have_the_stated_correlation(correlation: float, decay: float) -> None:
    found = autocorrelation(ColouredReadNoise(correlation=correlation, decay=decay))
    assert found[0] == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(found[1:4], correlation * decay ** np.arange(3), atol=1e-9)


def test_a_spectrum_is_never_below_zero() -> None:
    """r = 0.9 without decay can't be: the power is cut off, and its mean stays 1."""
    power = signal_of(CAMERA, (ColouredReadNoise(correlation=0.9),)).read_power(FREQUENCY)
    assert power.min() > 0.0
    assert power.mean() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(("level_e", "share"), [(0.0, 1.0), (400.0, 100.0 / 500.0)])
def test_drawn_frames_have_it_in_the_read_noise_alone(level_e: float, share: float) -> None:
    """Read noise of 10 e; in 400 e of light it is a fifth of the variance. Standard deviation of a correlation:
    1 / sqrt(pixels)."""
    camera = CAMERA.model_copy(
        update={
            "rows": 400,
            "cols": 512,
            "black_level_dn": 200.0,
            "read_noise_e": 10.0,
            "row_noise_e": 0.0,
            "conversion_gain_dn_per_e": 1.0,
        }
    )
    effect = ColouredReadNoise(correlation=-0.2, decay=-0.3)
    law = read_out(camera, Exposure(Darkness(), 0.01), (effect,))
    shape = camera.rows, camera.cols
    frame = sample_from(np.full(shape, level_e), camera, np.random.default_rng(3), read_out=law).astype(float)
    away = frame - frame.mean()
    tolerance = 4.0 / np.sqrt(away.size)
    assert away.var() == pytest.approx(100.0 + level_e + 1.0 / 12.0, rel=4.0 * np.sqrt(2.0 / away.size) * 1.1)
    for distance, stated in ((1, -0.2), (2, 0.06), (3, -0.018)):
        product = np.mean(away[:, distance:] * away[:, :-distance]) / away.var()
        assert product == pytest.approx(share * stated, abs=tolerance)
    assert np.mean(away[1:] * away[:-1]) / away.var() == pytest.approx(0.0, abs=tolerance)
