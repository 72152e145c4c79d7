"""Errors as HTTP responses: problem details (RFC 9457), with one line in `detail`."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any, TypeVar

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException as RouterException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.expected import Expected, paths_of
from lab.errors import CannotWrite, DeviceError, InputError, NoRoom, failure_of_environment

log = logging.getLogger(__name__)
T = TypeVar("T")


class Conflict(Exception):
    """The request conflicts with what is under way (status 409)."""


class Problem(BaseModel):
    """The body of every error response: problem details (RFC 9457). `detail` is one line: what, where, remedy."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "about:blank",
                "title": "Not Found",
                "status": 404,
                "detail": "no session '20300101-120000-abcdef'; GET /api/v1/sessions lists them",
            }
        }
    )

    type: str = "about:blank"
    title: str
    status: int
    detail: str


MEDIA_TYPE = "application/problem+json"


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """Return an error response: problem details (RFC 9457).

    status : of HTTP
    detail : one line: quantity, value, limit, remedy
    headers : further ones

    >>> problem(404, "no session 7").status_code
    404
    """
    body = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail)
    return Response(body.model_dump_json(), status, headers, MEDIA_TYPE)


_MEANINGS = {
    400: "a Host that isn't this service's, or a body that isn't JSON",
    401: "no valid key",
    403: "the key's scope doesn't reach, or a foreign Origin",
    404: "there is no such thing",
    405: "not this method; `Allow` names those of the path",
    409: "conflicts with what is under way",
    410: "it was removed; what took its place",
    413: "larger than allowed",
    422: "can't be used: what, where, remedy",
    429: "too many keys that aren't valid; `Retry-After` says when another is looked at",
    500: "a defect of calibench; its log says more",
    503: "an instrument or the data folder failed",
    507: "the data folder's disk is full: what to do",
}


