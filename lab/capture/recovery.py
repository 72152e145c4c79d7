"""Recovery of sessions whose process died: kill -9, a power cut, a crash.

Such a session may have left the shutter open. Its station is made safe (shutter closed, screen dark, motion stopped),
the reason is recorded, and the session is resumed where its station says so (`resume_automatically`) or where only
packing is left."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping

from drivers.instrument import Instrument
from drivers.monochromator.base import Monochromator
from lab.capture.blocking_calls import STOP_S, in_thread
from lab.capture.by_hand import left_by_session
from lab.capture.file_lock import Lock
from lab.capture.instruments import SafeState, Shutter, made_safe
from lab.capture.records import now
from lab.capture.station import Drivers, Station, drivers_of
from lab.capture.store import Store
from lab.errors import CannotWrite, DeviceError, InputError

log = logging.getLogger(__name__)
#: Interval (s) between searches of the registry for sessions whose process died, and longest interval between attempts
#: to reach instruments that didn't answer.
LOOK_S, LONGEST_PAUSE_S = 5.0, 60.0


def make_station_safe(
    station: Station, connect: Callable[[Station], Drivers] = drivers_of, on_shut: Callable[[], None] = lambda: None
) -> SafeState:
    """Connect to every instrument of a station and stop it, all at once: shutter closed, screen dark, motion stopped. A
    person at a prompt isn't asked.

    An instrument that isn't reached, or doesn't stop within `STOP_S`, has its complaint. `on_shut` is called as soon as
    the shutter has answered that it is closed: where it can be asked at once, long before the instrument's identity
    and state are known. Raises nothing.
    """
    try:
        drivers = connect(station.machines)
    except (InputError, DeviceError) as error:
        shutter: Shutter = "none" if station.monochromator is None else "unknown"
        return SafeState(shutter=shutter, complaints=(str(error),), at=now())

    def shut_and_connect(driver: Instrument) -> None:
        if isinstance(driver, Monochromator) and driver.shut_at_once():
            on_shut()
        driver.connect()

    states, until = made_safe(drivers, shut_and_connect, on_shut), time.monotonic() + STOP_S
    closing = [in_thread(driver.close) for driver in drivers.all.values()]
    for done in closing:
        try:
            done.result(max(0.0, until - time.monotonic()))
        except Exception:
            log.debug("a connection wasn't closed", exc_info=True)
    return states


def ended_without_progress_twice(store: Store, session_id: str) -> bool:
    """Return whether the last two runs of a session finished no step: resuming it automatically could repeat for
    ever."""
    done, runs = store.session(session_id).steps_done, store.runs(session_id)
    return len(runs) >= 2 and all(run.steps_done == done for run in runs[-2:])


class Recovery:
    """Looks for sessions whose process died, makes their stations safe, and resumes those that may be resumed
    automatically.

    It works in a thread from `start` to `close`. `connect` makes a station's drivers. An instrument that doesn't answer
    is tried again until it does; meanwhile the session's `error` says so. `made_safe`: sessions whose stations are safe
    already, with their locks, which are held since.
    """

    def __init__(
        self,
        store: Store,
        connect: Callable[[Station], Drivers] = drivers_of,
        clock: Callable[[], float] = time.monotonic,
        made_safe: Mapping[str, Lock] | None = None,
    ) -> None:
        self._made_safe = dict(made_safe or {})
        self._store, self._connect, self._clock = store, connect, clock
        self._resume: Callable[[str], None] | None = None
        self._note: Callable[[Station, SafeState], None] | None = None
        self._found: list[tuple[Station, SafeState]] = []  # of which nobody was informed yet
        self._waiting: list[str] = []  # sessions that are safe and will be resumed automatically
        self._safe_since: dict[str, SafeState] = {}  # stations that were made safe, which couldn't be recorded yet
        self._next_try_s: dict[str, tuple[float, float]] = {}  # session -> (when, the pause before it)
        self._looked, self._ended = threading.Event(), threading.Event()
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._work, name="recovery", daemon=True)

    def start(self, patience_s: float = 0.0) -> None:
        """Start the thread if it doesn't run yet, and wait for its first search to end, for `patience_s` at most."""
        if self._thread.ident is None:
            self._thread.start()
        self._looked.wait(patience_s)

    def resume_with(
        self, resume: Callable[[str], None], note: Callable[[Station, SafeState], None] = lambda station, state: None
    ) -> None:
        """Set the functions that resume a session and that keep what a station's instruments have answered; sessions
        that waited are resumed now."""
        self._resume, self._note = resume, note
        self._wake.set()

    @property
    def settled(self) -> bool:
        """Whether the first search is over and no session waits to be resumed."""
        return self._looked.is_set() and not self._waiting

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(STOP_S)
        while self._made_safe:  # nobody looked
            self._made_safe.popitem()[1].release()

    def _work(self) -> None:
        failed = False
        while not self._ended.is_set():
            try:
                self.look()
                failed = False
            except CannotWrite as error:  # tried again
                log.log(logging.DEBUG if failed else logging.WARNING, "sessions whose process ended: %s", error)
                failed = True
            except Exception:
                log.exception("looking for sessions whose process ended: a defect")
            self._looked.set()
            self._wake.wait(LOOK_S)
            self._wake.clear()

    def look(self) -> None:
        """Make the stations of all sessions safe whose process died, and resume those that may be resumed
        automatically."""
        for session_id in self._store.under_way():
            at, _ = self._next_try_s.get(session_id, (0.0, 0.0))
            if self._clock() >= at and not self._ended.is_set():
                self._recover(session_id)
        while self._found and self._note is not None:
            self._note(*self._found.pop(0))
        while self._waiting and self._resume is not None and not self._ended.is_set():
            session_id = self._waiting.pop()
            try:
                self._resume(session_id)
            except Exception as error:
                log.warning("session %s: not resumed by itself: %s", session_id, error)

    def _recover(self, session_id: str) -> None:
        lock = self._made_safe.pop(session_id, None)
        is_safe = lock is not None
        if lock is None:
            lock = self._store.lock(session_id)
            if not lock.acquire(patience_s=0.0):
                return  # its process is alive
        try:
            if session_id not in self._store.under_way():
                return  # it ended in good order, just now
            station = self._store.station(session_id)
            began = f"the process that ran it died (a crash, kill -9, a power cut), found {now():%Y-%m-%d %H:%M:%S} UTC"
            shutter: Shutter = "none" if station.monochromator is None else "closed"
            safe = SafeState(shutter=shutter, at=now()) if is_safe else self._safe_since.get(session_id)
            if safe is None:
                safe = make_station_safe(station, self._connect)
            self._found.append((station, safe))
            if complaints := safe.complaints:
                _, pause_s = self._next_try_s.get(session_id, (0.0, LOOK_S / 2))
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
                self._next_try_s[session_id] = (self._clock() + pause_s, pause_s)
                message = (
                    f"{began}; not brought into a safe state: {'; '.join(complaints)}; look after them, they are "
                    "tried again"
                )
                self._store.set_state(session_id, "running", error=message)  # so that the next look finds it
                log.error("session %s: %s", session_id, message)
                return
            self._safe_since.setdefault(session_id, safe)
            self._next_try_s.pop(session_id, None)
            then, again = self._what_next(session_id, station)
            left = left_by_session(self._store.root, session_id)
            then += "" if left is None else f"; {left.words}"
            self._store.set_state(session_id, "interrupted", error=f"{began}; its station was made safe; {then}")
            del self._safe_since[session_id]
            log.warning("session %s: %s; its station was made safe; %s", session_id, began, then)
            if again:
                self._waiting.append(session_id)
        finally:
            lock.release()

    def _what_next(self, session_id: str, station: Station) -> tuple[str, bool]:
        """Return what happens next to the session, as the end of a sentence, and whether it is resumed."""
        info = self._store.session(session_id)
        if info.steps_done == info.steps:
            return "only packing was left, which goes on by itself", True
        if not station.resume_automatically:
            return "resume it when the bench is ready", False
        if ended_without_progress_twice(self._store, session_id):
            return (
                (
                    "its last two runs finished no step, so it isn't resumed by itself: look after the bench, then "
                    "resume "
                    "it"
                ),
                False,
            )
        return "it goes on by itself, as its station says", True
