"""Stations, sessions on them, and what they captured."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

import anyio
from fastapi import APIRouter, Depends, HTTPException, Query, Request, Response
from sse_starlette.event import ServerSentEvent
from sse_starlette.sse import EventSourceResponse

from api.archives import ARCHIVE, Form, Packed
from api.errors import Conflict, answers, find_or_404
from api.events import describe_events, event, stream, watch_state
from api.frames import FOR_EVER, Npy, Picture, Stretch, Width, npy_of, picture_of
from api.kept_sets import session_set
from api.keys import Permission, StoredKey
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, NumberCursor, WordsOfName, page_headers
from api.preview import Form as PictureForm
from api.schemas import (
    CaptureCount,
    CaptureKind,
    LeftChanged,
    ListedSession,
    SessionDetail,
    SessionResume,
    SessionStart,
    SessionWords,
    StationState,
    StepDone,
    StoredCapture,
    StoredSession,
)
from api.security import Demand
from api.service import ADMIN, OPERATE, OVER, READ, ROOM, Here, RegistryId, Service, SessionId, missing_session
from api.then import check_webhook, keep_request, read_request, then_of
from lab.calibration.overview import SessionOverview, overviews, sessions_of_verdict, tags_of
from lab.capture.by_hand import left_by_hand
from lab.capture.plan import full_plan
from lab.capture.questions import confirm
from lab.capture.queue import put_into_queue
from lab.capture.records import CaptureInfo, SessionInfo
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import Station
from lab.errors import InputError
from lab.formats.results.diagnosis import DiagnosisVerdict
from lab.quick_look.curves import Curves, FrameFigures
from lab.resolve import read_journal
from sim.camera import Side

router = APIRouter()


def station_state(service: Service, name: str) -> StationState:
    """What a station file says, or why it can't be used."""
    try:
        station = service.station(name)
    except InputError as error:
        return StationState(name=name, title=name, problem=service.public(str(error)))
    return StationState(
        name=name,
        title=station.name or name,
        cameras=station.sides,
        instruments={name: entry.driver for name, entry in station.devices.items() if not name.startswith("cameras.")},
        targets=tuple(station.targets),
        lights=dict(station.lights),
        sequences=full_plan(station).names,
        busy_with=(busy := service.live.busy(station)),
        asks=service.asks(busy),
        safety=service.safety(station),
        left_by_hand=tuple(
            LeftChanged(session=left.session, words=service.public(left.words))
            for left in left_by_hand(service.store.root, station)
        ),
    )


@router.get("/stations", tags=["stations"], dependencies=[READ], responses=answers(401))
def list_stations(service: Here) -> list[StationState]:
    """The station files in the folder `stations` of the data folder. They are written there, not sent: they name
    devices."""
    return [station_state(service, name) for name in service.station_files()]


def _fields(service: Service, info: SessionInfo) -> dict[str, Any]:
    live, state = service.live.find(info.id), service.state(info)
    if live is not None and state in ("finished", "interrupted", "failed"):
        # A run that is about to end: the registry has how, with the error.
        live, info = None, service.store.session(info.id)
        state = info.state
    fields = info.model_dump(exclude={"packed"}) | {"state": state}
    # The error of an earlier run doesn't concern this one.
    error = info.error if live is None else live.capture.paused_by if live.capture is not None else None
    return fields | {"error": service.public.or_none(error)}


def _list_entry(service: Service, info: SessionInfo, by_session: dict[str, SessionOverview]) -> dict[str, Any]:
    overview = by_session.get(info.id, SessionOverview())  # it was deleted meanwhile
    return _fields(service, info) | overview.model_dump() | {"tags": tags_of(info.notes)}


def check_then(service: Service, request: Request, start: SessionStart) -> None:
    """Raises 403 for a key that may not ask for what follows a session, and 422 for a webhook on a foreign host."""
    if start.then is not None:
        Demand(Permission.ADMIN)(request, None, None)
        check_webhook(start.then.webhook, service.then.hosts)


def register_session(service: Service, start: SessionStart, station: Station) -> str:
    """Register a session that doesn't run yet; its id. Raises InputError where the station can't take it."""
    session = CaptureSession.start(
        service.store,
        station,
        start.plan(station),
        name=start.name,
        notes=start.notes,
        demands_certified=start.demands_certified,
    )
    keep_request(service.store, session.id, start)
    return session.id


