"""The proof of discovery: what shows along a law's axes, what is dealt, what counts, and that truths stay shut."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import evaluation.sealed
import evaluation.truth
from evaluation.__main__ import main
from evaluation.case_run import CaseRun
from evaluation.draw_unlisted import BLOCK, TARGETS, concealed_in, draw_unlisted, separability_along, sized, target_of
from evaluation.independent_simulator import (
    LISTED,
    OUTSIDE,
    UNLISTED,
    ConcealedCamera,
    DrawnSession,
    Law,
    Plan,
    UnlistedLaw,
    record,
)
from evaluation.truth import CaseTruth, Concealed, Kind, Seals, Truths, load, salted, seal
from evaluation.unlisted import (
    UnlistedProof,
    UnlistedScore,
    axes_of,
    axis_is_right,
    drawing,
    removed,
    score,
    stage_is_right,
    table,
)
from lab.errors import InputError
from lab.formats.results import DiagnosisResult, DiscoveredLaw, HeldOut, NamedEffect
from sim.effects.library import effects as library

LAW = {law.name: law for law in UNLISTED}
LISTED_LAW = {law.name: law for law in LISTED}
ROWS, COLS = 96, 128
PLAN = Plan(kinds=("dark", "flat", "narrowband"))
QUICK = Plan(kinds=("dark", "flat"))


# --- what shows along the axes ----------------------------------------------------------------------------------------


def bare(cfa: str = "MONO") -> ConcealedCamera:
    return ConcealedCamera(31, cfa=cfa, rows=ROWS, cols=COLS)


def shown(law: UnlistedLaw, *instead: Law, cfa: str = "MONO", plan: Plan = PLAN) -> float:
    """The separability along the law's axes of recordings with it, or with others in its place."""

    def session(noise_draw: int, *present: Law) -> DrawnSession:
        return record(ConcealedCamera(31, present, cfa=cfa, rows=ROWS, cols=COLS, noise_draw=noise_draw), plan)

    return separability_along(law, bare(cfa), [(session(k, *(instead or (law,))), session(k)) for k in (0, 1)])


def test_offsets_of_banks_beside_noise_and_fixed_patterns() -> None:
    """Sum over banks of offset^2 times 1' C^-1 1, C of the settings: shot and read noise by setting, fixed patterns in
    common; the banks' mean is free and 0."""
    law, camera = LAW["row_banks"](0.5, 0, 5), bare()
    levels = (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8, 0.92)
    share = camera.quantum_efficiency["Y"].sum() / camera.stated_efficiency["Y"].sum() * float(camera.shading.mean())
    lit = np.array([0.0, 0.0, 0.0, *(level * share * camera.full_well_e for level in levels)]) * camera.gain_dn_per_e
    dark = camera.gain_dn_per_e * camera.dark_e_per_s * np.array([0.001, 0.5, 2.0, *[0.0] * len(levels)])
    signal = lit + dark
    noise = camera.gain_dn_per_e * signal + (camera.gain_dn_per_e * camera.read_noise_e) ** 2 + 1.0 / 12.0
    pixels = ROWS * COLS / 8
    covariance = np.diag(noise / 3 / pixels)
    covariance += (camera.prnu_percent / 100.0) ** 2 * np.outer(lit, lit) / pixels
    covariance += (camera.gain_dn_per_e * camera.dsnu_e) ** 2 / pixels
    one = np.ones(len(signal))
    expected = np.sum(np.square(0.5 * law.balanced(8))) * float(one @ np.linalg.solve(covariance, one))
    # the curves' shapes differ a little from the stated ones, by which exposures are chosen: 5 %
    assert shown(law) == pytest.approx(expected, rel=0.05)


def test_noise_of_odd_columns() -> None:
    """The two variances differ by D = (K a)^2, known to 4 v^2 / (n (repeats - 1)), n pixels of each kind."""
    law, camera = LAW["bank_noise"](3.0, 0, 5), bare()
    gain = camera.gain_dn_per_e
    dark = gain**2 * (camera.read_noise_e**2 + camera.dark_e_per_s * np.array([0.001, 0.5, 2.0])) + 1.0 / 12.0
    pixels = ROWS * COLS / 2
    expected = np.sum((9.0 * gain**2) ** 2 / (4.0 * dark**2 / (pixels * 2)))
    # flats add little; the sample variance of the law's own noise is known to 2 sqrt(2 / n) with the camera's
    assert shown(law) == pytest.approx(expected, rel=0.15)


