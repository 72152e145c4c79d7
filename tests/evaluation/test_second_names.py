"""Second names: a strong concealed effect whose law is varied, and nothing else.

What the nearest law of the library lacks beside the concealed one is no second effect.
"""

from __future__ import annotations

import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.laws import (
    DefocusLaw,
    InfraredCutFilterLaw,
    OpticalLowPassFilterLaw,
    PixelApertureLaw,
)
from evaluation.names import OF_THE_BENCH, NameRun, _judged, run_case, table
from lab.diagnose import diagnose
from lab.formats.results import DiagnosisResult, NamedEffect
from sim.effects.library import effects as library

pytestmark = pytest.mark.timeout(900)

#: Beams of 45 and 55 %, a filter's edge of another form; the rest takes longer.
STRONG: tuple[Law, ...] = (OpticalLowPassFilterLaw(1.8, 2), InfraredCutFilterLaw(60.0, 1))
MORE: tuple[Law, ...] = (
    OpticalLowPassFilterLaw(1.5, 1),
    DefocusLaw(20.0, 0),
    DefocusLaw(20.0, 2),
    PixelApertureLaw(0.6, 1, 1),
    PixelApertureLaw(0.6, 2, 1),
)


def _names(law: Law) -> set[str]:
    camera = ConcealedCamera(930, [law], cfa="MONO", rows=96, cols=128)
    kinds = ("dark", "flat", "narrowband", "slanted_edge")
    return {e.name for e in diagnose(recordings_of(camera, Plan(kinds=kinds))).effects}


@pytest.mark.extra  # whole diagnoses
@pytest.mark.parametrize(
    "law",
    [*STRONG, *(pytest.param(law, marks=pytest.mark.slow) for law in MORE)],
    ids=lambda law: f"{law.name}-{law.variant}",
)
def test_a_strong_effect_by_another_law_has_no_second_name(law: Law) -> None:
    """Its own name, or its family's, and nothing else."""
    assert law.effect is not None
    named = _names(law)
    assert len(named) == 1
    assert named <= {law.effect, library()[law.effect].family.value}


@pytest.mark.slow
@pytest.mark.parametrize("number", range(1, 13))
def test_a_drawn_strong_effect_has_no_false_name(number: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert run_case("strong", number, tmp_path_factory.mktemp("strong")).false == ()


def _told(*names: tuple[str, str]) -> DiagnosisResult:
    effects = tuple(
        NamedEffect(
            name=name,
            family="spectral_filter",
            law="exact",
            probability=1.0,
            sides=(side,),
            parameters={},
            statement="",
        )
        for name, side in names
    )
    return DiagnosisResult(source="", verdict="explained", effects=effects)


def test_names_are_judged_by_side() -> None:
    right = _judged(_told(*sorted(OF_THE_BENCH)), OF_THE_BENCH, {})
    assert (right.false, right.missing) == ((), ())
    wrong = _judged(_told(("column_noise", "left"), ("defocus", "right")), OF_THE_BENCH, {})
    assert wrong.false == ("defocus (right)",)
    assert "column_noise (right)" in wrong.missing


def test_a_family_stands_for_its_effect() -> None:
    wanted, besides = frozenset({("defocus", "left")}), {"defocus": frozenset({"isotropic_contrast_loss"})}
    run = _judged(_told(("isotropic_contrast_loss", "left")), wanted, besides)
    assert (run.false, run.missing) == ((), ())


def test_the_table_names_every_false_name() -> None:
    runs = {"bench-001": NameRun(case="bench-001"), "healthy-002": NameRun(case="healthy-002", false=("coma (left)",))}
    told = table(runs)
    assert "| bench | 1 of 60 | 0 | 0 | 1 of 1 |" in told
    assert "healthy-002 (healthy): coma (left)." in told
