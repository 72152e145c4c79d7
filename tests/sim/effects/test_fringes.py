"""Fringes: crests where the wavelength fits twice the optical thickness, and what a line of finite width leaves."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.fringes import Fringes
from sim.spectrum import Spectrum
from sim.uniform import Uniform, electron_rate
from tests.sim.effects.test_sensor_effects import CAMERA


def test_crests_lie_where_the_wavelength_fits() -> None:
    one = Uniform(CAMERA, (Fringes(cos_percent=4.0, optical_thickness_um=6.0),))
    crests, troughs = 12000.0 / np.arange(20.0, 26.0), 12000.0 / (np.arange(20.0, 26.0) + 0.5)
    np.testing.assert_allclose(one.transmittance(crests), 1.04, rtol=1e-12)
    np.testing.assert_allclose(one.transmittance(troughs), 0.96, rtol=1e-12)
    # a quarter of a turn beside
    beside = Uniform(CAMERA, (Fringes(sin_percent=4.0, optical_thickness_um=6.0),))
    np.testing.assert_allclose(beside.transmittance(12000.0 / (np.arange(20.0, 26.0) + 0.25)), 1.04, rtol=1e-12)


@pytest.mark.parametrize("thickness_um", [3.0, 8.0])
def test_a_line_averages_fringes(thickness_um: float) -> None:
    """A normal line of std s at w leaves exp(-(2 pi s / p)^2 / 2) of the ripple, p = w^2 / (2 L) its period; to 2 % of
    the ripple, as the period isn't the same over the line and the sensitivity has a slope."""
    crest = 2000.0 * thickness_um / round(2000.0 * thickness_um / 550.0)
    wavelength_nm = np.arange(crest - 25.0, crest + 25.0, 0.1)
    line = Spectrum.of(wavelength_nm, 0.02 * np.exp(-0.5 * ((wavelength_nm - crest) / 4.0) ** 2))
    plain, rippled = (
        electron_rate(CAMERA, "Y", line, e)
        for e in ((), (Fringes(cos_percent=10.0, optical_thickness_um=thickness_um),))
    )
    left = np.exp(-0.5 * (2.0 * np.pi * 4.0 * 2000.0 * thickness_um / crest**2) ** 2)
    assert rippled / plain - 1.0 == pytest.approx(0.1 * left, abs=0.002)
