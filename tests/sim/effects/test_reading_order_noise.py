"""Noise in reading order: drawn frames have the stated variance, spectra in both directions, and covariances."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sim.effects.reading_order_noise import ReadingOrderNoise
from sim.sensor.reading_order import OrderedNoise
from sim.stages import Signal, signal_of
from tests.sim.effects.test_sensor_effects import CAMERA

SHAPE, FRAMES = (48, 64), 800
#: Of one amplifier; of two that take turns; of both, less steep.
NOISES = (OrderedNoise(3.0), OrderedNoise(0.0, 3.0), OrderedNoise(3.0, 2.0, 0.6))


@cache
def drawn(noise: OrderedNoise) -> np.ndarray:
    rng = np.random.default_rng(11)
    return np.array([noise.draw(SHAPE, rng) for _ in range(FRAMES)])


@cache
def periodogram(noise: OrderedNoise) -> np.ndarray:
    frames = drawn(noise) - drawn(noise).mean((1, 2), keepdims=True)
    return np.asarray(np.mean(np.abs(np.fft.fft2(frames)) ** 2, axis=0) / (SHAPE[0] * SHAPE[1]))


@pytest.mark.parametrize("noise", NOISES)
def test_the_variance_is_that_of_a_pixel(noise: OrderedNoise) -> None:
    """Half of the power is slower than a frame: a few modes of each of 800 frames, 4 sqrt(2 / 1600) / 2 = 7 %."""
    assert drawn(noise).var() == pytest.approx(noise.variance_e2(SHAPE), rel=0.07)
    fine = np.geomspace(1e-9, 0.25, 40001)
    both = noise.spectrum_e2(fine) + noise.spectrum_e2(0.5 - fine)  # poles at 0 and at 0.5
    assert 2.0 * np.trapezoid(both, fine) == pytest.approx(noise.variance_e2(SHAPE), rel=5e-3)


@pytest.mark.parametrize("noise", NOISES)
def test_rows_and_columns_have_the_stated_power(noise: OrderedNoise) -> None:
    """Means over 800 frames and several waves: 4 / sqrt(800 n), and 3 % that the ends of a frame leave."""
    rows, cols = SHAPE
    down, across = np.arange(rows) / rows, np.arange(cols) / cols
    power = periodogram(noise)
    of_rows = power[:, 0] / noise.plane_e2(SHAPE, np.zeros(rows), down)
    of_columns = power[0] / noise.plane_e2(SHAPE, across, np.zeros(cols))
    for ratio, count in ((of_rows, rows), (of_columns, cols)):
        low, high = ratio[1:5].mean(), ratio[5 : count // 2].mean()
        assert low == pytest.approx(1.0, abs=4.0 / np.sqrt(4 * FRAMES) + 0.03)
        assert high == pytest.approx(1.0, abs=4.0 / np.sqrt((count // 2 - 5) * FRAMES) + 0.03)
    along = power[2:-1, 1:9].mean(0) / noise.along_rows_e2(SHAPE, across[1:9])
    np.testing.assert_allclose(along, 1.0, atol=4.0 / np.sqrt(rows * FRAMES) + 0.03)
    every = power[1:9, 1 : cols // 2 + 1].mean(1) / noise.along_columns_e2(SHAPE, down[1:9])
    # of two amplifiers, one wave of a frame has most of the power
    np.testing.assert_allclose(every, 1.0, atol=4.0 / np.sqrt(FRAMES) + 0.03)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("period", [1, 2])
def test_neighbours_have_the_stated_covariance(noise: OrderedNoise, period: int) -> None:
    """After the means of rows and columns of each plane were taken out: 1 % of the variance by chance over 2.4 million
    pixels, of which slow waves are few, and 2 % that ends leave."""
    left = drawn(noise).copy()
    for row in range(period):
        for col in range(period):
            plane = left[:, row::period, col::period]
            plane -= plane.mean(2, keepdims=True)
            plane -= plane.mean(1, keepdims=True)
    own = noise.departures_e2(SHAPE, period, 0, 0, 0)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):
        here, there = left[:, : SHAPE[0] - down, : SHAPE[1] - right], left[:, down:, right:]
        found = np.mean((here * there)[:, :, ::period])
        assert found == pytest.approx(noise.departures_e2(SHAPE, period, 0, down, right), abs=0.03 * own)


def test_two_amplifiers_that_take_turns_share_nothing() -> None:
    """Pixels of even and of odd columns: 4 / sqrt(800) of the frames' means."""
    frames = drawn(NOISES[1])
    even, odd = frames[:, :, ::2].mean((1, 2)), frames[:, :, 1::2].mean((1, 2))
    assert abs(np.corrcoef(even, odd)[0, 1]) < 4.0 / np.sqrt(FRAMES)
    assert even.std() > 0.3 * 3.0  # a frame's own offset


def test_none_is_no_law_and_all_frames_have_others() -> None:
    assert ReadingOrderNoise().on_signal(Signal(CAMERA)) == Signal(CAMERA)
    (law,) = signal_of(CAMERA, (ReadingOrderNoise(noise_e=2.0),)).reading_order
    rng = np.random.default_rng(1)
    first, second = law.draw(SHAPE, rng), law.draw(SHAPE, rng)
    assert np.abs(first - second).max() > 0.0
    assert law.mean_e(SHAPE) == 0.0
