"""A dozen concealed cases with a new seed, drawn from the commit and the date; CALIBENCH_SEED repeats it.

The assertions hold for any seed with a probability above 99.9 %, by the binomial limits given beside them. They are
weaker than the goals of the proof, which a dozen cases can't judge.
"""

from __future__ import annotations

import os
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest

from evaluation.draw import Case, draw
from evaluation.independent_simulator import Law
from evaluation.independent_simulator.laws import (
    AbsorptionBandLaw,
    DustShadowLaw,
    InfraredCutFilterLaw,
    LampJumpLaw,
    NonlinearityLaw,
    OpticalLowPassFilterLaw,
    RowNoiseLaw,
    TreeRingsLaw,
)
from evaluation.truth import FIRST_FRESH_SEED, CaseTruth, Kind, SaltedTruth, canonical, purpose_of, salted, seal
from lab.diagnose import diagnose
from lab.formats.results import DiagnosisResult

#: Laws whose nominal strength is far above what small frames need, whatever the variant.
PLAIN: tuple[type[Law], ...] = (OpticalLowPassFilterLaw, InfraredCutFilterLaw, NonlinearityLaw, RowNoiseLaw)
#: Of the kinds that no list names, some that are soon diagnosed.
STRANGE: tuple[type[Law], ...] = (
    AbsorptionBandLaw,
    DustShadowLaw,
    LampJumpLaw,
    TreeRingsLaw,
)


def fresh_seed() -> int:
    """From the commit's hash and the date: another one every commit and every day, apart from tuning and proof
    seeds."""
    if "CALIBENCH_SEED" in os.environ:
        return int(os.environ["CALIBENCH_SEED"])
    command = ["git", "rev-parse", "HEAD"]
    there = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    commit = there.stdout.strip() or "0"
    return FIRST_FRESH_SEED + (int(commit[:12], 16) + int(datetime.now(UTC).strftime("%Y%m%d"))) % 10**9


SEED = fresh_seed()

pytestmark = [pytest.mark.extra, pytest.mark.timeout(900)]  # several diagnoses on a seed of the day


def diagnosed(kind: Kind, index: int, law: type[Law] | None = None) -> tuple[Case, SaltedTruth, str, DiagnosisResult]:
    case = draw(
        SEED, index, "small", cfa="MONO", kind=kind, law=law, sizing="nominal" if kind == "single" else "unmeasured"
    )
    kept = salted(case.truth)
    sealed = seal(kept)  # before anything is diagnosed
    return case, kept, sealed, diagnose(case.recordings)


def told(found: list[tuple[Case, SaltedTruth, str, DiagnosisResult]]) -> str:
    """For whoever has to repeat it."""
    lines = [f"CALIBENCH_SEED={SEED}"]
    lines += [
        f"{canonical(kept.truth)} -> {result.verdict} {[e.name for e in result.effects]}"
        for _, kept, _, result in found
    ]
    print("\n".join(lines))
    return "\n".join(lines)


def sealed_as_before(found: list[tuple[Case, SaltedTruth, str, DiagnosisResult]]) -> bool:
    return all(
        seal(SaltedTruth(salt=k.salt, truth=CaseTruth.model_validate_json(canonical(k.truth)))) == s
        for _, k, s, _ in found
    )


def test_the_seed_is_neither_a_tuning_nor_a_proof_seed() -> None:
    assert purpose_of(SEED) == "fresh"


def test_healthy_cameras_are_not_given_names() -> None:
    """At a share of 2 % false names, 3 or more of 5 come with 10 x 0.02^3 = 8e-5."""
    found = [diagnosed("healthy", i) for i in range(1, 6)]
    words = told(found)
    assert sealed_as_before(found), words
    assert sum(bool(result.effects) for *_, result in found) <= 2, words


def test_strong_effects_are_named() -> None:
    """At 95 % right names, fewer than 2 of 4 come with 4 x 0.95 x 0.05^3 = 5e-4."""
    found = [diagnosed("single", 10 + i, law) for i, law in enumerate(PLAIN)]
    words = told(found)
    assert sealed_as_before(found), words
    assert min(case.truth.concealed[0].noncentrality for case, *_ in found) > 50.0, words
    right = [set(kept.truth.names) & {e.name for e in result.effects} for _, kept, _, result in found]
    assert sum(map(bool, right)) >= 2, words


@pytest.mark.parametrize("index", [20, 21, 22])
def test_what_no_list_names_is_diagnosed_without_failing(index: int) -> None:
    """Whether a name is given can't be asserted of one case; that there is a verdict and that its parts agree can."""
    found = [diagnosed("outside", index, STRANGE[(SEED + index) % len(STRANGE)])]
    words = told(found)
    result = found[0][3]
    assert sealed_as_before(found), words
    assert (result.verdict == "no_mismatch") == (
        not result.effects and not result.unexplained and not result.mismatches
    ), words
