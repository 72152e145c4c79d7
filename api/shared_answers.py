"""While a session runs here, an answer that many clients ask for is made once for all who ask within half a second.

The cores belong to the session then. Lists, a session, its captures and curves are shared; what a client changes, and
every change of a session's or a job's state, is seen by the next request. Only the count of a running session's steps
and captures may be half a second old. The key of each request is checked as ever.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.keys import Permission
from api.security import Gate, TooManyFailures

#: How long (s) an answer is shared, the largest that is (bytes), and how many are kept.
FRESH_S, LARGEST_BYTES, MOST = 0.5, 1 << 18, 256
#: What is shared, below the API's prefix: what every key may read, and no stream.
_SHARED = re.compile(
    r"/(sessions|jobs|stations|queue|recordings|calibrations|camera-models|figures|history|drift)\b(?!.*/(events|archive|frame))"
)


@dataclass
class _Answer:
    """An answer that is being made, or was; `body` is None where it can't be shared."""

    until_s: float
    headers: tuple[tuple[bytes, bytes], ...] = ()
    body: bytes | None = None
    route: Any = None
    made: asyncio.Event = field(default_factory=asyncio.Event)


class Shared:
    """The answers that are shared now; one per application."""

    def __init__(self) -> None:
        self._answers: dict[str, _Answer] = {}

    def forget(self) -> None:
        """Forget what is kept, as something changed: the next request of each kind is answered anew. May be called by
        any thread.
        """
        self._answers = {}

    def find(self, asked: str) -> _Answer | None:
        """Return the answer that others got, or wait for; None where there is none."""
        answer = self._answers.get(asked)
        return answer if answer is not None and time.monotonic() < answer.until_s else None

    def begin(self, asked: str) -> _Answer:
        """Return an answer that is going to be made."""
        if len(self._answers) >= MOST:
            self.forget()
        made = self._answers[asked] = _Answer(time.monotonic() + FRESH_S)
        return made


class SharedAnswers:
    """Answers a GET below `prefix` with what another client was answered just now, as long as `busy` says that a
    session runs."""

    def __init__(self, app: ASGIApp, shared: Shared, prefix: str, busy: Callable[[], bool], gate: Gate) -> None:
        self.app, self.shared, self.prefix, self.busy, self.gate = app, shared, prefix, busy, gate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it."""
        if scope["type"] != "http" or not scope["path"].startswith(self.prefix):
            await self.app(scope, receive, send)
        elif scope["method"] not in ("GET", "HEAD"):
            await self._change(scope, receive, send)
        elif scope["method"] == "GET" and self.busy() and self._shareable(scope) and await self._may_read(scope):
            await self._share(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    def _shareable(self, scope: Scope) -> bool:
        conditional = any(name in (b"if-none-match", b"range") for name, _ in scope["headers"])
        return not conditional and _SHARED.match(scope["path"], len(self.prefix)) is not None

    async def _may_read(self, scope: Scope) -> bool:
        """Return whether the request has a key that may read; where it hasn't, the route says so."""
        gate, request = self.gate, Request(scope)
        try:
            key = gate.identify(request) if gate.is_quick() else await asyncio.to_thread(gate.identify, request)
        except TooManyFailures:
            return False
        return key is not None and key.scope.allows(Permission.READ)

    async def _change(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a change on; whoever hears of it is answered anew."""

        async def pass_on(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.shared.forget()
            await send(message)

        try:
            await self.app(scope, receive, pass_on)
        finally:
            self.shared.forget()

    async def _share(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked = f"{scope['path']}?{scope['query_string'].decode('latin-1')}"
        answer = self.shared.find(asked)
        if answer is not None:
            await answer.made.wait()
            if answer.body is not None:
                scope["route"] = answer.route  # which the metrics name
                await send({"type": "http.response.start", "status": 200, "headers": list(answer.headers)})
                await send({"type": "http.response.body", "body": answer.body, "more_body": False})
                return
        mine = self.shared.begin(asked)
        status = 0

        async def keep(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status, mine.headers, mine.route = message["status"], tuple(message["headers"]), scope.get("route")
            elif not mine.made.is_set():
                content = message.get("body", b"")
                if status == 200 and not message.get("more_body", False) and len(content) <= LARGEST_BYTES:
                    mine.body = content
                mine.made.set()  # before it is sent: this client may be slow
            await send(message)

        try:
            await self.app(scope, receive, keep)
        finally:
            mine.made.set()