def answers(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI's error responses of a route. They are problem details whatever the route returns, so that
    FastAPI's `model` doesn't fit.

    >>> list(answers(404, 422))
    [404, 422]
    """
    content = {MEDIA_TYPE: {"schema": {"$ref": f"#/components/schemas/{Problem.__name__}"}}}
    return {status: {"description": _MEANINGS[status], "content": content} for status in statuses}


def find_or_404(what: str, look: Callable[[], T]) -> T:
    """Return the result of `look`. Raises 404 with `what` as its one line where `look` raises InputError."""
    try:
        return look()
    except InputError:
        raise HTTPException(404, what) from None


def _one_line(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip()) or type(error).__name__


def _answer(status: int) -> Callable[[Request, Exception], Response]:
    def handler(request: Request, error: Exception) -> Response:
        return problem(status, request.app.state.public(_one_line(error)))

    return handler


def _unknown_in_path(request: Request, name: str) -> Response:
    """404: what a path names can't be there, as it isn't even formed as such names are. Says which list to look
    into."""
    paths = request.app.openapi()["paths"]
    listed = next(path for path in paths_of(request) if f"/{{{name}}}" in path).partition(f"/{{{name}}}")[0]
    where = listed
    while where and "get" not in paths.get(where, {}):
        where = where.rpartition("/")[0]
    detail = f"no {request.path_params[name][:60]!r} among the {listed.rpartition('/')[2].replace('-', ' ')}"
    return problem(404, request.app.state.public(f"{detail}; see GET {re.sub('{.*?}', 'ID', where)}"))


def _not_as_expected(request: Request, where: str, problem: Mapping[str, Any]) -> str:
    """Return one line for what pydantic found: the field, what was sent, what is expected, an example."""
    expected = Expected(request)
    if problem["type"] == "value_error":  # of our own checks, which name the value
        text = str(problem["msg"]).removeprefix("Value error, ")
        return f"{where}: {text}" if where else text
    if where:
        return f"{where}: {_of_field(expected, problem)}"
    sent = request.headers.get("content-type", "")
    also = "" if "json" in sent else f", with the header Content-Type: application/json (it is {sent[:60]!r})"
    what = "is missing" if problem.get("input") is None else "isn't a JSON object"
    return f"the body: {what}; send one, such as {expected.example()}{also}"


def _of_field(expected: Expected, problem: Mapping[str, Any]) -> str:
    kind, given, place = str(problem["type"]), problem.get("input"), problem["loc"]
    field = expected.field(place)
    give = f"; give {field}" if field else ""
    # A key that was sent is never repeated.
    shown = "what was sent" if place[-1] == "key" else json.dumps(given, ensure_ascii=False, default=str)[:60]
    match kind:
        case "extra_forbidden":
            text = f"there is no such field; those that there are: {', '.join(expected.names(place[:-1])) or 'none'}"
        case "string_too_long":
            text = f"{len(str(given))} characters, {problem['ctx']['max_length']} at most; shorten it"
        case "string_pattern_mismatch":  # ids alone have patterns
            text = f"{str(given)[:60]!r} is no id: take one that the lists have, of letters, digits and hyphens"
        case "timezone_aware":
            text = f"{shown} has no time zone{give}"
        case "too_short":
            text = f"{problem['ctx']['actual_length']} given, {problem['ctx']['min_length']} at least{give}"
        case "missing":
            text = f"is missing{give}"
        case _ if field and kind.endswith(("_type", "_parsing", "literal_error", "enum")):
            text = f"{shown} isn't taken{give}"
        case _:
            ends = re.sub(r"^[A-Z]\w+ (should|must)", r"\1", str(problem["msg"]))
            text = f"{shown} {ends}{give}"
    return text


def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    lines: list[str] = []
    for detail in error.errors():
        if detail["loc"][0] == "path" and detail["type"] != "literal_error":
            return _unknown_in_path(request, str(detail["loc"][1]))
        if detail["type"] == "json_invalid":
            lines.append(f"the body isn't JSON: {detail['ctx']['error']}, at character {detail['loc'][-1]}")
            continue
        where = ".".join(str(part) for part in detail["loc"] if part != "body")
        line = _not_as_expected(request, where, detail)
        if not any(
            known_line.startswith(f"{where}.") for known_line in lines
        ):  # it follows from the line on a part of it
            lines.append(line)
    return problem(422, request.app.state.public("; ".join(lines)))


def _answer_refusal(request: Request, error: Exception) -> Response:
    """Return what a route or the router refuses; of a wrong method, `Allow` names the methods of all routes of the
    path."""
    assert isinstance(error, RouterException)
    headers = dict(error.headers or {})
    if error.status_code == 405:
        paths = request.app.openapi()["paths"]
        methods = [method.upper() for path in paths_of(request) for method in paths[path]]
        headers["allow"] = ", ".join(dict.fromkeys(methods)) or headers.get("allow", "GET")
        return problem(405, f"{request.method} isn't for this path; use {headers['allow']}", headers)
    detail = str(error.detail)
    if detail == HTTPStatus.NOT_FOUND.phrase:  # the router's own
        detail = "there is no such path; /docs lists those that there are"
    if error.status_code == 400 and error.__cause__ is not None:  # the framework's, of a body that it can't decode
        detail = f"the body can't be read as JSON in UTF-8; send one, such as {Expected(request).example()}"
    return problem(error.status_code, request.app.state.public(detail), headers)


class DefectMiddleware:
    """Turns a failure of the disk, the registry or the network into status 507 or 503, and an unexpected exception into
    status 500, whose text stays in the log."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        begun = False

        async def watch(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self.app(scope, receive, watch)
        except ClientDisconnect:  # there is nobody to answer
            log.info("%s %s: the client broke off", scope.get("method"), scope.get("path"))
        except Exception as error:
            if (failure := failure_of_environment(error)) is not None and not begun:
                log.warning("%s %s: %s", scope.get("method"), scope.get("path"), failure)
                status = 507 if isinstance(failure, NoRoom) else 503
                await problem(status, scope["app"].state.public(_one_line(failure)))(scope, receive, send)
                return
            log.exception("%s %s: a defect", scope.get("method"), scope.get("path"))
            if begun:
                raise
            detail = f"{type(error).__name__}: a defect of calibench; its log says more"
            await problem(500, detail)(scope, receive, send)


def install(app: FastAPI) -> None:
    """Turn exceptions of `lab` into answers."""
    app.add_exception_handler(InputError, _answer(422))
    app.add_exception_handler(DeviceError, _answer(503))
    app.add_exception_handler(NoRoom, _answer(507))
    app.add_exception_handler(CannotWrite, _answer(503))
    app.add_exception_handler(Conflict, _answer(409))
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(RouterException, _answer_refusal)