@router.get("/sessions/{session_id}/request", tags=["sessions"], dependencies=[READ], responses=answers(401, 404, 422))
def session_request(service: Here, session_id: SessionId) -> SessionStart:
    """What a session was asked to start with, as `POST /sessions` takes it: to be copied, or edited while it waits. 404
    where it wasn't started by a service."""
    service.session(session_id)
    kept = read_request(service.store, session_id)
    if kept is None:
        raise HTTPException(404, f"session {session_id}: what it was asked with isn't kept; start one by hand")
    return kept


def stored_session(service: Service, session_id: str) -> StoredSession:
    """A session as most routes answer it."""
    return StoredSession(**_fields(service, service.session(session_id)))


@router.get(
    "/sessions",
    tags=["sessions"],
    dependencies=[READ],
    responses=answers(401, 422) | {200: {"headers": HEADERS}},
)
def list_sessions(
    service: Here,
    request: Request,
    response: Response,
    after: IdCursor = None,
    limit: Limit = PAGE,
    search: Annotated[
        str,
        Query(
            max_length=200,
            description="only those with each of these words in id, name, notes, the station's name or what their "
            "instruments reported",
        ),
    ] = "",
    verdict: Annotated[
        DiagnosisVerdict | None, Query(description="only those whose newest diagnosis said this")
    ] = None,
) -> list[ListedSession]:
    """Sessions, newest first, in pages: all, or those that are searched for."""
    only = None if verdict is None else sessions_of_verdict(service.store, verdict)
    infos = service.store.sessions(after, limit, search=search, only=only)
    total = service.store.count_sessions(search=search, only=only)
    page_headers(request, response, total, limit, [info.id for info in infos])
    by_session = overviews(service.store, [info.id for info in infos])
    return [ListedSession(**_list_entry(service, info, by_session)) for info in infos]


@router.post(
    "/sessions",
    status_code=201,
    tags=["sessions"],
    dependencies=[OPERATE, ROOM],
    responses=answers(401, 403, 404, 409, 422),
)
def start_session(service: Here, request: Request, start: SessionStart, response: Response) -> StoredSession:
    """Start a session, which runs in the background. 409 while another session runs on the same instruments; with
    `queue` it waits for its turn instead. With `then` it is analysed when it has finished, and the key's scope has to
    be `admin`."""
    check_then(service, request, start)
    station = service.station(start.station)
    if start.queue:
        session_id = register_session(service, start, station)
        put_into_queue(service.store, session_id, start.not_before)
        service.waiting.look_soon()
    else:
        plan = start.plan(station)
        session_id = service.live.start(station, plan, start.name, start.notes, start.demands_certified)
        keep_request(service.store, session_id, start)
    response.headers["Location"] = f"/api/v1/sessions/{session_id}"
    return stored_session(service, session_id)


@router.get("/sessions/{session_id}", tags=["sessions"], dependencies=[READ], responses=answers(401, 404, 422))
def get_session(service: Here, session_id: SessionId) -> SessionDetail:
    """One session, with its provenance."""
    details = find_or_404(missing_session(session_id), lambda: service.store.details(session_id))
    return SessionDetail(
        **_list_entry(service, details.info, overviews(service.store, [session_id])),
        can_copy=read_request(service.store, session_id) is not None,
        then=then_of(service.store, session_id),
        progress=service.progress(session_id) if details.info.closed is None else None,
        asks=service.asks(session_id),
        runs=service.public_runs(details.runs),
        captures=tuple(
            CaptureCount(kind=kind, side=side, captures=n)  # type: ignore[arg-type]
            for (kind, side), n in sorted(service.store.count_captures(session_id).items())
        ),
        results=service.store.newest_results(session_id),
        resolving=read_journal(service.store.folder(session_id)),
    )


@router.patch(
    "/sessions/{session_id}",
    tags=["sessions"],
    dependencies=[OPERATE, ROOM],
    responses=answers(401, 403, 404, 422),
)
def describe_session(service: Here, session_id: SessionId, asked: SessionWords) -> StoredSession:
    """Give a session another name or other notes, also while it runs."""
    service.session(session_id)
    service.store.describe_session(session_id, asked.name, asked.notes)
    return stored_session(service, session_id)


@router.delete(
    "/sessions/{session_id}",
    status_code=204,
    tags=["sessions"],
    dependencies=[ADMIN],
    responses=answers(401, 403, 404, 409, 422),
)
def delete_session(service: Here, session_id: SessionId) -> None:
    """Delete a session for ever: its captures and its files. Results, reports and calibrations of it stay. 409 while it
    runs, while a job works on it, and while a certified calibration rests on it. The key's scope has to be `admin`."""
    session_set(service, session_id).delete(service)


