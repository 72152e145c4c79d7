"""The sequences as a catalogue, and what a plan takes on a station: captures and time.

The time is learned from the sessions that the station has finished: a step takes a + b t, t being its fixed exposure. a
is the mean of what the steps of the same sequence and the same work took, b the slope over all fixed exposures, as a
stage, a search for an exposure or a person at a prompt are as fast as they are. Where a station has no such session,
typical times of the instruments stand in."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, get_args, get_origin

import numpy as np
import sqlalchemy as sa

from lab.capture.plan import CapturePlan
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture.tables import SessionRow, StepRow
from lab.capture_kinds.base import CAPTURES, SEQUENCES, FindExposure, FixedExposure, Sequence, Step
from lab.errors import InputError
from sim.parameters import Frozen, read_quantities

#: What a step does, in seconds where a station hasn't shown it yet: a search takes some six test frames and a change of
#: the light, a spectroradiometer 3 to 12 s at the levels of a monochromator, a pair of frames its read-out and its
#: files, and an operator's hand half a minute.
TYPICAL_S = {"search": 5.0, "measurement": 6.0, "frame": 0.5, "hand": 30.0}
#: Sessions of a station that its times are learned from, of so many that are looked at, the newest ones.
LEARNED_FROM, LOOKED_AT = 3, 40


class SequenceParameter(Frozen):
    """A parameter of a sequence as it is declared; `several`: it is a list of numbers, each within the bounds."""

    name: str
    unit: str
    meaning: str
    lower: float | None
    upper: float | None
    several: bool


class SequenceDescription(Frozen):
    """A sequence of the catalogue: what it is for, what it captures, what it needs, what can be set."""

    name: str
    purpose: str
    capture_kinds: tuple[str, ...]
    instruments: tuple[str, ...]
    targets: tuple[str, ...]
    parameters: tuple[SequenceParameter, ...]


class PlannedSequence(Frozen):
    """A sequence with its values on a station. `learned`: whether the time rests on sessions of this station."""

    name: str
    parameters: dict[str, int | float | tuple[float, ...] | None]
    steps: int
    captures: int
    estimated_s: float
    learned: bool


class PlanEstimate(Frozen):
    """What a session takes: its sequences, and their sum."""

    sequences: tuple[PlannedSequence, ...]
    steps: int
    captures: int
    estimated_s: float


def catalogue() -> tuple[SequenceDescription, ...]:
    """Return the descriptions of all sequences, in the order of a full session.

    >>> "dark" in [sequence.name for sequence in catalogue()]
    True
    """
    return tuple(map(_describe, SEQUENCES.values()))


def describe_sequence(name: str) -> SequenceDescription:
    """Return the description of a sequence. Raises InputError for an unknown name.

    >>> describe_sequence("dark").capture_kinds
    ('dark',)
    """
    if name not in SEQUENCES:
        raise InputError(f"no sequence {name[:60]!r}; there are {', '.join(SEQUENCES)}")
    return _describe(SEQUENCES[name])


def _describe(kind: type[Sequence]) -> SequenceDescription:
    return SequenceDescription(
        name=kind.name,
        purpose=kind.purpose,
        capture_kinds=tuple(name for name, model in CAPTURES.models.items() if model.sequence is kind),
        instruments=kind.instruments,
        targets=tuple(get_args(target.model_fields["kind"].annotation)[0] for target in kind.targets),
        parameters=tuple(
            SequenceParameter(
                name=name,
                unit=quantity.unit,
                meaning=quantity.meaning,
                lower=quantity.lower,
                upper=quantity.upper,
                several=get_origin(kind.model_fields[name].annotation) is tuple,
            )
            for name, quantity in read_quantities(kind).items()
        ),
    )


def parse_parameters(texts: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return parameters of sequences, by sequence and name.

    texts : `SEQUENCE.PARAMETER=VALUE`, several values with commas

    Raises InputError for a sequence that there isn't, and for a value that is no number.

    >>> parse_parameters(["narrowband.step_nm=5"])
    {'narrowband': {'step_nm': 5.0}}
    """
    parameters: dict[str, dict[str, Any]] = defaultdict(dict)
    for text in texts:
        name, _, value = text.partition("=")
        sequence, _, parameter = name.strip().partition(".")
        if sequence not in SEQUENCES or not parameter or not value:
            raise InputError(f"{text!r}: give SEQUENCE.PARAMETER=VALUE, of a sequence of {', '.join(SEQUENCES)}")
        several = {parameter.name for parameter in describe_sequence(sequence).parameters if parameter.several}
        try:
            numbers = [float(part) for part in value.split(",")]
        except ValueError:
            raise InputError(
                f"{text!r}: {value!r} isn't a number, nor several with commas between; give that"
            ) from None
        parameters[sequence][parameter] = numbers if parameter in several or len(numbers) > 1 else numbers[0]
    return dict(parameters)


