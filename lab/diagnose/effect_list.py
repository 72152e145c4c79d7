"""The library of effects as a document: what `calibench effects` prints and the REST service returns."""

from __future__ import annotations

from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from lab.diagnose.visibility import visibility
from lab.errors import InputError
from sim.effects import library
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Frozen, Quantity

UNSEEN = "No measurement of a diagnosis can see it, so a diagnosis never names it."
NOT_SOUGHT = (
    "A diagnosis doesn't look for it: it is a part that a camera is known to have, or a term of the diagnosis itself."
)
NOT_DERIVED = "What shows it hasn't been derived yet: run `python docs/write_tables.py`."


class ParameterDescription(Frozen):
    """A declared quantity.

    lower, upper : its bounds; None: unbounded
    prior : mean and standard deviation of its prior; None: flat
    absent : the value at which an effect isn't there
    """

    name: str
    unit: str
    meaning: str
    lower: float | None
    upper: float | None
    prior: tuple[float, float] | None
    absent: float | None

    @classmethod
    def of(cls, name: str, quantity: Quantity) -> ParameterDescription:
        """Return the declaration of the quantity `name`."""
        return cls(
            name=name,
            unit=quantity.unit,
            meaning=quantity.meaning,
            lower=quantity.lower,
            upper=quantity.upper,
            prior=quantity.prior,
            absent=quantity.absent,
        )


class ChoiceDescription(Frozen):
    """A field of an effect that no fit changes.

    values : what it may be; empty where any value of its type will do
    default : the value that it has where none is given
    """

    name: str
    meaning: str
    values: tuple[str, ...]
    default: str

    @classmethod
    def of(cls, name: str, field: FieldInfo) -> ChoiceDescription:
        """Return the declaration of the field `name`."""
        return cls(
            name=name,
            meaning=field.description or "",
            values=choice_values(field),
            default="none" if field.default is None else str(field.default),
        )


def choice_values(field: FieldInfo) -> tuple[str, ...]:
    """Return the values among which a field chooses; empty where any value of its type will do."""
    return tuple(str(value) for value in _literals(field.annotation))


def _literals(annotation: Any) -> tuple[Any, ...]:
    """Return the values of a `Literal`, at any depth of unions."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return tuple(value for part in get_args(annotation) for value in _literals(part))


class EffectDescription(Frozen):
    """An effect of the library.

    family : the physics that it is one law of; named in its place where no law holds exactly, or several fit equally
    well stages : the stages of the forward model in which it acts, in the order of the light
    sentence : the physics that a model without it lacks
    reference : source of its law
    choices : its fields that no fit changes
    measurements, capture_kinds : the measurements that can show it, and the captures that these need; derived
    rivals : effects that change some part of a session alike; derived
    invariances : conditions that it doesn't depend on
    remark : why a diagnosis never names it; None for an effect that can be named
    """

    name: str
    family: str
    stages: tuple[str, ...]
    sentence: str
    reference: str
    parameters: tuple[ParameterDescription, ...]
    choices: tuple[ChoiceDescription, ...]
    measurements: tuple[str, ...]
    capture_kinds: tuple[str, ...]
    rivals: tuple[str, ...]
    invariances: tuple[str, ...]
    remark: str | None


class FamilyDescription(Frozen):
    """A family of effects.

    words : the physics, as a noun phrase
    sentence : what recordings show where it is named
    members : its effects that a diagnosis looks for
    told_apart_by : the capture that tells these apart; empty where there is only one
    """

    name: str
    words: str
    sentence: str
    members: tuple[str, ...]
    told_apart_by: str


class EffectList(Frozen):
    """The document that `calibench effects --json FILE` writes."""

    format: Literal["calibench-effects"] = "calibench-effects"
    version: Literal[1] = 1
    effects: tuple[EffectDescription, ...]
    families: tuple[FamilyDescription, ...] = ()


def effect_list() -> EffectList:
    """All effects of the library, and their families."""
    return EffectList(
        effects=tuple(_described(kind) for kind in library.effects().values()),
        families=tuple(_family(family) for family in Family if library.members(family)),
    )


def _family(family: Family) -> FamilyDescription:
    return FamilyDescription(
        name=family.value,
        words=family.words,
        sentence=family.sentence,
        members=library.members(family),
        told_apart_by=family.separating_capture,
    )


def effect_description(name: str) -> EffectDescription:
    """One effect. Raises InputError for an unknown name."""
    try:
        return _described(library.effect(name))
    except KeyError as unknown:
        raise InputError(str(unknown.args[0])) from None


def _described(kind: type[Effect]) -> EffectDescription:
    shown = visibility().get(kind.name)
    return EffectDescription(
        name=kind.name,
        family=kind.family.value,
        stages=kind.stages(),
        sentence=kind.sentence,
        reference=kind.reference,
        parameters=tuple(ParameterDescription.of(name, quantity) for name, quantity in kind.quantities().items()),
        choices=tuple(ChoiceDescription.of(name, field) for name, field in kind.choices().items()),
        measurements=shown.measurements if shown else (),
        capture_kinds=shown.capture_kinds if shown else (),
        rivals=shown.rivals if shown else (),
        invariances=tuple(sorted(kind.invariances)),
        remark=_remark(kind, None if shown is None else shown.measurements),
    )


def _remark(kind: type[Effect], measurements: tuple[str, ...] | None) -> str | None:
    """Why a diagnosis never names an effect."""
    if not kind.is_candidate:
        return NOT_SOUGHT
    if measurements is None:
        return NOT_DERIVED
    return None if measurements else UNSEEN