@router.get(
    "/sessions/{session_id}/archive.{form}",
    tags=["sessions"],
    dependencies=[READ],
    response_class=Packed,
    responses=answers(401, 404, 409, 422) | ARCHIVE,
)
def session_archive(service: Here, session_id: SessionId, form: Form) -> Response:
    """The session as a recording set, a .zip or .tar as `POST /recordings` takes it: sent while it is packed, without a
    stated length. 409 while it runs, because what it has is still changing, and where it has captured nothing."""
    return session_set(service, session_id).archive(form)


@router.post(
    "/sessions/{session_id}/pause",
    status_code=202,
    tags=["sessions"],
    dependencies=[OPERATE],
    responses=answers(401, 403, 404, 409, 422),
)
def pause_session(service: Here, session_id: SessionId) -> StoredSession:
    """Pause at the end of the present step. The shutter closes, the screen goes dark."""
    service.session(session_id)
    service.live.pause(session_id)
    return stored_session(service, session_id)


@router.post(
    "/sessions/{session_id}/resume",
    status_code=202,
    tags=["sessions"],
    dependencies=[OPERATE],
    responses=answers(401, 403, 404, 409, 422),
)
def resume_session(service: Here, session_id: SessionId, resume: SessionResume | None = None) -> StoredSession:
    """Continue after a pause, or continue a session that ended early. Finished steps aren't taken again."""
    service.session(session_id)
    service.live.resume(session_id, service.station(resume.station) if resume and resume.station else None)
    return stored_session(service, session_id)


@router.post(
    "/sessions/{session_id}/abort",
    status_code=202,
    tags=["sessions"],
    dependencies=[OPERATE],
    responses=answers(401, 403, 404, 409, 422),
)
def abort_session(service: Here, session_id: SessionId) -> StoredSession:
    """End the run now. The present step is dropped, finished steps are kept, and the session can be resumed."""
    service.session(session_id)
    service.live.abort(session_id, "aborted over the network")
    return stored_session(service, session_id)


@router.post(
    "/sessions/{session_id}/confirm",
    tags=["sessions"],
    responses=answers(401, 403, 404, 409, 422),
)
def confirm_step(
    service: Here,
    key: Annotated[StoredKey, Depends(Demand(Permission.OPERATE))],
    session_id: SessionId,
    done: StepDone,
) -> StoredSession:
    """Say that what a session waits for (`asks`) is done: the target is there, the chart turned, the aperture set, or
    put back. 409 where it doesn't wait for that now: it asks for another target, somebody confirmed it already, or the
    session has ended."""
    service.session(session_id)
    try:
        confirm(service.store, session_id, done.target, key.name, done.since)
    except InputError as error:
        raise Conflict(str(error)) from None
    return stored_session(service, session_id)


async def _follow(service: Service, session_id: str, stopping: anyio.Event) -> AsyncIterator[ServerSentEvent]:
    def look() -> StoredSession:
        return stored_session(service, session_id)

    last_state = None
    live = service.live.find(session_id)
    if live is None:  # another process runs it, or nobody does
        async for progress_event in watch_state(
            look, lambda session: session.state in OVER, "state", stopping, service.changed
        ):
            yield progress_event
        return
    yield event("state", await asyncio.to_thread(look))
    async for progress in live.follow(stopping):
        text = live.once(progress, lambda state: service.make_public(state).model_dump_json())
        yield ServerSentEvent(event="progress", data=text)
        if (progress.state, live.pausing) != last_state:
            last_state = (progress.state, live.pausing)
            yield event("state", await asyncio.to_thread(look))
    if not stopping.is_set():
        yield event("end", await asyncio.to_thread(look))


@router.get(
    "/sessions/{session_id}/events",
    tags=["sessions"],
    dependencies=[READ],
    response_class=EventSourceResponse,
    responses=answers(401, 404, 422)
    | describe_events(
        ("state", StoredSession, "at once, and whenever the state changes"),
        ("progress", Progress, "at once and at every step, while this service runs the session"),
        ("end", StoredSession, "when nothing more will come"),
    ),
)
def session_events(service: Here, session_id: SessionId) -> EventSourceResponse:
    """Follow a session."""
    service.session(session_id)
    return stream(lambda stopping: _follow(service, session_id, stopping))


