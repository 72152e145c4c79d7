"""Robust statistics of images, against sorting and against direct sums."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.flats.line_gains import _bands, _repeats, _share_and_modes, _window
from lab.observables.noise.robust import SAMPLE, lower_median, robust_std, sampled
from lab.observables.noise.temporal import level_out
from sim.sensor.lines import Lines


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 6])
def test_the_lower_median_is_that_of_sorted_values(frames: int) -> None:
    """Bit for bit, ties of whole codes included."""
    images = np.random.default_rng(frames).integers(0, 4, (frames, 40, 50)).astype(np.float32)
    np.testing.assert_array_equal(lower_median(images), np.sort(images, axis=0)[(frames - 1) // 2])


def test_a_sample_holds_all_columns_and_phases() -> None:
    """Of 2 million pixels in rows of 1000: each column and each place of the mosaic alike, to five standard deviations
    of a count."""
    image = np.broadcast_to(np.arange(1000, dtype=np.float32), (2000, 1000))
    columns = np.bincount(sampled(image).astype(int), minlength=1000)
    assert SAMPLE // 2 < columns.sum() < 2 * SAMPLE
    assert np.ptp(columns) <= 5.0 * np.sqrt(columns.mean())


def test_the_standard_deviation_of_a_large_image_is_known_from_a_sample() -> None:
    """Of normal numbers cut at five standard deviations: within 4 / sqrt(2 SAMPLE); hot pixels don't count."""
    image = np.random.default_rng(5).normal(0.0, 3.0, (1500, 1400)).astype(np.float32)
    image[::50, ::50] = 1000.0
    assert robust_std(image) == pytest.approx(3.0, rel=4.0 / np.sqrt(2.0 * SAMPLE))


def test_two_frames_have_one_departure() -> None:
    """That of the first, of each plane without its row and column means; the second's is its negative."""
    frames = [np.random.default_rng(k).normal(500.0, 9.0, (12, 16)).astype(np.float32) for k in (1, 2)]
    expected = 0.5 * (frames[0] - frames[1])
    for r in (0, 1):
        for c in (0, 1):
            plane = expected[r::2, c::2]
            plane -= plane.mean(axis=1, keepdims=True)
            plane -= plane.mean(axis=0, keepdims=True)
    (found,), alike = level_out(frames, "RGGB", None)
    assert alike == 2
    np.testing.assert_allclose(found, expected, atol=1e-4)  # single precision at 500 DN


@pytest.mark.parametrize("lines", ["rows", "columns"])
def test_the_modes_of_a_band_are_those_of_its_waves(lines: Lines) -> None:
    """Against the waves themselves in the window, with what repeats taken out."""
    count = 200
    base = _repeats(count) if lines == "rows" else np.zeros((count, 0))
    left, modes = _share_and_modes(lines, count)
    for k, band in enumerate(_bands(count)):
        turn = np.arange(count)[:, None] * np.arange(band.start, band.stop) / count
        waves = _window(count)[:, None] * np.exp(-2j * np.pi * turn)
        waves = waves - base @ (base.T @ waves)
        common = waves.conj().T @ waves
        whole = np.real(np.trace(common))
        assert left[k] == pytest.approx(whole / count / waves.shape[1], rel=1e-9)
        assert modes[k] == pytest.approx(whole**2 / np.sum(np.square(np.abs(common))), rel=1e-9)
