"""Diagnosis of recordings of the independent simulator, and of the two foreign sets beside the project."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law
from evaluation.independent_simulator.laws import (
    AbsorptionBandLaw,
    ChargeDiffusionLaw,
    DefocusLaw,
    InfraredCutFilterLaw,
    NonlinearityLaw,
    OpticalLowPassFilterLaw,
    VeilingGlareLaw,
)
from lab.diagnose import diagnose
from lab.formats.recording_set import read
from lab.formats.results import DiagnosisResult

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def _shared(name: str) -> DiagnosisResult:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"{name} isn't beside the project")
    return diagnose(read(folder))


@pytest.mark.extra  # a whole diagnosis
def test_a_healthy_camera_of_the_independent_simulator_has_no_mismatch() -> None:
    result = _shared("foreign_healthy")
    assert result.verdict == "no_mismatch"
    assert not result.effects
    assert not result.mismatches


@pytest.mark.slow  # the main job and the fresh cases find both every day
def test_two_effects_of_the_independent_simulator_are_named() -> None:
    """Truth: 1.9 um along rows and columns, cut at 652 nm; wanted within 5 % and 3 nm."""
    result = _shared("foreign_two_effects")
    assert result.verdict == "explained"
    assert {e.name for e in result.effects} == {"optical_low_pass_filter", "infrared_cut_filter"}
    by_name = {e.name: e for e in result.effects}
    for field in ("displacement_x_um", "displacement_y_um"):
        assert by_name["optical_low_pass_filter"].parameters[field].value == pytest.approx(1.9, rel=0.05)
    assert by_name["infrared_cut_filter"].parameters["cut_wavelength_nm"].value == pytest.approx(652.0, abs=3.0)
    assert result.held_out is not None
    assert result.held_out.chi2_after < 0.05 * result.held_out.chi2_before
    assert result.held_out.chi2_after < 1.3 * result.held_out.n


@pytest.mark.slow  # half a minute; a screen of the independent simulator is placed likewise in tests of the measurement
def test_a_filter_before_an_aligned_screen_is_named() -> None:
    """Truth: 1.9 um along rows and columns; the screen stands within 0.04 degrees, its cells are 4.0 px."""
    result = _shared("foreign_screen_aligned")
    assert result.verdict == "explained"
    assert [e.name for e in result.effects] == ["optical_low_pass_filter"]
    for field in ("displacement_x_um", "displacement_y_um"):
        found = result.effects[0].parameters[field]
        assert found.std is not None
        assert abs(found.value - 1.9) < 2.0 * found.std


@pytest.mark.slow  # half a minute
def test_an_aperture_of_half_the_stated_area_is_named() -> None:
    """Truth: 0.45 of a pixel of 3.75 um, stated 0.89: the side is 1.02 um shorter. The bands of the screen, whose cells
    are 4.0 px, come out about a tenth of the change too small, hence 10 %."""
    result = _shared("foreign_aperture")
    assert result.verdict == "explained"
    assert [e.name for e in result.effects] == ["pixel_aperture"]
    assert result.effects[0].parameters["side_change_um"].value == pytest.approx(-1.022, rel=0.1)


CASES: list[tuple[str, tuple[Law, ...], str]] = [
    ("healthy mono", (), "MONO"),
    ("glare", (VeilingGlareLaw(2.0, 0),), "GRBG"),
    ("bend", (NonlinearityLaw(2.0, 0),), "BGGR"),
]


def named(concealed: tuple[Law, ...]) -> set[str]:
    return {str(law.effect) for law in concealed}


@pytest.mark.slow  # the fresh cases try the like every day
@pytest.mark.parametrize(("name", "concealed", "cfa"), CASES, ids=[c[0] for c in CASES])
def test_one_effect_by_another_law_is_named_alone(name: str, concealed: tuple[Law, ...], cfa: str) -> None:
    result = diagnose(recordings_of(ConcealedCamera(900, concealed, cfa=cfa)))
    assert {e.name for e in result.effects} == named(concealed)
    assert result.verdict == ("explained" if concealed else "no_mismatch")


MORE: list[tuple[Law, ...]] = [
    (DefocusLaw(12.0, 1),), (ChargeDiffusionLaw(0.7, 2),), (OpticalLowPassFilterLaw(1.4, 1),),
    (InfraredCutFilterLaw(55.0, 1),),
    (DefocusLaw(14.0, 1), NonlinearityLaw(1.5, 0)), (ChargeDiffusionLaw(0.8, 1), VeilingGlareLaw(2.0, 0)),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("concealed", MORE)
def test_more_concealed_effects(concealed: tuple[Law, ...]) -> None:
    result = diagnose(recordings_of(ConcealedCamera(910, concealed, cfa="RGGB")))
    assert {e.name for e in result.effects} == named(concealed)


@pytest.mark.slow
def test_what_nobody_lists_is_located_and_not_named() -> None:
    result = diagnose(recordings_of(ConcealedCamera(920, [AbsorptionBandLaw(10.0)], cfa="GBRG")))
    assert not result.effects
    assert result.verdict == "unexplained"
    assert any(m.measurement == "narrowband" for m in result.mismatches)
