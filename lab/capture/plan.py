"""What a session captures: its sequences, in their order, with their parameters."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from lab.capture_kinds.base import SEQUENCES, Cells, Equipment, Sequence, Step
from lab.errors import InputError


@dataclass(frozen=True)
class CapturePlan:
    """The sequences of one session, in their order."""

    sequences: tuple[Sequence, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The sequences' names."""
        return tuple(sequence.name for sequence in self.sequences)

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        """All steps. Raises InputError if the station lacks what one of them needs."""
        return tuple(step for sequence in self.sequences for step in sequence.steps(station))

    def patterns(self, station: Equipment) -> dict[str, Cells]:
        """The cells (rows, cols) of all patterns that the screen is to show, by path in the session."""
        return {path: cells for sequence in self.sequences for path, cells in sequence.patterns(station).items()}

    def document(self) -> dict[str, Any]:
        """The sequences' parameters by name, as JSON."""
        return {sequence.name: sequence.model_dump(mode="json", exclude_none=True) for sequence in self.sequences}


def full_plan(station: Equipment, quick: bool = False, only: Collection[str] | None = None) -> CapturePlan:
    """Every sequence whose instruments and targets the station has. `quick` takes fewer frames of each.

    `only`: names of the sequences to take. Raises InputError where the station can't take one of them.
    """
    possible = [planned for kind in SEQUENCES.values() if (planned := kind.planned(station, quick)) is not None]
    if only is None:
        return CapturePlan(tuple(possible))
    if unknown := set(only) - SEQUENCES.keys():
        raise InputError(f"sequences: there is no {', '.join(sorted(unknown))}; name some of {', '.join(SEQUENCES)}")
    if missing := set(only) - {sequence.name for sequence in possible}:
        raise InputError(
            f"sequences: the station lacks instruments or targets for {', '.join(sorted(missing))}; "
            "leave it out or add them to the station file"
        )
    return CapturePlan(tuple(sequence for sequence in possible if sequence.name in only))
