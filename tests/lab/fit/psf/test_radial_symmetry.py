"""The test of radial symmetry on kernels over the field."""

from __future__ import annotations

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.psf.radial_symmetry import radial_symmetry
from lab.fit.psf.screen_kernel import ScreenKernel
from tests.lab.fit.psf.drawn_targets import (
    gaussian,
)


def kernel_at(row_px, col_px, sigma_row, sigma_col, angle_deg, rng):
    size, std = 9, 2e-4
    kernel = gaussian(size, sigma_row, sigma_col, angle_deg) + rng.normal(0, std, (size, size))
    return ScreenKernel(
        channel="G",
        kernel=kernel,
        kernel_std=np.full((size, size), std),
        covariance=std**2 * np.eye(size * size),
        fine=None,
        oversample=2,
        outside=0.0,
        corner_rms_px=0.0,
        centre_px=(row_px, col_px),
    )


def field(blur, seed=0):
    rng = np.random.default_rng(seed)
    places = [(r, c) for r in (-200, 0, 200) for c in (-300, 0, 300)]
    return [kernel_at(r, c, *blur(r, c), rng) for r, c in places]


def test_a_symmetric_lens_passes_and_an_asymmetric_one_does_not():
    def symmetric(r, c):  # longer along the radius, the farther out
        return 0.8 + 0.4 * (r * r + c * c) / 130000, 0.8, np.degrees(np.arctan2(c, r)) if r or c else 0.0

    passed = [radial_symmetry(field(symmetric, seed), (0.0, 0.0)) for seed in range(20)]
    # a Gaussian's second moment grows with sigma^2: not quite the parabola of the test, but by less than the noise
    assert sum(p.symmetric for p in passed) >= 18
    assert passed[0].radial_growth_px2 > 5 * abs(passed[0].tangential_growth_px2)
    tilted = radial_symmetry(field(lambda r, c: (0.8 + 0.1 * c / 300, 0.8 + 0.1 * c / 300, 0.0)), (0.0, 0.0))
    assert not tilted.symmetric
    astigmatic = radial_symmetry(field(lambda r, c: (0.9, 0.8, 0.0)), (0.0, 0.0))
    assert not astigmatic.symmetric
    with pytest.raises(NotDetermined, match="5 at unequal distances"):
        radial_symmetry(field(symmetric)[:4], (0.0, 0.0))
