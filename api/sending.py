"""Archives in the body of a request: what the routes that take one share."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi import HTTPException, Request

from api.service import Service
from api.unpacking import TooMuch, check_room
from api.upload import check_size, name_as_in_archive, receive
from lab.errors import FULL, NoRoom

#: What an archive may be; its own first bytes say which it is.
ARCHIVES = ("application/zip", "application/x-tar", "application/gzip")
TYPES = (*ARCHIVES, "application/x-zip-compressed", "application/x-gzip", "application/octet-stream")
#: OpenAPI's description of such a body.
BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {archive: {"schema": {"type": "string", "format": "binary"}} for archive in ARCHIVES},
    }
}


@dataclass(frozen=True)
class Arrived:
    """An archive on the disk, and the temporary folder in which it may be unpacked."""

    service: Service
    place: Path
    archive: Path

    def name_as_sent(self, text: str) -> str:
        """Return a sentence about its files, which names them as in the archive."""
        return self.service.public(name_as_in_archive(text, self.place))


@contextlib.asynccontextmanager
async def receive_archive(service: Service, request: Request, most_bytes: int) -> AsyncIterator[Arrived]:
    """Receive the archive of a request's body, `most_bytes` at most, while it is used. Raises 422 for another kind of
    body, and 413 or 507 where the body, or what is done with it, goes beyond a cap or the disk.
    """
    sent = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if sent not in TYPES:
        raise HTTPException(422, f"Content-Type {sent[:60]!r}: send the archive itself, as {', '.join(ARCHIVES)}")
    stated = request.headers.get("content-length", "0")
    stated_bytes = int(stated) if stated.isdecimal() else 0
    closing = {"Connection": "close"}
    with service.inbox.receiving() as place:
        archive = place / "archive"
        try:
            check_size(stated_bytes, most_bytes)
            check_room(place, stated_bytes)
            with archive.open("wb") as file:
                await receive(request.stream(), file, most_bytes)
            yield Arrived(service, place, archive)
        except TooMuch as error:
            raise HTTPException(413, str(error), headers=closing) from None
        except NoRoom as error:
            raise HTTPException(507, str(error), headers=closing) from None
        except OSError as error:
            if error.errno not in FULL:
                raise
            raise HTTPException(507, "the data folder is full; make room", headers=closing) from None
