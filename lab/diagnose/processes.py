"""The sides of a recording set at the same time, each in an OS process of its own, as Python computes in one thread at
a time.

A process is `python -m lab.diagnose`. It receives its task on standard input, and sends progress and findings as
pickles on standard output. Unlike a pool's worker it needs nothing of the caller's main module, may be started by a
pool's worker, and ends with the process that started it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.side import SideFindings
from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from lab.workers import Workers
from sim.camera import Side

#: How often (s) a waiting main thread wakes to let Python run signal handlers.
WAKE_S = 0.2
#: Two processes on two cores: a library's own threads would only get into each other's way.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def in_processes(
    recordings: RecordingSet,
    fit: FitResult | None,
    baseline: Mapping[Side, CameraFile],
    report: Callable[[Side, str], None],
    *,
    policy: DecisionPolicy,
    pictures: bool = False,
    bootstrap: int = 0,
    workers: Workers | None = None,
) -> list[SideFindings]:
    """The findings of every side, in the order of the sides. `report` is called in the caller's thread. An exception in
    it, or in a process, ends all processes. Raises InputError where a process was ended from outside."""
    recordings.let_go()  # every process reads its own frames
    said: queue.SimpleQueue[tuple[Side, Any]] = queue.SimpleQueue()
    found: dict[Side, SideFindings] = {}
    with contextlib.ExitStack() as stack:
        for side in recordings.sides:
            # registered before it starts: an interrupt in between must find it
            stack.enter_context(
                _Process(side, (recordings, side, fit, baseline.get(side), policy, pictures, bootstrap, workers), said)
            ).start()
        while len(found) < len(recordings.sides):
            try:
                side, what = said.get(timeout=WAKE_S)
            except queue.Empty:
                continue
            if isinstance(what, BaseException):
                raise what
            if isinstance(what, SideFindings):
                found[side] = what
            else:
                report(side, what)
    return [found[side] for side in recordings.sides]


class _Process:
    """One side's process, and a thread that reads its output. Leaving the context ends both."""

    def __init__(self, side: Side, task: tuple[Any, ...], said: queue.SimpleQueue[tuple[Side, Any]]) -> None:
        self._side, self._task, self._said = side, task, said

        self._process: subprocess.Popen[bytes] | None = None
        self._listener = threading.Thread(target=self._listen, name=f"diagnose-{side}", daemon=True)

    def __enter__(self) -> _Process:
        return self

    def start(self) -> None:
        # Of its own session: Ctrl-C is for the caller, who ends this process.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lab.diagnose"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD,
            start_new_session=True,
        )
        self._listener.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._process is None:
            return
        if kind is not None:
            self._process.kill()
        self._process.wait()
        if self._listener.is_alive():
            self._listener.join()

    def _listen(self) -> None:
        """Send the task; put what the process sends into the queue until its findings have come."""
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError), self._process.stdin as to:
            pickle.dump(self._task, to, pickle.HIGHEST_PROTOCOL)
        with self._process.stdout as heard:
            try:
                while True:
                    what = pickle.load(heard)
                    self._said.put((self._side, what))
                    if not isinstance(what, str):
                        return
            except (EOFError, pickle.UnpicklingError):
                ended = self._process.wait()
                by = f"signal {-ended}" if ended < 0 else f"exit code {ended}"
                self._said.put((self._side, InputError(
                    f"diagnose: the process for the {self._side} side ended with {by}; where memory was short, free about 1 GB a side "
                    "and start again"
                )))  # fmt: skip
