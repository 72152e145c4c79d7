"""Turbulent air's transfer: its width at half maximum, its structure function, and the light that it keeps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from sim.effects.turbulent_air import TurbulentAir
from sim.spectrum import FloatArray
from sim.stages import Image
from tests.sim.test_stop_down import CAMERA


def _kept(effect: TurbulentAir, f: FloatArray) -> FloatArray:
    (law,) = effect.on_image(Image(CAMERA)).transfer
    return np.asarray(law(f, np.zeros(np.size(f)), 550.0))


def _spread(effect: TurbulentAir, r_um: float) -> float:
    """The point spread at a distance, the transfer's Hankel transform, by quadrature between the waves' zeros."""

    def ring(f: float) -> float:
        return float(2.0 * np.pi * f * _kept(effect, np.array([f]))[0] * j0(2.0 * np.pi * f * r_um))

    return float(sum(quad(ring, a, b)[0] for a, b in pairwise(np.linspace(0.0, 2.0, 21))))


def test_the_spread_is_as_wide_as_stated() -> None:
    """At half of its width it has half of its height. The constant 0.976 has three digits: 1e-3."""
    effect = TurbulentAir(width_um=3.0)
    assert _spread(effect, 1.5) / _spread(effect, 0.0) == pytest.approx(0.5, rel=2e-3)


def test_minus_the_logarithm_grows_with_the_power_five_thirds() -> None:
    f = np.array([0.02, 0.04])
    one, two = -np.log(_kept(TurbulentAir(width_um=2.0), f))
    assert two / one == pytest.approx(2.0 ** (5.0 / 3.0), rel=1e-12)
    assert one == pytest.approx(3.44 * (2.0 / 0.975863 * 0.02) ** (5.0 / 3.0), rel=1e-12)


def test_light_is_kept_and_none_blurs_nothing() -> None:
    assert _kept(TurbulentAir(width_um=3.0), np.zeros(1))[0] == 1.0
    assert TurbulentAir().on_image(Image(CAMERA)) == Image(CAMERA)