#: A step's sequence, and what it does.
Work = tuple[str, tuple[str, ...]]


def _work(step: Step) -> Work:
    does = {
        "search": isinstance(step.exposure, FindExposure),
        "measurement": step.radiance is not None,
        "frame": bool(step.captures),
        "hand": bool(step.setting.by_hand) and not step.captures,
    }
    return step.sequence, tuple(name for name, so in does.items() if so)


def _exposure_s(step: Step) -> float:
    return step.exposure.exposure_s if isinstance(step.exposure, FixedExposure) else 0.0


@dataclass(frozen=True)
class StepTimes:
    """How long the steps of a station take: `mean_s` of each work, and `per_exposure` s more for a second of fixed
    exposure."""

    mean_s: Mapping[Work, float]
    per_exposure: float = 1.0

    @classmethod
    def learn(cls, seen: Iterable[tuple[Step, float]]) -> StepTimes:
        """Return the times that steps and how long (s) each took show."""
        taken = [(_work(step), _exposure_s(step), seconds) for step, seconds in seen]
        per_exposure = 1.0
        if len({exposure for _, exposure, _ in taken if exposure > 0}) > 1:
            fixed = np.array([(exposure, seconds) for _, exposure, seconds in taken if exposure > 0])
            per_exposure = max(0.0, float(np.polyfit(fixed[:, 0], fixed[:, 1], 1)[0]))
        rest: dict[Work, list[float]] = defaultdict(list)
        for work, exposure, seconds in taken:
            rest[work].append(seconds - per_exposure * exposure)
        return cls({work: float(np.mean(each)) for work, each in rest.items()}, per_exposure)

    def seconds(self, step: Step) -> tuple[float, bool]:
        """Return what a step takes, and whether that was learned."""
        work = _work(step)
        mean_s = self.mean_s.get(work)
        whole = (sum(TYPICAL_S[does] for does in work[1]) if mean_s is None else mean_s) + (
            _exposure_s(step) * self.per_exposure
        )
        return max(0.0, whole), mean_s is not None


def step_times(store: Store, station: Station) -> StepTimes:
    """Return what the newest finished sessions on the same instruments show."""
    instruments = _instruments(station.model_dump(mode="json"))
    newest = sa.select(SessionRow.id, SessionRow.station).where(SessionRow.state == "finished")
    newest = newest.order_by(SessionRow.created.desc()).limit(LOOKED_AT)
    with store.reading() as db:
        same = [id for id, kept in db.execute(newest) if _instruments(kept) == instruments][:LEARNED_FROM]
        steps = sa.select(StepRow.spec, StepRow.started, StepRow.finished).where(
            StepRow.session_id.in_(same), StepRow.started.is_not(None), StepRow.finished.is_not(None)
        )
        rows = db.execute(steps).all()
    return StepTimes.learn(
        (Step.model_validate(spec), (finished - started).total_seconds()) for spec, started, finished in rows
    )


def _instruments(station: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Driver and address of every instrument of a station's document."""
    entries = {
        name: station.get(name)
        for name in ("monochromator", "spectroradiometer", "photodiode", "light_source", "display", "stage")
    }
    entries |= {f"cameras.{side}": camera for side, camera in station["cameras"].items()}
    return {name: (entry["driver"], entry["address"]) for name, entry in entries.items() if entry}


def estimate(plan: CapturePlan, station: Station, times: StepTimes) -> PlanEstimate:
    """Return captures and time of a plan. Raises InputError where the station lacks what it needs."""
    plan.steps(station)  # refuses what can't be taken as a whole
    planned = []
    for sequence in plan.sequences:
        steps = sequence.steps(station)
        each = [times.seconds(step) for step in steps]
        planned.append(
            PlannedSequence(
                name=sequence.name,
                parameters={name: getattr(sequence, name) for name in read_quantities(type(sequence))},
                steps=len(steps),
                captures=sum(len(step.captures) for step in steps),
                estimated_s=round(sum(seconds for seconds, _ in each), 1),
                learned=all(known for _, known in each),
            )
        )
    return PlanEstimate(
        sequences=tuple(planned),
        steps=sum(sequence.steps for sequence in planned),
        captures=sum(sequence.captures for sequence in planned),
        estimated_s=round(sum(sequence.estimated_s for sequence in planned), 1),
    )
