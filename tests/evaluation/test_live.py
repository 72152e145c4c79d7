"""The parts of the live proof, and three randomly drawn cases of it, over the wire; the seed is drawn from the commit
and the date."""

from __future__ import annotations

import os
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from evaluation.live import (
    HEALTHY_SEEDS,
    NOT_SHOWN_BY_BENCH,
    PAIRS,
    RATIO,
    SIZES,
    IsotropicProof,
    LiveCase,
    LiveProof,
    LiveRun,
    drawing,
    drawn,
    every_case,
    isotropic_cases,
    isotropic_table,
    judged,
    run_case,
    summary,
    table,
    typical_spec,
)
from evaluation.truth import store
from lab.formats.results import DiagnosisResult, NamedEffect, ParameterValue, Rival
from mocks.conceal import NOT_SHOWN, parse
from sim.camera import Side
from sim.effects.library import effects as library
from sim.effects.library import typical

pytestmark = pytest.mark.extra  # whole sessions of the mock bench


@pytest.mark.slow
def test_a_weak_blur_is_settled_over_the_wire(tmp_path: Path) -> None:
    """Screens alone leave the low-pass filter and charge diffusion; edges in light of one wavelength don't."""
    run = run_case(isotropic_cases()["isotropic-charge_diffusion-1"], tmp_path / "session")
    assert run.outcome == "named", run.error
    assert run.stages[0].rivals
    assert run.resolve_end == "settled"
    assert run.stages[-1].named == ("charge_diffusion",)
    assert run.stages[-1].rivals == ()
    assert 1 <= len(run.captures) <= 3
    assert "| 0 | 0 of 1 |" in isotropic_table({run.case.name: run})


def day_seed() -> int:
    """Another one every commit and every day; `CALIBENCH_SEED` repeats one."""
    if "CALIBENCH_SEED" in os.environ:
        return int(os.environ["CALIBENCH_SEED"])
    there = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return (int((there.stdout.strip() or "0")[:12], 16) + int(datetime.now(UTC).strftime("%Y%m%d"))) % 10**9


def result(verdict: str, *effects: tuple[str, tuple[Side, ...], dict[str, float], tuple[str, ...]]) -> DiagnosisResult:
    named = [
        NamedEffect(
            name=name,
            family="",
            law="exact",
            probability=0.9,
            sides=sides,
            parameters={key: ParameterValue(value=value, std=0.1, unit="um") for key, value in values.items()},
            rivals=tuple(Rival(name=rival, probability=0.1) for rival in rivals),
            statement="",
        )
        for name, sides, values, rivals in effects
    ]
    return DiagnosisResult(source="test", verdict=verdict, effects=tuple(named))  # type: ignore[arg-type]


def test_every_effect_that_the_bench_shows_has_a_case() -> None:
    shown = set(library()) - set(NOT_SHOWN)
    assert set(NOT_SHOWN) == NOT_SHOWN_BY_BENCH
    assert set(SIZES) <= shown <= set(every_case())
    assert len(PAIRS) == 10
    assert len(HEALTHY_SEEDS) == 6
    assert len(set(every_case())) == len(shown) + 10 + 6 + 3


@pytest.mark.parametrize("effect", sorted(set(library()) - set(NOT_SHOWN)))
def test_the_bench_takes_every_effect_at_its_typical_size(effect: str) -> None:
    """Effects that `SIZES` doesn't list are concealed at their typical size."""
    concealed = parse([typical_spec(effect)])
    assert concealed["left"] == (typical(library()[effect]),)


@pytest.mark.parametrize("case", every_case().values(), ids=lambda case: case.name)
def test_the_bench_takes_every_case(case: LiveCase) -> None:
    concealed = parse(case.concealed)
    assert {effect.name for effects in concealed.values() for effect in effects} == set(case.effects)


@pytest.mark.parametrize(
    ("found", "outcome"),
    [
        (result("explained", ("defocus", ("left",), {"defocus_um": 21.0}, ())), "named"),
        (result("no_mismatch"), "not named"),
        (result("explained", ("coma", ("left",), {}, ())), "wrong name"),
        (result("explained", ("coma", ("left",), {}, ("defocus",))), "among rivals"),
        (result("explained", ("defocus", ("left", "right"), {}, ())), "wrong name"),
        (result("explained", ("defocus", ("left",), {}, ()), ("coma", ("right",), {}, ())), "wrong name"),
    ],
)
def test_a_diagnosis_is_judged(found: DiagnosisResult, outcome: str) -> None:
    run = judged(every_case()["defocus"], found)
    assert run.outcome == outcome
    assert [p.truth for p in run.parameters] == ([22.0] if found.effects and found.effects[0].parameters else [])


