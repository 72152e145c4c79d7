"""The queue of sessions, and the halt of everything."""

from __future__ import annotations

import contextlib
import time
from concurrent.futures import wait
from typing import Annotated

from fastapi import APIRouter, Depends

from api.errors import Conflict, answers
from api.keys import Permission, StoredKey
from api.safety import key_of
from api.schemas import Halt, Halted, HaltedStation, QueuePlace
from api.security import Demand
from api.service import OPERATE, OVER, READ, Here, Service, SessionId
from lab.capture.queue import QueuedSession, hold_queue, leave_queue, put_into_queue, queue
from lab.capture.station import Station
from lab.errors import InputError

#: How long (s) a halt waits for the instruments' answers before it says that they haven't come.
ANSWER_S = 1.5
router = APIRouter(tags=["sessions"])


def _told(service: Service) -> list[QueuedSession]:
    live = service.live
    waiting = [one for one in queue(service.store) if live.find(one.id) is None]
    return [
        one.model_copy(update={"place": place, "held": service.public.or_none(one.held)})
        for place, one in enumerate(waiting, start=1)
    ]


@router.get("/queue", dependencies=[READ], responses=answers(401))
def list_queue(service: Here) -> list[QueuedSession]:
    """The sessions that wait for their instruments, in their order. `held`: it doesn't start by itself, because the run
    before it on the same instruments ended badly, or because of a halt."""
    return _told(service)


@router.put("/sessions/{session_id}/queue", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def queue_session(service: Here, session_id: SessionId, asked: QueuePlace) -> list[QueuedSession]:
    """Let a session wait for its turn, move one that waits to another place or time, and release one that is held. The
    queue as it is then. 409 for a session that runs or is finished."""
    info = service.session(session_id)
    state = service.state(info)
    if state not in OVER or state == "finished":
        raise Conflict(f"session {session_id} is {state}; only one that can be started or resumed can wait")
    put_into_queue(service.store, session_id, asked.not_before, asked.place)
    service.waiting.look_soon()
    return _told(service)


@router.delete("/sessions/{session_id}/queue", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def unqueue_session(service: Here, session_id: SessionId) -> list[QueuedSession]:
    """Take a session out of the queue; it can be resumed by hand. The queue as it is then. 409 for a session that
    doesn't wait."""
    service.session(session_id)
    if service.live.find(session_id) is not None:
        raise Conflict(f"session {session_id} has begun; abort it")
    try:
        leave_queue(service.store, session_id)
    except InputError as error:
        raise Conflict(str(error)) from None
    return _told(service)


def _stations(service: Service) -> dict[str, Station]:
    """The stations by name, without those whose files can't be used."""
    found = {}
    for name in service.station_files():
        with contextlib.suppress(InputError):
            found[name] = service.station(name)
    return found


@router.post("/halt", responses=answers(401, 403, 404, 422))
def halt(
    service: Here,
    key: Annotated[StoredKey, Depends(Demand(Permission.OPERATE, Permission.CALIBRATE))],
    asked: Halt | None = None,
) -> Halted:
    """End every session that this service runs now, also one that is packed, or those on one station: shutters close,
    screens go dark, each can be resumed. Stations on which nothing runs are made safe, too. What waits for the same
    instruments is held until somebody releases it. Answers within 2 s; `stations` says whose shutter is closed, by its
    own answer, and whose isn't confirmed by then."""
    station = service.station(asked.station) if asked is not None and asked.station is not None else None
    until_s, live, why = time.monotonic() + ANSWER_S, service.live, f"halted by {key.name}"
    ended = live.halt(station, why)  # first: nothing that the registry does delays it
    stations = (
        _stations(service)
        if asked is None or asked.station is None
        else {asked.station: service.station(asked.station)}
    )
    busy = {key_of(session.station) for id in ended if (session := live.find(id)) is not None}
    answering = list(ended.values())
    for one in {key_of(one): one for one in stations.values()}.values():
        if key_of(one) not in busy:
            answering.append(live.make_safe(one))
    with service.store.transaction() as db:
        hold_queue(db, why, station.model_dump(mode="json") if station is not None else None)
    later = live.halt(station, why)  # what the queue began in between
    wait([*answering, *later.values()], max(0.0, until_s - time.monotonic()))
    told = []
    for name, one in stations.items():
        if (found := live.safety.find(one)) is None or (found.state == "halting" and found.shutter == "unknown"):
            live.safety.note_trouble(one, f"no answer of its shutter within {ANSWER_S:g} s; it is still being asked")
        if (safety := service.safety(one)) is not None:
            told.append(HaltedStation(name=name, safety=safety))
    return Halted(sessions=tuple(dict.fromkeys([*ended, *later])), stations=tuple(told))
