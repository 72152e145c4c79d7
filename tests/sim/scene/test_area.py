"""Compiled loops of drawing by area, each against sums over points."""

import numpy as np
import pytest

from sim.scene.area import aligned_means


def _table(pattern: np.ndarray) -> np.ndarray:
    return np.pad(pattern.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))


@pytest.mark.parametrize(("wide", "high"), [(0.3, 0.4), (2.7, 1.6)], ids=["within a cell", "over several"])
def test_aligned_means_are_means_over_their_squares(wide: float, high: float) -> None:
    rng = np.random.default_rng(3)
    pattern = rng.random((7, 9))
    u, v = rng.uniform(-1.0, 10.0, (6, 5)), rng.uniform(-1.0, 8.0, (6, 5))
    # dark outside; midpoints of 400 x 400 parts: each cell's rim is off by half a part at most
    dark = np.pad(pattern, 6)
    share = (np.arange(400) + 0.5) / 400 - 0.5
    rows = np.floor(v[..., None] + high * share).astype(int) + 6
    cols = np.floor(u[..., None] + wide * share).astype(int) + 6
    summed = dark[rows[..., :, None], cols[..., None, :]].mean(axis=(2, 3))
    # up to 3 + 2 rims each way, each off by half of 1 / 400 of a square of up to 1
    np.testing.assert_allclose(aligned_means(_table(pattern), u, v, wide, high), summed, atol=5 * 0.5 / 400)


def test_a_place_that_is_no_number_is_dark() -> None:
    nowhere = np.full((1, 1), np.nan)
    assert aligned_means(_table(np.ones((3, 3))), nowhere, nowhere, 1.0, 1.0) == 0.0
