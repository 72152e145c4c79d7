"""Recording sets that are sent in, listed, fetched and deleted; jobs run on them as on a session."""

from __future__ import annotations

import asyncio
import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, HTTPException, Query, Request, Response

from api.archives import ARCHIVE, Form, Packed
from api.errors import answers
from api.frames import FOR_EVER, Npy, Picture, Stretch, Width, npy_of, picture_of
from api.kept_sets import find_sent_set
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, NumberCursor, WordsOfName, page_headers, page_of
from api.preview import Form as PictureForm
from api.schemas import CaptureCount, CaptureKind, RecordedCapture, Recordings, RecordingsDetail, SentAs
from api.sending import BODY, receive_archive
from api.service import CALIBRATE, READ, Here, HexId, RegistryId, Service
from api.unpacking import TooMuch
from api.upload import Foreign
from lab.calibration.overview import verdict_of
from lab.capture_kinds.base import Capture
from lab.errors import InputError
from lab.formats.importers.single_picture import ImportOptions, chart_corners, grid
from lab.quick_look.curves import FrameFigures
from sim.camera import Side

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
    return re.sub(r"--([a-z]+(?:-[a-z]+)*)", lambda match: match[1].replace("-", "_"), text)


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
        only=asked.only or None,
        ignore=asked.ignore or None,
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
    async with receive_archive(service, request, limits.upload_bytes) as sent:
        try:
            id, warnings = await asyncio.to_thread(
                service.inbox.take_in, sent.place, sent.archive, limits.unpacked_bytes, limits.unpacked_files, foreign
            )
        except TooMuch:
            raise
        except InputError as error:
            raise InputError(_as_parameters(str(error)) if foreign is not None else str(error)) from None
        lines = tuple(sent.name_as_sent(line) for line in warnings.warnings)
    response.headers["Location"] = f"/api/v1/recordings/{id}"
    return _recordings(id, warnings.manifest.model_dump(include={"name", "notes", "cameras", "captures"}), lines)


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
def get_recordings(service: Here, recordings_id: HexId) -> RecordingsDetail:
    """One recording set, with its captures by kind and its results."""
    folder = str(service.recordings(recordings_id))
    recordings = service.pictures.recordings(recordings_id)
    counts = Counter((capture.kind, capture.side) for capture in recordings.captures())
    results = service.store.newest_results(folder)
    return RecordingsDetail(
        **_recordings(recordings_id, service.inbox.manifest(recordings_id)).model_dump(),
        counts=tuple(CaptureCount(kind=kind, side=side, captures=n) for (kind, side), n in sorted(counts.items())),
        verdict=verdict_of(service.store, results["diagnose"]) if "diagnose" in results else None,
        results=results,
    )


def _capture(recordings_id: str, number: int, capture: Capture) -> RecordedCapture:
    address = f"/api/v1/recordings/{recordings_id}/captures/{number}"
    document = capture.model_dump(mode="json", exclude_none=True)
    return RecordedCapture(
        id=number,
        name=capture.id,
        kind=capture.kind,
        side=capture.side,
        exposure_s=document.get("exposure_s"),
        document=document,
        preview=f"{address}/preview.png",
        frame=f"{address}/frame.npy",
    )


def _find_capture(service: Service, recordings_id: str, number: int) -> Capture:
    service.recordings(recordings_id)
    captures = service.pictures.recordings(recordings_id).captures()
    if number > len(captures):
        raise HTTPException(404, f"recordings {recordings_id}: no capture {number}; they have {len(captures)}")
    return captures[number - 1]


@router.get(
    "/recordings/{recordings_id}/captures",
    tags=["captures"],
    dependencies=[READ],
    responses=answers(401, 404, 422) | {200: {"headers": HEADERS}},
)
def list_recorded_captures(
    service: Here,
    request: Request,
    response: Response,
    recordings_id: HexId,
    kind: Annotated[CaptureKind | None, Query(description="only of this kind")] = None,
    side: Annotated[Side | None, Query(description="only of this camera")] = None,
    order: Annotated[Literal["oldest", "newest"], Query(description="the manifest's first, or its last")] = "oldest",
    search: WordsOfName = "",
    after: NumberCursor = None,
    limit: Limit = PAGE,
) -> list[RecordedCapture]:
    """The captures of a recording set, numbered from 1 in the manifest's order, in pages."""
    service.recordings(recordings_id)
    every = enumerate(service.pictures.recordings(recordings_id).captures(), start=1)
    words = search.lower().split()
    numbered = [
        (n, capture)
        for n, capture in every
        if kind in (None, capture.kind)
        and side in (None, capture.side)
        and all(word in capture.id.lower() for word in words)
    ]
    if order == "newest":
        numbered.reverse()
    page = [
        (n, capture) for n, capture in numbered if after is None or (n < after if order == "newest" else n > after)
    ][:limit]
    page_headers(request, response, len(numbered), limit, [str(n) for n, _ in page])
    return [_capture(recordings_id, n, capture) for n, capture in page]


@router.get(
    "/recordings/{recordings_id}/captures/{number}",
    tags=["captures"],
    dependencies=[READ],
    responses=answers(401, 404, 422),
)
def get_recorded_capture(service: Here, recordings_id: HexId, number: RegistryId) -> RecordedCapture:
    """One capture of a recording set."""
    return _capture(recordings_id, number, _find_capture(service, recordings_id, number))


@router.get(
    "/recordings/{recordings_id}/captures/{number}/preview.{picture}",
    tags=["captures"],
    dependencies=[READ],
    response_class=Picture,
    responses=answers(401, 404, 422) | {200: {"content": {"image/webp": {}}}},
)
def preview_recorded_capture(
    service: Here,
    request: Request,
    recordings_id: HexId,
    number: RegistryId,
    picture: PictureForm,
    width: Width = 480,
    stretch: Stretch = False,
) -> Response:
    """A small picture, as of a session's capture."""
    _find_capture(service, recordings_id, number)
    return picture_of(service, request, recordings_id, number, picture, width, stretch)


@router.get(
    "/recordings/{recordings_id}/captures/{number}/frame.npy",
    tags=["captures"],
    dependencies=[READ],
    response_class=Npy,
    responses=answers(401, 404, 422),
)
def recorded_frame(service: Here, recordings_id: HexId, number: RegistryId) -> Response:
    """The raw frame as .npy: uint16 (rows, cols)."""
    _find_capture(service, recordings_id, number)
    return npy_of(service, recordings_id, number)


@router.get(
    "/recordings/{recordings_id}/captures/{number}/figures",
    tags=["captures"],
    dependencies=[READ],
    responses=answers(401, 404, 422),
)
def recorded_figures(service: Here, recordings_id: HexId, number: RegistryId, response: Response) -> FrameFigures:
    """Histogram, mean and share of saturated pixels of each channel of the frame."""
    _find_capture(service, recordings_id, number)
    response.headers.update(FOR_EVER)
    return service.pictures.figures(recordings_id, number)


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
    return find_sent_set(service, recordings_id).archive(form)


@router.delete(
    "/recordings/{recordings_id}",
    status_code=204,
    tags=["recordings"],
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 409, 422),
)
def delete_recordings(service: Here, recordings_id: HexId) -> None:
    """Delete a recording set for ever. Results and reports of it stay. 409 while a job works on it."""
    find_sent_set(service, recordings_id).delete(service)
