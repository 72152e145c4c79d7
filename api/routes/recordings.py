"""Recording sets that are sent in, on which jobs run as on a session."""

from __future__ import annotations

import asyncio
import errno

from fastapi import APIRouter, HTTPException, Request, Response

from api.errors import answers
from api.schemas import Recordings
from api.service import CALIBRATE, READ, Here, HexId
from api.upload import NoRoom, TooMuch, check_room, check_size, receive
from lab.formats.recording_set import Manifest

router = APIRouter()
TYPES = ("application/zip", "application/x-zip-compressed", "application/octet-stream")


def _recordings(id: str, manifest: Manifest, warnings: tuple[str, ...] = ()) -> Recordings:
    return Recordings(
        id=id,
        name=manifest.name,
        notes=manifest.notes,
        cameras=tuple(manifest.cameras),
        captures=len(manifest.captures),
        warnings=warnings,
    )


@router.post(
    "/recordings",
    status_code=201,
    tags=["recordings"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 413, 422, 503),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def send_recordings(service: Here, request: Request, response: Response) -> Recordings:
    """Send in a recording set: its folder as a .zip, as the body. It is checked completely before it is kept."""
    sent = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if sent not in TYPES:
        raise HTTPException(422, f"Content-Type {sent[:60]!r}: send the .zip itself as application/zip")
    limits = service.limits
    stated = request.headers.get("content-length", "0")
    with service.inbox.receiving() as place:
        archive = place / "archive.zip"
        try:
            stated_bytes = int(stated) if stated.isdecimal() else 0
            check_size(stated_bytes, limits.upload_bytes)
            check_room(place, stated_bytes)
            with archive.open("wb") as file:
                await receive(request.stream(), file, limits.upload_bytes)
            id, found = await asyncio.to_thread(
                service.inbox.take_in, place, archive, limits.unpacked_bytes, limits.unpacked_files
            )
        except TooMuch as error:
            raise HTTPException(413, str(error), headers={"Connection": "close"}) from None
        except NoRoom as error:
            raise HTTPException(503, str(error), headers={"Connection": "close"}) from None
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise HTTPException(503, "the data folder is full; make room", headers={"Connection": "close"}) from None
    response.headers["Location"] = f"/api/v1/recordings/{id}"
    return _recordings(
        id,
        found.manifest,
        tuple(
            service.public(line.replace(f"{place}/set/", "").replace(f"{place}/set", "the archive"))
            for line in found.warnings
        ),
    )


@router.get("/recordings", tags=["recordings"], dependencies=[READ], responses=answers(401))
def list_recordings(service: Here) -> list[Recordings]:
    """All recordings that were sent in."""
    return [_recordings(id, service.inbox.manifest(id)) for id in service.inbox.ids()]


@router.get("/recordings/{recordings_id}", tags=["recordings"], dependencies=[READ], responses=answers(401, 404, 422))
def get_recordings(service: Here, recordings_id: HexId) -> Recordings:
    """One recording set."""
    service.recordings(recordings_id)
    return _recordings(recordings_id, service.inbox.manifest(recordings_id))
