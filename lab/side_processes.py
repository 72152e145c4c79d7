"""The sides of a recording set at the same time, each in an OS process of its own, as Python computes in one thread at
a time.

A process is `python -m lab.side_processes`. It receives tasks on standard input, one after the other, and sends
progress and findings as pickles on standard output. Unlike a pool's worker it needs nothing of the caller's main
module, may be started by a pool's worker, and ends with the process that started it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, TypeVar

from lab.errors import InputError
from lab.formats.recording_set import RecordingSet
from sim.camera import Side
from sim.memory import return_freed_memory

#: What is found of one side. It and the task have to be picklable: functions by their module's name, results by value.
F = TypeVar("F")
#: Computes a side; the argument is called with progress.
Task = Callable[[Callable[[Any], None]], F]

#: How often (s) a waiting main thread wakes to let Python run signal handlers.
WAKE_S = 0.2
#: Two processes on two cores: a library's own threads would only get into each other's way.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@dataclass(frozen=True)
class _TaskResult(Generic[F]):
    """The last message of a task, after those of its progress: what the task returned."""

    findings: F


#: Processes that wait for a task; None where none is kept.
_waiting: ContextVar[list[_Process] | None] = ContextVar("_waiting", default=None)


@contextlib.contextmanager
def kept_processes() -> Iterator[None]:
    """Within it, and in its thread, a process that has carried out a task waits for the next one: a start takes about
    1.5 s."""
    waiting: list[_Process] = []
    before = _waiting.set(waiting)
    try:
        yield
    finally:
        _waiting.reset(before)
        for process in waiting:
            process.end()


def in_processes(
    recordings: RecordingSet, tasks: Mapping[Side, Task[F]], report: Callable[[Side, Any], None], doing: str
) -> dict[Side, F]:
    """Return the findings of every side. `tasks` are partials of functions that a module has by name; `recordings` are
    those that they read.

    `report` is called in the caller's thread with what a task tells. An exception in it, or in a process, ends all
    processes. `doing`: the command, for messages. Raises InputError where a process was ended from outside, and what a
    task raises."""
    recordings.let_go()  # every process reads its own frames
    said: queue.SimpleQueue[tuple[Side, Any]] = queue.SimpleQueue()
    found: dict[Side, F] = {}
    with contextlib.ExitStack() as stack:
        for side, task in tasks.items():
            # registered before it starts: an interrupt in between must find it
            stack.enter_context(_Work(side, task, said, doing)).start()
        while len(found) < len(tasks):
            try:
                side, what = said.get(timeout=WAKE_S)
            except queue.Empty:
                continue
            if isinstance(what, BaseException):
                raise what
            if isinstance(what, _TaskResult):
                found[side] = what.findings
            else:
                report(side, what)
    return {side: found[side] for side in tasks}


class _Process:
    """A process that carries out tasks."""

    def __init__(self) -> None:
        #: Held while a task is carried out: its pipes are closed before or after that, never meanwhile.
        self._in_use = threading.Lock()
        # Of its own session: Ctrl-C is for the caller, who ends this process.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "lab.side_processes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | ONE_THREAD,
            start_new_session=True,
        )

    def carry_out(self, task: Task[Any], say: Callable[[Any], None]) -> None:
        """Send the task, and pass on what the process says, its findings last. Raises EOFError, with how it ended,
        where the process ends before. Does nothing after `end`: an interrupt may end the process while the thread that
        calls this is being started."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with self._in_use:
            if self._process.stdin.closed:
                return
            with contextlib.suppress(BrokenPipeError):
                pickle.dump(task, self._process.stdin, pickle.HIGHEST_PROTOCOL)
                self._process.stdin.flush()
            try:
                while True:
                    what = pickle.load(self._process.stdout)
                    say(what)
                    if isinstance(what, _TaskResult | BaseException):
                        return
            except (EOFError, pickle.UnpicklingError):
                ended = self._process.wait()
                raise EOFError(f"signal {-ended}" if ended < 0 else f"exit code {ended}") from None

    @property
    def lives(self) -> bool:
        return self._process.poll() is None

    def kill(self) -> None:
        self._process.kill()

    def end(self) -> None:
        """Let it end, as it does when it can't hear of a task any more, and wait for that and for `carry_out`."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with self._in_use:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
            self._process.wait()
            self._process.stdout.close()


class _Work:
    """One side's task in a process, and a thread that reads what the process says. Leaving the context ends the process
    where it isn't kept, and with it what the thread reads."""

    def __init__(self, side: Side, task: Task[Any], said: queue.SimpleQueue[tuple[Side, Any]], doing: str) -> None:
        self._side, self._task, self._said, self._doing = side, task, said, doing
        self._process: _Process | None = None
        self._listener = threading.Thread(target=self._listen, name=f"{doing}-{side}", daemon=True)

    def __enter__(self) -> _Work:
        return self

    def start(self) -> None:
        waiting = _waiting.get()
        while waiting and not waiting[-1].lives:
            waiting.pop().end()
        self._process = waiting.pop() if waiting else _Process()
        self._listener.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._process is None:
            return
        waiting = _waiting.get()
        if kind is not None:
            self._process.kill()
        if kind is None and waiting is not None:
            waiting.append(self._process)
        else:
            self._process.end()

    def _listen(self) -> None:
        """Put what the process sends into the queue until its findings have come."""
        assert self._process is not None
        try:
            self._process.carry_out(self._task, lambda what: self._said.put((self._side, what)))
        except EOFError as ended:
            self._said.put((self._side, InputError(
                f"{self._doing}: the process for the {self._side} side ended with {ended}; where memory was short, "
                "free about 1 GB a side "
                "and start again"
            )))  # fmt: skip


def serve() -> None:
    """Read tasks from standard input until it ends, carry them out, and write progress and findings as pickles to
    standard output."""
    with os.fdopen(os.dup(1), "wb") as to:
        os.dup2(2, 1)  # what a library prints goes to standard error

        def say(what: Any) -> None:
            to.write(pickle.dumps(what, pickle.HIGHEST_PROTOCOL))
            to.flush()

        while _carried_out(say):
            return_freed_memory()


def _carried_out(say: Callable[[Any], None]) -> bool:
    """Carry out the next task; False where there is none. Nothing of it is held afterwards."""
    try:
        task = pickle.load(sys.stdin.buffer)
    except EOFError:
        return False
    except pickle.UnpicklingError:
        os._exit(1)  # the caller was interrupted while it sent the task
    try:
        say(_TaskResult(task(say)))
    except BrokenPipeError:
        os._exit(1)  # the caller is gone
    except Exception as error:
        error.add_note(traceback.format_exc())
        say(_sendable(error))
    return True


def _sendable(error: Exception) -> Exception:
    """Return the error itself where it can be pickled, else one with the same text."""
    try:
        return error if isinstance(pickle.loads(pickle.dumps(error)), Exception) else RuntimeError(str(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    # The module by its name, not as `__main__`: what it sends is unpickled by the caller.
    from lab.side_processes import serve as serve_task

    serve_task()
