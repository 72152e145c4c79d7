"""The header `Idempotency-Key`: a POST that is sent twice, because its answer got lost, is carried out once.

The first request's answer is kept for a day, and given again to a request of the same key, holder, path and body.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
from datetime import timedelta

import sqlalchemy as sa
from fastapi import HTTPException, Request
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.errors import problem
from api.security import TooManyFailures
from lab.capture.records import now
from lab.capture.store import Store
from lab.capture.tables import IdempotentRow

HEADER = "Idempotency-Key"
KEPT = timedelta(days=1)
_KEY = re.compile(r"[A-Za-z0-9_.:-]{1,100}")
#: OpenAPI's description of the header, for the routes that take it.
PARAMETER = {
    "name": HEADER,
    "in": "header",
    "required": False,
    "schema": {"type": "string", "pattern": f"^{_KEY.pattern}$"},
    "description": "a random text of the client's: the same request sent again within a day is answered as the first "
    "was, and "
    "not carried out again",
}


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"\0".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


class Idempotency:
    """Answers a repeated POST below `prefix` from what was kept; only a success is kept. Of the bodies sent to
    `unread_paths`, which may be larger than the memory, only the stated length is compared."""

    def __init__(self, app: ASGIApp, store: Store, prefix: str, unread_paths: frozenset[str]) -> None:
        self.app, self.store, self.prefix, self.unread_paths = app, store, prefix, unread_paths

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer it from what was kept."""
        wanted = scope["type"] == "http" and scope["method"] == "POST" and scope["path"].startswith(self.prefix)
        request = Request(scope, receive) if wanted else None
        key = request.headers.get(HEADER) if request is not None else None
        if request is None or key is None:
            await self.app(scope, receive, send)
            return
        if not _KEY.fullmatch(key):
            said = f"{HEADER}: give 1 to 100 letters, digits and any of _ . : -"
            await problem(422, said)(scope, receive, send)
            return
        try:
            holder = await asyncio.to_thread(scope["app"].state.gate.identify, request)
        except TooManyFailures:
            holder = None
        if holder is None:  # the route refuses it
            await self.app(scope, receive, send)
            return
        unread = scope["path"] in self.unread_paths
        try:
            body = request.headers.get("content-length", "").encode() if unread else await request.body()
        except HTTPException as refused:  # larger than allowed
            await problem(refused.status_code, str(refused.detail), refused.headers)(scope, receive, send)
            return
        except ClientDisconnect:
            return
        id = _digest(holder.name.encode(), key.encode())
        fingerprint = _digest(scope["path"].encode(), scope["query_string"], body)
        known = await asyncio.to_thread(self._begin, id, fingerprint)
        if known is not None:
            await known(scope, receive, send)
            return
        await self._carry_out(id, None if unread else body, scope, receive, send)

    async def _carry_out(self, id: str, body: bytes | None, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and keep its answer. Where it fails, the key is free again. `body`: what was read of the
        request already."""
        sent, status, location, answer = False, 500, "", b""

        async def again() -> Message:
            nonlocal sent
            if sent or body is None:
                return await receive()
            sent = True
            return {"type": "http.request", "body": body, "more_body": False}

        async def keep_answer(message: Message) -> None:
            nonlocal status, location, answer
            if message["type"] == "http.response.start":
                status, location = message["status"], MutableHeaders(scope=message).get("location", "")
            else:
                answer += message.get("body", b"")
                if not message.get("more_body", False):  # kept before the client hears of it
                    await asyncio.to_thread(self._end, id, status, location, answer.decode())
            await send(message)

        try:
            await self.app(scope, again, keep_answer)
        except BaseException:
            await asyncio.to_thread(self._end, id, 500, "", "")
            raise

    def _begin(self, id: str, fingerprint: str) -> Response | None:
        """Take the key for this request; what to answer where it is taken."""
        try:
            with self.store.transaction() as db:
                db.execute(sa.delete(IdempotentRow).where(IdempotentRow.created < now() - KEPT))
                row = db.get(IdempotentRow, id)
                if row is None:
                    db.add(IdempotentRow(id=id, fingerprint=fingerprint, created=now()))
                    return None
                stored = (row.fingerprint, row.status, row.location, row.body)
        except sa.exc.IntegrityError:  # another request took it just now
            stored = (fingerprint, None, None, None)
        kept, status, location, body = stored
        if kept != fingerprint:
            return problem(422, f"{HEADER}: was used with another request; make a new key for each")
        if status is None:
            return problem(
                409, f"{HEADER}: the first request of this key isn't answered; look whether it was carried out"
            )
        headers = {"Idempotency-Replayed": "true"} | ({"Location": location} if location else {})
        return Response(body or "", status, headers, "application/json")

    def _end(self, id: str, status: int, location: str, body: str) -> None:
        """Keep a success; let go of the key after a failure, which changed nothing."""
        with self.store.transaction() as db:
            row = db.get(IdempotentRow, id)
            if row is None:
                return
            if status < 300:
                row.status, row.location, row.body = status, location, body
            else:
                db.delete(row)
