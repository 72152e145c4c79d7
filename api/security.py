"""Who may do what: keys with scopes, a cookie for the page, checks of Host and Origin.

A key is 256 random bits. Only its SHA-256 is stored (a slow hash would protect nothing more at that entropy), compared in
constant time, sent in the header `Authorization: Bearer KEY`, never in a URL. The page swaps it once for a cookie that
scripts can't read and other sites can't send.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from urllib.parse import urlsplit

from fastapi import HTTPException, Request, Response
from starlette.types import ASGIApp, Receive, Scope, Send

COOKIE = "calibench"
COOKIE_LIFETIME_S = 12 * 3600.0


class Permission(StrEnum):
    """What a key allows. `operate` and `calibrate` include `read`; `admin` includes all."""

    READ = "read"
    OPERATE = "operate"
    CALIBRATE = "calibrate"
    ADMIN = "admin"

    def allows(self, wanted: Permission) -> bool:
        """Whether a key of this scope may do what needs `wanted`."""
        return self is wanted or self is Permission.ADMIN or wanted is Permission.READ


def new_key() -> str:
    """A fresh key: 256 random bits behind a prefix that secret scanners can find."""
    return "calibench_" + secrets.token_urlsafe(32)


def digest(key: str) -> str:
    """What is stored of a key."""
    return hashlib.sha256(key.encode()).hexdigest()


@dataclass(frozen=True)
class StoredKey:
    name: str
    scope: Permission
    sha256: str


def holder(key: str, stored: Iterable[StoredKey]) -> StoredKey | None:
    """The stored key that `key` is, or None; every stored key is compared, each in constant time."""
    mine = digest(key)
    found = None
    for candidate in stored:
        if hmac.compare_digest(mine, candidate.sha256):
            found = candidate
    return found


@dataclass
class Logins:
    """The page's sessions: random tokens in memory, gone with the process."""

    clock: Callable[[], float] = time.monotonic
    _tokens: dict[str, tuple[StoredKey, float]] = field(default_factory=dict)

    def open(self, key: StoredKey) -> str:
        """A token for `key`, good for twelve hours."""
        token = secrets.token_urlsafe(32)
        self._tokens[digest(token)] = (key, self.clock() + COOKIE_LIFETIME_S)
        return token

    def holder(self, token: str) -> StoredKey | None:
        """The key that opened `token`, or None where it is unknown or has run out."""
        key, until = self._tokens.get(digest(token), (None, 0.0))
        return key if key is not None and self.clock() < until else None

    def close(self, token: str) -> None:
        """Forget `token`."""
        self._tokens.pop(digest(token), None)


@dataclass(frozen=True)
class Gate:
    """Decides on each request; one per application."""

    keys: Callable[[], Iterable[StoredKey]]
    logins: Logins

    def identify(self, request: Request) -> StoredKey | None:
        """The key behind a request: from the Authorization header, else from the page's cookie."""
        header = request.headers.get("authorization", "")
        scheme, _, key = header.partition(" ")
        if scheme.lower() == "bearer" and key:
            return holder(key.strip(), self.keys())
        token = request.cookies.get(COOKIE)
        return self.logins.holder(token) if token else None

    def demand(self, wanted: Permission) -> Callable[[Request], Awaitable[StoredKey]]:
        """A FastAPI dependency: 401 without a valid key, 403 where its scope doesn't reach."""

        async def check(request: Request) -> StoredKey:
            key = self.identify(request)
            if key is None:
                raise HTTPException(
                    401,
                    "no valid key: send 'Authorization: Bearer KEY'; `calibench serve` prints one at its first start",
                    headers={"WWW-Authenticate": "Bearer"},
                )
            if not key.scope.allows(wanted):
                raise HTTPException(403, f"key '{key.name}' has the scope '{key.scope}', this needs '{wanted}'")
            return key

        return check


def set_cookie(response: Response, token: str, *, secure: bool) -> None:
    """Put a login's token where only the browser can send it, and only to us."""
    response.set_cookie(
        COOKIE, token, max_age=int(COOKIE_LIFETIME_S), httponly=True, samesite="strict", secure=secure, path="/"
    )


def is_loopback(host: str) -> bool:
    """Whether an address is this computer's own."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class SameHost:
    """Refuses a foreign Host (DNS rebinding) and a foreign Origin on anything that changes state (cross-site requests)."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self.app = app
        self.hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let the request pass, or answer 400 (Host) or 403 (Origin)."""
        if scope["type"] == "http":
            request = Request(scope)
            host = urlsplit("//" + request.headers.get("host", "")).hostname or ""
            if host not in self.hosts:
                response = Response(f"Host '{host}' is not one of this service's: {', '.join(sorted(self.hosts))}", 400)
                return await response(scope, receive, send)
            origin = request.headers.get("origin")
            if (
                origin is not None
                and request.method not in ("GET", "HEAD", "OPTIONS")
                and urlsplit(origin).netloc != request.headers.get("host")
            ):
                return await Response(f"Origin '{origin}' is not this service", 403)(scope, receive, send)
        await self.app(scope, receive, send)
        return None
