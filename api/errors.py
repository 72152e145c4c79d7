"""Errors as HTTP responses: one line in `detail`, and a status."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from lab.errors import DeviceError, InputError

log = logging.getLogger(__name__)
T = TypeVar("T")


class Conflict(Exception):
    """The request conflicts with what is under way (status 409)."""


class Problem(BaseModel):
    """The body of every error response."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {"detail": "no session '20300101-120000-abcdef'; GET /api/v1/sessions lists them"}
        }
    )

    detail: str


_MEANINGS = {
    400: "a Host that isn't this service's",
    401: "no valid key",
    403: "the key's scope doesn't reach, or a foreign Origin",
    404: "there is no such thing",
    409: "conflicts with what is under way",
    413: "larger than allowed",
    422: "can't be used: what, where, remedy",
    429: "too often",
    503: "an instrument failed",
}


def answers(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's error responses of a route. They are JSON whatever the route returns, so FastAPI's `model` doesn't fit."""
    content = {"application/json": {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}}
    return {status: {"description": _MEANINGS[status], "content": content} for status in statuses}


def known(what: str, look: Callable[[], T]) -> T:
    """The result of `look`. Raises 404 with `what` as its one line where `look` raises InputError."""
    try:
        return look()
    except InputError:
        raise HTTPException(404, what) from None


def _one_line(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip()) or type(error).__name__


def _answer(status: int) -> Callable[[Request, Exception], JSONResponse]:
    def handler(request: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"detail": _one_line(error)}, status)

    return handler


def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    lines = []
    for one in error.errors():
        where = ".".join(str(part) for part in one["loc"] if part != "body") or "body"
        lines.append(f"{where}: {one['msg']}")
    return JSONResponse({"detail": "; ".join(lines)}, 422)


class DefectMiddleware:
    """Turns an unexpected exception into status 500. Its text stays in the log."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        begun = False

        async def watched(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self.app(scope, receive, watched)
        except Exception as error:
            log.exception("%s %s: a defect", scope.get("method"), scope.get("path"))
            if begun:
                raise
            said = f"{type(error).__name__}: a defect of calibench; its log says more"
            await JSONResponse({"detail": said}, 500)(scope, receive, send)


def install(app: FastAPI) -> None:
    """Turn exceptions of `lab` into answers."""
    app.add_exception_handler(InputError, _answer(422))
    app.add_exception_handler(DeviceError, _answer(503))
    app.add_exception_handler(Conflict, _answer(409))
    app.add_exception_handler(RequestValidationError, _invalid)
