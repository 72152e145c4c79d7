"""The Moffat blur against its point spread, its two limits, and the light that it keeps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from sim.effects.moffat_blur import MoffatBlur
from sim.stages import Image
from tests.sim.test_stop_down import CAMERA


def _kept(effect: MoffatBlur, f):
    (law,) = effect.on_image(Image(CAMERA)).transfer
    return law(np.atleast_1d(np.asarray(f, float)), np.zeros(np.size(f)), 550.0)


@pytest.mark.parametrize("exponent", [1.8, 2.5, 4.0])
def test_the_transfer_is_that_of_the_point_spread(exponent: float) -> None:
    """The Hankel transform of the Moffat function, to the quadrature's 1e-4: beyond 1000 radii 1000^(2 - 2 b) of the
    light is left out, 2e-5 of b = 1.8."""
    radius_um, f = 1.5, 0.1

    def ring(r: float) -> float:
        spread = (exponent - 1.0) / (np.pi * radius_um**2) * (1.0 + (r / radius_um) ** 2) ** -exponent
        return 2.0 * np.pi * r * spread * float(j0(2.0 * np.pi * f * r))

    periods = np.arange(0.0, 1500.0, 5.0)
    wanted = sum(quad(ring, a, b)[0] for a, b in pairwise(periods))
    found = _kept(MoffatBlur(radius_um=radius_um, exponent=exponent), f)[0]
    assert found == pytest.approx(wanted, abs=1e-4)


def test_an_exponent_of_three_halves_is_an_exponential() -> None:
    f = np.linspace(0.01, 0.4, 7)
    wanted = 0.7 + 0.3 * np.exp(-2.0 * np.pi * 2.0 * f)
    np.testing.assert_allclose(_kept(MoffatBlur(radius_um=2.0, share_percent=30.0), f), wanted, rtol=1e-9)


def test_a_fine_one_of_finite_variance_loses_contrast_as_a_gaussian() -> None:
    """1 - x^2 / (4 (b - 2)) for b > 2, x = 2 pi a f; the next term, x^2 / (8 (b - 3)) of it, is 5e-5 at 0.02."""
    radius_um, exponent, f = 1.0, 4.0, 0.02 / (2.0 * np.pi)
    lost = 1.0 - _kept(MoffatBlur(radius_um=radius_um, exponent=exponent), f)[0]
    assert lost == pytest.approx(0.02**2 / 8.0, rel=1e-3)


def test_it_keeps_the_light() -> None:
    assert _kept(MoffatBlur(radius_um=3.0, share_percent=40.0, exponent=2.2), 0.0)[0] == 1.0


def test_without_radius_or_share_nothing_is_spread() -> None:
    image = Image(CAMERA)
    assert MoffatBlur().on_image(image) is image
    assert MoffatBlur(radius_um=2.0, share_percent=0.0).on_image(image) is image
