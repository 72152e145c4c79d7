"""Run a session on a station: every step exactly once, through interruptions.

bluesky's RunEngine runs the plan; the journal in the registry says which steps are done. A run that ended early
(Ctrl-C, an instrument that failed, kill -9, a power cut) is resumed by running the session again: finished steps are
not taken again, and the others are taken whole.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import os
import platform
import signal
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, TypeVar

import bluesky.preprocessors as bpp
import bluesky.run_engine
from bluesky.run_engine import RunEngine
from bluesky.utils import DuringTask, FailedStatus, Msg, RunEngineInterrupted, TransitionError

from drivers.errors import InstrumentError
from lab.capture.blocking_calls import STOP_S, in_thread
from lab.capture.by_hand import ByHand, left_by_session, note_put_back
from lab.capture.instruments import BenchState, Instruments, SafeState
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.questions import Question, put_question, wait_for_answer, withdraw
from lab.capture.records import JournalEntry, RunRecord, SessionInfo, now
from lab.capture.station import Drivers, Station, drivers_of
from lab.capture.store import Store
from lab.capture.take_step import Taken, adjust, repeats_ahead, take
from lab.capture_kinds.base import Step
from lab.errors import FULL, CannotWrite, DeviceError, InputError, lacks_room
from lab.formats.recording_set import Snapshots, differences
from sim.parameters import Frozen

T = TypeVar("T")
#: Raises InputError unless the rig of these instruments has a certified calibration.
CheckCertified = Callable[[Store, Snapshots, Station], None]
log = logging.getLogger(__name__)
# Without a handler, bluesky's errors would go to stderr as tracebacks, across the progress bar.
logging.getLogger("bluesky").addHandler(logging.NullHandler())
# The RunEngine announces pauses and aborts on stdout, which belongs to the command line.
bluesky.run_engine.__dict__["print"] = lambda *words, **_: log.debug(" ".join(map(str, words)))

#: How often (s) a waiting main thread wakes to let Python run signal handlers.
WAKE_S = 0.1
#: How often (s) a session that waits for room looks whether there is some.
ROOM_S = 1.0
#: How often a step is taken again, at most, where its files couldn't be written although the disk seems to have room
#: (a quota).
MOST_TRIES = 3

#: In the error of a session whose run left an instrument out of its safe state.
UNSAFE = "not brought into a safe state"
PACKAGES = ("calibench", "numpy", "bluesky", "pyserial", "pyusb", "h5py")


def _refuse(store: Store, instruments: Snapshots, station: Station) -> None:
    """Refuse a session that demands a certified calibration where its program doesn't look for one."""
    raise InputError(
        f"station {station.name}: the session demands a certified calibration, and nothing here checks it; run it by "
        "`calibench capture` or the service"
    )


class Progress(Frozen):
    """Progress of a session: `done` of `total` steps are finished, `what` is the current one; times in s. `bench`:
    state of the instruments after the previous step. `asks`: what an operator is asked to do now, over the service."""

    session: str
    state: Literal["connecting", "running", "paused", "packing", "interrupted", "failed", "finished"]
    what: str
    sequence: str = ""
    done: int
    total: int
    elapsed_s: float
    left_s: float | None = None
    remark: str | None = None
    bench: BenchState | None = None
    asks: Question | None = None


class _Pace:
    """Estimates the time left (s) from the mean duration of this run's steps, sequence by sequence."""

    def __init__(self) -> None:
        self._spent_s: dict[str, float] = defaultdict(float)
        self._steps: Counter[str] = Counter()

    def add(self, step: Step, seconds: float) -> None:
        self._spent_s[step.sequence] += seconds
        self._steps[step.sequence] += 1

    def left_s(self, to_do: Counter[str]) -> float | None:
        """Seconds for the steps that are left, `to_do` of them by sequence; None before the first step is done."""
        if not self._steps:
            return None
        mean_s = sum(self._spent_s.values()) / self._steps.total()
        own_s = {name: self._spent_s[name] / count for name, count in self._steps.items()}
        return sum(count * own_s.get(name, mean_s) for name, count in to_do.items())


