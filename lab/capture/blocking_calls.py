"""An instrument's blocking calls in threads of their own, each with a time-out: a driver that never returns can't hang a session."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from drivers.errors import NoAnswer

T = TypeVar("T")
#: Time-out (s) of an instrument's stop.
STOP_S = 15.0


def in_thread(call: Callable[[], T]) -> Future[T]:
    """Run a blocking call in a daemon thread, so that a call which never returns doesn't keep the process alive."""
    future: Future[T] = Future()
    # The call can't be cancelled, so the future must not be, either: it has to accept a late result.
    future.set_running_or_notify_cancel()

    def work() -> None:
        try:
            result = call()
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    threading.Thread(target=work, daemon=True, name="instrument").start()
    return future


class Status:
    """A `bluesky.protocols.Status` of a blocking call, which fails with `NoAnswer` after `timeout_s`."""

    def __init__(self, who: str, call: Callable[[], object], timeout_s: float) -> None:
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[Any], None]] = []
        self._done = threading.Event()
        self._error: BaseException | None = None
        self._watch = threading.Timer(timeout_s, self._late, args=(who, timeout_s))
        self._watch.daemon = True
        self._watch.start()
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
        self._watch.cancel()
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
