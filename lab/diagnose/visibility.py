"""Which measurements show each effect, and which effects are rivals, derived from the reference study.

An effect is visible in a measurement where one of its prototypes changes a predicted number by more than rounding.
Rivals are pairs of effects whose whitened signatures have a cosine of `DecisionPolicy.rival_cosine` or more in some
part of a session: the whole, one measurement, or one condition of a measurement. (For independent measurements no other
subset has to be looked at: the cosine over several is a weighted mean of the single ones with weights that sum to 1 at
most, by Cauchy and Schwarz.)

Deriving takes about a minute, so that the result is kept in visibility.toml. docs/write_tables.py writes it anew; a
slow test compares."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic.fields import FieldInfo

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.rivals import parallel_pairs, signature_changes, symmetric, whitened
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.reference_study import reference_study
from lab.errors import InputError
from sim.effects import library
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.effects.library import candidates, effects
from sim.parameters import Frozen, Quantity
from sim.sensor.margins import Margins

TABLE = Path(__file__).with_name("visibility.toml")
#: Of the frames from which it is derived: masked pixels before the image, overscan behind it.
MARGINS = Margins(masked_rows=(4, 0), masked_cols=(4, 0), overscan_rows=(0, 12), overscan_cols=(0, 12))
#: Changes below this share of a number's standard deviation are rounding.
ROUNDING = 1e-6
#: Numbers that a condition has to have to count as a part of a session: of fewer, nuisance parameters leave no shape to
#: compare.
LEAST_NUMBERS = 8


@dataclass(frozen=True)
class EffectVisibility:
    """The measurements that show one effect, the kinds of capture that they need, and the effect's rivals."""

    effect: str
    measurements: tuple[str, ...]
    capture_kinds: tuple[str, ...]
    rivals: tuple[str, ...]


@cache
def visibility() -> dict[str, EffectVisibility]:
    """Effect -> its entry in visibility.toml. An effect that was added after the file was written is missing."""
    content = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    return {
        name: EffectVisibility(
            name, tuple(entry["measurements"]), tuple(entry["capture_kinds"]), tuple(entry["rivals"])
        )
        for name, entry in content.items()
    }


def derived_visibility(policy: DecisionPolicy | None = None) -> dict[str, EffectVisibility]:
    """Return the table, derived anew from both sides of the reference study."""
    policy = policy or DecisionPolicy()
    recordings = reference_study(margins=MARGINS)
    kind_of = {capture.id: capture.kind for capture in recordings.captures()}
    looked_for = {kind.name for kind in candidates()}
    measurements: dict[str, dict[str, None]] = {name: {} for name in effects()}
    kinds: dict[str, set[str]] = {name: set() for name in effects()}
    pairs: set[tuple[str, str]] = set()
    for side in recordings.sides:
        model, _ = measurement_model(recordings, side)
        if model is None:
            continue
        changes = signature_changes(model, effects().values())
        std = np.sqrt(np.concatenate([np.diag(block.covariance) for block in model.blocks]))
        for name, table in changes.items():
            changed = (np.abs(table) > ROUNDING * std[:, None]).any(axis=1)
            for measurement, captures in _shown(model, changed):
                measurements[name][measurement] = None
                kinds[name] |= {kind_of[capture] for capture in captures}
        compared = {name: table for name, table in changes.items() if name in looked_for}
        for part in _parts(model):
            pairs |= parallel_pairs(whitened(model, compared, part), policy.rival_cosine)
    rivals = symmetric(effects(), pairs)
    return {
        name: EffectVisibility(name, tuple(measurements[name]), tuple(sorted(kinds[name])), tuple(sorted(rivals[name])))
        for name in effects()
    }


def _shown(model: MeasurementModel, changed: np.ndarray) -> Iterator[tuple[str, set[str]]]:
    """Measurements of changed numbers, and their captures."""
    for block, at in zip(model.blocks, model.slices, strict=True):
        labels = [label for label, is_changed in zip(block.labels, changed[at], strict=True) if is_changed]
        if labels:
            yield block.measurement.name, {capture for label in labels for capture in label.captures}


def _parts(model: MeasurementModel) -> Iterable[np.ndarray]:
    """Masks (n,) of the session's parts: the whole, each measurement, and each condition of one."""
    yield np.ones(len(model.value), bool)
    for index, (block, at) in enumerate(zip(model.blocks, model.slices, strict=True)):
        yield model.mask(index)
        if block.measurement.conditions:
            condition = np.array([label.condition for label in block.labels])
            for one in np.unique(condition):
                part = np.zeros(len(model.value), bool)
                part[at] = condition == one
                if LEAST_NUMBERS <= part.sum() < len(condition):
                    yield part


def as_toml(table: Mapping[str, EffectVisibility]) -> str:
    """Return the table as the text of visibility.toml."""
    lines = ["# Generated by docs/write_tables.py from the reference study; see visibility.py."]
    for name, one in table.items():
        lines += ["", f"[{name}]"]
        for key in ("measurements", "capture_kinds", "rivals"):
            values = ", ".join(f'"{value}"' for value in getattr(one, key))
            lines.append(f"{key} = [{values}]")
    return "\n".join(lines) + "\n"


# --- The library of effects as a document: what `calibench effects` prints and the REST service returns ---------------


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
