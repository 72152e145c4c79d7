"""An instrument's blocking calls in threads of their own, each with a time-out: a driver that never returns can't hang
a session."""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import itertools
import os
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from drivers.errors import NoAnswer

T = TypeVar("T")
#: Time-out (s) of an instrument's stop.
STOP_S = 15.0


#: How long (s) a thread without work is kept: starting one takes milliseconds where the cores are busy, and a step
#: takes five.
IDLE_S = 1.0
_Work = tuple[Callable[[], Any], "Future[Any]"]


class _Threads:
    """Daemon threads that carry out one call after the other. One whose call never returns is replaced, and doesn't
    keep the process alive."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[queue.SimpleQueue[_Work]] = []

    def give(self, work: _Work) -> None:
        """Have a call carried out at once."""
        with self._lock:
            taker = self._idle.pop() if self._idle else None
        if taker is None:
            taker = queue.SimpleQueue()
            threading.Thread(target=self._take, args=(taker,), daemon=True, name="instrument").start()
        taker.put(work)

    def _take(self, mine: queue.SimpleQueue[_Work]) -> None:
        while (work := self._next(mine)) is not None:
            call, future = work
            try:
                result = call()
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)
            del work, call, future  # what they hold isn't kept while the thread waits
            with self._lock:
                self._idle.append(mine)

    def _next(self, mine: queue.SimpleQueue[_Work]) -> _Work | None:
        """Return the next call; None where the thread ends."""
        try:
            return mine.get(timeout=IDLE_S)
        except queue.Empty:
            with self._lock:
                if mine in self._idle:
                    self._idle.remove(mine)
                    return None
            return mine.get()  # it was given just now


class _Deadlines:
    """One thread that calls what is due."""

    def __init__(self) -> None:
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._changed = threading.Condition()
        self._numbers = itertools.count()
        self._thread: threading.Thread | None = None

    def add(self, after_s: float, call: Callable[[], None]) -> None:
        """Call it in `after_s`; it returns soon, and does nothing where it is no longer wanted."""
        with self._changed:
            heapq.heappush(self._due, (time.monotonic() + after_s, next(self._numbers), call))
            if self._thread is None:
                self._thread = threading.Thread(target=self._watch, daemon=True, name="deadlines")
                self._thread.start()
            elif self._due[0][2] is call:
                self._changed.notify()

    def _watch(self) -> None:
        while True:
            with self._changed:
                while not self._due or self._due[0][0] > time.monotonic():
                    self._changed.wait(self._due[0][0] - time.monotonic() if self._due else None)
                call = heapq.heappop(self._due)[2]
            call()


_threads, _deadlines = _Threads(), _Deadlines()


def _after_fork() -> None:
    """A child process has none of its parent's threads."""
    global _threads, _deadlines
    _threads, _deadlines = _Threads(), _Deadlines()


if hasattr(os, "register_at_fork"):  # not on Windows, which doesn't fork
    os.register_at_fork(after_in_child=_after_fork)


def in_thread(call: Callable[[], T]) -> Future[T]:
    """Run a blocking call in a daemon thread, so that a call which never returns doesn't keep the process alive.

    >>> in_thread(lambda: 6 * 7).result(timeout=30.0)
    42
    """
    future: Future[T] = Future()
    # The call can't be cancelled, so the future must not be, either: it has to accept a late result.
    future.set_running_or_notify_cancel()
    _threads.give((call, future))
    return future


class Status:
    """A `bluesky.protocols.Status` of a blocking call, which fails with `NoAnswer` after `timeout_s`."""

    def __init__(self, who: str, call: Callable[[], object], timeout_s: float) -> None:
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[Any], None]] = []
        self._done = threading.Event()
        self._error: BaseException | None = None
        _deadlines.add(timeout_s, lambda: self._late(who, timeout_s))
        in_thread(call).add_done_callback(lambda future: self._finish(future.exception()))

    def _late(self, who: str, timeout_s: float) -> None:
        self._finish(NoAnswer(f"{who}: no answer within {timeout_s:g} s; check its power and its cable"))

    def _finish(self, error: BaseException | None) -> None:
        with self._lock:
            if self._done.is_set():
                return
            self._error = error
            self._done.set()
            callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            with contextlib.suppress(RuntimeError):  # the run was aborted meanwhile: its loop is closed, nobody waits
                callback(self)

    def add_callback(self, callback: Callable[[Any], None]) -> None:
        with self._lock:
            if not self._done.is_set():
                self._callbacks.append(callback)
                return
        callback(self)

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        if not self._done.wait(timeout):
            raise TimeoutError("not done yet")
        return self._error

    @property
    def done(self) -> bool:
        return self._done.is_set()

    @property
    def success(self) -> bool:
        return self._done.is_set() and self._error is None


async def bounded(who: str, call: Callable[[], object], timeout_s: float = STOP_S) -> None:
    """Await a blocking call. Raises NoAnswer after `timeout_s`, and what the call raises."""
    try:
        await asyncio.wait_for(asyncio.wrap_future(in_thread(call)), timeout_s)
    except TimeoutError as error:
        raise NoAnswer(f"{who}: no answer within {timeout_s:g} s; check its power and its cable") from error
