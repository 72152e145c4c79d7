"""The queue of sessions, and the halt of everything."""

from __future__ import annotations

import functools
import time
from concurrent.futures import wait
from datetime import datetime, timedelta
from typing import Annotated

from fastapi import APIRouter, Depends, HTTPException, Request, Response

from api.errors import Conflict, answers
from api.keys import StoredKey
from api.routes.sessions import check_then, register_session, stored_session
from api.safety import StationSafety, shutter_key
from api.schemas import Halt, Halted, HaltedStation, QueueEntry, QueuePlace, SessionStart, StoredSession
from api.security import DemandHalt
from api.service import OPERATE, OVER, READ, ROOM, Here, Service, SessionId
from api.then import read_request
from lab.capture.catalogue import step_times
from lab.capture.queue import expected_times, leave_queue, put_into_queue, queue
from lab.capture.records import now
from lab.capture.station import Station
from lab.capture.store import Store
from lab.errors import InputError, one_line

#: How long (s) a halt waits for the instruments' answers before it says that they haven't come.
ANSWER_S = 1.5
router = APIRouter(tags=["sessions"])


@functools.lru_cache(maxsize=1024)
def _duration_s(store: Store, session_id: str, hour: int) -> float:
    """How long a session that waits will take, learned anew every hour."""
    times = step_times(store, store.station(session_id))
    return sum(times.seconds(entry.step)[0] for entry in store.journal(session_id) if entry.finished is None)


