"""The sessions that this process runs, one thread each, and their followers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from functools import partial

import anyio

from api.errors import Conflict
from api.safety import KnownSafety, StationSafety, shutter_key
from lab.calibration.life import check_certified
from lab.capture.blocking_calls import in_thread
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.records import now
from lab.capture.recovery import make_station_safe
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import Drivers, Station, drivers_of
from lab.capture.store import Store
from lab.errors import Cancelled, CannotWrite, DeviceError, InputError
from lab.pipeline import Capturer, CaptureRequest

log = logging.getLogger(__name__)
RUNS = frozenset({"running", "paused"})
#: How often (s) a job looks at the session that it captures, and how long it waits for the end of an aborted one.
POLL_S, PATIENCE_S = 0.2, 60.0
#: The least time (s) between two events of one follower: quick steps share one.
APART_S = 0.2


def _wake(followers: list[asyncio.Event]) -> None:
    for follower in followers:
        follower.set()


class LiveSession:
    """One session in a thread of its own. A follower gets the latest progress first, then later ones; a slow follower
    misses some."""

    def __init__(self, station: Station, changed: Callable[[], None], safety: KnownSafety) -> None:
        self.station = station
        self._on_change, self._safety = changed, safety
        self.pausing = False
        self.capture: CaptureSession | None = None
        self._latest: Progress | None = None
        self._made: tuple[Progress, str] | None = None
        self._number = 0
        self._ended = False
        self._lock = threading.Lock()
        self._followers: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self._thread: threading.Thread | None = None
        self._known_before: StationSafety | None = None

    @property
    def latest(self) -> Progress | None:
        """The latest progress of the run; None before the first."""
        return self._latest

    @property
    def ended(self) -> bool:
        """Whether the run has ended, well or not."""
        return self._ended

    def begin(self, capture: CaptureSession) -> None:
        """Start the run's thread. How the run ends is written to the registry."""
        self.capture = capture
        self._known_before = self._safety.find(self.station)
        self._safety.note(self.station, None)
        self._thread = threading.Thread(target=self._work, args=(capture,), name=f"session {capture.id}", daemon=True)
        self._thread.start()

    def join(self, timeout_s: float) -> bool:
        """Wait `timeout_s` at most; True if the run has ended."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return self._ended

    def _work(self, capture: CaptureSession) -> None:
        try:
            capture.run()
        except (InputError, DeviceError, CannotWrite) as error:
            log.warning("session %s: %s", capture.id, error)
        except Exception:
            log.exception("session %s: a defect", capture.id)
        finally:
            if capture.safe is not None:
                self._safety.note(self.station, StationSafety.of(capture.safe))
            elif self._known_before is not None:  # it took no instruments up
                self._safety.note(self.station, self._known_before)
            self._note_change(ended=True)

    def tell(self, progress: Progress) -> None:
        """Called by the run, from its thread, at every progress."""
        if progress.state != "running":
            self.pausing = False
        self._note_change(progress)

    def _note_change(self, progress: Progress | None = None, ended: bool = False) -> None:
        with self._lock:
            was = self._latest.state if self._latest is not None else None
            asked = self._latest.asks if self._latest is not None else None
            self._latest = progress or self._latest
            self._number += 1
            self._ended = self._ended or ended
            followers = list(self._followers)
        if (
            progress is None or progress.state != was or progress.asks != asked
        ):  # before the followers hear of it and ask
            self._on_change()
        for loop in {loop for loop, _ in followers}:  # one call into a loop, however many follow there
            mine = [wake for of, wake in followers if of is loop]
            with contextlib.suppress(RuntimeError):  # that loop is closed
                loop.call_soon_threadsafe(_wake, mine)

    def once(self, progress: Progress, make: Callable[[Progress], str]) -> str:
        """Return what `make` makes of a progress, made once for all who follow. For one thread: that of the followers'
        loop."""
        if self._made is None or self._made[0] is not progress:
            self._made = (progress, make(progress))
        return self._made[1]

    def nudge(self) -> None:
        """Wake the followers, because the session's state changed without progress."""
        self._note_change()

    async def follow(self, stopping: anyio.Event) -> AsyncIterator[Progress]:
        """Yield the latest progress, then later ones, until the run ends or the service stops. A slow follower misses
        some, never the last."""
        wake = asyncio.Event()
        me = (asyncio.get_running_loop(), wake)
        with self._lock:
            self._followers.add(me)
        last_number = -1
        try:
            while True:
                wake.clear()
                with self._lock:
                    number, latest, ended = self._number, self._latest, self._ended
                if number != last_number and latest is not None:
                    last_number = number
                    yield latest
                if ended or stopping.is_set():
                    return
                await asyncio.sleep(APART_S)
                with anyio.move_on_after(0.5):  # to look whether the service stops
                    await wake.wait()
        finally:
            with self._lock:
                self._followers.discard(me)


