"""A program that talks on its standard input and output, as the line to an instrument: time-outs, interruptions and
the transcript are those of every line. For POSIX systems."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from drivers.errors import Disconnected, Garbled, NoAnswer
from drivers.instrument import Recorder
from drivers.transport import LONGEST_ANSWER, SLICE_S, Transport, shown

#: How long (s) a program is given to end by itself.
_FAREWELL_S = 1.0
#: Ends the program's group once the driver's process is gone: many programs don't notice the end of their input.
_WATCH = "import os, signal, sys; sys.stdin.read(); os.killpg(int(sys.argv[1]), signal.SIGKILL)"


class Program(Transport):
    """A running program as a line. `address`: the instrument's, for messages; `farewell`: what makes it end.

    `command` is asked for the program and its arguments each time it is started.
    """

    def __init__(
        self,
        command: Callable[[], Sequence[str]],
        address: str,
        device: str,
        *,
        environment: Mapping[str, str],
        farewell: bytes,
        timeout_s: float,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(address, device, timeout_s=timeout_s, recorder=recorder)
        self._command, self._environment, self._farewell = command, environment, farewell
        self._process: subprocess.Popen[bytes] | None = None
        self._watch: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """The program's process, if it runs."""
        return None if self._process is None else self._process.pid

    def open(self) -> None:
        """Start the program anew. Raises `Disconnected` where it isn't there."""
        self.close()
        command = list(self._command())
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                bufsize=0,
                env=os.environ | self._environment,
                start_new_session=True,  # Ctrl-C is for who measures
            )
        except OSError as error:
            raise Disconnected(
                f"{self.name}: {command[0]} can't be started ({error.strerror}); install it, or name its file as "
                "`program` in the station file"
            ) from error
        watch = [sys.executable, "-I", "-S", "-c", _WATCH, str(self._process.pid)]
        self._watch = subprocess.Popen(watch, stdin=subprocess.PIPE, start_new_session=True)

    def close(self) -> None:
        """Let the program end, by force where it takes long; never raises."""
        process, self._process = self._process, None
        watch, self._watch = self._watch, None
        self._received.clear()
        if process is None:
            return
        if watch is not None:  # first: a process that has ended may have given its number to another
            watch.kill()
            watch.wait()
            assert watch.stdin is not None
            watch.stdin.close()
        assert process.stdin is not None and process.stdout is not None
        with suppress(OSError):
            process.stdin.write(self._farewell)
        with suppress(OSError):
            process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            process.wait(_FAREWELL_S)
        if process.poll() is None:
            with suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        process.stdout.close()

    def write(self, data: bytes) -> None:
        process = self._running()
        assert process.stdin is not None
        try:
            process.stdin.write(data)
        except OSError as error:
            raise self._ended() from error
        self._record("sent", data)

    def read_until_prompt(self, prompts: re.Pattern[bytes], timeout_s: float, asked: str) -> tuple[bytes, str]:
        """Return everything up to the end of the next prompt, and the name of the group that it matches.

        Raises `NoAnswer`, `Disconnected` with the program's last line where it ended, `Garbled` or `Interrupted`.
        """
        end = time.monotonic() + timeout_s
        while (match := prompts.search(self._received)) is None:
            if len(self._received) > LONGEST_ANSWER:
                raise Garbled(f"{self.name}: sends without end; check that `program` is the right one")
            if self._heeds and self._interrupted.is_set():
                raise self._stopped(asked)
            left = end - time.monotonic()
            if not self._receive(max(0.0, min(SLICE_S, left))) and left <= 0:
                got = f"only {shown(bytes(self._received[-60:]))}" if self._received else "no answer"
                raise NoAnswer(
                    f"{self.name}: {got} within {timeout_s:g} s to {asked!r}; check the instrument's cable, and that "
                    "no other program uses it"
                )
        assert match.lastgroup is not None
        return self._take(match.end()), match.lastgroup

    def _receive(self, timeout_s: float) -> bool:
        process = self._running()
        assert process.stdout is not None
        if not select.select([process.stdout], [], [], timeout_s)[0]:
            return False
        data = os.read(process.stdout.fileno(), 1 << 16)
        if not data:
            raise self._ended()
        self._record("received", data)
        self._received += data
        return True

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise Disconnected(f"{self.name}: not connected; connect first")
        return self._process

    def _ended(self) -> Disconnected:
        lines = [line.strip() for line in self._received.decode("latin-1").splitlines() if line.strip()]
        self.close()
        return ProgramEnded(self.name, lines)


class ProgramEnded(Disconnected):
    """The program ended by itself. `lines`: what it printed since the last prompt."""

    def __init__(self, who: str, lines: Sequence[str]) -> None:
        self.lines = tuple(lines)
        why = f": {lines[-1][:200]}" if lines else " without a word"
        super().__init__(f"{who}: its program ended{why}; check the instrument, the next call starts it again")