def _capture(info: CaptureInfo) -> StoredCapture:
    address = f"/api/v1/sessions/{info.session_id}/captures/{info.id}"
    return StoredCapture(
        **info.model_dump(),
        exposure_s=info.document.get("exposure_s"),
        preview=f"{address}/preview.png",
        frame=f"{address}/frame.npy",
    )


def _find_capture(service: Service, session_id: str, capture_id: int) -> CaptureInfo:
    missing = f"no capture {capture_id} in session {session_id[:60]!r}; GET /api/v1/sessions/ID/captures lists them"
    info = find_or_404(missing, lambda: service.store.capture(capture_id))
    if info.session_id != session_id:
        raise HTTPException(404, missing)
    return info


@router.get(
    "/sessions/{session_id}/captures",
    tags=["captures"],
    dependencies=[READ],
    responses=answers(401, 404, 422) | {200: {"headers": HEADERS}},
)
def list_captures(
    service: Here,
    request: Request,
    response: Response,
    session_id: SessionId,
    kind: Annotated[CaptureKind | None, Query(description="only of this kind")] = None,
    side: Annotated[Side | None, Query(description="only of this camera")] = None,
    order: Annotated[Literal["oldest", "newest"], Query(description="which come first")] = "oldest",
    search: WordsOfName = "",
    after: NumberCursor = None,
    limit: Limit = PAGE,
) -> list[StoredCapture]:
    """The captures of a session, in the order in which they were taken or the newest first, in pages."""
    capture = find_or_404(
        missing_session(session_id),
        lambda: service.store.captures(
            session_id,
            kind=kind,
            side=side,
            search=search,
            after=after,
            newest_first=order == "newest",
            limit=limit,
        ),
    )
    total = sum(
        n
        for of, n in service.store.count_captures(session_id, search).items()
        if kind in (None, of[0]) and side in (None, of[1])
    )
    page_headers(request, response, total, limit, [str(info.id) for info in capture])
    return [_capture(info) for info in capture]


@router.get(
    "/sessions/{session_id}/captures/{capture_id}",
    tags=["captures"],
    dependencies=[READ],
    responses=answers(401, 404, 422),
)
def get_capture(service: Here, session_id: SessionId, capture_id: RegistryId) -> StoredCapture:
    """One capture."""
    return _capture(_find_capture(service, session_id, capture_id))


@router.get(
    "/sessions/{session_id}/captures/{capture_id}/preview.{picture}",
    tags=["captures"],
    dependencies=[READ],
    response_class=Picture,
    responses=answers(401, 404, 422) | {200: {"content": {"image/webp": {}}}},
)
def preview_capture(
    service: Here,
    request: Request,
    session_id: SessionId,
    capture_id: RegistryId,
    picture: PictureForm,
    width: Width = 480,
    stretch: Stretch = False,
) -> Response:
    """A small picture, .png or .webp (a tenth of its bytes): black subtracted, one value per colour and mosaic cell,
    gamma-encoded, without white balance."""
    info = _find_capture(service, session_id, capture_id)
    return picture_of(service, request, session_id, info.id, picture, width, stretch)


@router.get(
    "/sessions/{session_id}/captures/{capture_id}/frame.npy",
    tags=["captures"],
    dependencies=[READ],
    response_class=Npy,
    responses=answers(401, 404, 422),
)
def capture_frame(service: Here, session_id: SessionId, capture_id: RegistryId) -> Response:
    """The raw frame as .npy: uint16 (rows, cols), checked against its SHA-256."""
    info = _find_capture(service, session_id, capture_id)
    return npy_of(service, session_id, info.id)


@router.get(
    "/sessions/{session_id}/captures/{capture_id}/figures",
    tags=["captures"],
    dependencies=[READ],
    responses=answers(401, 404, 422),
)
def capture_figures(service: Here, session_id: SessionId, capture_id: RegistryId, response: Response) -> FrameFigures:
    """Histogram, mean and share of saturated pixels of each channel of the frame."""
    info = _find_capture(service, session_id, capture_id)
    response.headers.update(FOR_EVER)
    return service.pictures.figures(session_id, info.id)


@router.get("/sessions/{session_id}/curves", tags=["captures"], dependencies=[READ], responses=answers(401, 404, 422))
def session_curves(service: Here, session_id: SessionId) -> Curves:
    """Photon transfer, sensitivity and MTF as the captures so far show them: cheap estimates that grow while the
    session runs, computed in a process of their own. A long session is looked at in several turns: ask again while
    `looked_at` is less than `captures`. The fit is what counts."""
    service.session(session_id)
    return service.quick_look.curves(session_id)