def test_widths_of_codes_beside_their_parity() -> None:
    """Sum of n (w - 1)^2 over residues, n pixels of each, without what repeats every two codes."""
    law, camera = LAW["ring_codes"](0.1, 0, 5), bare()
    frames = record(camera, PLAN)
    lit = sum(frames.frames[c["frame"]].size for c in frames.manifest["captures"] if c["kind"] != "dark")
    away = 0.1 * law.balanced(10)
    away -= np.tile([away[::2].mean(), away[1::2].mean()], 5)
    # thousands of pixels a residue: 1.5 % of n; frames of low level lie within few codes
    assert shown(law) == pytest.approx(lit / 10 * np.sum(away**2), rel=0.1)


@pytest.mark.parametrize(("name", "cfa"), [("reset_settling", "RGGB"), ("charge_pocket", "MONO")])
def test_what_a_listed_effect_does_along_the_same_axis_is_not_counted(name: str, cfa: str) -> None:
    law = LAW[name](3.0, 0, 5)
    strong = shown(LAW[name](30.0, 0, 5), cfa=cfa)
    for other, strength in (
        ("black_level_drift", 0.3),
        ("source_drift", 0.5),
        ("exposure_offset", 3.0),
        ("nonlinearity", 3.0),
    ):
        assert shown(law, LISTED_LAW[other](strength, 0, 5), cfa=cfa) < 0.02 * strong, other


@pytest.mark.parametrize("law", UNLISTED, ids=lambda law: law.name)
def test_every_law_shows_by_the_power_that_it_states(law: type[UnlistedLaw]) -> None:
    """Twice the strength, 4 or 16 times the separability: rounding leaves 30 %."""
    cfa = "RGGB" if law.needs == "bayer" else "MONO"
    plan = PLAN if "narrowband" in law.shown_by else QUICK
    one, target = sized(law(law.nominal, 0, 3), lambda some: shown(some, cfa=cfa, plan=plan), 400.0)
    assert target == pytest.approx(400.0, rel=0.31)
    twice = shown(law(2.0 * one.strength, 0, 3), cfa=cfa, plan=plan)
    assert twice / target == pytest.approx(4.0**law.power, rel=0.3 * law.power)


# --- what is dealt ----------------------------------------------------------------------------------------------------


def test_each_block_holds_every_law_once_and_as_many_healthy_cameras() -> None:
    beside = []
    for block in range(5):
        dealt = [concealed_in(77, block * BLOCK + i) for i in range(1, BLOCK + 1)]
        assert sorted(law.name for law, _ in dealt if law is not None) == sorted(LAW)
        assert len(dealt) == 40
        with_another = [law.name for law, other in dealt if law is not None and other]
        assert len(with_another) == 4
        beside += with_another
    assert sorted(beside) == sorted(LAW)
    assert concealed_in(77, 3) != concealed_in(78, 3) or concealed_in(77, 4) != concealed_in(78, 4)


def test_a_law_s_targets_are_spread_over_the_range() -> None:
    by_law: dict[str, list[float]] = {}
    for index in range(1, 5 * BLOCK + 1):
        law, _ = concealed_in(77, index)
        if law is not None:
            by_law.setdefault(law.name, []).append(target_of(77, index))
    for targets in by_law.values():
        share = np.sort(np.log(np.array(targets) / TARGETS[0]) / np.log(TARGETS[1] / TARGETS[0]))
        assert share.min() >= 0.0
        assert share.max() <= 1.0
        # five steps of the golden ratio leave no gap above 0.382 on the circle (Steinhaus)
        assert np.diff(np.append(share, share[0] + 1.0)).max() < 0.39


def test_a_case_has_the_separability_that_it_is_drawn_for() -> None:
    index = next(i for i in range(1, BLOCK + 1) if concealed_in(5, i) == (LAW["row_banks"], False))
    case = draw_unlisted(5, index, "small")
    (hidden,) = case.truth.concealed
    assert (hidden.name, hidden.effect, case.truth.kind) == ("row_banks", None, "outside")
    assert hidden.separability == pytest.approx(target_of(5, index), rel=0.31)


def test_the_same_arguments_give_the_same_case() -> None:
    index = next(i for i in range(1, BLOCK + 1) if concealed_in(5, i) == (None, False))
    one, two = (draw_unlisted(5, index, "small") for _ in range(2))
    assert one.truth == two.truth
    last = one.recordings.manifest.captures[-1]
    assert np.array_equal(one.recordings.frame(last), two.recordings.frame(last))


