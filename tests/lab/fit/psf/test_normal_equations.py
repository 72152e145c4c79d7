"""Normal equations against direct sums."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.psf.normal_equations import normal_equations


def test_normal_equations_are_the_direct_sums():
    rng = np.random.default_rng(0)
    sharp, blurred, s, h = rng.random((19, 23)), rng.random((19, 23)), 5, 2
    # the definition, word by word
    design = np.array(
        [
            [sharp[r - i + h, c - j + h] for i in range(s) for j in range(s)]
            for r in range(h, 19 - h)
            for c in range(h, 23 - h)
        ]
    )
    inner = blurred[h:-h, h:-h].ravel()
    normal = normal_equations(sharp, blurred, s)
    np.testing.assert_allclose(normal.gram, design.T @ design, rtol=1e-12)
    np.testing.assert_allclose(normal.right, design.T @ inner, rtol=1e-12)
    assert normal.power == pytest.approx(inner @ inner, rel=1e-12)
    assert normal.count == len(inner)


@pytest.mark.parametrize(("shape", "s"), [((40, 31), 1), ((31, 40), 15), ((90, 17), 3), ((19, 60), 9)])
def test_every_element_is_the_direct_sum_at_other_shapes(shape: tuple[int, int], s: int):
    """Wider than tall and the reverse, more columns than a block of the products holds, and a kernel of one element."""
    rng = np.random.default_rng(1)
    sharp, h = 5.0 + rng.random(shape), s // 2
    windows = np.lib.stride_tricks.sliding_window_view(sharp, (s, s))[:, :, ::-1, ::-1].reshape(-1, s * s)
    assert windows.shape[0] == (shape[0] - 2 * h) * (shape[1] - 2 * h)
    np.testing.assert_allclose(normal_equations(sharp, sharp, s).gram, windows.T @ windows, rtol=1e-12)