class _Writes:
    """Allows writes until the run is over.

    An abort doesn't end the threads that wait for instruments. A thread that returns late must not write into the next
    run's files."""

    def __init__(self) -> None:
        self._change = threading.Condition()
        self._under_way = 0
        self._over = False

    def do(self, write: Callable[[], T]) -> T:
        """Write now, several at once. Raises InstrumentError after `close`."""
        with self._change:
            if self._over:
                raise InstrumentError("came back after the run had ended; what it brought is dropped")
            self._under_way += 1
        try:
            return write()
        finally:
            with self._change:
                self._under_way -= 1
                self._change.notify_all()

    def close(self) -> None:
        """Refuse all later writes, and wait for those that are under way."""
        with self._change:
            self._over = True
            self._change.wait_for(lambda: self._under_way == 0)


@dataclass(frozen=True)
class _Lack:
    """Room that the disk lacks: for so many bytes beside the reserve; in words."""

    wanted_bytes: int
    words: str


class _Ended(Exception):
    """The run was ended from another thread."""


class CaptureSession:
    """One session on its station. `run` blocks; `pause`, `resume` and `abort` may be called from other threads.

    `station`: None for the station of its last run, or that it was registered with; another one where instruments have
    new addresses. `on_progress` is called from a thread of the run. An exception that it raises ends the run.
    `asks_on_page`: a person as stage is asked by `lab.capture.questions`, not on the terminal. `check_certified`: a
    session that demands a certified calibration needs it."""

    def __init__(
        self,
        store: Store,
        session_id: str,
        *,
        station: Station | None = None,
        on_progress: Callable[[Progress], None] | None = None,
        connect: Callable[[Station], Drivers] = drivers_of,
        asks_on_page: bool = False,
        check_certified: CheckCertified | None = None,
    ) -> None:
        self.store, self.id = store, session_id
        self.station = station or store.station(session_id)
        self._on_progress = on_progress
        self._connect = connect
        self._asks_on_page = asks_on_page
        self._check_certified = check_certified or _refuse
        self._told: Progress | None = None
        self._asks: Question | None = None
        self._engine: RunEngine | None = None
        self._instruments: Instruments | None = None
        self._control = threading.Condition()
        self._held = threading.Lock()  # while instruments are taken up, shut or let go
        self._ended_by: str | None = None
        self._resume_asked = False
        self._lacks: _Lack | None = None  # the room on the disk that it has to wait for
        #: Why it is paused, where nobody asked for that; None else.
        self.paused_by: str | None = None
        self._began_s = time.monotonic()
        self._pace = _Pace()
        self._entries: list[JournalEntry] = []
        self._done = 0
        self._writes = _Writes()
        #: How the run left its instruments; None while it captures, and where it had nothing to capture.
        self.safe: SafeState | None = None

    @classmethod
    def start(
        cls,
        store: Store,
        station: Station,
        plan: CapturePlan | None = None,
        *,
        quick: bool = False,
        name: str = "",
        notes: str = "",
        demands_certified: bool = False,
        on_progress: Callable[[Progress], None] | None = None,
        connect: Callable[[Station], Drivers] = drivers_of,
        asks_on_page: bool = False,
        check_certified: CheckCertified | None = None,
    ) -> CaptureSession:
        """Register a new session, by default of everything that the station can do. `run` starts it.

        Raises InputError if the station lacks what the plan needs.
        """
        chosen = plan or full_plan(station, quick)
        steps = chosen.steps(station)
        if not steps:
            raise InputError("station: nothing to capture with; add instruments and targets to the station file")
        session_id = store.create_session(
            station,
            steps,
            plan=chosen.document(),
            patterns=chosen.patterns(station),
            name=name,
            notes=notes,
            demands_certified=demands_certified,
        )
        return cls(
            store, session_id, on_progress=on_progress, connect=connect, asks_on_page=asks_on_page,
            check_certified=check_certified,
        )  # fmt: skip

    # --- from other threads -------------------------------------------------------------------------------------------

    def pause(self) -> None:
        """Pause after the current step: the shutter closes, the screen goes dark, all connections stay open."""
        with self._control:
            engine = self._engine
        if engine is not None and engine.state == "running":
            with contextlib.suppress(TransitionError):
                engine.request_pause(defer=True)

    def resume(self) -> None:
        """Go on after a pause."""
        with self._control:
            self._resume_asked = True
            self._control.notify_all()

    def shut(self, reason: str) -> Literal["closed", "none"] | None:
        """Close the shutter now, without waiting for the step under way, and open it no more in this run.

        `abort` then ends the run, for the same `reason`. Returns `closed` by the monochromator's own answer, `none`
        where the station has no monochromator, and None where the run holds no instruments, and takes none up from now
        on. Raises InstrumentError where the monochromator doesn't say that its shutter is closed."""
        with self._control:
            self._ended_by = self._ended_by or reason
        with self._held:
            if self._instruments is None:
                return None
            if self._instruments.lamp is not None:
                in_thread(self._instruments.lamp.bar)  # who stops all instruments hears whether it got dark
            if self._instruments.shutter is None:
                return "none"
            self._instruments.shutter.bar()
            return "closed"

    def abort(self, reason: str = "aborted") -> None:
        """End the run now. The current step is dropped, finished ones stay, and `run` continues from there: also while
        the session is packed."""
        with self._control:
            if self._ended_by is None:
                self._ended_by = reason
            engine = self._engine
            self._control.notify_all()
        if engine is not None and engine.state == "running":
            with contextlib.suppress(TransitionError):
                engine.abort(reason)

    # --- the run ------------------------------------------------------------------------------------------------------

    def run(self) -> SessionInfo:
        """Take every step that isn't in the journal yet, and pack the session.

        Raises DeviceError if an instrument fails (what was finished is kept, the shutter closed), InputError if another
        process runs the session or the disk is full, and KeyboardInterrupt on Ctrl-C, after everything is safe. A run
        that `abort` ended returns with the state "interrupted".
        """
        lock = self.store.lock(self.id)
        if not lock.acquire():
            raise InputError(f"session {self.id}: another process runs it; wait for that, or end it")
        try:
            with self._signals() as interrupted:
                self._run()
            if interrupted.is_set():
                raise KeyboardInterrupt
        finally:
            # what a run held lives on in cycles of its exception and engine, until Python looks for these
            self._entries.clear()
            lock.release()
        return self.store.session(self.id)

    def _run(self) -> None:
        self._began_s = time.monotonic()
        withdraw(self.store.folder(self.id))  # what a killed run asked
        swept = self.store.sweep(self.id)
        if swept:
            log.info("session %s: took away %d files of steps that weren't finished", self.id, len(swept))
        self._entries = self.store.journal(self.id)
        self._done = sum(entry.finished is not None for entry in self._entries)
        try:
            if self._done < len(self._entries):
                self._capture()
            with contextlib.suppress(_Ended):
                while self._ended_by is None:
                    if self._pack():
                        self._tell("finished", "done")
                        return
                    self._wait_until_resumed()
        except BaseException as error:
            reason = str(error) or type(error).__name__
            self._record_end("failed", reason + self._left_by_hand())
            self._tell("failed", str(error), quietly=True)
            raise
        reason = (self._ended_by or "") + self._left_by_hand()
        self._record_end("interrupted", reason)
        self._tell("interrupted", reason)

    def _record_end(self, state: Literal["failed", "interrupted"], error: str) -> None:
        """Record how the run ended. On a full disk the reserve makes way for it."""
        try:
            self.store.set_state(self.id, state, error=error)
        except CannotWrite as why:
            self.store.room.give_up()
            try:
                self.store.set_state(self.id, state, error=error)
            except CannotWrite:
                log.warning("session %s is %s (%s), which couldn't be recorded: %s", self.id, state, error, why)

    def _pack(self) -> bool:
        """Pack the session; whether there was room for it."""
        self._tell("packing", "packing the session")
        try:
            self.store.close_session(self.id, self._tell_packing)
        except Exception as error:
            if not lacks_room(error):
                raise
            frames_bytes = sum(file.bytes for file in self.store.files(self.id) if file.role == "frame")
            self._look_for_room(frames_bytes, error)
            return False
        return True

    # --- room on the disk -----------------------------------------------------------------------------------------

    def _look_for_room(self, wanted_bytes: int, error: BaseException | None = None) -> None:
        """Note the room that the disk lacks, if it does. `error`: what failed because of that."""
        lack = self.store.room.lack(wanted_bytes) or error
        self._lacks = None if lack is None else _Lack(wanted_bytes, f"{lack}; the session goes on when there is room")

    def _wait_until_resumed(self) -> None:
        """Be paused until somebody resumes or ends the run, or until the disk has the room that it lacks. Raises
        _Ended."""
        lacks, self._lacks = self._lacks, None
        self.paused_by = why = None if lacks is None else lacks.words
        try:
            self.store.set_state(self.id, "paused", error=why)
        except CannotWrite as error:
            log.warning("session %s: that it is paused couldn't be recorded: %s", self.id, error)
        self._tell("paused", "paused: the shutter is closed", remark=why)
        look_s = time.monotonic() + ROOM_S
        with self._control:
            while not self._control.wait_for(lambda: self._resume_asked or self._ended_by is not None, WAKE_S):
                if lacks is not None and time.monotonic() >= look_s:
                    if self.store.room.lack(lacks.wanted_bytes) is None:
                        break
                    look_s = time.monotonic() + ROOM_S
            self._resume_asked = False
        self.paused_by = None
        self._check_goes_on()
        self.store.set_state(self.id, "running")

    def _take_with_room(
        self, step: Step, instruments: Instruments, results: Mapping[str, Mapping[str, Any]], repeats: int
    ) -> Generator[Msg, Any, Taken]:
        """Take a step and keep what it took, once the disk has room for that: until then the run is paused, shutter
        closed, screen dark. A step whose files a full disk didn't take is taken again."""
        sheets = {side: camera.datasheet for side, camera in self.station.cameras.items()}
        wanted_bytes = sum(2 * math.prod(sheets[capture.side].frame_shape) for capture in step.captures)
        failures = 0
        while True:
            if self._lacks is None:
                self._look_for_room(wanted_bytes)
            if self._lacks is not None:
                yield Msg("pause", None, defer=True)
                yield Msg("checkpoint")  # here it is paused
            started = now()
            try:
                taken: Taken = yield from take(step, instruments, results, repeats)
                yield Msg("in_a_thread", None, call=lambda t=taken, b=started: self._keep(step, t, b))
            except Exception as error:
                failures += self.store.room.lack(wanted_bytes) is None
                if not lacks_room(error) or failures == MOST_TRIES or self._ended_by is not None:
                    raise
                self._look_for_room(wanted_bytes, _plain(error, ()))
            else:
                return taken

    def _left_by_hand(self) -> str:
        """Return what the session leaves changed by hand, as the end of a sentence; empty: nothing."""
        left = left_by_session(self.store.root, self.id)
        return "" if left is None else f"; {left.words}"

    def _tell_packing(self, what: str, share: float) -> None:
        self._check_goes_on()
        self._tell("packing", f"{what}, {share:.0%}")

    def _check_goes_on(self) -> None:
        """Raise `_Ended` where the run was ended from another thread."""
        if self._ended_by is not None:
            raise _Ended(self._ended_by)

    def _capture(self) -> None:
        """Connect, run the plan, and bring all instruments into their safe state."""
        self._tell("connecting", "connecting to the instruments")
        self._writes = _Writes()
        by_hand = ByHand(self.store.root, self.id, self.station)
        by_hand.check_can_put_back()
        drivers = self._connect(self.station)
        if self._asks_on_page and drivers.stage is not None:
            drivers.stage.ask_by(partial(self._ask, drivers.stage.place_timeout_s))
        instruments = Instruments(
            self.station,
            drivers,
            write_frame=lambda path, side, frame: self._writes.do(
                lambda: self.store.write_frame(self.id, path, side, frame)
            ),
            write_spectrum=lambda path, spectrum: self._writes.do(
                lambda: self.store.write_spectrum(self.id, path, spectrum)
            ),
            cells=self.store.recording_set(self.id).target,
            by_hand=by_hand,
        )
        failure: BaseException | None = None
        with self._held:
            if self._ended_by is not None:
                return
            self._instruments = instruments
        try:
            snapshots = instruments.connect(self._check_goes_on)
            self._check_identities(snapshots)
            if self.store.session(self.id).demands_certified:
                self._check_certified(self.store, snapshots, self.station)
            instruments.check([entry.step for entry in self._entries if entry.finished is None])
            self.store.set_state(self.id, "running", run=self._provenance(snapshots), station=self.station)
            self._drive(instruments)
        except BaseException as error:
            failure = error
        self.safe = instruments.make_safe()  # before any file is waited for
        mine = self._held.acquire(timeout=STOP_S)  # no driver that hangs holds the run up
        try:
            instruments.close()
            self._instruments = None
        finally:
            if mine:
                self._held.release()
        self._writes.close()
        self._asks = None
        withdraw(self.store.folder(self.id))
        if failure is not None and not (self._ended_by is not None and isinstance(failure, Exception)):
            raise _plain(failure, self.safe.complaints) from failure
        if self.safe.complaints:
            raise DeviceError(f"{self._ended_by or 'at its end'}; {UNSAFE}: {'; '.join(self.safe.complaints)}")

    def _check_identities(self, snapshots: Snapshots) -> None:
        """Check that the session's instruments are the same. Raises InputError if one was exchanged since the previous
        run."""
        for run in self.store.runs(self.id)[-1:]:
            for name, snapshot in snapshots.items():
                before = run.instruments[name].serial_number if name in run.instruments else ""
                if before and snapshot.serial_number and before != snapshot.serial_number:
                    raise InputError(
                        f"session {self.id}: {name} has the serial number {snapshot.serial_number}, the session began "
                        f"with {before}; connect that one again or start a new session"
                    )

    def _provenance(self, snapshots: Snapshots) -> RunRecord:
        """Return the record of this run; what differs of the instruments from the run before is told now."""
        versions = {"python": platform.python_version()}
        for package in PACKAGES:
            with contextlib.suppress(PackageNotFoundError):
                versions[package] = version(package)
        session, before = self.store.run_before(self.id) or ("", None)
        changes = () if before is None else differences(before.instruments, snapshots)
        for line in changes:
            self._tell("connecting", "looking at the instruments", remark=f"{line} (in session {session})")
        return RunRecord(
            started=now(),
            steps_done=self._done,
            instruments=dict(snapshots),
            versions=versions,
            compared_with=session,
            changes=changes,
        )

    def _drive(self, instruments: Instruments) -> None:
        """Run the plan to its end on a RunEngine of its own, across pauses."""
        engine = RunEngine({}, context_managers=[], during_task=_Wakeful())
        documents = self.store.folder(self.id) / "documents.jsonl"
        engine.subscribe(_Documents(documents))

        async def in_a_thread(message: Any) -> Any:
            return await _awaited(message.kwargs["call"])

        engine.register_command("in_a_thread", in_a_thread)
        with self._control:
            self._engine = engine
        try:
            go: Callable[[], Any] = lambda: engine(self._plan(instruments), session=self.id)  # noqa: E731
            while True:
                with contextlib.suppress(RunEngineInterrupted):
                    go()
                if engine.state != "paused":
                    return  # at its end, or aborted
                try:
                    self._wait_until_resumed()
                except _Ended:
                    engine.abort(self._ended_by)
                    return
                go = engine.resume
        except BaseException:
            if self._ended_by is not None:
                return  # the abort itself caused this exception
            raise
        finally:
            with self._control:
                self._engine = None
            engine.loop.call_soon_threadsafe(engine.loop.stop)
            engine._th.join(5.0)  # the RunEngine has no way to end its thread
            if not engine.loop.is_running():
                engine.loop.close()

    def _plan(self, instruments: Instruments) -> Generator[Msg, Any, None]:
        results: dict[str, dict[str, Any]] = {}
        entries = self._entries

        def steps() -> Generator[Msg, Any, None]:
            yield Msg("open_run", None)
            results.update({entry.step.id: entry.result for entry in entries if _has_exposure(entry.result)})
            yield from self._put_back(instruments)
            to_do = Counter(entry.step.sequence for entry in entries if entry.finished is None)
            repeats = repeats_ahead([None if entry.finished else entry.step for entry in entries])
            for entry, following in zip(entries, repeats, strict=True):
                step = entry.step
                if entry.finished is not None:
                    continue
                yield Msg("checkpoint")  # a pause takes effect here, between steps
                if self._ended_by is not None:
                    break
                self._tell("running", step.what, step.sequence, to_do)
                for question in instruments.questions(step):
                    self._tell("running", step.what, step.sequence, to_do, remark=question)
                began_s = time.monotonic()
                taken = yield from self._take_with_room(step, instruments, results, following)
                if _has_exposure(taken.result):
                    results[step.id] = taken.result
                to_do[step.sequence] -= 1
                self._done += 1
                self._pace.add(step, time.monotonic() - began_s)
                if "skipped" in taken.result:
                    self._tell("running", step.what, step.sequence, remark=f"left out: {taken.result['skipped']}")
                for line in taken.result.get("retaken", ()):
                    self._tell("running", step.what, step.sequence, remark=line)
            yield Msg("close_run", None)

        def leave() -> Generator[Msg, Any, None]:
            yield Msg("in_a_thread", None, call=instruments.make_safe)

        yield from bpp.finalize_wrapper(steps(), leave)

    def _put_back(self, instruments: Instruments) -> Generator[Msg, Any, None]:
        """Have put back, before anything is captured, what other sessions left changed by hand."""
        for left in instruments.by_hand.left_by_others():
            for change in left.changes:
                self._tell("running", f"putting back what session {left.session} changed", remark=change.words)
                yield from adjust(change.back, instruments)
                note_put_back(self.store.root, left.session, change.changes)

    def _ask(self, timeout_s: float, target: str, instruction: str) -> None:
        """Ask an operator, wherever he is, and wait until it is confirmed. Where nobody does so within `timeout_s`, the
        run is ended: it can be resumed, and asks again."""
        since = now()
        question = Question(
            target=target, instruction=instruction, since=since, until=since + timedelta(seconds=timeout_s)
        )
        folder = self.store.folder(self.id)
        self._writes.do(lambda: put_question(folder, question))
        self._tell_asks(question)
        by = wait_for_answer(folder, question, timeout_s, self._check_goes_on)
        if not by:
            self.abort(
                f"nobody confirmed {target} within {timeout_s:g} s (place_timeout_s under [stage] of the station "
                "file); resume the session, and it asks again"
            )
            self._check_goes_on()
        log.info("session %s: %s is there, said %s", self.id, target, by)
        self._tell_asks(None, f"{target} is there, said {by}")

    def _tell_asks(self, question: Question | None, remark: str | None = None) -> None:
        self._asks = question
        if self._told is not None and self._on_progress is not None:
            elapsed_s = time.monotonic() - self._began_s
            changes = {"asks": question, "remark": remark, "elapsed_s": elapsed_s}
            self._on_progress(self._told.model_copy(update=changes))

    def _keep(self, step: Step, taken: Taken, started: Any) -> None:
        self._writes.do(
            lambda: self.store.finish_step(self.id, step.id, started, taken.result, taken.files, taken.captures)
        )

    def _tell(
        self,
        state: Any,
        what: str,
        sequence: str = "",
        to_do: Counter[str] | None = None,
        remark: str | None = None,
        quietly: bool = False,
    ) -> None:
        if self._on_progress is None:
            return
        progress = Progress(
            session=self.id,
            state=state,
            what=what,
            sequence=sequence,
            done=self._done,
            total=len(self._entries),
            elapsed_s=time.monotonic() - self._began_s,
            left_s=self._pace.left_s(to_do) if to_do else None,
            remark=remark,
            bench=self._bench(),
            asks=self._asks,
        )
        self._told = progress
        try:
            self._on_progress(progress)
        except Exception:
            if not quietly:
                raise

    def _bench(self) -> BenchState | None:
        """Return the state of the instruments: while the run holds them, and after that as it left them."""
        if self._instruments is not None:
            return self._instruments.state()
        return BenchState(shutter_open=False) if self.safe is not None and self.safe.shutter == "closed" else None

    @contextlib.contextmanager
    def _signals(self) -> Iterator[threading.Event]:
        """In the main thread, Ctrl-C and SIGTERM abort the run. In other threads, signals aren't handled."""
        asked = threading.Event()
        if threading.current_thread() is not threading.main_thread():
            yield asked
            return

        def end(number: int, frame: Any) -> None:
            asked.set()
            # Not in the handler itself: the main thread may hold the lock that `abort` takes.
            threading.Thread(target=self.abort, args=(f"ended by {signal.Signals(number).name}",), daemon=True).start()

        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield asked
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class _Wakeful(DuringTask):  # type: ignore[misc]  # the library has no types
    """Waits for the end of a plan and wakes every `WAKE_S`.

    Python runs signal handlers in the main thread only. A signal that the kernel delivers to another thread doesn't
    wake the main thread from an unlimited wait.
    """

    def block(self, blocking_event: threading.Event) -> None:
        while not blocking_event.wait(WAKE_S):
            pass