def test_a_strength_is_found_in_a_few_rounds_within_its_limits() -> None:
    law = LAW["row_banks"]
    one, size = sized(law(1.0), lambda some: 3.0 * some.strength**2, 300.0)
    assert (one.strength, size) == (pytest.approx(10.0), pytest.approx(300.0))
    # steps of a factor of 10 at most, and as many as are allowed
    assert sized(law(0.01), lambda some: some.strength**2, 1e4, 1)[0].strength == pytest.approx(0.1)
    assert sized(law(1.0), lambda some: some.strength**2, 1e6)[0].strength == law.limits[1]


def test_a_size_without_one_frame_is_refused() -> None:
    with pytest.raises(InputError, match="foreign"):
        draw_unlisted(5, 1, "foreign")


# --- what counts ------------------------------------------------------------------------------------------------------


def told(
    stage: str, along: str, period: int = 0, chi2: tuple[float, float, int] = (100.0, 100.0, 100)
) -> DiscoveredLaw:
    return DiscoveredLaw(
        side="left",
        stage=stage,
        along=along,
        period=period,
        table=(0.0,),
        shown_period=period,
        shown_departure=(0.0,),
        shown_std=(0.1,),
        chi2_before=chi2[0],
        chi2_after=chi2[1],
        n=chi2[2],
        own_chi2_before=chi2[0],
        own_chi2_after=chi2[1],
        own_n=chi2[2],
        suspects="",
        statement="",
    )


def result(
    *discovered: DiscoveredLaw, named: tuple[str, ...] = (), held: tuple[float, float, int] | None = None
) -> DiagnosisResult:
    effects = tuple(
        NamedEffect(
            name=name,
            family=library()[name].family.value,
            law="exact",
            probability=0.9,
            sides=("left",),
            parameters={},
            statement="",
        )
        for name in named
    )
    return DiagnosisResult(
        source="",
        verdict="unexplained" if discovered or named else "no_mismatch",
        discovered=discovered,
        effects=effects,
        held_out=HeldOut(captures=(), chi2_before=held[0], chi2_after=held[1], n=held[2]) if held else None,
    )


def truth(law: str | None = None, separability: float = 80.0, beside: str | None = None) -> CaseTruth:
    hidden = [] if law is None else [Concealed(name=law, strength=1.0, noncentrality=7.0, separability=separability)]
    if beside is not None:
        hidden.append(Concealed(name=beside, effect=beside, strength=1.0, noncentrality=300.0))
    kind: Kind = "healthy" if not hidden else "outside" if len(hidden) == 1 else "compound"
    return CaseTruth(kind=kind, concealed=tuple(hidden), cfa="MONO", f_number=2.8, frames=9, rows=8, cols=8)


CASES: tuple[tuple[CaseTruth, DiagnosisResult | None], ...] = (
    (truth(), result()),
    (truth(), result(told("signal", "row", 8))),  # a discovery on a healthy camera
    # right, 90 % removed
    (truth("row_banks"), result(told("signal", "row", 8), held=(300.0, 120.0, 100))),
    # right by column and period 8 of 4: the axis, not the period; 50 % removed along it, as nothing held out has an
    # excess
    (truth("column_amplifiers"), result(told("charge", "column", 8, (300.0, 200.0, 100)), held=(110.0, 100.0, 100))),
    # the axis, at another stage; what is there wasn't found: 0 %
    (truth("ring_codes", 60.0), result(told("signal", "code", 10))),
    (truth("saddle_shading", 55.0), result(named=("vignetting",))),  # a wrong name
    (truth("mid_level_noise", 30.0), result()),  # weak, nothing told
    (truth("shared_cell", 30.0), result(told("charge", "row and column", 4))),
    (truth("wide_carries", 20.0, beside="defocus"), result(told("codes", "code", 64), named=("defocus",))),
    (truth("warm_centre", 90.0, beside="defocus"), None),  # failed
)


def scored(broken: tuple[str, ...] = ()) -> UnlistedScore:
    names = [f"case-{i:04d}" for i in range(1, len(CASES) + 1)]
    kept = {name: salted(one) for name, (one, _) in zip(names, CASES, strict=True)}
    truths = Truths(purpose="tuning", seed=3, size="small", cases=len(CASES), laws="unlisted", truths=kept)
    runs = {
        name: CaseRun(
            case=name, wall_s=2.0, cpu_s=3.0, memory_mib=100.0, diagnosis=said, error=None if said else "ValueError: x"
        )
        for name, (_, said) in zip(names, CASES, strict=True)
    }
    return score(truths, Seals(seals={n: seal(s) for n, s in kept.items()}), runs, broken)


