"""Starts the sessions that wait in the queue, each when its turn has come and its instruments are free."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future

from api.errors import Conflict
from api.live import LiveSessions
from lab.capture.held_queue import hold_queue
from lab.capture.queue import put_into_queue, queue
from lab.capture.records import now
from lab.capture.station import Station
from lab.capture.store import Store
from lab.errors import CannotWrite, InputError

log = logging.getLogger(__name__)
#: How often (s) the queue is looked at.
LOOK_S = 1.0


class QueueRunner:
    """Looks at the queue in a thread of its own, from `start` to `close`. `ready`: False while stations are still made
    safe after a crash, whose sessions go on first."""

    def __init__(self, store: Store, live: LiveSessions, ready: Callable[[], bool]) -> None:
        self._store, self._live, self._ready = store, live, ready
        self._begun: set[str] = set()
        self._holds: list[tuple[str, Station | None, Future[None]]] = []  # that aren't in the registry yet
        self._ended, self._wake = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="queue", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def look_soon(self) -> None:
        """Look at the queue now, not at the next turn."""
        self._wake.set()

    def hold(self, why: str, station: Station | None) -> Future[None]:
        """Hold what waits for an instrument of `station` (None: all that waits), from now on: nothing starts until the
        registry has it, which is tried again where the registry can't be written. Returns at once; what is returned is
        done when the registry has it."""
        written: Future[None] = Future()
        self._holds.append((why, station, written))
        self._wake.set()
        return written

    def close(self) -> None:
        """End the thread; what waits goes on waiting."""
        self._ended.set()
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(10.0)

    def _work(self) -> None:
        while not self._ended.is_set():
            try:
                self._write_holds()
                if self._ready():
                    self.look()
            except CannotWrite as error:  # tried again
                log.debug("looking at the queue: %s", error)
            except Exception:
                log.exception("looking at the queue: a defect")
            self._wake.wait(LOOK_S)
            self._wake.clear()

    def look(self) -> None:
        """Start every session whose turn has come."""
        halts = self._live.halts
        if self._store.room.lack() is not None:  # what waits goes on waiting
            return
        waiting = queue(self._store)
        if not waiting:
            return
        ended = [id for id in self._store.under_way() if self._live.find(id) is None]
        taken = {address for id in ended for address in self._store.station(id).addresses}
        for waiter in waiting:
            if self._holds:
                return
            if self._ended.is_set() or self._live.find(waiter.id) is not None:
                continue
            addresses = self._store.station(waiter.id).addresses
            if (
                waiter.held is None
                and (waiter.not_before is None or waiter.not_before <= now())
                and not addresses & taken
            ):
                self._start(waiter.id, halts)
            if waiter.not_before is None or waiter.held is not None:
                taken |= addresses  # who comes later on these instruments waits for its turn

    def _write_holds(self) -> None:
        while self._holds:
            why, station, written = self._holds[0]
            with self._store.transaction() as db:
                hold_queue(db, why, station.model_dump(mode="json") if station is not None else None)
            del self._holds[0]
            written.set_result(None)

    def _start(self, session_id: str, halts: int) -> None:
        if session_id in self._begun:  # it began, and nothing of that was recorded
            self._begun.discard(session_id)
            put_into_queue(self._store, session_id, held="its run ended before it began; the service's log says more")
            return
        try:
            self._live.resume(session_id, in_turn=halts)
        except Conflict:
            return  # its instruments are in use, or it was held just now
        except InputError as error:
            log.warning("session %s: not started from the queue: %s", session_id, error)
            put_into_queue(self._store, session_id, held=str(error))
            return
        self._begun.add(session_id)