def _list_entries(service: Service) -> list[QueueEntry]:
    live, store = service.live, service.store
    waiting = [info for info in queue(store) if live.find(info.id) is None]
    at = now()
    busy_until: dict[str, datetime | None] = {}
    for session in live.running():
        left_s = session.latest.left_s if session.latest is not None else None
        until = None if left_s is None else at + timedelta(seconds=left_s)
        busy_until |= dict.fromkeys(session.station.addresses, until)
    expected = expected_times(
        waiting,
        {info.id: store.station(info.id).addresses for info in waiting},
        {info.id: _duration_s(store, info.id, int(at.timestamp()) // 3600) for info in waiting},
        busy_until,
        at,
    )
    entries = []
    for place, waiting_session in enumerate(waiting, start=1):
        start, end = expected.get(waiting_session.id, (None, None))
        request = read_request(store, waiting_session.id)
        entries.append(
            QueueEntry(
                **waiting_session.model_dump(exclude={"place", "held"}),
                place=place,
                held=service.public.or_none(waiting_session.held),
                expected_start=start,
                expected_end=end,
                then=request.then.in_words if request is not None and request.then is not None else None,
                can_copy=request is not None,
            )
        )
    return entries


@router.get("/queue", dependencies=[READ], responses=answers(401))
def list_queue(service: Here) -> list[QueueEntry]:
    """The sessions that wait for their instruments, in their order. `held`: it doesn't start by itself, because the run
    before it on the same instruments ended badly, or because of a halt."""
    return _list_entries(service)


@router.put("/sessions/{session_id}/queue", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def queue_session(service: Here, session_id: SessionId, asked: QueuePlace) -> list[QueueEntry]:
    """Let a session wait for its turn, move one that waits to another place or time, and release one that is held. The
    queue as it is then. 409 for a session that runs or is finished."""
    info = service.session(session_id)
    state = service.state(info)
    if state not in OVER or state == "finished":
        raise Conflict(f"session {session_id} is {state}; only one that can be started or resumed can wait")
    put_into_queue(service.store, session_id, asked.not_before, asked.place)
    service.waiting.look_soon()
    return _list_entries(service)


@router.delete("/sessions/{session_id}/queue", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def unqueue_session(service: Here, session_id: SessionId) -> list[QueueEntry]:
    """Take a session out of the queue; it can be resumed by hand. The queue as it is then. 409 for a session that
    doesn't wait."""
    service.session(session_id)
    if service.live.find(session_id) is not None:
        raise Conflict(f"session {session_id} has begun; abort it")
    try:
        leave_queue(service.store, session_id)
    except InputError as error:
        raise Conflict(str(error)) from None
    return _list_entries(service)


@router.put("/sessions/{session_id}/request", dependencies=[OPERATE, ROOM], responses=answers(401, 403, 404, 409, 422))
def change_request(
    service: Here, request: Request, session_id: SessionId, start: SessionStart, response: Response
) -> StoredSession:
    """Change what a session that waits, and never ran, will do: another one with a new id takes its place in the queue.
    `Location` names it. 409 for a session that doesn't wait, or has run."""
    info = service.session(session_id)
    check_then(service, request, start)
    station = service.station(start.station)
    start.plan(station).steps(station)  # refused before anything changes
    waits = next((info for info in queue(service.store) if info.id == session_id), None)
    if waits is None or service.live.find(session_id) is not None or service.store.runs(session_id):
        raise Conflict(
            f"session {session_id} is {service.state(info)}; only one that waits in the queue, and never ran, can be "
            "changed: copy it"
        )
    try:
        service.store.delete_session(session_id)
    except InputError as error:
        raise Conflict(str(error)) from None
    changed = register_session(service, start, station)
    put_into_queue(service.store, changed, start.not_before, waits.place, waits.held)
    service.waiting.look_soon()
    response.headers["Location"] = f"/api/v1/sessions/{changed}"
    return stored_session(service, changed)


def _stations(service: Service) -> tuple[dict[str, Station], dict[str, str]]:
    """Return the stations by name, and by the same names why the files of others can't be used."""
    stations, unusable = {}, {}
    for name in service.station_files():
        try:
            stations[name] = service.station(name)
        except (InputError, OSError, HTTPException) as error:  # a file that is gone meanwhile: 404
            unusable[name] = one_line(error)
    return stations, unusable


@router.post("/halt", responses=answers(401, 403, 404, 422))
def halt(
    service: Here,
    key: Annotated[StoredKey, Depends(DemandHalt())],
    asked: Halt | None = None,
) -> Halted:
    """End every session that this service runs now, also one that is packed, or those on one station: shutters close,
    screens go dark, each can be resumed. Stations on which nothing runs are made safe, too. What waits for the same
    instruments is held until somebody releases it. Answers within 2 s, whatever the registry and the disk do;
    `stations` has every station by its name: whose shutter is closed, by its own answer, and whose isn't confirmed by
    then."""
    station = service.station(asked.station) if asked is not None and asked.station is not None else None
    until_s, live = time.monotonic() + ANSWER_S, service.live
    why = f"halted by the key {key.name!r} at {now():%H:%M:%S} UTC"
    ended = live.halt(station, why)  # first: nothing that the registry does delays it
    held = service.waiting.hold(why, station)
    unusable: dict[str, str] = {}
    if asked is None or asked.station is None or station is None:
        stations, unusable = _stations(service)
    else:
        stations = {asked.station: station}
    busy: dict[str, Station] = {}
    for id in ended:
        if (session := live.find(id)) is not None:
            busy[shutter_key(session.station)] = session.station
            if shutter_key(session.station) not in {
                shutter_key(station) for station in stations.values()
            }:  # it has no file any more
                stations[f"session {id}"] = session.station
    answering = list(ended.values())
    for idle_station in {shutter_key(station): station for station in stations.values()}.values():
        if shutter_key(idle_station) not in busy:
            answering.append(live.make_safe(idle_station))
    wait([held], max(0.0, until_s - time.monotonic()))
    later = live.halt(station, why)  # what the queue began in between
    wait([*answering, *later.values()], max(0.0, until_s - time.monotonic()))
    answers = [
        HaltedStation(name=name, safety=StationSafety(state="not confirmed", shutter="unknown", at=now(), words=words))
        for name, why_not in unusable.items()
        if (words := service.public(f"its station file can't be used, so it wasn't asked: {why_not}"))
    ]
    for name, asked_station in stations.items():
        if (state := live.safety.find(asked_station)) is None or (
            state.state == "halting" and state.shutter == "unknown"
        ):
            live.safety.note_trouble(
                asked_station, f"no answer of its shutter within {ANSWER_S:g} s; it is still being asked"
            )
        if (safety := service.safety(asked_station)) is not None:
            answers.append(HaltedStation(name=name, safety=safety))
    return Halted(sessions=tuple(dict.fromkeys([*ended, *later])), stations=tuple(answers))
