"""A maker's library in a process of its own: a call that doesn't end, or a crash within it, ends that process and not
ours.

Requests and answers are pickles on its standard input and output: (method, arguments) there, (how it ended, value)
back. Run as `python -m drivers.apart module:Class ARGUMENT...`; the class's methods are what may be asked for.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from importlib import import_module
from typing import Any

from drivers import errors
from drivers.errors import Disconnected, InstrumentError, NoAnswer

#: How long (s) the library is given to let its instrument go before its process is ended.
_FAREWELL_S = 3.0
#: How a call ended that raised an error of the library's own.
_UNEXPECTED = "unexpected"


class Apart:
    """One object of a library's, in a process of its own. `served`: `module:Class`; `arguments`: what it is made with.

    `who`: the instrument in messages. Once a call has failed to end the process is gone, until it is started anew:
    `start_timeout_s` is the longest time for that (an interpreter and a library are loaded, the object is made).
    """

    def __init__(self, served: str, *arguments: str, who: str, start_timeout_s: float = 10.0) -> None:
        self._command = [sys.executable, "-m", "drivers.apart", served, *arguments]
        self._who = who
        self._start_timeout_s = start_timeout_s
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: queue.SimpleQueue[tuple[str, Any] | None] = queue.SimpleQueue()

    @property
    def pid(self) -> int | None:
        """The process, if it runs."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the process, where it doesn't run yet. Raises what the object raises when it is made, or `NoAnswer`."""
        if self._process is not None:
            return
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        self._answers = queue.SimpleQueue()
        threading.Thread(target=_listen, args=(self._process.stdout, self._answers), daemon=True).start()
        try:
            self._answer("starting its library", self._start_timeout_s)
        except InstrumentError:
            self._kill()
            raise

    def call(self, method: str, *arguments: Any, timeout_s: float) -> Any:
        """Return what a method of the object returns. Raises what it raises.

        Raises `NoAnswer` where it doesn't end in time and `Disconnected` where the process died: it is gone then.
        """
        if self._process is None or self._process.stdin is None:
            raise Disconnected(f"{self._who}: not connected; the next call reconnects")
        try:
            pickle.dump((method, arguments), self._process.stdin)
            self._process.stdin.flush()
        except OSError:
            raise self._end_and_report(method) from None
        return self._answer(method, timeout_s)

    def end(self) -> None:
        """Let the instrument go and end the process, by force where it takes long; may be called twice."""
        process = self._process
        if process is None:
            return
        with contextlib.suppress(OSError):
            assert process.stdin is not None
            process.stdin.close()  # it lets the instrument go then
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_FAREWELL_S)
        self._kill()

    def _answer(self, doing: str, timeout_s: float) -> Any:
        try:
            answer = self._answers.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            self._kill()
            raise NoAnswer(
                f"{self._who}: no answer within {timeout_s:.3g} s to {doing!r}; check the cable and the power; the "
                "next call reconnects"
            ) from None
        if answer is None:
            raise self._end_and_report(doing)
        ended, value = answer
        if ended == "":
            return value
        if ended == _UNEXPECTED:
            raise InstrumentError(f"{self._who}: {value}")
        kind = getattr(errors, ended, InstrumentError)
        raise (kind if kind is not errors.Refused else InstrumentError)(value)

    def _end_and_report(self, doing: str) -> Disconnected:
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        code = self._process.poll()
        self._kill()
        how = f"exit code {code}" if code is None or code >= 0 else signal.Signals(-code).name
        return Disconnected(
            f"{self._who}: its library's process ended ({how}) during {doing!r}; plug the instrument in again, the "
            "next call reconnects"
        )

    def _kill(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(1.0)
        with contextlib.suppress(OSError):
            if process.stdin is not None:
                process.stdin.close()  # the other is closed by who listens


def _listen(answers: Any, heard: queue.SimpleQueue[tuple[str, Any] | None]) -> None:
    """Take the answers as they come; None: no more will."""
    try:
        with answers:
            while True:
                heard.put(pickle.load(answers))
    except (EOFError, OSError, ValueError, pickle.UnpicklingError):
        heard.put(None)


def _hear(requests: queue.SimpleQueue[Any]) -> None:
    with contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            requests.put(pickle.load(sys.stdin.buffer))
    requests.put(None)
    time.sleep(_FAREWELL_S)  # whoever asked is gone, and the library hangs
    os._exit(1)


def _serve(served: str, arguments: list[str]) -> None:
    """Do what is asked until the other side ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who asks
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the library prints isn't an answer
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_hear, args=(requests,), daemon=True).start()
    module, _, name = served.partition(":")
    made: Any = None

    def answer(doing: str, action: Any) -> Any:
        value: Any
        ended = ""
        try:
            value = action()
        except InstrumentError as error:
            ended, value = type(error).__name__, str(error)
        except Exception as error:
            message = " ".join(str(error).split())
            ended, value = _UNEXPECTED, f"{doing} failed ({type(error).__name__}: {message}); look into its library"
        result = None if doing == "start" else value
        pickle.dump((ended, value if ended else result), answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()
        return None if ended else value

    made = answer("start", lambda: getattr(import_module(module), name)(*arguments))
    while made is not None and (request := requests.get()) is not None:
        method, given = request
        doing = " ".join([method, *map(str, given)])[:80]
        answer(doing, lambda method=method, given=given: getattr(made, method)(*given))
    with contextlib.suppress(Exception):
        made.close()
    os._exit(0)


if __name__ == "__main__":
    _serve(sys.argv[1], sys.argv[2:])
