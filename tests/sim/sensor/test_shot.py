"""Shot noise is Poisson, at every mean."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sim.sensor.shot import FROM_NORMAL, draw_poisson


@pytest.mark.parametrize("mean", [0.0, 0.3, 1.0, 2.7, FROM_NORMAL - 0.01, FROM_NORMAL, 10.3, 17.7, 64.2, 300.0, 9000.0])
def test_counts_are_poisson(mean: float) -> None:
    """A chi-squared test of all counts that are wanted 20 times and more, at 4.5 standard deviations; 2e6 draws."""
    n, mean = 2_000_000, float(np.float32(mean))
    drawn = draw_poisson(np.full(n, mean, np.float32), np.random.default_rng(3)).astype(int)
    counts = np.bincount(drawn)
    wanted = stats.poisson(mean).pmf(np.arange(counts.size)) * n
    often = wanted > 20
    chi2 = float(np.sum((counts[often] - wanted[often]) ** 2 / wanted[often]))
    assert chi2 <= often.sum() + 4.5 * np.sqrt(2.0 * often.sum())
    if mean > 0:
        assert drawn.mean() == pytest.approx(mean, abs=4.5 * np.sqrt(mean / n))


def test_means_may_differ_from_pixel_to_pixel() -> None:
    mean = np.linspace(0.0, 40.0, 400_000, dtype=np.float32).reshape(400, 1000)
    drawn = draw_poisson(mean, np.random.default_rng(4))
    assert drawn.shape == mean.shape and drawn.dtype == np.float32
    assert np.all(drawn == np.floor(drawn))
    # Each row of 1000 draws by its own mean: chi-squared with 400 degrees of freedom (the first row's mean is near 0).
    pull = (drawn.mean(axis=1) - mean.mean(axis=1)) / np.sqrt(mean.mean(axis=1) / 1000)
    assert np.sum(pull**2) == pytest.approx(400, abs=4.5 * np.sqrt(800))


def test_the_means_are_left_as_they_are() -> None:
    mean = np.full((3, 4), 20.0, np.float32)
    mean.flags.writeable = False
    assert draw_poisson(mean, np.random.default_rng(5)).shape == (3, 4)
    assert draw_poisson(np.empty((0, 4), np.float32), np.random.default_rng(5)).shape == (0, 4)
