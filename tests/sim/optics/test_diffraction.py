"""Diffraction and the pixel's aperture against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from sim.optics.diffraction import aperture_otf, diffraction_cutoff_cy_per_um, diffraction_otf


def test_an_ideal_lens_at_f_4_has_the_published_contrast() -> None:
    # Analytic values stated for f/4, 550 nm at 30, 60, 100 lp/mm, to the four digits given.
    np.testing.assert_allclose(diffraction_otf([0.03, 0.06, 0.1], 550.0, 4.0), [0.9160, 0.8324, 0.7222], atol=6e-5)


def test_diffraction_ends_at_the_cutoff_and_starts_with_a_cusp() -> None:
    cutoff = diffraction_cutoff_cy_per_um(550.0, 4.0)
    assert cutoff == pytest.approx(1 / 2.2)
    assert diffraction_otf(0.0, 550.0, 4.0) == 1.0
    assert np.all(diffraction_otf(cutoff * np.array([1.0, 1.5, 100.0]), 550.0, 4.0) == 0.0)
    assert (1 - diffraction_otf(1e-6 * cutoff, 550.0, 4.0)) / 1e-6 == pytest.approx(4 / np.pi, rel=1e-4)


def test_an_aperture_is_the_transform_of_its_square() -> None:
    w = np.sqrt(0.5)
    direct = integrate.quad(lambda x: np.cos(2 * np.pi * 0.7 * x) / w, -w / 2, w / 2)[0]
    assert aperture_otf(0.7, 0.0, 0.5) == pytest.approx(direct, rel=1e-10)
    assert aperture_otf(1 / w, 0.0, 0.5) == pytest.approx(0.0, abs=1e-15)
