"""Recording sets that are sent in, listed, fetched and deleted; jobs run on them as on a session."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Request, Response

from api.archives import ARCHIVE, Form, Packed
from api.errors import answers
from api.kept_sets import sent_set
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers, page_of
from api.schemas import Recordings, SentAs
from api.sending import BODY, arrived
from api.service import CALIBRATE, READ, Here, HexId
from api.unpacking import TooMuch
from api.upload import Foreign
from lab.errors import InputError
from lab.formats.importers.import_options import ImportOptions, chart_corners, grid

router = APIRouter()


def _recordings(id: str, manifest: dict[str, Any], warnings: tuple[str, ...] = ()) -> Recordings:
    return Recordings(
        id=id,
        name=manifest.get("name", ""),
        notes=manifest.get("notes", ""),
        cameras=tuple(manifest["cameras"]),
        captures=len(manifest["captures"]),
        warnings=warnings,
    )


def _as_parameters(text: str) -> str:
    """A sentence about the command line's options as one about this route's parameters."""
    text = re.sub(r"--from (?=[a-z])", "format ", text)
    return re.sub(r"--([a-z]+(?:-[a-z]+)*)", lambda found: found[1].replace("-", "_"), text)


def _foreign(asked: SentAs) -> Foreign | None:
    """What the parameters say of an archive that isn't a recording set; None where it is one. Raises InputError."""
    stated = sorted(asked.model_fields_set - {"format"})
    if asked.format is None:
        if stated:
            raise HTTPException(
                422, f"{', '.join(stated)}: a recording set states it itself; leave it out, or give the format"
            )
        return None
    statements = ImportOptions(
        checkerboard=grid("checkerboard", asked.checkerboard),
        dots=grid("dots", asked.dots),
        square_mm=asked.square_mm,
        camera=Path(asked.camera) if asked.camera else None,
        exposure_s=asked.exposure_s,
        channel=asked.channel,
        transfer=asked.transfer,
        corners=chart_corners("corners", asked.corners),
        light=Path(asked.light) if asked.light else None,
        white_patch=Path(asked.white_patch) if asked.white_patch else None,
        tap=asked.tap or None,
    )
    return Foreign(asked.format, asked.path, statements)


@router.post(
    "/recordings",
    status_code=201,
    tags=["recordings"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 413, 422, 503),
    openapi_extra=BODY,
)
async def send_recordings(
    service: Here, request: Request, response: Response, asked: Annotated[SentAs, Query()]
) -> Recordings:
    """Send in a recording set: its folder as a .zip, .tar or .tar.gz, as the body. It is checked completely before it
    is kept. With `format`, the archive holds recordings as `calibench import` takes them, which become a recording set;
    the other parameters state what that format doesn't."""
    foreign = _foreign(asked)
    limits = service.limits
    async with arrived(service, request, limits.upload_bytes) as sent:
        try:
            id, found = await asyncio.to_thread(
                service.inbox.take_in, sent.place, sent.archive, limits.unpacked_bytes, limits.unpacked_files, foreign
            )
        except TooMuch:
            raise
        except InputError as error:
            raise InputError(_as_parameters(str(error)) if foreign is not None else str(error)) from None
        lines = tuple(sent.told(line) for line in found.warnings)
    response.headers["Location"] = f"/api/v1/recordings/{id}"
    return _recordings(id, found.manifest.model_dump(include={"name", "notes", "cameras", "captures"}), lines)


@router.get(
    "/recordings", tags=["recordings"], dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}}
)
def list_recordings(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[Recordings]:
    """Recordings that were sent in, the newest first, in pages."""
    ids = service.inbox.ids()
    page = page_of(ids, after, limit, "recordings")
    page_headers(request, response, len(ids), limit, page)
    return [_recordings(id, service.inbox.manifest(id)) for id in page]


@router.get("/recordings/{recordings_id}", tags=["recordings"], dependencies=[READ], responses=answers(401, 404, 422))
def get_recordings(service: Here, recordings_id: HexId) -> Recordings:
    """One recording set."""
    service.recordings(recordings_id)
    return _recordings(recordings_id, service.inbox.manifest(recordings_id))


@router.get(
    "/recordings/{recordings_id}/archive.{form}",
    tags=["recordings"],
    dependencies=[READ],
    response_class=Packed,
    responses=answers(401, 404, 409, 422) | ARCHIVE,
)
def recordings_archive(service: Here, recordings_id: HexId, form: Form) -> Response:
    """The recording set as a .zip or .tar, as `POST /recordings` takes it: sent while it is packed, without a stated
    length."""
    return sent_set(service, recordings_id).archive(form)


@router.delete(
    "/recordings/{recordings_id}",
    status_code=204,
    tags=["recordings"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 409, 422),
)
def delete_recordings(service: Here, recordings_id: HexId) -> None:
    """Delete a recording set for ever. Results and reports of it stay. 409 while a job works on it."""
    sent_set(service, recordings_id).delete(service)
