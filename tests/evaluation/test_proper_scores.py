"""Proper scores of made-up statements against figures computed by hand, and on draws whose probabilities are true."""

from __future__ import annotations

from math import log

import numpy as np
import pytest

from evaluation.case_run import CaseRun
from evaluation.proper_scores import (
    CLIP,
    CaseStatements,
    Statement,
    calibration_error,
    case_statements,
    comparison_table,
    mean_interval,
    reliability,
    wrong_names,
)
from evaluation.truth import CaseTruth, Concealed, Kind
from lab.formats.results import (
    DiagnosisResult,
    EffectSet,
    IncludedEffect,
    NamedEffect,
    SideModels,
    Unlisted,
)
from sim.effects.library import effects as library


def truth(*effects: str, outside: bool = False) -> CaseTruth:
    concealed = tuple(
        Concealed(name=e, effect=None if outside else e, strength=1.0, noncentrality=80.0, separability=60.0)
        for e in effects
    )
    kinds: tuple[Kind, ...] = ("healthy", "single", "compound")
    kind: Kind = "outside" if outside else kinds[len(effects)]
    return CaseTruth(kind=kind, concealed=concealed, cfa="MONO", f_number=2.8, frames=9, rows=8, cols=8)


def run(
    inclusion: dict[str, float], named: tuple[str, ...] = (), unlisted: float | None = None
) -> CaseRun:  # fmt: skip
    """Inclusion probabilities of one side; names have 0.96 each."""
    models = SideModels(
        side="left", share=0.95,
        sets=tuple(EffectSet(effects=(name,), probability=p) for name, p in inclusion.items()),
        inclusion=tuple(IncludedEffect(name=name, probability=p) for name, p in inclusion.items()),
    )  # fmt: skip
    effects = tuple(
        NamedEffect(
            name=name, family=library()[name].family.value, law="exact", probability=0.96, sides=("left",),
            parameters={}, statement="",
        )
        for name in named
    )  # fmt: skip
    told = () if unlisted is None else (Unlisted(side="left", state="transfer", probability=unlisted),)
    result = DiagnosisResult(
        source="", engine="evidence", verdict="unexplained", models=(models,), effects=effects, unlisted=told
    )
    return CaseRun(case="", wall_s=1.0, cpu_s=1.0, memory_mib=1.0, diagnosis=result)


def probability(case: CaseStatements, kind: str, name: str) -> float:
    return next(s.probability for s in case.statements if (s.kind, s.name) == (kind, name))


def test_a_wrong_statement_counts_as_wrong_metadata() -> None:
    """It is no effect of the library: of its family alone is anything said."""
    case = case_statements("case", truth(), run({"wrong_exposure": 0.3}))
    assert probability(case, "family", "wrong_metadata") == 0.3
    assert all(s.probability == 0.0 for s in case.statements if s.kind == "effect")


def test_scores_of_a_single_effect() -> None:
    """0.8 for the one that acts and its family, 0.1 for one of another family and that family, 0 for all others."""
    case = case_statements("case", truth("defocus"), run({"defocus": 0.8, "crosstalk": 0.1}))
    assert probability(case, "effect", "defocus") == probability(case, "family", library()["defocus"].family) == 0.8
    others = len(library()) + len({kind.family for kind in library().values()}) - 4
    assert case.log_score == pytest.approx(2 * log(0.8) + 2 * log(0.9) + others * np.log1p(-CLIP))
    assert case.brier_score == pytest.approx(2 * 0.2**2 + 2 * 0.1**2)
    assert case.group == "single, separability above 50"


def test_the_log_score_of_a_certain_error_is_clipped() -> None:
    case = case_statements("case", truth("defocus"), run({"crosstalk": 1.0}))
    assert case.log_score == pytest.approx(4 * log(CLIP), rel=1e-3)  # two effects and two families, each wrong


def test_a_name_has_its_own_probability() -> None:
    case = case_statements("case", truth("defocus"), run({"defocus": 0.999}, named=("defocus",)))
    assert probability(case, "effect", "defocus") == 0.96
    assert case.wrong == ()
    assert case_statements("case", truth("crosstalk"), run({}, named=("defocus",))).wrong == ("defocus",)


def test_a_failed_case_says_nothing() -> None:
    failed = CaseRun(case="", wall_s=1.0, cpu_s=1.0, memory_mib=1.0, error="ValueError")
    case = case_statements("case", truth("defocus"), failed)
    assert case.log_score == pytest.approx(2 * log(CLIP), rel=1e-2)


def test_unlisted_physics_is_true_of_strong_laws_outside_the_list() -> None:
    for law, is_true in ((truth("a law", outside=True), True), (truth(), False)):
        case = case_statements("case", law, run({}, unlisted=0.7))
        assert [s for s in case.statements if s.kind == "unlisted"] == [Statement("unlisted", "any", 0.7, is_true)]


def test_wrong_names_are_compared_with_what_their_probabilities_promise() -> None:
    cases = [
        case_statements("a", truth("defocus"), run({}, named=("defocus",))),
        case_statements("b", truth(), run({}, named=("crosstalk",))),
    ]
    count, promised, std = wrong_names(cases)
    assert count == 1
    assert promised == pytest.approx(2 * 0.04)
    assert std == pytest.approx(np.sqrt(2 * 0.96 * 0.04))


@pytest.mark.parametrize(("true_power", "low", "high"), [(1.0, 0.0, 0.03), (3.0, 0.15, 0.4)])
def test_the_calibration_error_is_that_of_the_probabilities(true_power: float, low: float, high: float) -> None:
    """Statements of p that are true with probability p: the error of 4,000 is below 0.03 (of some 600 a bin, each errs
    by 0.02 in its mean, 0.015 on average). True with p^3 only: the mean of p - p^3 over 0.05..1 is 0.25."""
    rng = np.random.default_rng(3)
    cases = []
    for number in range(1000):
        p = rng.uniform(0.05, 1.0, 4)
        y = rng.random(4) < p**true_power
        statements = tuple(Statement("effect", str(k), float(p[k]), bool(y[k])) for k in range(4))
        cases.append(CaseStatements(str(number), "healthy", statements, (), ()))
    error = calibration_error(cases, "effect")
    assert low <= error.value <= high
    assert error.low <= error.high
    assert sum(b.n for b in reliability(cases, "effect")) == 4000


def test_the_interval_of_a_mean_holds_it_in_95_percent() -> None:
    """200 means of 50 normal numbers: 95 % +- 3 sqrt(0.95 0.05 / 200) = 4.6 %."""
    rng = np.random.default_rng(5)
    held = [(i.low <= 0.0 <= i.high) for i in (mean_interval(rng.normal(size=50).tolist()) for _ in range(200))]
    assert abs(np.mean(held) - 0.95) < 0.046 + 0.01  # a bootstrap of 50 holds 1 % less


def test_the_table_compares_engines_in_pairs() -> None:
    engines = {
        "today": [case_statements("a", truth("defocus"), run({"defocus": 0.5}))],
        "evidence": [case_statements("a", truth("defocus"), run({"defocus": 1.0}, unlisted=0.2))],
    }
    text = comparison_table(engines)
    gain = 2 * (np.log1p(-CLIP) - log(0.5))  # of the effect and of its family
    assert "| all (few) | 1 | " in text and f"{gain:+.2f}" in text
    assert "| evidence | unlisted |" in text
