"""Which of its alternatives a named law is, in the result and in words."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from lab.diagnose.outcome.merge_sides import _choices
from lab.formats.results import NamedEffect, ParameterValue
from lab.report.answers import effect_line
from sim.effects.base import Effect
from sim.effects.library import effect


class _Rows(Effect):
    name: ClassVar[str] = "test_rows"
    period: Annotated[Literal[4, 8], Field(description="rows from one to the next")] = 8
    first_row: Annotated[int, Field(description="first of them", ge=0, lt=8)] = 0
    seed: Annotated[int, Field(description="which pattern")] = 0


def test_the_choices_of_a_law_are_its_alternatives_and_no_seeds() -> None:
    glow = effect("amplifier_glow")(glow_e_per_s=3.0, corner="bottom_right")
    assert _choices(glow) == {"corner": "bottom_right"}
    assert _choices(effect("row_noise")(noise_e=3.0, pattern_seed=4)) == {}
    assert _choices(effect("optical_low_pass_filter")(displacement_x_um=2.0)) == {}


def test_integers_with_bounds_are_told_and_all_that_are_alike() -> None:
    """A period among listed numbers, and a row; what the recordings can't tell from them stands beside them."""
    found = _Rows(first_row=3, seed=5)
    assert _choices(found) == {"period": "8", "first_row": "3"}
    alike = (_Rows(first_row=1), _Rows(first_row=3, period=4))
    assert _choices(found, alike) == {"period": "8 or 4", "first_row": "3 or 1"}


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
