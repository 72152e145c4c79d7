"""The key of the request, the camera model's parameters, and the library of effects."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends

from api.errors import answers, find_or_404
from api.keys import Permission, StoredKey
from api.schemas import Me
from api.security import Demand
from api.service import READ
from lab.diagnose.visibility import EffectDescription, ParameterDescription, effect_description, effect_list
from sim.camera import CameraModel, Lens
from sim.parameters import read_quantities

router = APIRouter()


@router.get("/me", tags=["access"], responses=answers(401))
def me(key: Annotated[StoredKey, Depends(Demand(Permission.READ))]) -> Me:
    """Name and scope of the key of the request."""
    return Me(name=key.name, scope=key.scope)


@router.get("/parameters", tags=["knowledge"], dependencies=[READ], responses=answers(401))
def list_parameters() -> list[ParameterDescription]:
    """The parameters of the camera model with unit, bounds and prior; those of its lens are called `lens.NAME`."""
    camera = [ParameterDescription.of(name, quantity) for name, quantity in read_quantities(CameraModel).items()]
    return camera + [
        ParameterDescription.of(f"lens.{name}", quantity) for name, quantity in read_quantities(Lens).items()
    ]


@router.get("/effects", tags=["knowledge"], dependencies=[READ], responses=answers(401))
def list_effects() -> list[EffectDescription]:
    """The library that a diagnosis chooses from; `remark` says why an effect is never named."""
    return list(effect_list().effects)


@router.get("/effects/{name}", tags=["knowledge"], dependencies=[READ], responses=answers(401, 404, 422))
def get_effect(name: str) -> EffectDescription:
    """One effect."""
    missing = f"no effect {name[:60]!r}; GET /api/v1/effects lists them"
    return find_or_404(missing, lambda: effect_description(name))
