"""Photometry of light sources: luminance, the CIE's illuminants, screens."""

from __future__ import annotations

import numpy as np
import pytest

from sim.scene.light import at_luminance, illuminant, illuminant_names, luminance_cd_m2, screen
from sim.spectrum import Spectrum


def test_luminance_of_a_line_at_555_nm_is_683_lumens_a_watt() -> None:
    """V is 1 at 555 nm and falls by 2e-4 within 1 nm: a triangle of 2 nm holds 1 W sr^-1 m^-2 there."""
    assert luminance_cd_m2(Spectrum.of([554.0, 555.0, 556.0], [0.0, 1.0, 0.0])) == pytest.approx(683.0, rel=5e-4)


def test_luminance_is_linear_whatever_the_knots() -> None:
    curve = Spectrum.of([400.0, 555.5, 700.0], [1.0, 3.0, 0.5])
    fine = np.arange(400.0, 700.5, 0.5)
    assert luminance_cd_m2(curve) == pytest.approx(luminance_cd_m2(Spectrum.of(fine, curve.at(fine))), rel=1e-12)
    assert luminance_cd_m2(at_luminance(curve, 12.0)) == pytest.approx(12.0, rel=1e-12)


def test_illuminants_are_the_cies() -> None:
    d65, a = illuminant("D65", 100.0), illuminant("a", 100.0)
    # CIE 15: relative power of D65 at 400, 560 and 600 nm is 82.7549, 100, 90.0062; of A 14.7080 at 400, 100 at 560 nm.
    assert d65.at([400.0, 600.0]) / d65.at(560.0) == pytest.approx(np.array([0.827549, 0.900062]), rel=1e-4)
    assert a.at(400.0) / a.at(560.0) == pytest.approx(0.147080, rel=1e-4)
    assert {"D65", "A", "FL2", "LED-B1"} <= set(illuminant_names())


def test_what_cannot_be_a_light_is_refused() -> None:
    with pytest.raises(ValueError, match="'D66' is not known: name one of A, "):
        illuminant("D66", 100.0)
    with pytest.raises(ValueError, match="below the limit of 0"):
        illuminant("D65", -1.0)
    with pytest.raises(ValueError, match="visible light"):
        at_luminance(Spectrum.of([900.0, 1000.0], [1.0, 1.0]), 100.0)


def test_a_screens_white_and_black_have_the_luminance_asked_for() -> None:
    shown = screen(white_cd_m2=250.0, contrast_ratio=500.0)
    assert luminance_cd_m2(shown.white_radiance) == pytest.approx(250.0, rel=1e-9)
    assert luminance_cd_m2(shown.black_radiance) == pytest.approx(0.5, rel=1e-9)
    with pytest.raises(ValueError, match=r"contrast ratio is 0\.5"):
        screen(contrast_ratio=0.5)
