"""Lights, screens and the colour chart."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sim.scene import Screen, SubPixels, colorchecker
from sim.scene.light import at_luminance, colour_science, illuminant, luminance_cd_m2, screen
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


# --- Screens: gamma of each primary, black and white, stripes of sub-pixels -------------------------------------------


CURVE = Spectrum.of([400.0, 700.0], [1.0, 2.0])


def drawn_screen(**changes: object) -> Screen:
    return Screen.model_validate(
        {"primaries": (CURVE, CURVE.scale(2.0), CURVE.scale(3.0)), "black_radiance": CURVE.scale(0.01)} | changes
    )


def ramp() -> np.ndarray:
    return np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)


def test_drives_follow_each_primarys_gamma() -> None:
    drives = np.squeeze(drawn_screen(gamma=(2.2, 1.8, 1.0)).drives(ramp())).T
    code = np.arange(256) / 255
    np.testing.assert_allclose(drives, np.stack([code**2.2, code**1.8, code], axis=-1), rtol=1e-14)


def test_codes_up_to_black_are_off() -> None:
    drives = np.squeeze(drawn_screen(black_code=(0.1, 0.0, 0.2)).drives(ramp())).T
    assert np.all(drives[:26, 0] == 0)
    assert drives[26, 0] > 0
    assert np.all(drives[:52, 2] == 0)
    np.testing.assert_array_equal(drives[255], 1.0)
    assert np.all(np.diff(drives, axis=0) >= 0)


def test_white_is_all_primaries_and_black() -> None:
    np.testing.assert_allclose(drawn_screen().white_radiance.value, np.array(CURVE.value) * 6.01, rtol=1e-14)


def test_stripes_do_not_overlap() -> None:
    for order in ("RGB", "BGR"):
        layout = SubPixels(width=1 / 3, height=0.7, order=order)
        edges = sorted(layout.locate_stripe(channel)[:2] for channel in range(3))
        np.testing.assert_allclose(np.ravel(edges), [0, 1 / 3, 1 / 3, 2 / 3, 2 / 3, 1], atol=1e-15)
        assert (layout.locate_stripe(0)[0] < layout.locate_stripe(2)[0]) == (order == "RGB")
        assert layout.share == pytest.approx(0.7 / 3)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"gamma": (2.2, 9.0, 2.2)}, "9.0 is above the upper limit 5.0"),
        ({"black_code": (-0.1, 0.0, 0.0)}, "-0.1 is below the lower limit 0.0"),
        ({"black_radiance": CURVE.scale(-1.0)}, "black has a radiance of -2"),
        ({"falloff_exponent": -1.0}, "below the lower limit"),
        ({"sub_pixels": {"width": 0.5}}, "above the upper limit"),
    ],
)
def test_a_screen_that_cannot_be_is_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        drawn_screen(**changes)


# --- Reflectances of the ColorCheckers against published colours ------------------------------------------------------


def xyz_under_d50(curves: np.ndarray) -> np.ndarray:
    """XYZ of reflectances on 380..730 nm by 10 under D50, from the CIE's tables directly."""
    colour = colour_science()
    w = np.arange(380.0, 731.0, 10.0)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    light = colour.SDS_ILLUMINANTS["D50"]
    weight = np.stack([np.interp(w, observer.wavelengths, column) for column in observer.values.T], axis=1)
    weight *= np.interp(w, light.wavelengths, light.values)[:, None]
    return curves @ weight / weight[:, 1].sum()


def test_the_sg_has_the_published_colours() -> None:
    curves = colorchecker.reflectances("ColorCheckerSG")
    assert colorchecker.grid("ColorCheckerSG") == (10, 14)
    assert list(curves)[:2] == ["A1", "B1"]
    assert list(curves)[-1] == "N10"
    assert len(curves) == 140
    at = np.array([curve.at(np.arange(380.0, 731.0, 10.0)) for curve in curves.values()])
    assert at.min() >= 0
    assert at.max() <= 1
    published = colour_science().CCS_COLOURCHECKERS["ColorCheckerSG - After November 2014"].data
    for (x, y, luminance), xyz in zip(published.values(), xyz_under_d50(at), strict=True):
        # To 1e-5 as promised, and 2e-5 of the tables' own rounding and interpolation.
        np.testing.assert_allclose(xyz, [x / y * luminance, luminance, (1 - x - y) / y * luminance], atol=3e-5)
    # White, the 24 patches' red, black: named places on the chart.
    assert curves["A1"].at(550.0) > 0.85
    assert curves["C1"].at(550.0) < 0.02
    assert curves["N5"].at(550.0) == pytest.approx(0.18, abs=0.01)


def test_recovery_leaves_what_it_is_said_to_leave() -> None:
    """The measured 24, from their colours alone: metamers, 0.04 rms away and of the same colour."""
    measured = np.array([curve.at(np.arange(380.0, 731.0, 10.0)) for curve in colorchecker.reflectances().values()])
    wanted = xyz_under_d50(measured)
    wavelength_nm, found = colorchecker.recover_reflectances(wanted)
    np.testing.assert_array_equal(wavelength_nm, np.arange(380.0, 731.0, 10.0))
    np.testing.assert_allclose(xyz_under_d50(found), wanted, atol=3e-5)
    assert np.sqrt(np.mean((found - measured) ** 2)) < 0.042


def test_colours_beyond_any_surface_are_refused() -> None:
    with pytest.raises(ValueError, match="beyond any reflectance"):
        colorchecker.recover_reflectances(np.array([[1.3, 1.2, 0.9]]))
