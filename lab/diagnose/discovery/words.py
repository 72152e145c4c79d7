"""Discovered laws in words: what they are of, how large, and what may do that, as suspects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.diagnose.discovery.profile import Entry, Look, PredictiveTable
from lab.diagnose.outcome.law_words import BY_LINES, QUANTITIES, SUSPECTS, departure_unit
from sim.camera import Side
from sim.effects.empirical_law import PLACES

MOST_TOLD = 16  # entries of a table

#: Remark where a table by code isn't made.
BEYOND_TABLE = (
    "Single codes aren't tabled: more than {most} were counted, and a table of so many numbers describes no law; "
    "flats of a narrower range of levels would show them."
)


def entry(look: Look) -> Entry:
    """Return how a departure is written, with its unit."""
    unit = entry_unit(look)
    if unit == "%":
        return lambda value: f"{100.0 * value:+.2g} %"
    return lambda value: f"{value:+.2g} {unit}"


def entry_unit(look: Look) -> str:
    """Return the unit of a look's departures."""
    return departure_unit(look.stage, look.along, look.of, bool(look.at))


def unit_of(look: Look) -> str:
    """Return the unit of a curve's coordinate."""
    return PLACES[look.stage, look.along, look.of][2].split(" after ")[0].split(" from ")[0]


def place_in_words(look: Look) -> str:
    """Return the quantity and the index of a look."""
    quantity = QUANTITIES.get((look.stage, look.along)) or BY_LINES[look.stage]
    if look.of != "mean" and look.stage == "signal":
        quantity = "variance of the noise" if look.along == "time" else "variances of the dark noise"
        quantity = quantity if look.of == "variance" else f"covariances of the dark noise with the next {look.along}"
    return f"{quantity} by {look.along}"


def suspects_of(found: PredictiveTable) -> str:
    """Return what physics may do it; none of it is a name."""
    look, name = (*found.shorter, found)[0].look, (*found.shorter, found)[0].form.name
    period = (*found.shorter, found)[0].period
    if look.along == "code" and period & (period - 1):
        name = "no power of two"
    kinds = (look.of, name, "") if look.of != "mean" else (name, "")
    return next(SUSPECTS[look.stage, look.along, k] for k in kinds if (look.stage, look.along, k) in SUSPECTS)


def statement(side: Side, found: PredictiveTable) -> str:
    """Say which entries differ, what that may be, and by how much held-out captures are predicted better.

    The shortest table is told, and what longer ones take off chi2 besides.
    """
    look, steps = found.look, (*found.shorter, found)
    base, n, say = steps[0], found.chi2[2], entry(look)
    line = look.along
    what = f"No named effect accounts for this: the {place_in_words(look).split(' by ')[0]} of the {side} camera"
    if look.columns:
        period = f"{base.period // look.columns} rows and {look.columns} columns"
        what += f" repeat every {period}, by up to {say(float(base.departure[np.argmax(np.abs(base.departure))]))}"
    elif base.period:
        shown = ", ".join(say(value) for value in base.departure[:MOST_TOLD])
        more = ", ..." if base.period > MOST_TOLD else ""
        each = f"each ± {say(float(np.median(base.std))).removeprefix('+')}"
        what += f" repeat every {base.period} {line}s; by {line} mod {base.period}: {shown}{more} ({each})"
    elif base.form.name == "by index":
        rms = float(np.std(base.departure[look.seen.index]))
        what += f" differ by {say(rms).removeprefix('+')} rms, without a period"
    elif look.at:
        what += f" follows the {line.replace(' x ', ' and the ')}: {base.said}"
    else:
        what += f" have {base.said}"
    suspects = suspects_of(found)
    where = " of held-out captures" if look.held_out is not None else ""
    falls = ", ".join(f"to {one.chi2[1] / n:.3g} with {_numbers(one)}" for one in steps)
    told = [
        f"{what}.",
        f"{suspects[0].upper()}{suspects[1:]}.",
        f"By such a {'law' if look.at else 'table'} chi2 over n{where} falls from {found.chi2[0] / n:.3g} {falls}.",
    ]
    if found.equal:
        told.append(f"These captures don't tell it from a law of the {_listed(found.equal)}.")
    return " ".join([*told, *([found.remark] if found.remark else [])])


def _numbers(one: PredictiveTable) -> str:
    if one.form.name == "by index":
        return "a width for every code"
    count = one.period or one.form.numbers
    return f"{count} numbers" if count > 1 else "one number"


def _listed(words: Sequence[str]) -> str:
    return ", or of the ".join(words)