def test_the_sums_of_made_up_results() -> None:
    found = scored()
    strong, middle, weak = found.classes
    assert (strong.separability, strong.axis_right.count, strong.right.count, strong.right.of) == ("above 50", 3, 2, 5)
    assert (middle.axis_right.count, middle.right.count, middle.right.of) == (1, 1, 2)
    assert (weak.right.count, weak.right.of) == (1, 1)
    # 0.9, 0.5, 0, 0 and the failed one, 0
    assert found.excess_removed == pytest.approx((0.9 + 0.5) / 5.0)
    reached = {goal.name: (goal.reached, goal.met) for goal in found.goals}
    assert reached["axis and stage right above a separability of 50"] == ("2 of 5: 40.0 % (5.3..85.3)", False)
    assert reached["no listed name for an unlisted law"] == ("7 of 8: 87.5 % (47.3..99.7)", False)
    assert reached["healthy cameras with a discovery"][0].startswith("1 of 2")
    assert reached["cases that ran"] == ("9 of 10", False)
    # rows mod 8, ring codes, shared cell and carries have their periods
    assert (found.periods.count, found.periods.of) == (4, 5)
    assert (found.beside_named.count, found.beside_named.of) == (1, 2)
    assert not found.reached
    by_law = {law.law: law for law in found.laws}
    assert by_law["saddle_shading"].instead == {"vignetting": 1}
    assert by_law["ring_codes"].instead == {"signal by code mod 10": 1}
    assert (by_law["ring_codes"].axis_right.count, by_law["ring_codes"].right.count) == (1, 0)
    assert by_law["shared_cell"].axes == "row mod 2 x column mod 4"


def test_broken_seals_are_left_out() -> None:
    found = scored(broken=("case-0003",))
    assert (found.cases, found.classes[0].right.of) == (9, 4)
    assert found.goals[0].met is False


def test_axes_by_the_words_of_a_result() -> None:
    """Every index that a discovered law may have is one word, or two of which both count."""
    for along in get_args(library()["empirical_law"].model_fields["along"].annotation):
        assert axes_of(along) in ({along}, {"row", "column", "place"}, set(along.split(" x ")))
    assert axes_of("column x level") == {"column", "level"}


@pytest.mark.parametrize(
    ("law", "along", "right"),
    [
        ("row_banks", "row", True),
        ("row_banks", "column", False),
        ("row_banks", "row x level", False),  # an axis too many
        ("bent_columns", "column", False),  # one too few
        ("bent_columns", "level x column", True),
        ("warm_centre", "radius", True),
        ("warm_centre", "radius x exposure", True),
        ("warm_centre", "exposure", False),
        ("saddle_shading", "place", True),
        ("warming_noise", "time", False),  # of the mean
        ("warm_centre", "row and column", True),
        ("saddle_shading", "row and column", True),
        ("saddle_shading", "row", False),
        ("shared_cell", "row and column", True),
        ("shared_cell", "column", False),
        ("reddening_lamp", "plane x time", True),
        ("reddening_lamp", "time", False),
    ],
)
def test_which_axes_are_right(law: str, along: str, right: bool) -> None:
    assert axis_is_right(LAW[law], told("signal", along)) is right


def test_a_law_of_noise_is_told_as_one() -> None:
    of_means = told("signal", "time")
    of_noise = of_means.model_copy(update={"of": "variance"})
    assert axis_is_right(LAW["warming_noise"], of_noise)
    assert not axis_is_right(LAW["warming_noise"], of_means)
    assert not axis_is_right(LAW["row_banks"], told("signal", "row").model_copy(update={"of": "variance"}))


def test_held_out_chi2_is_that_with_the_discovered_laws() -> None:
    found = result(held=(300.0, 300.0, 100))
    assert removed(found, (), True) == 0.0
    assert found.held_out is not None
    held = found.held_out.model_copy(update={"chi2_discovered": 140.0})
    assert removed(found.model_copy(update={"held_out": held}), (), True) == pytest.approx(0.8)
    # nothing held out has an excess of 3 sqrt(2 n): what isn't told wasn't found, if it is strong
    assert removed(result(held=(140.0, 140.0, 100)), (), True) == 0.0
    assert removed(result(held=(140.0, 140.0, 100)), (), False) is None


def test_stages_that_recordings_tell_apart_count() -> None:
    assert stage_is_right(LAW["wavy_columns"], told("light", "column"))
    assert stage_is_right(LAW["wavy_columns"], told("charge", "column"))
    assert not stage_is_right(LAW["row_banks"], told("charge", "row"))
    assert not stage_is_right(LAW["ring_codes"], told("signal", "code"))


