"""JSON's kinds in requests: true is no number, 1 is no truth value, "3" is no number."""

from __future__ import annotations

import json
from typing import Any, Literal, get_args, get_origin


def _kinds(annotation: Any) -> set[Any]:
    """Return the plain kinds that an annotation allows for a value, those of a sequence's items and a mapping's values
    among them."""
    if get_origin(annotation) is Literal:
        return {type(value) for value in get_args(annotation)}
    arguments = get_args(annotation)
    if not arguments:
        return {annotation}
    if get_origin(annotation) is dict:
        return _kinds(arguments[1])
    return {kind for argument in arguments for kind in _kinds(argument)}


def check_kind(where: str, value: Any, annotation: Any) -> None:
    """Check that a value has the kind that an annotation states, without a conversion. Raises ValueError where it
    hasn't.

    where : of the value, for the message

    >>> check_kind("exposure_s", 0.1, float)
    """
    kinds = _kinds(annotation)
    _check(where, value, kinds - {type(None), Ellipsis}, none_allowed=type(None) in kinds)


def _check(where: str, value: Any, wanted: set[Any], *, none_allowed: bool) -> None:
    shown = json.dumps(value) if isinstance(value, bool) else repr(value)[:60]
    numbers = bool(wanted & {int, float})
    if isinstance(value, list | tuple):
        for number, item in enumerate(value):
            _check(f"{where}.{number}", item, wanted, none_allowed=none_allowed)
    elif isinstance(value, dict):
        for name, item in value.items():
            _check(f"{where}.{name}", item, wanted, none_allowed=none_allowed)
    elif value is None and numbers and not none_allowed:
        raise ValueError(f"{where}: null isn't a number; write one")
    elif isinstance(value, bool) and numbers and bool not in wanted:
        raise ValueError(f"{where}: {shown} isn't a number; write one")
    elif isinstance(value, str) and numbers and wanted <= {int, float}:
        raise ValueError(f"{where}: {shown} isn't a number; write it without quotes")
    elif isinstance(value, str | int | float) and not isinstance(value, bool) and wanted == {bool}:
        raise ValueError(f"{where}: {shown} isn't true or false; write one of them, without quotes")
