"""Query parameters that a route doesn't have are refused: a name that is mistyped would be ignored silently. So are
control characters in a path or a query."""

from __future__ import annotations

from typing import Any

from fastapi import HTTPException, Request
from fastapi.dependencies.models import Dependant
from pydantic import BaseModel

from lab.plain_text import complaints_of, escaped


def _names(field: Any) -> list[str]:
    kind = field.field_info.annotation
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return list(kind.model_fields)
    return [field.alias]


def _query(dependant: Dependant) -> list[Any]:
    """Return the query parameters of a route and of all that it depends on."""
    return [*dependant.query_params, *(field for dependency in dependant.dependencies for field in _query(dependency))]


async def check_query(request: Request) -> None:
    """Raise 404 or 422 for a control character, and 422, naming those that there are, where a request with a valid key
    has a query parameter that its route doesn't take."""
    for name, value in request.path_params.items():
        for complaint in complaints_of(str(value)):
            raise HTTPException(404, f"{name}: {complaint}")
    for name, value in request.query_params.multi_items():
        for complaint in (*complaints_of(name), *complaints_of(value)):
            raise HTTPException(422, f"{escaped(name)[:60]}: {complaint}")
    if not request.query_params:
        return
    known = [name for field in _query(request.scope["route"].dependant) for name in _names(field)]
    for name in request.query_params:
        if name not in known:
            if request.app.state.gate.identify(request) is None:
                return  # the route answers that there is no valid key
            there = f"it takes {', '.join(known)}" if known else "it takes none"
            raise HTTPException(422, f"{name[:60]!r}: isn't a query parameter of {request.url.path}; {there}")
