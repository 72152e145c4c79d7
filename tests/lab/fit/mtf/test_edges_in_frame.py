"""Edges are found in a frame without a stated region, or the reason is given."""

from __future__ import annotations

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.mtf import edge_mtf
from lab.fit.mtf.edges_in_frame import find_edges
from tests.lab.fit.mtf.drawn_edges import gaussian_mtf50, squares


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_edges_are_found_by_themselves(cfa):
    light = squares((300, 420), [(100, 110, 60, 5.0), (150, 300, 70, 40.0)], 0.6)
    raw = 64 + np.round(0.4 * np.random.default_rng(0).poisson(8000 * light))
    found = find_edges(raw, cfa, 4095.0)
    assert len(found) == 8
    wanted = sorted([-5.0, -5.0, 85.0, 85.0, -40.0, -40.0, 50.0, 50.0])
    np.testing.assert_allclose(sorted(e.angle_deg for e in found), wanted, atol=0.1)
    for e in found:
        row0, col0, row1, col1 = e.region
        mtf = edge_mtf(raw[row0:row1, col0:col1] - 64)
        assert mtf.mtf50_cy_per_px == pytest.approx(gaussian_mtf50(0.6), abs=4 * mtf.mtf50_cy_per_px_std)


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (np.full((200, 200), 7.0), "uniform"),
        (np.random.default_rng(0).normal(100, 3, (200, 200)), "no straight line"),
        (np.full((200, 200), np.nan), "finite"),
        (np.minimum(1500.0 * squares((200, 200), [(100, 100, 50, 5.0)], 0.6), 1023), "saturated"),
    ],
    ids=["uniform", "noise", "not finite", "saturated"],
)
def test_a_frame_without_an_edge_says_why(frame, reason):
    with pytest.raises(NotDetermined, match=reason):
        find_edges(frame, "MONO", 1023.0)
