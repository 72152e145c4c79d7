"""What a bench may conceal: effects of the library, with parameters, on one side or on both.

    left:nonlinearity:quadratic_percent=2
    both:source_drift:drift_percent_per_min=0.5,settling_min=8

Effects on the light (lamp, monochromator, radiometer, screen, room, pair) act on both sides, as both cameras stand at
one rig."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import effects as library

SIDES: tuple[Side, ...] = ("left", "right")
Concealed = Mapping[Side, tuple[Effect, ...]]

#: Effects that this bench can't show, and why.
NOT_SHOWN: dict[str, str] = {
    "second_order_light": "the lamp's light ends at 730 nm, and the cameras see nothing of half the wavelength",
    "stereo_time_offset": "every target of this bench stands still, and only what moves tells when a camera captures",
}

#: Effects of what the radiometer says: the light stays as it is.
OF_THE_RADIOMETER = frozenset({"wavelength_offset", "radiometer_nonlinearity"})


class ConcealError(ValueError):
    """A specification that can't be used; the message is one line."""


def parse(specs: Iterable[str]) -> Concealed:
    """Return the effects that a bench conceals, by side.

    specs : `SIDE:EFFECT[:PARAMETER=VALUE,...]` each; the side is left, right or both

    Raises `ConcealError` that names the effect, the parameter or the limit, and what may be chosen.

    >>> [effect.name for effect in parse(["left:defocus:defocus_um=10"])["left"]]
    ['defocus']
    """
    by_side: dict[Side, tuple[Effect, ...]] = {"left": (), "right": ()}
    for spec in specs:
        sides, effect = _parse(spec.strip())
        for side in sides:
            if any(type(acting) is type(effect) for acting in by_side[side]):
                raise ConcealError(f"--conceal {spec}: {effect.name} is concealed on the {side} already; give it once")
            by_side[side] = (*by_side[side], effect)
    return by_side


def _parse(spec: str) -> tuple[tuple[Side, ...], Effect]:
    where, _, rest = spec.partition(":")
    name, _, text = rest.partition(":")
    sides: tuple[Side, ...] = SIDES if where == "both" else tuple(side for side in SIDES if side == where)
    if not sides:
        raise ConcealError(
            f"--conceal {spec}: {where!r} is no side; write SIDE:EFFECT:PARAMETER=VALUE with left, right or both"
        )
    if name not in library():
        alike = get_close_matches(name.strip().lower(), library(), 3)
        meant = f"did you mean {' or '.join(alike)}? " if alike else ""
        raise ConcealError(f"--conceal {spec}: no effect named {name!r}; {meant}`calibench effects` lists them")
    if name in NOT_SHOWN:
        raise ConcealError(f"--conceal {spec}: the bench can't show {name}: {NOT_SHOWN[name]}")
    kind = library()[name]
    if "light" in kind.stages() and sides != SIDES:
        raise ConcealError(f"--conceal {spec}: {name} is of the rig before both cameras; write both:{name}:{text}")
    return sides, _make_effect(spec, kind, text)


def _make_effect(spec: str, kind: type[Effect], text: str) -> Effect:
    quantities = kind.quantities()
    names = (*quantities, *(name for name, field in kind.choices().items() if _is_one_value(field.annotation)))
    known = ", ".join(names)
    values: dict[str, Any] = {}
    for part in text.split(",") if text else ():
        field, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or field not in names:
            raise ConcealError(
                f"--conceal {spec}: {kind.name} has no parameter {field!r}; write PARAMETER=VALUE with {known}"
            )
        if field in values:
            raise ConcealError(f"--conceal {spec}: {field} is given twice; give it once")
        values[field] = value
    # a number among listed ones is no string that pydantic would take for it
    listed = {
        name: value for name in values for value in _integers(kind.choices().get(name)) if str(value) == values[name]
    }
    try:
        effect = kind.model_validate_strings({name: text for name, text in values.items() if name not in listed})
        effect = effect.replace_fields(**listed)
    except ValidationError as error:
        first = error.errors()[0]
        field = str(first["loc"][0]) if first["loc"] else ""
        problem = str(first["msg"]).removeprefix("Value error, ")
        if field in quantities and not problem.startswith(quantities[field].meaning):
            unit = quantities[field].unit
            problem = (
                f"{values[field]!r} is no number; give one{'' if unit == '1' else f', which is in {unit}'}, without a "
                "unit"
            )
        raise ConcealError(f"--conceal {spec}: {' '.join((kind.name, field)).strip()}: {problem}") from None
    if effect == kind():
        raise ConcealError(f"--conceal {spec}: nothing of {kind.name} would be there; give a value of {known}")
    return effect


def _integers(choice: FieldInfo | None) -> tuple[int, ...]:
    """Integers among which a choice is made."""
    annotation = None if choice is None else choice.annotation
    values = get_args(annotation) if get_origin(annotation) is Literal else ()
    return tuple(value for value in values if isinstance(value, int))


def _is_one_value(annotation: Any) -> bool:
    """Return whether a field of that type can be given as VALUE."""
    if isinstance(annotation, UnionType) or get_origin(annotation) is Union:
        return all(_is_one_value(part) for part in get_args(annotation))
    return annotation in (int, float, bool, type(None)) or get_origin(annotation) is Literal


def check(concealed: Concealed) -> None:
    """Raises `ConcealError` for effects that the bench can't show, and for effects of the rig that differ from side to
    side."""
    rig = {side: [effect for effect in concealed.get(side, ()) if "light" in effect.stages()] for side in SIDES}
    if rig["left"] != rig["right"]:
        names = sorted({effect.name for side in SIDES for effect in rig[side]})
        raise ConcealError(f"{', '.join(names)}: of the rig before both cameras; conceal the same on both sides")
    for side in SIDES:
        for effect in concealed.get(side, ()):
            if effect.name in NOT_SHOWN:
                raise ConcealError(f"the bench can't show {effect.name}: {NOT_SHOWN[effect.name]}")
