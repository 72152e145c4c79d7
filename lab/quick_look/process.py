"""The curves of sessions, computed in a process of its own at low priority, so that no capture waits for them.

The process is `python -m lab.quick_look.process`. Its standard input says which store, then one session's id a line; it
answers each with a line of JSON. It ends when nobody asks for a while, and with the process that started it.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import select
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from lab.capture.store import Store
from lab.errors import InputError
from lab.quick_look.curves import Curves, GrowingCurves
from lab.side_processes import ONE_THREAD

log = logging.getLogger(__name__)
#: How long (s) an answer holds, how long one is waited for, and after how long without a question the process ends.
HOLDS_S, PATIENCE_S, IDLE_S = 2.0, 60.0, 120.0
SESSIONS = 16
NICE = 19


@dataclass(frozen=True)
class _Known:
    at_s: float
    curves: Curves


class QuickLook:
    """Asks the process, in a thread of its own. Threads may share one; nobody waits for an answer."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._process: subprocess.Popen[str] | None = None
        self._asking = ThreadPoolExecutor(1, thread_name_prefix="quick-look")
        self._asked_for: set[str] = set()
        self._known: OrderedDict[str, _Known] = OrderedDict()
        self._lock = threading.Lock()
        self._closed = False

    def curves(self, session_id: str) -> Curves:
        """Return the newest curves of a session; without any yet, `looked_at` is 0. Where they are older than
        `HOLDS_S`, newer ones are asked for."""
        with self._lock:
            known = self._known.get(session_id)
            fresh = known is not None and time.monotonic() - known.at_s < HOLDS_S
            if not fresh and session_id not in self._asked_for:
                self._asked_for.add(session_id)
                self._asking.submit(self._ask, session_id)
        return known.curves if known is not None else Curves()

    def close(self) -> None:
        """End the process."""
        self._closed = True
        self._asking.shutdown(wait=False, cancel_futures=True)
        if self._process is not None:
            self._process.kill()  # which ends the thread's wait, too
        self._asking.shutdown()
        self._end()

    def _ask(self, session_id: str) -> None:
        try:
            answer = self._read_curves(session_id)
        except Exception as error:
            log.warning("curves of session %s: %s", session_id, error)
            answer = None
        with self._lock:
            self._asked_for.discard(session_id)
            if answer is not None:
                self._known[session_id] = _Known(time.monotonic(), answer)
                self._known.move_to_end(session_id)
                while len(self._known) > SESSIONS:
                    self._known.popitem(last=False)

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
            self._process.wait()
            self._process = None

    def _read_curves(self, session_id: str) -> Curves:
        for _ in range(2):  # it may have ended because nobody asked
            if self._process is None or self._process.poll() is not None:
                self._end()
                self._process = self._start()
            line = self._answer(self._process, session_id)
            if line:
                answer = json.loads(line)
                if "error" in answer:
                    raise InputError(answer["error"])
                return Curves.model_validate(answer)
            self._end()
            if self._closed:
                break
        raise InputError(f"session {session_id}: its curves can't be computed now; the log says more")

    def _start(self) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "lab.quick_look.process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD,
            text=True,
            start_new_session=True,
        )
        settings = self._store.settings
        assert process.stdin is not None
        with contextlib.suppress(OSError):
            process.stdin.write(json.dumps([str(settings.data), settings.database_url]) + "\n")
        return process

    @staticmethod
    def _answer(process: subprocess.Popen[str], session_id: str) -> str:
        """Return the answer's line; empty where the process ended or doesn't answer."""
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.write(session_id + "\n")
            process.stdin.flush()
            if select.select([process.stdout], [], [], PATIENCE_S)[0]:
                return process.stdout.readline()
        return ""


def serve() -> None:
    """Answer questions from standard input until it ends, or nobody asks for `IDLE_S`."""
    os.nice(NICE)
    asked = io.FileIO(0, closefd=False)  # without a buffer, in which a question could wait unseen by `select`
    root, database_url = json.loads(asked.readline())
    store = Store(root, database_url)
    sessions: OrderedDict[str, GrowingCurves] = OrderedDict()
    while select.select([asked], [], [], IDLE_S)[0]:
        session_id = asked.readline().decode().strip()
        if not session_id:
            return
        growing = sessions.setdefault(session_id, GrowingCurves(store, session_id))
        sessions.move_to_end(session_id)
        while len(sessions) > SESSIONS:
            sessions.popitem(last=False)
        try:
            answer = growing.look().model_dump_json()
        except InputError as error:
            sessions.pop(session_id)
            answer = json.dumps({"error": str(error)})
        print(answer, flush=True)


if __name__ == "__main__":
    serve()
