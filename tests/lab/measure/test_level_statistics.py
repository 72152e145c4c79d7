"""Statistics of the repeats of a level against their definitions; shading and defective pixels."""

from __future__ import annotations

import numpy as np
import pytest

from lab.measure.levels import defective_pixels, level_statistics, shading


def test_statistics_agree_with_their_definitions() -> None:
    rng = np.random.default_rng(1)
    frames = rng.integers(500, 600, (5, 40, 60)).astype(np.uint16)
    found = level_statistics(frames, "RGGB", 4095)
    blue = frames[:, 1::2, 1::2].astype(float)
    assert found["B"].mean == pytest.approx(blue.mean(), rel=1e-12)
    rest = blue - blue.mean(axis=(1, 2), keepdims=True)
    # The frames' means are taken out: (L - 1)(N - 1) degrees of freedom.
    expected = np.sum((rest - rest.mean(axis=0)) ** 2) / (4 * (blue[0].size - 1))
    assert found["B"].temporal_variance == pytest.approx(expected, rel=1e-5)
    assert found["B"].spatial_variance == pytest.approx(np.var(rest.mean(axis=0), ddof=1) - expected / 5, abs=0.02)


def test_a_drifting_lamp_is_no_temporal_noise() -> None:
    rng = np.random.default_rng(2)
    pattern = 20.0 * rng.standard_normal((80, 100))
    frames = [np.rint(1000.0 + offset + pattern).astype(np.uint16) for offset in (0, 30, -20, 75)]
    found = level_statistics(frames, "MONO", 4095)["Y"]
    assert found.temporal_variance == pytest.approx(0.0, abs=1e-6)
    assert found.spatial_variance == pytest.approx(400.0, rel=0.1)


def test_row_noise_widens_the_uncertainty_of_a_variance() -> None:
    rng = np.random.default_rng(3)
    frames = [
        np.rint(500 + 3 * rng.standard_normal((200, 300)) + 3 * rng.standard_normal((200, 1))).astype(np.uint16)
        for _ in range(2)
    ]
    found = level_statistics(frames, "MONO", 4095)["Y"]
    # Half of the variance 18 is common to a row: 9 sqrt(2 / 200) = 0.9, three times what independent pixels would say.
    assert 0.5 < found.temporal_variance_std < 1.5


def test_shading_takes_cos4_out_and_nothing_of_a_pattern() -> None:
    row, col = np.meshgrid(np.linspace(-0.25, 0.25, 240), np.linspace(-0.35, 0.35, 320), indexing="ij")
    fall_off = 1.0 / (1.0 + row**2 + col**2) ** 2
    # cos^4 to a corner of 23 deg, to a thousandth of the 0.8 % that PRNU usually is.
    assert np.max(np.abs(shading(fall_off) - fall_off)) < 1e-4
    noise = np.random.default_rng(4).standard_normal((240, 320))
    assert np.var(noise - shading(noise)) == pytest.approx(1.0, rel=0.02)


def test_hot_pixels_are_found_and_a_glow_is_not() -> None:
    rng = np.random.default_rng(5)
    image = 100 + rng.standard_normal((100, 120)) + np.linspace(0, 6, 120) ** 2
    image[[3, 50, 70], [8, 60, 119]] += 60
    assert set(zip(*np.nonzero(defective_pixels(image, "RGGB")), strict=True)) == {(3, 8), (50, 60), (70, 119)}
