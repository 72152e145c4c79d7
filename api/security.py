"""Access control: keys and how often one may fail, the page's cookie, Host and Origin, security headers, limits of
request bodies.

A key is sent in the header `Authorization: Bearer KEY`, never in a URL. The operator's page exchanges it for a cookie
that scripts can't read and other sites can't send. A second cookie of this kind allows a halt and nothing else. It
outlives the service, whose logins end with its process: the page can halt also before the key is typed again.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import HTTPException, Request, Response, Security
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.errors import problem
from api.failed_keys import FailedKeys
from api.keys import HALT_TOKEN_LIFETIME, Permission, StoredKey, digest, holder

COOKIE = "calibench"
COOKIE_LIFETIME_S = 12 * 3600.0
HALT_COOKIE = "calibench_halt"


@dataclass
class Logins:
    """The logins of the operator's page: random tokens, kept in memory until the process ends."""

    clock: Callable[[], float] = time.monotonic
    _tokens: dict[str, tuple[StoredKey, float]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def open(self, key: StoredKey) -> str:
        """Return a token for `key`, valid for twelve hours."""
        token, at = secrets.token_urlsafe(32), self.clock()
        with self._lock:
            self._tokens = {known: entry for known, entry in self._tokens.items() if at < entry[1]}
            self._tokens[digest(token)] = (key, at + COOKIE_LIFETIME_S)
        return token

    def holder(self, token: str) -> StoredKey | None:
        """Return the key that `token` was made for; None for an unknown or expired token."""
        with self._lock:
            key, until = self._tokens.get(digest(token), (None, 0.0))
        return key if key is not None and self.clock() < until else None

    def close(self, token: str) -> None:
        """Forget `token`."""
        with self._lock:
            self._tokens.pop(digest(token), None)


class TooManyFailures(Exception):
    """The key isn't compared: its address has sent too many that weren't valid. `wait_s`: when it may try again."""

    def __init__(self, wait_s: int) -> None:
        super().__init__(f"too many keys that aren't valid; try again in {wait_s} s")
        self.wait_s = wait_s


@dataclass
class Gate:
    """Identifies the key of a request; one per application."""

    #: The keys as they are (True), or as they were known just now.
    keys: Callable[[bool], Iterable[StoredKey]]
    #: Whether those that were known just now are at hand.
    is_quick: Callable[[], bool] = lambda: False
    logins: Logins = field(default_factory=Logins)
    failures: FailedKeys = field(default_factory=FailedKeys)
    #: The key that the halt token of a hash was made for; None: it isn't valid.
    halt_token_key: Callable[[str], StoredKey | None] = lambda sha256: None
    #: SHA-256 of keys that were valid once: these are compared whatever their address did.
    _proven: set[str] = field(default_factory=set)

    def check(self, key: str, address: str) -> StoredKey | None:
        """Return the stored key that `key` is, or None. Raises TooManyFailures without comparing where the address has
        none left."""
        mine = digest(key)
        if mine not in self._proven and (wait_s := self.failures.wait_s(address)):
            raise TooManyFailures(wait_s)
        holder_of_key = holder(key, self.keys(False)) or holder(key, self.keys(True))
        if holder_of_key is None:
            self._proven.discard(mine)
            self.failures.count_failure(address)
        else:
            self._proven.add(mine)
        return holder_of_key

    def identify(self, request: Request) -> StoredKey | None:
        """Return the key of a request, from the Authorization header, else from the page's cookie; None without a valid
        one. Raises TooManyFailures. A request is identified once, however often it is asked."""
        if not hasattr(request.state, "key"):
            request.state.key = self._identify(request)
        key: StoredKey | None = request.state.key
        return key

    def _identify(self, request: Request) -> StoredKey | None:
        header = request.headers.get("authorization", "")
        scheme, _, key = header.partition(" ")
        if header:
            usable = scheme.lower() == "bearer" and key.strip()
            return self.check(key.strip(), address_of(request)) if usable else None
        token = request.cookies.get(COOKIE)
        login = self.logins.holder(token) if token else None
        # A key that was taken away takes its logins with it.
        return login if login is not None and login in self.keys(False) else None

    def identify_for_halt(self, request: Request) -> StoredKey | None:
        """Return the key of a request as `identify` does, else the key that its halt token was made for."""
        identified = self.identify(request)
        token = request.cookies.get(HALT_COOKIE)
        return identified if identified is not None or not token else self.halt_token_key(digest(token))


def address_of(request: Request) -> str:
    """Return the address that a request came from; a proxy's where there is one."""
    return request.client.host if request.client is not None else "unknown"


_BEARER = HTTPBearer(
    scheme_name="key",
    auto_error=False,
    description="A key: `calibench key create NAME --scope SCOPE` makes one, the first start of the service makes the "
    "first.",
)
_COOKIE = APIKeyCookie(
    name=COOKIE, scheme_name="login", auto_error=False, description="What `POST /login` gives the operator's page."
)


_HALT = APIKeyCookie(
    name=HALT_COOKIE,
    scheme_name="halt",
    auto_error=False,
    description="What `POST /login` gives the operator's page for a halt and nothing else, also after a "
    "restart of the service.",
)


class Demand:
    """A dependency of a route: 401 without a valid key, 403 for a key whose scope allows none of `wanted`."""

    def __init__(self, *wanted: Permission) -> None:
        self.wanted = wanted

    def __call__(
        self,
        request: Request,
        bearer: Annotated[HTTPAuthorizationCredentials | None, Security(_BEARER)],
        cookie: Annotated[str | None, Security(_COOKIE)],
    ) -> StoredKey:
        """Return the key of the request. `bearer` and `cookie` are parameters only so that OpenAPI lists the two
        schemes."""
        gate: Gate = request.app.state.gate
        return self._check(gate.identify(request))

    def _check(self, key: StoredKey | None) -> StoredKey:
        if key is None:
            raise HTTPException(
                401,
                "no valid key: send 'Authorization: Bearer KEY'; `calibench key create NAME` makes one",
                headers={"WWW-Authenticate": "Bearer"},
            )
        if not any(key.scope.allows(wanted) for wanted in self.wanted):
            needed = " or ".join(f"'{wanted}'" for wanted in self.wanted)
            raise HTTPException(403, f"key '{key.name}' has the scope '{key.scope}', this needs {needed}")
        return key


class DemandHalt(Demand):
    """A dependency of a halt: a key as `Demand` has it, or a halt token."""

    def __init__(self) -> None:
        super().__init__(Permission.OPERATE, Permission.CALIBRATE)

    def __call__(
        self,
        request: Request,
        bearer: Annotated[HTTPAuthorizationCredentials | None, Security(_BEARER)],
        cookie: Annotated[str | None, Security(_COOKIE)],
        halt: Annotated[str | None, Security(_HALT)] = None,
    ) -> StoredKey:
        gate: Gate = request.app.state.gate
        return self._check(gate.identify_for_halt(request))


def set_cookies(response: Response, login: str, halt: str | None, *, secure: bool) -> None:
    """Set the cookies of a login and of a halt token: hidden from scripts, sent only to this service."""
    life_s = HALT_TOKEN_LIFETIME.total_seconds()
    for name, token, seconds in ((COOKIE, login, COOKIE_LIFETIME_S), (HALT_COOKIE, halt, life_s)):
        if token is not None:
            response.set_cookie(
                name, token, max_age=int(seconds), httponly=True, samesite="strict", secure=secure, path="/"
            )


class SameHost:
    """Refuses a foreign Host (against DNS rebinding), and a foreign Origin where the request changes state (against
    cross-site requests)."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self.app = app
        self.hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 400 (Host) or 403 (Origin)."""
        if scope["type"] == "http" and (refusal := self._refusal(scope)) is not None:
            await refusal(scope, receive, send)
            return
        if scope["type"] == "websocket":  # there are none
            return
        await self.app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        named = headers.getlist("host")
        try:
            host = (urlsplit("//" + named[0]).hostname or "") if len(named) == 1 else ""
        except ValueError:
            host = ""
        if host not in self.hosts:
            return problem(
                400, f"Host {host[:80]!r} is not one of this service's; `calibench serve --allow-host` adds one"
            )
        origin = headers.get("origin")
        if origin is not None and scope["method"] not in ("GET", "HEAD", "OPTIONS"):
            try:
                origin_host = urlsplit(origin).netloc.lower()
            except ValueError:
                origin_host = ""
            if origin_host != named[0].lower():
                expected = f"http(s)://{named[0]}"
                return problem(
                    403,
                    f"Origin: {origin[:80]!r} isn't this service's, which is {expected!r} here; open the page under "
                    "that address, or send no Origin",
                )
        return None


PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
#: A report carries its own scripts and pictures, and needs nothing else: no network, no cookie, an origin of its own.
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class SafeHeaders:
    """Adds the security headers to every response. A route that needs another policy sets its own."""

    DEFAULTS: dict[str, str] = {
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Content-Security-Policy": PAGE_POLICY,
        "Cache-Control": "no-store",
    }

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and add the headers to its response."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self.DEFAULTS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self.app(scope, receive, with_headers if scope["type"] == "http" else send)


class SmallBodies:
    """Refuses bodies above `limit_bytes`, by their stated or their streamed size. `except_paths` have a limit of their
    own."""

    def __init__(self, app: ASGIApp, limit_bytes: int, except_paths: frozenset[str]) -> None:
        self.app, self.limit_bytes, self.except_paths = app, limit_bytes, except_paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on while its body is below the limit, else answer 413."""
        if scope["type"] != "http" or (scope["method"] == "POST" and scope["path"] in self.except_paths):
            await self.app(scope, receive, send)
            return
        stated = Headers(scope=scope).get("content-length", "0")
        if not stated.isdigit() or int(stated) > self.limit_bytes:
            await self._refuse(scope, receive, send)
            return
        taken = 0

        async def count_bytes() -> Message:
            nonlocal taken
            message: Message = await receive()
            taken += len(message.get("body", b""))
            if taken > self.limit_bytes:
                raise HTTPException(
                    413, self._why, headers={"Connection": "close"}
                )  # FastAPI's, while it reads the body
            return message

        await self.app(scope, count_bytes, send)

    @property
    def _why(self) -> str:
        return f"the body is larger than {self.limit_bytes} bytes; send less"

    async def _refuse(self, scope: Scope, receive: Receive, send: Send) -> None:
        await problem(413, self._why, {"Connection": "close"})(scope, receive, send)
