"""What a session captures: its sequences, in their order, with their parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from lab.capture_kinds.base import SEQUENCES, Adjustment, Cells, Equipment, Sequence, Step, name_of
from lab.capture_kinds.flare import FlareSequence
from lab.errors import InputError
from sim.parameters import read_quantities

#: Values of sequences' parameters: sequence -> parameter -> a number, or several.
Parameters = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class CapturePlan:
    """The sequences of one session, in their order."""

    sequences: tuple[Sequence, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The sequences' names."""
        return tuple(sequence.name for sequence in self.sequences)

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        """Return all steps. What a hand puts back only to change it again at once stays as it is. Raises InputError if
        the station lacks what one of them needs, and where a step is there twice.
        """
        every = [step for sequence in self.sequences for step in sequence.steps(station)]
        kinds = {name: type(target) for name, target in station.list_targets(Adjustment).items()}
        made = tuple(
            step
            for step, following in zip(every, [*every[1:], None], strict=True)
            if following is None or not _is_changed_again(step, following, kinds)
        )
        times = Counter(name_of(step.id) for step in made)
        for step in made:
            if step.setting.by_hand and station.lacks("stage"):
                raise InputError(
                    f"station: {step.setting.by_hand[0]!r} is set by hand and there is no [stage] to ask for it; add "
                    "one (driver 'prompt' asks you)"
                )
            if (there := times[name_of(step.id)]) > 1:
                raise InputError(
                    f"sequences: the step {step.id} is there {there} times; take each sequence once, and give every "
                    "value once"
                )
        return made

    def patterns(self, station: Equipment) -> dict[str, Cells]:
        """Return the cells (rows, cols) of all patterns that the screen is to show, by path in the session."""
        return {path: cells for sequence in self.sequences for path, cells in sequence.patterns(station).items()}

    def document(self) -> dict[str, Any]:
        """Return the sequences' parameters by name, as JSON; a list of them where a sequence is taken in several
        lights."""
        by_name: dict[str, list[Any]] = {}
        for sequence in self.sequences:
            by_name.setdefault(sequence.name, []).append(sequence.model_dump(mode="json", exclude_none=True))
        return {name: taken[0] if len(taken) == 1 else taken for name, taken in by_name.items()}


def _is_changed_again(step: Step, following: Step, kinds: Mapping[str, type[Adjustment]]) -> bool:
    """Return whether a step only puts back what the following one has changed again. `kinds`: of adjustments."""
    if step.captures or step.exposure is not None or not name_of(step.id).endswith("-back"):
        return False
    return {kinds[name] for name in step.setting.by_hand} <= {kinds[name] for name in following.setting.by_hand}


def full_plan(
    station: Equipment, quick: bool = False, only: Collection[str] | None = None, parameters: Parameters | None = None
) -> CapturePlan:
    """Return a plan of every sequence whose instruments and targets the station has.

    station : whose instruments and targets count
    quick : take fewer frames of each
    only : names of the sequences to take
    parameters : values in place of those that a full session has, by sequence and name

    Raises InputError where the station can't take one of the sequences, and for a parameter that none of them has or
    that is out of its bounds.
    """
    possible = [planned for kind in SEQUENCES.values() if (planned := kind.planned(station, quick)) is not None]
    taken = possible if only is None else _only(possible, only)
    wanted = parameters or {}
    if idle := wanted.keys() - {sequence.name for sequence in taken}:
        names = ", ".join(sequence.name for sequence in taken)
        raise InputError(f"parameters: {', '.join(sorted(idle))} isn't taken; name some of {names}")
    return CapturePlan(tuple(_with(sequence, wanted.get(sequence.name, {})) for sequence in taken))


#: Sequences that the standards read; those that a station can't take are left out.
STANDARDS_SEQUENCES = ("dark", "flat", "narrowband", "chart", "edge", "stereo")
#: Levels of light that EMVA 1288 asks for at least, and images of a spatial stack.
EMVA_LEVELS, STACK_IMAGES = 50, 16
QUICK_LEVELS = 12


def standards_plan(station: Equipment, quick: bool = False) -> CapturePlan:
    """Return the captures that the standards ask for: EMVA 1288's levels up to saturation and spatial stacks, charts,
    edges, boards, and the flare chart on the screen. `quick`: fewer levels, of which the standards' pages tell.
    """
    names = [kind.name for kind in SEQUENCES.values() if kind.name in STANDARDS_SEQUENCES and kind.possible(station)]
    taken = list(full_plan(station, quick, names).sequences)
    count = QUICK_LEVELS if quick else EMVA_LEVELS
    frames = 4 if quick else 2
    # far enough beyond saturation that the least sensitive channel gets there, too
    beyond = (1.15, 1.5, 2.2, 3.2, 4.5)
    below = (round(float(level), 4) for level in np.linspace(0.02, 0.98, count - len(beyond)))
    levels = (*below, *beyond, *(0.5,) * (STACK_IMAGES // frames))
    stated: dict[str, dict[str, Any]] = {
        "flat": {"levels": levels, "frames": frames},
        "dark": {"frames": STACK_IMAGES},
    }
    sequences = [_with(sequence, stated.get(sequence.name, {})) for sequence in taken]
    return CapturePlan(
        (*sequences, *((FlareSequence(frames=2 if quick else 4),) if FlareSequence.possible(station) else ()))
    )


def _with(sequence: Sequence, values: Mapping[str, Any]) -> Sequence:
    """Return the sequence with other values of its parameters. Raises InputError."""
    known = read_quantities(type(sequence))
    if unknown := values.keys() - known.keys():
        raise InputError(f"{sequence.name}.{min(unknown)}: isn't a parameter; {sequence.name} has {', '.join(known)}")
    if not values:
        return sequence
    try:
        return type(sequence).model_validate(sequence.model_dump() | dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join((sequence.name, *map(str, first["loc"])))
        raise InputError(f"{where}: {first['msg'].removeprefix('Value error, ')}") from error


def _only(possible: list[Sequence], only: Collection[str]) -> list[Sequence]:
    """Those of these names. Raises InputError where one isn't possible, or isn't at all."""
    if unknown := set(only) - SEQUENCES.keys():
        raise InputError(f"sequences: there is no {', '.join(sorted(unknown))}; name some of {', '.join(SEQUENCES)}")
    if missing := set(only) - {sequence.name for sequence in possible}:
        raise InputError(
            f"sequences: the station lacks instruments or targets for {', '.join(sorted(missing))}; "
            "leave it out or add them to the station file"
        )
    return [sequence for sequence in possible if sequence.name in only]
