"""The optimum on the simplex against the conditions of optimality."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.psf.simplex import on_simplex


def test_simplex_solution_meets_the_optimality_conditions():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(60, 40))
    quadratic, linear = root.T @ root, rng.normal(size=40) * 10
    x = on_simplex(quadratic, linear, np.full(40, 1 / 40))
    assert x.sum() == pytest.approx(1, abs=1e-12)
    assert x.min() >= 0
    slope = quadratic @ x - linear
    free = x > 0
    assert 0 < free.sum() < 40
    level = slope[free].mean()
    np.testing.assert_allclose(slope[free], level, atol=1e-8)
    assert (slope[~free] > level - 1e-8).all()
