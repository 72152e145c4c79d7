"""A name in words: its choices, its family, its parameters; and values of several sides as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.effect_titles import effect_title
from lab.formats.results import Combination, Member
from lab.formats.results.words import format_value
from sim.effects.base import Effect
from sim.effects.families import Family

#: Members of a named family that its sentence lists.
TOLD_MEMBERS = 4
#: What to capture where no measurement is determined.
LEAST_CAPTURES = (
    "Add dark frames at two exposures, and flat frames at three levels or more with the light's radiance: the "
    "measurements begin with these."
)


def choices_of(effect: Effect, alike: Sequence[Effect] = ()) -> dict[str, str]:
    """Return which of its alternatives an effect is, by field; and those that the recordings don't tell from it."""
    told: dict[str, str] = {}
    for name in type(effect).told_choices():
        values = dict.fromkeys(getattr(one, name) for one in (effect, *alike))
        if getattr(effect, name) is not None:
            told[name] = " or ".join(str(value) for value in values if value is not None)
    return told


def family_statement(
    family: Family, members: Sequence[Member], is_exact: bool, seen: str, values: str, corrections: Sequence[str]
) -> str:
    """Return the sentences about a named family: how well its laws hold, which they are, and the capture that tells
    them apart."""
    names = [f"{effect_title(m.name)} ({100 * m.probability:.0f} %)" for m in members[:TOLD_MEMBERS]]
    told = [family.sentence, f"{seen}."]
    if is_exact:
        told.append(f"The recordings can't tell {' from '.join(names)}; by the first: {values}.")
    else:
        told.append(
            f"No listed law of {family.words} fits exactly; the nearest is {effect_title(members[0].name)}: {values}."
        )
        if len(names) > 1:
            told.append(f"Of the listed laws: {', '.join(names)}.")
        if corrections:
            told.append(f"What it leaves is in the improved model: {'; '.join(corrections)}.")
    if len(names) > 1 and family.separating_capture:
        told.append(f"What tells them apart: {family.separating_capture}.")
    return " ".join(told)


def plain_name(field: str, unit: str) -> str:
    """Return a parameter's name in words, without its unit."""
    return field.removesuffix("_" + unit.lower()).replace("_", " ")


def pooled(values: list[tuple[float, float | None]], is_shared: bool) -> tuple[float, float | None]:
    """Mean of (value, standard deviation), weighted by 1 / variance; the first value where a standard deviation isn't
    known.

    `is_shared`: the values hold the same light, read by the same radiometer, so that their errors are taken as fully
    correlated: the mean's standard deviation is the weighted mean of theirs, the largest that any correlation allows.
    Else they are independent."""
    known = [(v, s) for v, s in values if s]
    if len(known) != len(values) or len(values) == 1:
        return values[0]
    weight = np.array([1.0 / s**2 for _, s in known])
    std = np.array([s for _, s in known])
    mean = float(np.sum(weight * np.array([v for v, _ in known])) / weight.sum())
    return mean, float(np.sum(weight * std) / weight.sum() if is_shared else 1.0 / np.sqrt(weight.sum()))


def combination_in_words(one: Combination) -> str:
    """Return in words what the recordings determine of parameters that they can't tell apart."""
    names = [f"{name}^{one.power}" if one.power > 1 else name for name in one.parameters]
    return (
        f"{sum_words(names, one.weights)} = {format_value(one.value, one.std, one.unit)} is, of the {one.side} camera"
    )


def sum_words(names: Sequence[str], weights: Sequence[float]) -> str:
    """Return a combination as a formula: `a + 0.52 b - 2 c`."""
    text = names[0]
    for name, weight in zip(names[1:], weights[1:], strict=True):
        size = f"{abs(weight):.2g}"
        text += f" {'-' if weight < 0.0 else '+'} {'' if size == '1' else f'{size} '}{name}"
    return text