def _has_exposure(result: Mapping[str, Any]) -> bool:
    """Return whether later steps ask for a step's result: for the exposure that it found. Others aren't kept: a session
    may take a day."""
    return "exposure_s" in result


async def _awaited(call: Callable[[], Any]) -> Any:
    return await asyncio.wrap_future(in_thread(call))


class _Documents:
    """Appends bluesky's documents to a file, a line of JSON each. Those that a full disk doesn't take are kept until it
    does."""

    def __init__(self, file: Path) -> None:
        self._file, self._kept = file, ""

    def __call__(self, name: str, document: dict[str, Any]) -> None:
        self._kept += json.dumps([name, document], default=str) + "\n"
        content = self._kept.encode()
        file = os.open(self._file, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            while content:
                content = content[os.write(file, content) :]
        except OSError as error:
            if error.errno not in FULL:
                raise
        finally:
            self._kept = content.decode()
            os.close(file)


def _plain(error: BaseException, complaints: Sequence[str]) -> BaseException:
    """Return the error as an InputError or a DeviceError where its kind is known, with the instruments that didn't
    reach their safe state."""
    while isinstance(error, FailedStatus) and error.__cause__ is not None:
        error = error.__cause__
    unsafe = [line for line in complaints if line not in str(error)]
    tail = f"; {UNSAFE}: {'; '.join(unsafe)}" if unsafe else ""
    if isinstance(error, DeviceError | InstrumentError):
        return DeviceError(f"{error}{tail}")
    if isinstance(error, CannotWrite):
        return CannotWrite(f"{error}{tail}")
    if isinstance(error, OSError):
        where = error.filename or "the data folder"
        return InputError(f"{where}: can't be written ({error.strerror}); make room, then resume the session{tail}")
    if isinstance(error, InputError):
        return InputError(f"{error}{tail}")
    return error
