"""Slanted edges at another f-number than the data sheet's: what of the blur is the lens's.

Nobody but an operator turns the aperture ring. He is asked as for a target: `[targets."f/8"]` of kind `aperture` is a
stop of the ring. The sequence sets its stop first and asks for the data sheet's stop at its end.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from lab.capture_kinds.base import Adjustment, Equipment, Sequence, Step, Target, back_step
from lab.capture_kinds.lamp import LAMP_INSTRUMENTS
from lab.capture_kinds.slanted_edge import EdgeCapture, EdgeSequence, EdgeTarget, TurnTarget, edge_steps
from lab.errors import InputError
from sim.parameters import Quantity


class ApertureTarget(Adjustment):
    """A stop of the lenses' aperture rings; the stop of the data sheet's f-number is one, too, the usual one."""

    changes: ClassVar[str] = "the lenses' aperture"

    kind: Literal["aperture"]
    f_number: float = Field(gt=0)

    @property
    def instruction(self) -> str:
        return f"turn the aperture ring of each lens to f/{self.f_number:g}, and move neither focus nor target"

    def is_usual(self, station: Equipment) -> bool:
        return self.f_number == station.f_number


class StoppedEdgeSequence(EdgeSequence):
    """Knife edges at `f_number`; the lenses are set back at the end."""

    name: ClassVar[str] = "stopped_edge"
    purpose: ClassVar[str] = "MTF at another f-number: which part of a blur is the lens's"
    targets: ClassVar[tuple[type[Target], ...]] = (EdgeTarget, ApertureTarget)
    adjustments: ClassVar[tuple[type[Adjustment], ...]] = (TurnTarget,)

    f_number: Annotated[float, Quantity("1", "f-number that the lenses are set to", lower=0.5, upper=64.0)]

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        """Return None: a full session leaves the lens alone."""
        return None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station, LAMP_INSTRUMENTS if self.lamp_level else None)
        stops = {stop.f_number: name for name, stop in station.list_targets(ApertureTarget).items()}
        opened = _stop_of(stops, self.f_number)
        _stop_of(stops, station.f_number)
        stem = f"stopped_edge/f{self.f_number:g}"
        taken = edge_steps(self, station, stem, StoppedEdgeCapture, by_hand=(opened,), f_number=self.f_number)
        return (*taken, back_step(stem, ApertureTarget, station))


def _stop_of(stops: Mapping[float, str], f_number: float) -> str:
    """Return the name of the target that is the stop. Raises InputError where the station has none."""
    if f_number in stops:
        return stops[f_number]
    have = ", ".join(f"f/{f_number:g}" for f_number in sorted(stops)) or "none"
    raise InputError(
        f"station: no target of kind 'aperture' with f_number = {f_number:g}; it has {have}; add "
        f'[targets."f/{f_number:g}"] to the station file if the lens has that stop'
    )


class StoppedEdgeCapture(EdgeCapture):
    """A straight edge as `slanted_edge` has it, at `f_number` in place of the data sheet's."""

    shows: ClassVar[str] = "a straight edge in each region, at another f-number"
    sequence: ClassVar[type[Sequence] | None] = StoppedEdgeSequence

    kind: Literal["stopped_edge"]
    f_number: float = Field(gt=0)


KIND = StoppedEdgeCapture
