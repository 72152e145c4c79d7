"""Indices: catalogues by name, model glasses by nd and Vd, and no index that nobody stated."""

import numpy as np
import pytest

from lab.predict.lens import parse_glasses
from sim.optics.prescription import GlassName, Prescription, PrescriptionError, Surface
from sim.optics.system import model_index, refractive_index, substitutions

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
    with pytest.raises(PrescriptionError, match=r"surface 7: the glass LAK10C .* --glass LAK10C=nd,Vd"):
        refractive_index(GlassName(name="LAK10C"), [D], ("RXGLASS",), "surface 7")


@pytest.mark.parametrize(
    ("glass", "remedy"),
    [
        (GlassName(name="XYZ-77", index_d=1.5168, abbe_d=64.17), "--glass XYZ-77=1.5168,64.17"),
        (GlassName(name="LASF9"), "--glass LASF9=N-LASF9"),
        (GlassName(name="L-TIM28_MOLD"), "--glass L-TIM28_MOLD=L-TIM28"),
        (GlassName(name="BAF10"), "--glass BAF10=N-BAF10"),  # its own data end at 700 nm
        (GlassName(name="LASF9", index_d=1.7, abbe_d=40.0), "--glass LASF9=1.7,40"),  # isn't N-LASF9's 1.850
        (GlassName(name="SK16"), "--glass SK16=N-SK16"),
    ],
)
def test_the_remedy_for_a_glass_is_one_that_works(glass: GlassName, remedy: str) -> None:
    wide = [400.0, D, 720.0]
    with pytest.raises(PrescriptionError) as refused:
        refractive_index(glass, wide, ("SCHOTT",), "surface 3")
    assert remedy in str(refused.value) and "\n" not in str(refused.value)
    (taken,) = parse_glasses([remedy.removeprefix("--glass ")]).values()
    found = refractive_index(taken, wide, ("SCHOTT",))
    assert found[1] == pytest.approx(glass.index_d or found[1], abs=1e-5) and np.all(np.diff(found) < 0)


def test_old_names_of_makers_files_are_known_and_reported() -> None:
    for name, index_d in (("BK7", 1.5168), ("B270", 1.523), ("F_SILICA", 1.4585), ("CAF2", 1.4338)):
        assert refractive_index(GlassName(name=name), [400.0, D, 720.0])[1] == pytest.approx(index_d, abs=2e-4)
    lines = substitutions(lens_of("BK7", "B270", "SF11"))
    assert lines == (
        "surface 1: BK7 is taken as N-BK7, its maker's replacement",
        "surface 2: B270 is taken as a model glass of nd 1.523 and Vd 58.5",
    )


def test_a_stated_index_that_the_catalogue_contradicts_is_reported() -> None:
    lens = lens_of("N-BK7", "N-SF11")
    stated = [
        surface.glass.model_copy(update={"index_d": 1.62, "abbe_d": 36.4}) for surface in lens.surfaces if surface.glass
    ]
    surfaces = tuple(
        surface.model_copy(update={"glass": glass}) for surface, glass in zip(lens.surfaces[:2], stated, strict=True)
    )
    lines = substitutions(lens.model_copy(update={"surfaces": (*surfaces, lens.surfaces[2])}))
    assert lines[0] == (
        "surface 1: the file states nd 1.62 for N-BK7, the catalogue has 1.5168; if the file is right, give "
        "--glass N-BK7=1.62,36.4"
    )
    assert len(lines) == 2


def lens_of(*glasses: str) -> Prescription:
    surfaces = [Surface(curvature_per_mm=0.01, thickness_mm=2.0, glass=GlassName(name=name)) for name in glasses]
    return Prescription(
        name="l", surfaces=(*surfaces, Surface()), stop=0, aperture_kind="entrance_pupil_mm", aperture_value=1.0
    )


def test_a_wavelength_beyond_the_glasss_data_is_refused() -> None:
    with pytest.raises(PrescriptionError, match="known from"):
        refractive_index(GlassName(name="N-BK7"), [150.0])
