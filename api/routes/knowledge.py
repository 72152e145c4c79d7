"""The key of the request, the camera model's parameters, and the library of effects."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException

from api.errors import answers
from api.keys import Permission, StoredKey
from api.schemas import Effect, Me, Parameter
from api.security import Demand
from api.service import READ
from lab.diagnose.visibility import visibility
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect as EffectType
from sim.effects.library import effects
from sim.parameters import Quantity, declared

router = APIRouter()


@router.get("/me", tags=["access"], responses=answers(401))
def me(key: Annotated[StoredKey, Depends(Demand(Permission.READ))]) -> Me:
    """Name and scope of the key of the request."""
    return Me(name=key.name, scope=key.scope)


def _parameter(name: str, quantity: Quantity) -> Parameter:
    return Parameter(
        name=name,
        unit=quantity.unit,
        meaning=quantity.meaning,
        lower=quantity.lower,
        upper=quantity.upper,
        prior=quantity.prior,
        absent=quantity.absent,
    )


@router.get("/parameters", tags=["knowledge"], dependencies=[READ], responses=answers(401))
def list_parameters() -> list[Parameter]:
    """The parameters of the camera model with unit, bounds and prior; those of its lens are called `lens.NAME`."""
    camera = [_parameter(name, quantity) for name, quantity in declared(CameraModel).items()]
    return camera + [_parameter(f"lens.{name}", quantity) for name, quantity in declared(Lens).items()]


def _effect(effect: type[EffectType]) -> Effect:
    shown = visibility().get(effect.name)
    return Effect(
        name=effect.name,
        stage=", ".join(effect.stages()),
        reference=effect.reference,
        sentence=effect.sentence,
        parameters=tuple(_parameter(name, quantity) for name, quantity in effect.quantities().items()),
        measurements=shown.measurements if shown else (),
        shown_by=shown.capture_kinds if shown else (),
        rivals=shown.rivals if shown else (),
        invariances=tuple(sorted(effect.invariances)),
    )


@router.get("/effects", tags=["knowledge"], dependencies=[READ], responses=answers(401))
def list_effects() -> list[Effect]:
    """The library that a diagnosis chooses from."""
    return [_effect(effect) for effect in effects().values()]


@router.get("/effects/{name}", tags=["knowledge"], dependencies=[READ], responses=answers(401, 404, 422))
def get_effect(name: str) -> Effect:
    """One effect."""
    if name not in effects():
        raise HTTPException(404, f"no effect {name[:60]!r}; GET /api/v1/effects lists them")
    return _effect(effects()[name])