class LiveSessions:
    """Starts, controls and ends sessions. Only one session at a time runs on an instrument, also across processes.
    `changed` is called at every change of a session's state, by any thread."""

    def __init__(
        self,
        store: Store,
        connect: Callable[[Station], Drivers] = drivers_of,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._store, self._connect, self._changed = store, connect, changed
        self.safety = KnownSafety(store, changed)
        self._live: dict[str, LiveSession] = {}
        #: How many halts there were.
        self.halts = 0
        self._lock = threading.Lock()
        self._closed = False
        self._held: list[frozenset[str]] = []  # addresses that sessions are kept off
        self._asking = threading.Lock()
        self._asked: dict[str, Future[None]] = {}  # what was asked last at each shutter

    def connect(self, station: Station) -> Drivers:
        """Return the drivers of a station, not yet connected."""
        return self._connect(station)

    def hold(self, station: Station, but: str = "") -> Callable[[], None]:
        """Keep sessions off a station's instruments until what is returned is called.

        Raises Conflict where one other than `but` runs on them, or they are held already.
        """
        with self._lock:
            self._check_free(station, but)
            self._held.append(station.addresses)
        return lambda: self._held.remove(station.addresses)

    @property
    def any_runs(self) -> bool:
        """Whether this process runs a session now."""
        return bool(self.running())

    def running(self) -> list[LiveSession]:
        """Return the sessions that this process runs now."""
        return [session for session in list(self._live.values()) if not session.ended]

    def find(self, session_id: str) -> LiveSession | None:
        """Return the session if this process runs it now, else None."""
        live = self._live.get(session_id)
        return live if live is not None and not live.ended else None

    def start(self, station: Station, plan: CapturePlan, name: str, notes: str, demands_certified: bool = False) -> str:
        """Register a session and run it; its id. Raises Conflict if one runs on an instrument of the station,
        InputError if the station lacks what the plan needs."""
        with self._lock:
            self._check_free(station)
            live = LiveSession(station, self._changed, self.safety)
            capture = CaptureSession.start(
                self._store,
                station,
                plan,
                name=name,
                notes=notes,
                demands_certified=demands_certified,
                on_progress=live.tell,
                connect=self._connect,
                asks_on_page=True,
                check_certified=check_certified,
            )
            self._live[capture.id] = live
            live.begin(capture)
        return capture.id

    def resume(self, session_id: str, moved: Station | None = None, in_turn: int | None = None) -> None:
        """Continue a paused session, or a session that ended early. `moved`: the station, if its instruments have other
        addresses now. `in_turn`: only while the number of halts is that, and it still waits in the queue and isn't
        held. Raises Conflict for a session that is running or finished."""
        with self._lock:
            live = self.find(session_id)
            if live is not None and live.capture is not None:
                if live.pausing or (live.latest is not None and live.latest.state == "paused"):
                    live.pausing = False
                    live.capture.resume()
                    return
                raise Conflict(f"session {session_id} runs already; pause it first")
            info = self._store.session(session_id)
            if info.state == "finished":
                raise Conflict(f"session {session_id} is finished; start a new one")
            if info.state in RUNS:
                raise Conflict(f"session {session_id} is run by another process; resume it there")
            station = moved or self._store.station(session_id)
            self._check_free(station)
            # After that: the run before, which is over, has said whether it ended badly.
            if in_turn is not None:
                info = self._store.session(session_id)
                if info.state != "queued" or info.error is not None:
                    raise Conflict(f"session {session_id} is {info.state} now: {info.error}")
            live = LiveSession(station, self._changed, self.safety)
            capture = CaptureSession(
                self._store,
                session_id,
                station=station,
                on_progress=live.tell,
                connect=self._connect,
                asks_on_page=True,
                check_certified=check_certified,
            )
            live.capture = capture  # from here on a halt reaches it
            self._live[session_id] = live
            if in_turn not in (None, self.halts):
                del self._live[session_id]
                raise Conflict(f"session {session_id}: halted just now")
            live.begin(capture)

    def capturer(self, station: Station) -> Capturer:
        """Return how a pipeline captures on `station`: as a session of this service, which can be followed, paused and
        aborted like any other. Joins a session that is under way. One that is under way now and is aborted before the
        pipeline begins isn't resumed."""
        under_way = frozenset(id for id, live in list(self._live.items()) if not live.ended)

        def capture_session(request: CaptureRequest, tell: Callable[[Progress], None]) -> str:
            session_id = request.session
            try:
                if not session_id:
                    plan = request.plan or full_plan(station, request.quick)
                    session_id = self.start(station, plan, request.name, request.notes, request.demands_certified)
                elif (
                    session_id not in under_way
                    and self.find(session_id) is None
                    and self._store.session(session_id).state != "finished"
                ):
                    self.resume(session_id, station)
            except Conflict as error:
                raise InputError(f"{error}; then start the job again") from error
            live = self._live.get(session_id)
            while live is not None and not live.join(POLL_S):
                try:
                    if live.latest is not None:
                        tell(live.latest)
                except Cancelled:
                    self._end(session_id, live)
                    raise
            info = self._store.session(session_id)
            if info.state == "finished":
                return session_id
            raise DeviceError(f"session {session_id} is {info.state}: {info.error}; resume it and start the job again")

        return capture_session

    def _end(self, session_id: str, live: LiveSession) -> None:
        """Abort a run and wait for its end."""
        if live.capture is not None:
            live.capture.abort("the job that captured was cancelled")
        if not live.join(PATIENCE_S):
            log.error("session %s didn't end within %g s; look after its instruments", session_id, PATIENCE_S)

    def pause(self, session_id: str) -> None:
        """Pause when the step under way is done. Raises Conflict where nothing can be paused now."""
        capture, live = self._running(session_id)
        state = live.latest.state if live.latest is not None else "connecting"
        if state != "running":
            raise Conflict(f"session {session_id} is {state}; only a running one can be paused")
        live.pausing = True
        capture.pause()
        live.nudge()

    def abort(self, session_id: str, reason: str) -> None:
        """End the run now. Finished steps are kept, and the session can be resumed."""
        capture, _ = self._running(session_id)
        capture.abort(reason)

    def halt(self, station: Station | None, reason: str) -> dict[str, Future[None]]:
        """End every run now, or those on the instruments of a station: shutters first, without waiting for anything.

        Returns by session what is done when the shutter has answered, or can't.
        """
        self.halts += 1
        wanted = None if station is None else station.addresses
        ended = {}
        for id, live in list(self._live.items()):
            if not live.ended and (wanted is None or wanted & live.station.addresses) and live.capture is not None:
                ended[id] = in_thread(partial(self._shut, id, live.station, live.capture, reason))
                in_thread(partial(live.capture.abort, reason))
        return ended

    def _shut(self, session_id: str, station: Station, capture: CaptureSession, reason: str) -> None:
        try:
            shutter = capture.shut(reason)
        except Exception as error:
            state = StationSafety(state="not confirmed", shutter="unknown", at=now(), words=str(error))
        else:
            if shutter is None:  # it connects or is packed: a connection of our own asks
                self.make_safe(station, session_id).result()
                return
            state = StationSafety(state="halting", shutter=shutter, at=now())
        if capture.safe is None:  # else what the run says of itself at its end is newer than `found`
            self.safety.note(station, state)
        else:
            self.safety.note(station, StationSafety.of(capture.safe))

    def make_safe(self, station: Station, session_id: str = "") -> Future[None]:
        """Make a station safe whose instruments no run of this service holds, by connections of our own.

        `session_id`: the run that may be under way, and holds none. What comes of it is noted; whoever asks while it is
        under way shares it, as a second connection would be refused.
        """
        with self._asking:
            under_way = self._asked.get(shutter_key(station))
            if under_way is None or under_way.done():
                self.safety.note_asked(station)
                under_way = self._asked[shutter_key(station)] = in_thread(partial(self._make_safe, station, session_id))
            return under_way

    def _make_safe(self, station: Station, session_id: str) -> None:
        try:
            let_go = self.hold(station, session_id)
        except Conflict as error:
            self.safety.note_trouble(station, str(error))
            return
        try:
            safe = make_station_safe(station, self._connect, partial(self.safety.note_shut, station))
            self.safety.note(station, StationSafety.of(safe))
        finally:
            let_go()

    def close(self, patience_s: float = PATIENCE_S) -> None:
        """End every run: shutters are closed, and the sessions can be resumed."""
        with self._lock:
            self._closed = True
            live = {id: session for id, session in self._live.items() if not session.ended}
        for session in live.values():
            if session.capture is not None:
                session.capture.abort("the service was stopped")
        until = time.monotonic() + patience_s
        for id, session in live.items():
            if not session.join(max(0.0, until - time.monotonic())):
                log.error("session %s didn't end within %g s; look after its instruments", id, patience_s)

    def _running(self, session_id: str) -> tuple[CaptureSession, LiveSession]:
        live = self.find(session_id)
        if live is None or live.capture is None:
            state = self._store.session(session_id).state
            elsewhere = "run by another process" if state in RUNS else state
            raise Conflict(f"session {session_id} isn't under way here, it is {elsewhere}")
        return live.capture, live

    def _check_free(self, station: Station, but: str = "") -> None:
        self._live = {id: session for id, session in self._live.items() if not session.ended}
        if self._closed:
            raise Conflict("the service is being stopped; start the session when it is up again")
        if (busy := self.busy(station)) not in (None, but):
            raise Conflict(f"session {busy} runs on these instruments; wait for it or abort it")
        if any(held & station.addresses for held in self._held):
            raise Conflict("one of these instruments is being checked or made safe; wait for the end of that")

    def busy(self, station: Station) -> str | None:
        """Return the id of a session that uses an instrument of this station now, in this process or another."""
        wanted = station.addresses
        for id, session in self._live.items():
            if not session.ended and wanted & session.station.addresses:
                return id
        for id in self._store.under_way():
            elsewhere = self.find(id) is None and self._store.session(id).state in RUNS
            if elsewhere and wanted & self._store.station(id).addresses:
                return id
        return None