@pytest.mark.parametrize(
    ("rivals", "sides", "outcome"),
    [
        (("vibration_blur",), ("right",), "among rivals"),  # one camera tells the effect, the other its rival
        ((), ("right",), "wrong name"),
        (("coma",), ("right",), "wrong name"),
        (("vibration_blur",), ("left", "right"), "wrong name"),  # a second name beside the effect
    ],
)
def test_each_side_of_an_effect_on_both_is_judged(
    rivals: tuple[str, ...], sides: tuple[Side, ...], outcome: str
) -> None:
    found = result("explained", ("optical_low_pass_filter", ("left",), {}, rivals), ("vibration_blur", sides, {}, ()))
    assert judged(every_case()["vibration_blur"], found).outcome == outcome


def test_a_healthy_camera_is_right_without_a_name() -> None:
    case = every_case()["healthy-11"]
    assert judged(case, result("no_mismatch")).outcome == "healthy"
    assert judged(case, result("unexplained")).outcome == "not named"
    assert judged(case, result("explained", ("coma", ("left",), {}, ()))).outcome == "wrong name"


def test_results_that_are_there_are_not_run_again(tmp_path: Path) -> None:
    case = every_case()["defocus"]
    kept = judged(case, result("explained", ("defocus", ("left",), {"defocus_um": 21.0}, ())))
    store(kept, tmp_path / "results" / "defocus.json")
    proof = LiveProof()
    runs = proof.run(tmp_path, ["defocus"])
    assert runs == {"defocus": kept}
    for _ in range(2):
        proof.prove(tmp_path, ["defocus"], tmp_path / "page.md")
    text = (tmp_path / "page.md").read_text()
    assert text.count("| defocus defocus_um=22 | named | defocus (left) |") == 1
    assert "defocus_um 21 ± 0.1 um, 22" in table(runs)
    assert drawing(runs).count("<circle") == 1
    assert (tmp_path / "page-live.svg").is_file()
    assert "Run at commit unknown." in text
    others = {name: kept.model_copy(update={"commit": "1234567"}) for name in ("coma", "ghost")}
    assert "Run at commit 1234567, except:\n- unknown: defocus" in summary(runs | others)


def test_the_isotropic_cases_that_have_run_go_into_the_page(tmp_path: Path) -> None:
    """Each with what stood before and after its captures; the rest of the page stays."""
    found = result("explained", ("defocus", ("left",), {"defocus_um": 6.0}, ()))
    cases = isotropic_cases()
    assert len(cases) == 40
    for name in list(cases)[:3]:  # of three effects
        run = judged(cases[name], found).model_copy(update={"commit": "abcdef0"})
        store(run, tmp_path / "results" / f"{name}.json")
    page = tmp_path / "page.md"
    page.write_text("# Proof\n")
    for _ in range(2):
        IsotropicProof().prove(tmp_path, list(cases)[:1], page)
    text = page.read_text()
    assert text.startswith("# Proof\n") and text.count("3 of 40 cases run.") == 1
    assert "Run at commit abcdef0." in text
    assert "| 0 | 1 of 3 | 0 of 3 | 2 of 3 | 0 of 3 | 0 |" in text


@pytest.mark.parametrize("case", isotropic_cases().values(), ids=lambda case: case.name)
def test_the_bench_takes_every_isotropic_case(case: LiveCase) -> None:
    concealed = parse(case.concealed)
    assert [effect.name for effect in concealed["left"]] == [case.effects[0]]


def test_a_size_with_an_interval_is_drawn_and_told_with_it() -> None:
    """A size without a standard deviation isn't an exact one: 21 in 20 to 27 um beside 22 um is a line from 20/22 to
    27/22."""
    case = every_case()["defocus"]
    found = result("explained", ("defocus", ("left",), {"defocus_um": 21.0}, ()))
    (effect,) = found.effects
    size = effect.parameters["defocus_um"].model_copy(update={"std": None, "interval": (20.0, 27.0)})
    told = effect.model_copy(update={"parameters": {"defocus_um": size}})
    runs = {"defocus": judged(case, found.model_copy(update={"effects": (told,)}))}
    assert "defocus_um 21 (20 to 27) um, 22" in table(runs)
    start, end = RATIO.x_px(20.0 / 22.0), RATIO.x_px(27.0 / 22.0)
    assert f"M{start:.1f} " in drawing(runs) and f"H{end:.1f}" in drawing(runs)


def test_a_bench_that_refuses_is_a_failed_case(tmp_path: Path) -> None:
    run = run_case(LiveCase(name="none", concealed=("left:frobnication:x=1",)), tmp_path / "none")
    assert run.outcome == "failed"
    assert "no effect named" in (run.error or "")


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("index", range(3))
def test_one_of_the_day_gets_no_wrong_name(index: int, tmp_path: Path) -> None:
    """Three randomly drawn cases of typical size: the concealed effect is named, or no effect is."""
    seed = day_seed()
    case = drawn(seed)[index]
    run: LiveRun = run_case(case, tmp_path / case.name)
    told = f"CALIBENCH_SEED={seed}: {case.name}: {run.outcome} {run.named} {run.error}"
    print(told)
    assert run.outcome not in ("wrong name", "failed"), told
