"""Diffraction and the pixel's aperture against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from sim.optics.diffraction import aperture_otf, diffraction_cutoff_cy_per_um, diffraction_otf
from sim.optics.fold import fold_diffraction, fold_transfer


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


# --- The transfer function folded onto the pixels' frequencies, against sums over its aliases -------------------------


@pytest.mark.parametrize("shape", [(24, 30), (25, 32), (7, 9)])
@pytest.mark.parametrize("cutoff", [0.3, 1.4, 2.6])
def test_the_radial_table_is_the_sum_over_aliases(shape: tuple[int, int], cutoff: float) -> None:
    plain = fold_transfer(lambda fx, fy: diffraction_otf(np.hypot(fx, fy) / cutoff, 1e3, 1.0), shape, 0.8, cutoff)
    # A line between 4096 samples of a curve whose slope falls to 0 as a root at the cutoff: 1e-6.
    np.testing.assert_allclose(fold_diffraction(shape, 0.8, cutoff), plain, atol=1e-6)


def test_light_is_conserved_and_a_perfect_image_is_its_pixels() -> None:
    """At zero frequency sinc of every other order is 0. A lens that passes everything over full pixels: sum over orders
    of sinc^2 = 1 at every frequency; 40 orders leave 2 / (pi^2 40).
    """
    assert fold_diffraction((16, 16), 0.7, 1.9)[0, 0] == pytest.approx(1.0, abs=1e-12)
    full = fold_transfer(lambda fx, fy: np.ones(np.broadcast_shapes(fx.shape, fy.shape)), (8, 1), 1.0, 40.0)
    np.testing.assert_allclose(full[:, 0], 1.0, atol=2.0 / (np.pi**2 * 40) + 1e-3)


def test_a_direct_kernel_has_the_folded_transform() -> None:
    """The kernel of a lens that blurs nothing below 40 cy/px: the overlap of pixel and square, by area. What lies
    beyond is 2 / (pi^2 20) a direction at most.
    """
    size = 16
    got = np.fft.irfft2(
        fold_transfer(lambda fx, fy: np.ones(np.broadcast_shapes(fx.shape, fy.shape)), (size, size), 1.0, 20.0)
    )
    wanted = np.zeros((size, size))
    wanted[0, 0] = 1.0
    np.testing.assert_allclose(got, wanted, atol=0.02)
    assert aperture_otf(0.0, 0.0, 1.0) == 1.0
