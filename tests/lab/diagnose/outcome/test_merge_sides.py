"""Findings of all sides as one result: choices between rivals, and families in sentences."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
import pytest
from pydantic import Field

from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.merge_sides import merged
from lab.diagnose.outcome.named_in_words import choices_of
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.side import NamedCandidate, SideFindings
from lab.formats.results import Combination, DiagnosisLists, DiagnosisResult, NamedEffect, ParameterValue
from lab.report.answers import effect_line
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.hot_pixels import HotPixels
from sim.effects.library import effect
from sim.effects.random_telegraph_noise import RandomTelegraphNoise
from sim.effects.source_drift import SourceDrift


class _Rows(Effect):
    name: ClassVar[str] = "test_rows"
    period: Annotated[Literal[4, 8], Field(description="rows from one to the next")] = 8
    first_row: Annotated[int, Field(description="first of them", ge=0, lt=8)] = 0
    seed: Annotated[int, Field(description="which pattern")] = 0


def test_the_choices_of_a_law_are_its_alternatives_and_no_seeds() -> None:
    glow = effect("amplifier_glow")(glow_e_per_s=3.0, corner="bottom_right")
    assert choices_of(glow) == {"corner": "bottom_right"}
    assert choices_of(effect("row_noise")(noise_e=3.0, pattern_seed=4)) == {}
    assert choices_of(effect("optical_low_pass_filter")(displacement_x_um=2.0)) == {}


def test_integers_with_bounds_are_told_and_all_that_are_alike() -> None:
    """A period among listed numbers, and a row; what the recordings can't tell from them stands beside them."""
    found = _Rows(first_row=3, seed=5)
    assert choices_of(found) == {"period": "8", "first_row": "3"}
    alike = (_Rows(first_row=1), _Rows(first_row=3, period=4))
    assert choices_of(found, alike) == {"period": "8 or 4", "first_row": "3 or 1"}


def test_a_finding_says_which_alternative_it_is() -> None:
    named = NamedEffect(
        name="amplifier_glow",
        family="dark_signal",
        law="exact",
        probability=1.0,
        sides=("left",),
        parameters={"glow_e_per_s": ParameterValue(value=30.0, std=4.0, unit="e/s")},
        choices={"corner": "bottom_right"},
        statement="It glows.",
    )
    assert effect_line(named) == (
        "Amplifier glow, left: electrons a second in that corner 30.0 ± 4.0 e/s (7.5 σ from 0); where the output "
        "stage is: bottom right."
    )


# ----------------------------------------------------------------------------------------------------------------------
# A named family in the result: its identifier, members, the nearest law's parameters, and the capture that tells
# members apart.


HOT = Candidate(
    HotPixels(excess_e_per_s=300.0),
    {"excess_e_per_s": 20.0, "share_ppm": 5.0, "relative_spread": 0.1},
    0.97,
    (("unknown", 0.5),),
    100.0,
    0.9,
    is_closed=False,
    members=(("hot_pixels", 0.9), ("random_telegraph_noise", 0.07)),
)
BLINKING = replace(
    HOT,
    effect=RandomTelegraphNoise(amplitude_e=20.0),
    std={"amplitude_e": 1.0, "share_percent": 0.1, "relative_spread": 0.1},
    members=(("random_telegraph_noise", 0.6), ("hot_pixels", 0.4)),
    log_odds=50.0,
)


def _told(*sides: tuple[Side, Candidate]) -> DiagnosisResult:
    found = [
        SideFindings(
            side,
            DiagnosisLists(),
            is_judged=True,
            named=(NamedCandidate(c, ("defective_pixels",), ("a factor on the noise",)),),
        )
        for side, c in sides
    ]
    return merged("made up", found, DecisionPolicy())


def test_an_inexact_family_says_its_nearest_law_and_what_is_left() -> None:
    result = _told(("left", HOT))
    one = result.effects[0]
    assert (one.name, one.family, one.law) == ("defective_pixels", "defective_pixels", "inexact")
    assert [(m.name, m.probability) for m in one.members] == [("hot_pixels", 0.9), ("random_telegraph_noise", 0.07)]
    assert one.nearest_law == "hot_pixels"
    assert one.parameters["excess_e_per_s"].value == 300.0
    assert one.alternatives == ("hot_pixels", "random_telegraph_noise", "unknown")
    assert "No listed law of defective pixels fits exactly; the nearest is hot pixels" in one.statement
    assert "a factor on the noise" in one.statement
    assert one.corrections == ("a factor on the noise",)
    # what the law leaves is the family's, and the camera isn't fully explained
    assert result.verdict == "partly_explained"


def test_an_undecided_family_names_the_capture_that_tells_its_members_apart() -> None:
    result = _told(("left", replace(HOT, is_closed=True)))
    assert result.effects[0].law == "exact"
    assert "can't tell hot pixels (90 %) from random telegraph noise (7 %)" in result.effects[0].statement
    assert "dark frames at two exposures" in result.effects[0].statement
    assert result.verdict == "explained"


def test_sides_of_one_family_are_one_entry_with_the_likelier_law() -> None:
    """Mean probabilities over the sides: hot pixels (0.9 + 0.4) / 2, blinking ones (0.07 + 0.6) / 2."""
    one = _told(("left", HOT), ("right", BLINKING)).effects
    assert len(one) == 1
    assert one[0].sides == ("left", "right")
    assert [(m.name, round(m.probability, 3)) for m in one[0].members] == [
        ("hot_pixels", 0.65),
        ("random_telegraph_noise", 0.335),
    ]
    assert "excess_e_per_s" in one[0].parameters


def _both(effect: Effect, std: dict[str, float | None]) -> DiagnosisResult:
    one = replace(HOT, effect=effect, std=std, is_closed=True, members=())
    return _told(("left", one), ("right", one))


def test_what_both_sides_share_is_no_better_told_by_two() -> None:
    """A drifting lamp is read by one radiometer: both sides hold the same reading's error. Two sensors' hot pixels are
    independent."""
    drift = _both(SourceDrift(drift_percent_per_min=4.0), {"drift_percent_per_min": 0.5}).effects[0]
    assert drift.parameters["drift_percent_per_min"].std == pytest.approx(0.5)
    assert "settling_min" not in drift.parameters
    hot = _both(HotPixels(excess_e_per_s=300.0), HOT.std).effects[0]
    assert hot.parameters["excess_e_per_s"].std == pytest.approx(20.0 / np.sqrt(2.0))


def test_sizes_that_are_not_determined_are_reported_with_the_combination_that_is() -> None:
    axial = effect("axial_chromatic_aberration")(slope_um=15.0, curvature_um=12.0)
    combined = Combination(
        side="left",
        parameters=("slope_um", "curvature_um"),
        weights=(1.0, 0.62),
        power=2,
        value=314.0,
        std=9.0,
        unit="um^2",
    )
    candidate = Candidate(axial, {"slope_um": 21.0, "curvature_um": 2.0}, 0.99, (), 40.0)
    found = SideFindings(
        side="left",
        lists=DiagnosisLists(),
        is_judged=True,
        named=(NamedCandidate(candidate, ("slanted_edge",), combinations=(combined,)),),
    )
    (told,) = merged("a set", [found], DecisionPolicy()).effects
    assert told.combinations == (combined,)
    assert not told.parameters["slope_um"].is_determined and told.parameters["curvature_um"].is_determined
    assert "slope 15 ± 21 µm, not determined, curvature 12.0 ± 2.0 µm, " in told.statement
    assert "slope_um^2 + 0.62 curvature_um^2 = 314.0 ± 9.0 um^2 is, of the left camera" in told.statement
