"""All effects, discovered: every module of this package is searched for subclasses of `Effect`."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

import sim.effects
from sim.effects.base import Effect


@cache
def effects() -> dict[str, type[Effect]]:
    """Name -> effect, in the order of the names."""
    found: dict[str, type[Effect]] = {}
    for module in pkgutil.iter_modules(sim.effects.__path__):
        content = importlib.import_module(f"sim.effects.{module.name}")
        for item in vars(content).values():
            if (
                isinstance(item, type)
                and issubclass(item, Effect)
                and item.__module__ == content.__name__
                and "name" in vars(item)  # not a base of several
            ):
                found[item.name] = item
    return dict(sorted(found.items()))


def effect(name: str) -> type[Effect]:
    """The effect of that name; raises KeyError that lists the names there are."""
    known = effects()
    if name not in known:
        raise KeyError(f"no effect named {name!r}; there are: {', '.join(known)}")
    return known[name]


def candidates() -> tuple[type[Effect], ...]:
    """The effects that a diagnosis looks for."""
    return tuple(kind for kind in effects().values() if kind.shown_by)