def test_the_page_has_a_line_and_a_dot_for_each_case(tmp_path: Path) -> None:
    found, page = scored(), tmp_path / "proof-unlisted.md"
    words = table(found)
    for law in UNLISTED:
        assert f"| {law.name} | {law.stage} |" in words
    picture = drawing(found)
    # eight laws, five colours of the legend
    assert picture.count("<circle") == 8 + 5
    page.write_text("# Proof of discovery\n\nBefore.\n", encoding="utf-8")
    UnlistedProof(tmp_path, ()).outcome(found).write(page)
    first = page.read_text(encoding="utf-8")
    UnlistedProof(tmp_path, ()).outcome(found).write(page)
    assert page.read_text(encoding="utf-8") == first
    assert "Before." in first
    assert "(proof-unlisted-tuning.svg)" in first
    assert f"| tuning | 3 | 10 | small | `{found.seals_sha256[:16]}` |" in first
    assert (tmp_path / "proof-unlisted-tuning.svg").read_text(encoding="utf-8") == picture


def test_the_page_lists_the_laws_as_they_declare_themselves() -> None:
    page = (Path(__file__).parents[2] / "docs" / "proof-unlisted.md").read_text(encoding="utf-8")
    for law in scored().laws:
        assert f"| `{law.law}` | {law.stage} | {law.axes} | " in page


# --- truths stay shut -------------------------------------------------------------------------------------------------

#: Two cases of which the second conceals a law that is quick to size.
SEED = next(s for s in range(2000) if concealed_in(s, 1)[0] is None and concealed_in(s, 2) == (LAW["row_banks"], False))


def test_a_sealed_set_is_made_diagnosed_and_only_then_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, truths = tmp_path / "sets", tmp_path / "truths.json"
    words = [
        "--unlisted",
        "--cases",
        "2",
        "--seed",
        str(SEED),
        "--truths",
        str(truths),
        "--size",
        "small",
        "--jobs",
        "1",
    ]
    assert main(["make", "--out", str(folder), *words]) == 0
    opened = load(Truths, truths)
    assert (opened.laws, opened.purpose) == ("unlisted", "tuning")
    assert truths.stat().st_mode & 0o777 == 0o600
    names = {law.name for law in (*LISTED, *OUTSIDE, *UNLISTED)}
    names |= {"unlisted", "healthy", "outside", "compound", "seed", "salt", "truth", "separability", "axis"}
    for path in folder.rglob("*"):
        if path.suffix in {".json", ".csv"}:
            assert not [name for name in names if name in path.read_text(encoding="utf-8")], path
    assert len(json.loads((folder / "seals.json").read_text())["seals"]) == 2
    # made again: nothing is drawn anew
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert main(["make", "--out", str(folder), *words]) == 0
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    # cases of another kind can't go on there
    assert main(["make", "--out", str(folder), *words[1:]]) != 0

    away = truths.rename(tmp_path / "away.json")
    said = {"case-0001": result(), "case-0002": result(told("signal", "row", 8), held=(300.0, 120.0, 100))}

    def diagnosed(case: Path, policy: object, engine: str) -> CaseRun:
        assert case.parent == folder
        assert not truths.exists()  # the diagnosis can do without
        if case.name == "case-0002":  # the last
            away.rename(truths)
        return CaseRun(case=case.name, wall_s=1.0, cpu_s=1.0, memory_mib=1.0, diagnosis=said[case.name])

    monkeypatch.setattr(evaluation.sealed, "run_case", diagnosed)
    scores = tmp_path / "score.json"
    main(
        [
            "score",
            str(folder),
            "--truths",
            str(truths),
            "--json",
            str(scores),
            "--page",
            str(tmp_path / "p.md"),
            "--jobs",
            "1",
        ]
    )
    found = load(UnlistedScore, scores)
    assert found.broken_seals == ()
    healthy, hidden = found.case_scores
    assert (healthy.law, hidden.law, hidden.right, hidden.excess_removed) == (
        None,
        "row_banks",
        True,
        pytest.approx(0.9),
    )
    assert "row_banks" in (tmp_path / "p.md").read_text(encoding="utf-8")


def test_rules_are_not_calibrated_on_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evaluation.truth.store(Seals(), tmp_path / "seals.json")
    evaluation.truth.store(
        Truths(purpose="tuning", seed=3, size="small", cases=0, laws="unlisted"), tmp_path / "truths.json"
    )
    asked = ["calibrate", str(tmp_path), "--truths", str(tmp_path / "truths.json"), "--each"]
    assert main(asked) != 0
    assert "laws that no list has" in capsys.readouterr().err
