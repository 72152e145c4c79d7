"""The library of effects as a document: what `calibench effects` prints and the REST service returns."""

from __future__ import annotations

from typing import Literal

from lab.diagnose.visibility import visibility
from lab.errors import InputError
from sim.effects import library
from sim.effects.base import Effect
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
        """The declaration of the quantity `name`."""
        return cls(
            name=name,
            unit=quantity.unit,
            meaning=quantity.meaning,
            lower=quantity.lower,
            upper=quantity.upper,
            prior=quantity.prior,
            absent=quantity.absent,
        )


class EffectDescription(Frozen):
    """An effect of the library.

    stages : the stages of the forward model in which it acts, in the order of the light
    sentence : what physics a model without it leaves out
    reference : where its law comes from
    measurements, capture_kinds : measurements of a diagnosis that can show it, and the captures that they rest on; derived
    rivals : effects that look the same in some part of a session; derived
    invariances : what it doesn't depend on
    remark : why a diagnosis never names it; None for an effect that can be named
    """

    name: str
    stages: tuple[str, ...]
    sentence: str
    reference: str
    parameters: tuple[ParameterDescription, ...]
    measurements: tuple[str, ...]
    capture_kinds: tuple[str, ...]
    rivals: tuple[str, ...]
    invariances: tuple[str, ...]
    remark: str | None


class EffectList(Frozen):
    """What `calibench effects --json FILE` writes."""

    format: Literal["calibench-effects"] = "calibench-effects"
    version: Literal[1] = 1
    effects: tuple[EffectDescription, ...]


def effect_list() -> EffectList:
    """All effects of the library."""
    return EffectList(effects=tuple(_described(kind) for kind in library.effects().values()))


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
        stages=kind.stages(),
        sentence=kind.sentence,
        reference=kind.reference,
        parameters=tuple(ParameterDescription.of(name, quantity) for name, quantity in kind.quantities().items()),
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
