"""Indices: catalogues by name, model glasses by nd and Vd, and no index that nobody stated."""

import numpy as np
import pytest

from sim.optics.prescription import GlassName, PrescriptionError
from sim.optics.system import model_index, refractive_index

D, F, C, G = 587.5618, 486.1327, 656.2725, 435.8343


def test_air_is_one() -> None:
    assert np.array_equal(refractive_index(None, [400.0, 700.0]), [1.0, 1.0])


def test_catalogue_glasses_have_their_data_sheets_values() -> None:
    # Schott's data sheets: N-BK7 nd 1.51680, Vd 64.17; SF11 nd 1.78472, Vd 25.76.
    for name, index, abbe in (("N-BK7", 1.51680, 64.17), ("SF11", 1.78472, 25.76)):
        d, f, c = refractive_index(GlassName(name=name), [D, F, C], ("SCHOTT",))
        assert d == pytest.approx(index, abs=6e-6)
        assert (d - 1) / (f - c) == pytest.approx(abbe, abs=6e-3)


def test_the_files_catalogue_comes_first() -> None:
    # Schott's F5 has Vd 38.03, CDGM's F5 has Vd 35.87.
    values = {}
    for catalogue in ("SCHOTT", "CDGM"):
        d, f, c = refractive_index(GlassName(name="F5"), [D, F, C], (catalogue,))
        values[catalogue] = (d - 1) / (f - c)
    assert values["SCHOTT"] == pytest.approx(38.03, abs=0.01)
    assert abs(values["CDGM"] - values["SCHOTT"]) > 0.5


def test_a_model_glass_has_its_nd_vd_and_partial_dispersion() -> None:
    glass = GlassName(name="m", model=True, index_d=1.6355, abbe_d=23.9, partial_dispersion_deviation=0.01)
    d, f, c, g = model_index(glass, [D, F, C, G])
    assert d == pytest.approx(1.6355, abs=1e-12)
    assert (d - 1) / (f - c) == pytest.approx(23.9, rel=1e-9)
    assert (g - f) / (f - c) == pytest.approx(0.6438 - 0.001682 * 23.9 + 0.01, rel=1e-9)


def test_a_model_glass_comes_near_the_glass_it_models() -> None:
    w = np.arange(400.0, 721.0, 20.0)
    real = refractive_index(GlassName(name="N-BK7"), w, ("SCHOTT",))
    model = model_index(GlassName(name="m", model=True, index_d=1.5168, abbe_d=64.17), w)
    assert np.max(np.abs(real - model)) < 3e-4  # three numbers for a whole curve


def test_an_alias_and_a_discontinued_glass() -> None:
    assert refractive_index(GlassName(name="LAFN21"), [D])[0] == pytest.approx(1.788, abs=1e-5)
    assert refractive_index(GlassName(name="SF53"), [D])[0] == pytest.approx(1.7283, abs=1e-5)


def test_an_unknown_glass_names_glass_surface_and_remedy() -> None:
    with pytest.raises(PrescriptionError, match=r"surface 7: the glass LAK10C .* nd and Vd"):
        refractive_index(GlassName(name="LAK10C"), [D], ("RXGLASS",), "surface 7")


def test_a_wavelength_beyond_the_glasss_data_is_refused() -> None:
    with pytest.raises(PrescriptionError, match="known from"):
        refractive_index(GlassName(name="N-BK7"), [150.0])
