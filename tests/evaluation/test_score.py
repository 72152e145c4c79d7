"""Scores of made-up results against figures computed by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.blind import BlindProof, confusion, table
from evaluation.case_run import CaseRun
from evaluation.independent_simulator import OUTSIDE
from evaluation.score import BlindScore, Rate, score
from evaluation.truth import CaseTruth, Concealed, Kind, Seals, Truths, canonical, salted, seal
from lab.formats.results import (
    DiagnosisResult,
    EffectSet,
    HeldOut,
    Member,
    NamedEffect,
    ParameterValue,
    Rival,
    SideModels,
)
from sim.effects.families import Family
from sim.effects.library import effects as library


def truth(kind: Kind, *hidden: tuple[str, float], fault: str | None = None, accepts: tuple[str, ...] = ()) -> CaseTruth:
    concealed = tuple(
        Concealed(
            name=name, effect=None if kind == "outside" else name, strength=1.0, noncentrality=size,
            parameters={"size_um": 2.0}
        )
        for name, size in hidden
    )  # fmt: skip
    return CaseTruth(
        kind=kind, concealed=concealed, fault=fault, accepts=accepts, cfa="MONO", f_number=2.8, frames=9, rows=8, cols=8
    )


def named(
    *names: str, rivals: tuple[str, ...] = (), value: float = 2.0, held: tuple[float, float, int] | None = None
) -> DiagnosisResult:
    """Names with probabilities that fall from the first on; the first has the rivals. All names are the one set of
    models."""
    effects = tuple(
        NamedEffect(
            name=name, family=library()[name].family.value, law="exact", probability=0.99 - 0.1 * i, sides=("left",),
            statement="",
            parameters={"size_um": ParameterValue(value=value, std=0.1, unit="um")},
            rivals=tuple(Rival(name=r, probability=0.1) for r in rivals) if i == 0 else (),
        )
        for i, name in enumerate(names)
    )  # fmt: skip
    held_out = HeldOut(captures=(), chi2_before=held[0], chi2_after=held[1], n=held[2]) if held else None
    models = SideModels(side="left", share=0.95, sets=(EffectSet(effects=names, probability=0.97),), inclusion=())
    return DiagnosisResult(
        source="",
        verdict="explained" if effects else "unexplained",
        effects=effects,
        held_out=held_out,
        models=(models,) if names else (),
    )


HEALTHY = DiagnosisResult(source="", verdict="no_mismatch")
CASES: tuple[tuple[CaseTruth, DiagnosisResult | None], ...] = (
    (truth("healthy"), HEALTHY),
    (truth("healthy"), HEALTHY),
    (truth("healthy"), named()),  # a false alarm without a name
    (truth("healthy"), named("defocus")),  # a false name
    (
        truth("single", ("defocus", 80.0)),
        named("defocus", rivals=("crosstalk", "unknown"), held=(300.0, 120.0, 100)),
    ),  # 90 % removed
    (truth("single", ("crosstalk", 60.0)), named("defocus", rivals=("crosstalk",), held=(300.0, 200.0, 100))),  # 50 %
    (truth("single", ("defocus", 55.0)), named()),
    (truth("single", ("defocus", 30.0)), named("defocus", "vignetting", value=2.19)),  # 1.9 sigma
    (truth("single", ("defocus", 5.0)), named("defocus", value=2.21)),  # 2.1 sigma
    (truth("compound", ("defocus", 80.0), ("vignetting", 90.0)), named("vignetting", "defocus")),
    (truth("compound", ("defocus", 80.0), ("vignetting", 20.0)), named("vignetting")),
    (truth("compound", ("defocus", 80.0), ("vignetting", 90.0)), None),  # failed
    (truth("outside", ("smear", 80.0)), named(held=(300.0, 150.0, 100))),  # 75 % removed without a name
    (truth("outside", ("motion", 80.0), accepts=("vibration_blur",)), named("vibration_blur")),
    (truth("outside", ("halo", 80.0)), named("veiling_glare")),
    (truth("outside", fault="stale_frame"), HEALTHY),
)


def scored(broken: tuple[str, ...] = ()) -> BlindScore:
    names = [f"case-{i:04d}" for i in range(1, len(CASES) + 1)]
    kept = {name: salted(t) for name, (t, _) in zip(names, CASES, strict=True)}
    truths = Truths(purpose="tuning", seed=3, size="small", cases=len(CASES), truths=kept)
    runs = {
        name: CaseRun(case=name, wall_s=2.0, cpu_s=float(i), memory_mib=100.0 + i, diagnosis=d,
        error=None if d else "ValueError: x")
        for i, (name, (_, d)) in enumerate(zip(names, CASES, strict=True))
    }  # fmt: skip
    return score(truths, Seals(seals={n: seal(s) for n, s in kept.items()}), runs, broken)


def counts(rate: Rate) -> tuple[int, int]:
    return rate.count, rate.of


def test_a_family_is_no_effect_and_may_be_right() -> None:
    """Two members are listed, neither is named: the family is right, the effect isn't named, and the rival set holds
    both."""
    told = (
        named("defocus")
        .effects[0]
        .model_copy(
            update={
                "name": "isotropic_contrast_loss",
                "members": (Member(name="defocus", probability=0.6), Member(name="charge_diffusion", probability=0.4)),
            }
        )
    )
    kept = {"case-0001": salted(truth("single", ("charge_diffusion", 80.0)))}
    run = CaseRun(
        case="case-0001",
        wall_s=1.0,
        cpu_s=1.0,
        memory_mib=1.0,
        diagnosis=named().model_copy(update={"effects": (told,)}),
    )
    seals = Seals(seals={n: seal(s) for n, s in kept.items()})
    found = score(Truths(purpose="tuning", seed=3, size="small", cases=1, truths=kept), seals, {"case-0001": run})
    one = found.case_scores[0]
    assert (one.right, one.right_family, one.wrong_family) == (False, True, False)
    assert counts(found.rival_sets_cover) == (1, 1)


def test_outside_laws_are_of_families_that_there_are() -> None:
    known = {family.value for family in Family}
    assert all(law.families <= known for law in OUTSIDE)


def test_every_figure_is_the_one_counted_by_hand() -> None:
    found = scored()
    assert [counts(s.top_1) for s in found.singles] == [(1, 3), (1, 1), (1, 1)]
    assert [counts(s.alone) for s in found.singles] == [(1, 3), (0, 1), (1, 1)]
    assert [counts(s.unnamed) for s in found.singles] == [(1, 3), (0, 1), (0, 1)]
    assert counts(found.compounds_both_named) == (1, 3)
    assert counts(found.compounds_one_named) == (2, 3)
    assert counts(found.compounds_strong_both_named) == (1, 2)
    # sets of the named singles: {defocus, crosstalk}, {defocus, crosstalk}, {defocus}, {defocus}
    assert counts(found.rival_sets_cover) == (4, 4)
    assert found.rival_set_mean_size == pytest.approx(1.5)
    # healthy cameras without a name three, singles the first and the last, compounds the first; of the failed case
    # there is none
    assert counts(found.model_sets_hold) == (6, 12)
    assert found.model_sets_mean_size == pytest.approx(11 / 12)
    assert counts(found.false_alarms) == (2, 4)
    assert counts(found.false_names) == (1, 4)
    assert counts(found.outside_not_named) == (3, 4)
    assert counts(found.outside_located) == (3, 3)
    # above 25 and of a family: three singles right of four, one compound of two, motion and halo of the three outside
    assert counts(found.families.right_families) == (5, 9)
    assert counts(found.families.right_effects) == (3, 6)
    assert counts(found.families.wrong_families) == (3, 16)  # healthy, crosstalk, and vignetting beside defocus
    # 2.0, 2.19 and 2.21 of the singles, 2.0 twice of the first compound, 2.0 of the second's one; the interval is 2 +-
    # 0.196
    assert counts(found.parameters_covered) == (5, 6)
    assert found.excess_removed == pytest.approx((0.9 + 0.5) / 2)
    assert found.outside_excess_removed_median == pytest.approx(0.75)
    assert found.cpu_max_s == 15.0
    assert found.memory_max_mib == 115.0
    assert found.failed == {"case-0012": "ValueError: x"}
    assert not found.reached
    by_name = {e.effect: e for e in found.effects}
    assert counts(by_name["defocus"].strong_top_1) == (1, 2)
    assert by_name["crosstalk"].instead == {"defocus": 1}


def test_goals_say_what_was_missed() -> None:
    met = {goal.name: goal.met for goal in scored().goals}
    assert met["seals that hold"] is True
    assert met["cases that ran"] is False
    assert met["top-1 of single effects above 50"] is False
    assert met["rival sets cover the truth"] is True
    assert met["rivals in a set, mean"] is True
    assert met["false names on healthy cameras"] is False
    assert met["memory of a case"] is True


def test_a_broken_seal_counts_nowhere_and_misses() -> None:
    found = scored(broken=("case-0004",))
    assert counts(found.false_names) == (0, 3)
    assert {goal.name: goal.met for goal in found.goals}["seals that hold"] is False


def test_clopper_pearson() -> None:
    """None of 10: 1 - 0.025^(1/10) = 0.3085 above; 1 of 2: symmetric, 1 - sqrt(0.975) = 0.01258 below."""
    none, all_, one = Rate.over([False] * 10), Rate.over([True] * 10), Rate.over([True, False])
    assert (none.low, none.high) == (0.0, pytest.approx(0.30850, abs=1e-5))
    assert (all_.low, all_.high) == (pytest.approx(1 - 0.30850, abs=1e-5), 1.0)
    assert (one.low, one.high) == (pytest.approx(0.01258, abs=1e-5), pytest.approx(1 - 0.01258, abs=1e-5))
    assert Rate.over([]).share is None


def test_the_page_gets_tables_picture_and_seed_once(tmp_path: Path) -> None:
    page = tmp_path / "proof.md"
    page.write_text("# Proof\n\nWords.\n")
    found = scored()
    for _ in range(2):
        BlindProof(tmp_path, ()).outcome(found).write(page)
    text = page.read_text()
    assert text.startswith("# Proof\n\nWords.\n")
    assert text.count(table(found)) == 1
    assert text.count(f"| tuning | 3 | 16 | small | `{found.seals_sha256[:16]}` |") == 1
    assert "(proof-tuning.svg)" in text
    picture = (tmp_path / "proof-tuning.svg").read_text()
    assert picture == confusion(found)
    # defocus above 50: once right, once unexplained; healthy: two right
    assert picture.count(">2</text>") == 1
    assert "veiling glare" in picture


def with_strengths(truth_: CaseTruth, separability: tuple[float, ...], oracle_share: float) -> CaseTruth:
    concealed = tuple(
        one.model_copy(update={"separability": left, "conditional": left, "nearest_rival": "crosstalk"})
        for one, left in zip(truth_.concealed, separability, strict=True)
    )
    return truth_.model_copy(update={"concealed": concealed, "oracle_share": oracle_share})


def fairly_scored() -> BlindScore:
    pair = truth("compound", ("defocus", 80.0), ("vignetting", 90.0))
    cases = (
        (with_strengths(truth("single", ("defocus", 80.0)), (70.0,), 1.0), named("defocus")),
        (with_strengths(truth("single", ("defocus", 80.0)), (60.0,), 0.8), named("crosstalk")),
        (with_strengths(truth("single", ("defocus", 80.0)), (9.0,), 0.3), named()),
        (truth("single", ("defocus", 80.0)), named("defocus")),  # not measured
        (with_strengths(pair, (30.0, 90.0), 0.9), named("defocus", "vignetting")),
        (with_strengths(pair, (80.0, 26.0), 0.7), named("defocus")),
    )
    names = [f"case-{i:04d}" for i in range(1, len(cases) + 1)]
    kept = {name: salted(t) for name, (t, _) in zip(names, cases, strict=True)}
    truths = Truths(purpose="tuning", seed=3, size="small", cases=len(cases), truths=kept)
    runs = {
        name: CaseRun(case=name, wall_s=1.0, cpu_s=1.0, memory_mib=1.0, diagnosis=d)
        for name, (_, d) in zip(names, cases, strict=True)
    }
    return score(truths, Seals(seals={n: seal(s) for n, s in kept.items()}), runs)


def test_every_share_stands_beside_the_oracle_s() -> None:
    found = fairly_scored()
    told = {(f.kind, f.separability): (counts(f.right), f.oracle, f.of_oracle) for f in found.fair}
    assert told == {
        ("single", "above 50"): ((1, 2), pytest.approx(0.9), pytest.approx(0.5 / 0.9)),
        ("single", "25 to 50"): ((0, 0), None, None),
        ("single", "below 25"): ((0, 1), pytest.approx(0.3), 0.0),
        ("compound", "above 50"): ((0, 0), None, None),
        ("compound", "25 to 50"): ((1, 2), pytest.approx(0.8), pytest.approx(0.5 / 0.8)),
        ("compound", "below 25"): ((0, 0), None, None),
    }
    oracle = {goal.name: goal.oracle for goal in found.goals if goal.oracle is not None}
    assert oracle == {
        "top-1 of single effects above 50": pytest.approx(0.7),
        "both members of a compound named": pytest.approx(0.8),
    }


def test_the_page_shows_both_curves(tmp_path: Path) -> None:
    page = tmp_path / "proof.md"
    BlindProof(tmp_path, ()).outcome(fairly_scored()).write(page)
    assert "![Right answers over separability" in page.read_text(encoding="utf-8")
    drawing = (tmp_path / "proof-tuning-oracle.svg").read_text(encoding="utf-8")
    # two panels, each with the oracle's curve and the diagnosis's; a point a class
    assert drawing.count('stroke-width="2"') == 4
    assert drawing.count("<circle") == 3
    BlindProof(tmp_path, ()).outcome(scored()).write(tmp_path / "other.md")
    assert not (tmp_path / "other-tuning-oracle.svg").exists()


def test_seals_from_before_strengths_were_measured_hold() -> None:
    """The sealed text leaves out figures that weren't measured, and holds all that were."""
    plain = truth("single", ("defocus", 80.0))
    assert not {"oracle_share", "separability", "conditional", "nearest_rival"} & set(canonical(plain).split('"'))
    measured = canonical(with_strengths(plain, (70.0,), 0.9))
    assert '"oracle_share":0.9' in measured
    assert '"separability":70.0' in measured
