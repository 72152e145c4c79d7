"""The queue of sessions that wait for their instruments. It is kept in the registry, so it survives a restart of the
service.

A queued session starts when its turn has come, its instruments are free and its time (`not_before`) is reached. A run
that was aborted, failed or was killed holds the queued sessions that need one of its instruments: no shutter that
somebody just closed opens by itself. They start after somebody releases them, or after the run that held them is
resumed and finishes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta

from lab.capture.held_queue import HELD, waiting_rows
from lab.capture.store import Store
from lab.capture.tables import SessionRow
from lab.errors import InputError
from sim.parameters import Frozen

#: States from which a session may be queued.
STARTABLE = ("created", "interrupted", "failed", "queued")


class QueuedSession(Frozen):
    """A session in the queue. `place`: 1 is first; `held`: why it doesn't start, None if it isn't held."""

    id: str
    name: str
    station: str
    place: int
    not_before: datetime | None
    held: str | None


def queue(store: Store) -> list[QueuedSession]:
    """Return the queued sessions in their order.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     queue(Store(Path(folder)))
    []
    """
    with store.reading() as db:
        return [
            QueuedSession(
                id=row.id,
                name=row.name,
                station=row.station.get("name", ""),
                place=place,
                not_before=_aware(row.not_before),
                held=row.error.removeprefix(HELD) if row.error else None,
            )
            for place, row in enumerate(waiting_rows(db), start=1)
        ]


def put_into_queue(
    store: Store, session_id: str, not_before: datetime | None = None, place: int | None = None, held: str | None = None
) -> None:
    """Queue a session, or move a queued one to `place` (1 is first; None: last, or its present place).

    It is held for the reason `held`, or released where that is None. Raises InputError for a session that is unknown,
    runs or is finished."""
    with store.transaction() as db:
        row = db.get(SessionRow, session_id)
        if row is None or row.state not in STARTABLE:
            state = "unknown" if row is None else row.state
            raise InputError(f"session {session_id} is {state}; only one that can be started or resumed can wait")
        others = [row for row in waiting_rows(db) if row.id != session_id]
        now_at = row.queue_place if row.queue_place is not None else len(others)
        others.insert(min(place - 1 if place is not None else now_at, len(others)), row)
        row.state, row.not_before, row.error = "queued", not_before, f"{HELD}{held}" if held else None
        for at, waiting_row in enumerate(others):
            waiting_row.queue_place = at


def expected_times(
    waiting: Sequence[QueuedSession],
    addresses: Mapping[str, frozenset[str]],
    duration_s: Mapping[str, float],
    busy_until: Mapping[str, datetime | None],
    at: datetime,
) -> dict[str, tuple[datetime, datetime]]:
    """Return when each session of the queue is expected to start and to end, as the queue starts them from `at` on.

    waiting : the queue, in its order
    addresses, duration_s : instruments, and estimated time, of each session by its id
    busy_until : of the instruments in use now, by address; None: not known
    at : now, UTC

    A session that is held, or waits for an instrument of which that isn't known, isn't in the answer.

    >>> at = datetime(2030, 1, 1, tzinfo=UTC)
    >>> sessions = [QueuedSession(id=id, name="", station="bench", place=n, not_before=None, held=None)
    ...     for n, id in enumerate("ab", start=1)]
    >>> one_bench = dict.fromkeys("ab", frozenset({"COM1"}))
    >>> expected = expected_times(sessions, one_bench, {"a": 60.0, "b": 60.0}, {}, at)
    >>> (expected["b"][0] - at).total_seconds()
    60.0
    """
    times: dict[str, tuple[datetime, datetime]] = {}
    until = dict(busy_until)
    moments = [at]
    while moments:
        at = moments.pop(0)
        taken = {address for address, end in until.items() if end is None or end > at}
        for queued in waiting:
            if queued.id in times:
                continue
            mine = addresses[queued.id]
            if queued.held is None and (queued.not_before is None or queued.not_before <= at) and not mine & taken:
                end = at + timedelta(seconds=duration_s[queued.id])
                times[queued.id] = (at, end)
                until |= dict.fromkeys(mine, end)
                taken |= mine
            elif queued.not_before is None or queued.held is not None:
                taken |= mine  # who comes later on these instruments waits for it
        left = [queued for queued in waiting if queued.id not in times]
        later = {end for end in until.values() if end is not None and end > at}
        later |= {queued.not_before for queued in left if queued.not_before is not None and queued.not_before > at}
        moments = sorted(later)[:1]
    return times


def leave_queue(store: Store, session_id: str) -> None:
    """Take a session out of the queue, so that it can be started by hand. Raises InputError where it isn't queued."""
    with store.transaction() as db:
        row = db.get(SessionRow, session_id)
        if row is None or row.state != "queued":
            raise InputError(f"session {session_id} isn't in the queue; GET /queue lists those that are")
        done = bool(row.runs)
        row.state, row.error = ("interrupted", "taken out of the queue") if done else ("created", None)
        row.queue_place = row.not_before = None


def _aware(at: datetime | None) -> datetime | None:
    return at.replace(tzinfo=UTC) if at is not None and at.tzinfo is None else at
