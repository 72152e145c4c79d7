"""The queue of sessions, and the halt of everything."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends

from api.errors import Conflict, answers
from api.keys import Permission, StoredKey
from api.schemas import Halt, Halted, QueuePlace
from api.security import Demand
from api.service import OPERATE, OVER, READ, Here, Service, SessionId
from lab.capture.queue import QueuedSession, hold_queue, leave_queue, put_into_queue, queue
from lab.errors import InputError

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
    """The sessions that wait for their instruments, in their order. `held`: it doesn't start by itself, because the run before it on the
    same instruments ended badly, or because of a halt."""
    return _told(service)


@router.put("/sessions/{session_id}/queue", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def queue_session(service: Here, session_id: SessionId, asked: QueuePlace) -> list[QueuedSession]:
    """Let a session wait for its turn, move one that waits to another place or time, and release one that is held. The queue as it is then.
    409 for a session that runs or is finished."""
    info = service.session(session_id)
    state = service.state(info)
    if state not in OVER or state == "finished":
        raise Conflict(f"session {session_id} is {state}; only one that can be started or resumed can wait")
    put_into_queue(service.store, session_id, asked.not_before, asked.place)
    service.waiting.look_soon()
    return _told(service)


@router.delete("/sessions/{session_id}/queue", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def unqueue_session(service: Here, session_id: SessionId) -> list[QueuedSession]:
    """Take a session out of the queue; it can be resumed by hand. The queue as it is then. 409 for a session that doesn't wait."""
    service.session(session_id)
    if service.live.find(session_id) is not None:
        raise Conflict(f"session {session_id} has begun; abort it")
    try:
        leave_queue(service.store, session_id)
    except InputError as error:
        raise Conflict(str(error)) from None
    return _told(service)


@router.post("/halt", responses=answers(401, 403, 404, 422))
def halt(
    service: Here, key: Annotated[StoredKey, Depends(Demand(Permission.OPERATE))], asked: Halt | None = None
) -> Halted:
    """End every session that this service runs now, or those on one station: shutters close, screens go dark, each can be resumed. What waits
    for the same instruments is held until somebody releases it."""
    station = service.station(asked.station) if asked is not None and asked.station is not None else None
    why = f"halted by {key.name}"
    ended = service.live.halt(station, why)  # first: nothing that the registry does delays it
    with service.store.transaction() as db:
        hold_queue(db, why, station.model_dump(mode="json") if station is not None else None)
    ended += service.live.halt(station, why)  # what the queue began in between
    return Halted(sessions=tuple(dict.fromkeys(ended)))
