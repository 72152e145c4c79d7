"""All effects, discovered: every module of this package is searched for subclasses of `Effect`, and other packages add
theirs by entry points of the group `calibench.effects`."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Collection
from functools import cache, lru_cache

import sim.effects
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.extensions import extensions, refuse
from sim.spectrum import Spectrum
from sim.stages import laws_of


@cache
def effects() -> dict[str, type[Effect]]:
    """Name -> effect, in the order of the names."""
    library: dict[str, type[Effect]] = {}
    for module in pkgutil.iter_modules(sim.effects.__path__):
        content = importlib.import_module(f"sim.effects.{module.name}")
        for item in vars(content).values():
            if (
                isinstance(item, type)
                and issubclass(item, Effect)
                and item.__module__ == content.__name__
                and "name" in vars(item)  # not a base of several
            ):
                library[item.name] = item
    for name, kind in extensions("effects"):
        if (why := _why_refused(name, kind, library)) is not None:
            refuse("effects", name, why)
        else:
            library[name] = kind
    return dict(sorted(library.items()))


def _why_refused(name: str, kind: object, known: Collection[str]) -> str | None:
    """Return why another package's object can't be an effect; None: it can."""
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        return f"{kind!r} is no subclass of sim.effects.base.Effect"
    if kind.__dict__.get("name") != name:
        return f"its entry point's name isn't that of the effect, {kind.__dict__.get('name')!r}"
    return f"there is an effect {name!r} already" if name in known else None


def effect(name: str) -> type[Effect]:
    """Return the effect of a name. Raises KeyError that lists the names.

    >>> effect("defocus").__name__
    'Defocus'
    """
    known = effects()
    if name not in known:
        raise KeyError(f"no effect named {name!r}; there are: {', '.join(known)}")
    return known[name]


@cache
def members(family: Family) -> tuple[str, ...]:
    """List the names of the effects of a family that a diagnosis looks for.

    >>> "row_noise" in members(effect("row_noise").family)
    True
    """
    return tuple(kind.name for kind in candidates() if kind.family is family)


def candidates() -> tuple[type[Effect], ...]:
    """Return the effects that a diagnosis looks for."""
    return tuple(kind for kind in effects().values() if kind.is_candidate)


#: Any camera with a mosaic: which laws an effect adds doesn't depend on it.
_CAMERA = CameraModel(
    rows=16, cols=24, pixel_pitch_um=3.0, fill_factor=1.0, cfa="RGGB", bit_depth=12, black_level_dn=64.0,
    white_level_dn=4095.0,
    conversion_gain_dn_per_e=0.4, full_well_e=1e4, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=1.0,
    prnu_percent=1.0,
    quantum_efficiency={c: Spectrum.of((400.0, 700.0), (0.5, 0.5)) for c in "RGB"},
    lens=Lens(f_number=4.0, focal_length_mm=8.0),
)  # fmt: skip


@lru_cache(maxsize=4096)
def list_changes(effect: Effect) -> frozenset[str]:
    """Return which quantities of the stages the effect as it stands changes, as `stage.field`; none where it is
    absent."""
    return laws_of(_CAMERA, (effect,))


@cache
def may_change(kind: type[Effect]) -> frozenset[str]:
    """Return which quantities of the stages an effect changes at any of its prototypes."""
    every = (effect for group in kind.prototypes(_CAMERA) for effect in group)
    return frozenset().union(*(list_changes(effect) for effect in every))


def typical(kind: type[Effect]) -> Effect:
    """Return an instance of usual size: its first prototype, with each parameter that sizes it one standard deviation
    of its prior from `absent`.

    Parameters without a prior stay at the prototype's value.
    """
    first = kind.prototypes(_CAMERA)[0][0]
    sizes = {
        name: (quantity.absent or 0.0) + quantity.prior[1]
        for name, quantity in kind.quantities().items()
        if name not in kind.shapes and quantity.prior is not None
    }
    return first.replace_fields(**sizes)
