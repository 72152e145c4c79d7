"""Alternating row noise: drawn frames have the stated variance, spectra in both directions, and covariances."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.alternating_row_noise import AlternatingRowNoise
from sim.sensor.alternating_rows import AlternatingRows
from sim.stages import Signal, signal_of
from tests.sim.effects.test_sensor_effects import CAMERA

SHAPE, FRAMES = (48, 64), 800
NOISE = AlternatingRows(3.0, SHAPE[1])
#: Independent numbers behind a mean over all frames: rows, of two amplifiers each.
DRAWN = FRAMES * SHAPE[0] * 2


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    rng = np.random.default_rng(11)
    return np.array([NOISE.draw(SHAPE, rng) for _ in range(FRAMES)])


def test_the_variance_is_that_of_a_pixel(frames: np.ndarray) -> None:
    """4 sqrt(2 / n) of n independent numbers; the power's mean over all frequencies is the variance."""
    assert frames.var() == pytest.approx(NOISE.variance_e2(SHAPE), rel=4.0 * np.sqrt(2.0 / DRAWN))
    frequency = np.fft.fftfreq(SHAPE[1])
    assert NOISE.spectrum_e2(frequency).mean() == pytest.approx(NOISE.variance_e2(SHAPE))
    lag = np.arange(-SHAPE[1] + 1, SHAPE[1])
    turn = np.cos(2.0 * np.pi * np.outer(frequency, lag))
    np.testing.assert_allclose(NOISE.spectrum_e2(frequency), turn @ NOISE.covariance_e2(lag), atol=1e-9)


def test_rows_and_columns_have_the_stated_power(frames: np.ndarray) -> None:
    """Each wave is of 800 frames: 4 / sqrt(800); of means over the rows' waves, 4 / sqrt(800 rows)."""
    rows, cols = SHAPE
    power = np.mean(np.abs(np.fft.fft2(frames)) ** 2, axis=0) / (rows * cols)
    across = np.arange(cols) / cols
    stated = NOISE.plane_e2(SHAPE, across, np.zeros(cols))
    np.testing.assert_allclose(power.mean(0), stated, atol=4.0 / np.sqrt(FRAMES * rows) * stated.max())
    np.testing.assert_allclose(power.mean(0), NOISE.along_rows_e2(SHAPE, across), atol=0.03 * stated.max())
    down = np.arange(rows) / rows
    np.testing.assert_allclose(power[:, 0], NOISE.plane_e2(SHAPE, np.zeros(rows), down), rtol=4.0 / np.sqrt(FRAMES))
    every = power[:, 1 : cols // 2 + 1].mean(1)
    np.testing.assert_allclose(every, NOISE.along_columns_e2(SHAPE, down), rtol=4.0 / np.sqrt(FRAMES))


@pytest.mark.parametrize("period", [1, 2])
def test_neighbours_have_the_stated_covariance(frames: np.ndarray, period: int) -> None:
    """After the means of rows and columns of each plane were taken out; 4 standard deviations over all rows."""
    left = frames.copy()
    for row in range(period):
        for col in range(period):
            plane = left[:, row::period, col::period]
            plane -= plane.mean(2, keepdims=True)
            plane -= plane.mean(1, keepdims=True)
    near = 4.0 * NOISE.variance_e2(SHAPE) / np.sqrt(DRAWN)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):
        here, there = left[:, : SHAPE[0] - down, : SHAPE[1] - right], left[:, down:, right:]
        found = np.mean((here * there)[:, :, ::period])
        assert found == pytest.approx(NOISE.departures_e2(SHAPE, period, 0, down, right), abs=near)
    apart = np.mean(left[:, :, : SHAPE[1] - 8] * left[:, :, 8:])
    assert apart == pytest.approx(NOISE.departures_apart_e2(SHAPE, period, 8, False), abs=near)
    turned = np.mean(
        left[:, :, SHAPE[1] // 2 - 8 : SHAPE[1] // 2] * left[:, :, SHAPE[1] // 2 : SHAPE[1] // 2 + 8][:, :, ::-1]
    )
    assert turned == pytest.approx(NOISE.departures_apart_e2(SHAPE, period, 8, True), abs=near)


def test_none_is_no_law_and_all_frames_have_others() -> None:
    assert AlternatingRowNoise().on_signal(Signal(CAMERA)) == Signal(CAMERA)
    (law,) = signal_of(CAMERA, (AlternatingRowNoise(noise_e=2.0),)).reading_order
    rng = np.random.default_rng(1)
    first, second = law.draw(SHAPE, rng), law.draw(SHAPE, rng)
    assert np.abs(first - second).max() > 0.0
    assert law.mean_e(SHAPE) == 0.0
