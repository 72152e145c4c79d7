"""Reflectances of the ColorCheckers against published colours."""

from __future__ import annotations

import numpy as np
import pytest

from sim.scene import colorchecker
from sim.scene.light import colour_science


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
