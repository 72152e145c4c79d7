"""Query parameters that a route doesn't have are refused: a name that is mistyped would be ignored silently."""

from __future__ import annotations

from typing import Any

from fastapi import HTTPException, Request
from fastapi.dependencies.models import Dependant
from pydantic import BaseModel


def _names(field: Any) -> list[str]:
    kind = field.field_info.annotation
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return list(kind.model_fields)
    return [field.alias]


def _query(dependant: Dependant) -> list[Any]:
    """Return the query parameters of a route and of all that it depends on."""
    return [*dependant.query_params, *(field for one in dependant.dependencies for field in _query(one))]


async def check_query(request: Request) -> None:
    """Raise 422, naming those that there are, where a request with a valid key has a query parameter that its route
    doesn't take."""
    if not request.query_params:
        return
    known = [name for field in _query(request.scope["route"].dependant) for name in _names(field)]
    for name in request.query_params:
        if name not in known:
            if request.app.state.gate.identify(request) is None:
                return  # the route answers that there is no valid key
            there = f"it takes {', '.join(known)}" if known else "it takes none"
            raise HTTPException(422, f"{name[:60]!r}: isn't a query parameter of {request.url.path}; {there}")
