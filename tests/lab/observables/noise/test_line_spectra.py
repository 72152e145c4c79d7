"""Periodograms of whole images and of bands of large ones, over the level of white noise."""

from __future__ import annotations

import numpy as np
import pytest

from lab.observables.noise import line_spectra
from lab.observables.noise.line_spectra import periodogram


def test_bands_of_a_large_image_tell_what_the_whole_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """White noise of 2 DN with column noise of 0.1 DN, 400 x 301 px, in bands of 30,000 px: the level is the variance
    within three standard deviations of a mean over its modes; powers of lines are those of the whole image but for the
    level; powers along lines have the mean 1 within three standard deviations."""
    rng = np.random.default_rng(4)
    image = (2.0 * rng.standard_normal((400, 301)) + 0.1 * rng.standard_normal(301)).astype(np.float32)
    whole = periodogram(image)
    monkeypatch.setattr(line_spectra, "BAND_PIXELS", 30_000)
    banded = periodogram(image)
    assert banded.modes < whole.modes
    assert banded.level == pytest.approx(4.0, rel=3.0 / np.sqrt(banded.modes))
    for lines in ("rows", "columns"):
        (frequency, power, _), (same, other, _) = whole.line(lines), banded.line(lines)
        np.testing.assert_array_equal(frequency, same)
        # L / (L - 1) of either
        ratio = (whole.level * (1.0 + 1.0 / whole.modes)) / (banded.level * (1.0 + 1.0 / banded.modes))
        np.testing.assert_allclose(other, power * ratio, rtol=1e-5)
        _, along, modes = banded.along(lines)
        assert np.mean(along) == pytest.approx(1.0, abs=3.0 / np.sqrt(modes.sum()) + 3.0 / np.sqrt(banded.modes))


def test_lines_are_the_first_row_and_column_of_the_transform() -> None:
    """The means' powers are |FFT|^2 / pixels at frequency 0 of the other axis."""
    image = np.random.default_rng(5).normal(0.0, 1.0, (24, 31)).astype(np.float32)
    found = periodogram(image)
    table = np.square(np.abs(np.fft.fft2(image - image.mean()))) / image.size
    np.testing.assert_allclose(found.means["rows"][1], table[:, 0], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.means["columns"][1], table[0, :16], rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(found.means["columns"][0], np.fft.rfftfreq(31))


def test_tones_are_no_part_of_the_level_of_white_noise() -> None:
    """Two plane waves in the level's band, as in EMVA's simulated camera, leave the level where it is."""
    rng = np.random.default_rng(5)
    rows = cols = 200
    white = 1.8 * rng.standard_normal((rows, cols))
    y, x = np.indices((rows, cols))
    waves = sum(1.5 * np.sin(2.0 * np.pi * f * (x + y)) for f in (0.04, 0.2))
    alone = periodogram(white.astype(np.float32))
    both = periodogram((white + waves).astype(np.float32))
    # a wave at a frequency of the transform takes one mode, whose power is then missing from the mean
    modes = alone.line("rows")[2]
    assert both.line("rows")[2] == modes - 2
    # two of the powers are missing, each of standard deviation and mean of the level: below 3 (2 / modes)
    assert abs(both.level / alone.level - 1.0) < 3.0 * 2.0 / modes
    # a level has `modes` exponential powers: a standard deviation of 1 / sqrt(modes) of it
    assert abs(both.level / 1.8**2 - 1.0) < 3.0 / np.sqrt(modes)
