"""Corners of a checkerboard are found where they are."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from lab.fit.geometry.corners import fit_corners


def test_corner_is_found_where_it_is():
    """A corner drawn as the product of two blurred edges, skewed, shaded and noisy."""
    rng = np.random.default_rng(1)
    y, x = np.indices((41, 41), dtype=float)
    found = []
    for place in rng.uniform(-0.5, 0.5, (60, 2)):
        dx, dy = x - 20 - place[0], y - 20 - place[1]
        edges = [erf((np.cos(a) * dx + np.sin(a) * dy) / (0.8 * np.sqrt(2))) for a in (0.2, 1.9)]
        picture = 0.5 + 0.003 * dx + 0.4 * edges[0] * edges[1] + rng.normal(0, 0.02, dx.shape)
        points, trusted, _ = fit_corners(
            picture,
            np.array([[20.0, 20.0]]),
            across=np.array([[-np.sin(0.2), np.cos(0.2)]]),
            down=np.array([[-np.sin(1.9), np.cos(1.9)]]),
            half_px=np.array([9.0]),
        )
        assert trusted[0]
        found.append(points[0] - 20 - place)
    std_px = np.std(found)
    # noise / (contrast slope) over about 4 window-lengths of edge pixels: 0.02 / 0.4 / sqrt(36) = 0.008 px
    assert std_px < 0.012
    assert np.abs(np.mean(found, axis=0)).max() < 4 * std_px / np.sqrt(60)
