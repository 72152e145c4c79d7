"""What all mock instruments share: a grammar (bytes in, bytes out), faults on its answers, and the line it is served
on.

A grammar is pure: it touches no file and no clock of its own. It says what an instrument answers at once (`receive`),
and what it says by itself once time has passed (`wait_s`, `elapse`). `FaultyLine` lets it fail as instruments fail,
and `serve` puts it on a pseudo-terminal or a TCP port.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import select
import socket
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from sim.spectrum import Spectrum

#: A host that has said nothing for so long has ended its line, whatever it ends lines with.
QUIET_S = 0.15
#: An answer that the host doesn't take within this time is lost: there is no flow control on these lines.
_UNREAD_S = 2.0
#: What an instrument keeps of a line that never ends.
LONGEST_LINE = 512


class MockClock(Protocol):
    """Virtual time."""

    def now(self) -> float: ...
    def sleep(self, seconds: float) -> None: ...


class MeasuredLight(Protocol):
    """What the optical instruments do to a light path, and see of it: `mocks.bench.Bench`, or `mocks.lamp.Lamp`
    alone."""

    @property
    def clock(self) -> MockClock: ...
    def set_wavelength(self, nm: float) -> None: ...
    def set_shutter(self, opened: bool) -> None: ...
    def set_filter(self, place: int) -> None: ...
    def set_slit_um(self, width_um: float) -> None: ...
    def set_leds(self, shares: Mapping[int, float]) -> None: ...
    def radiance(self) -> Spectrum: ...


class Reply(bytes):
    """An answer of the instrument, as opposed to an echo: what faults count and break."""


class Grammar(ABC):
    """A state machine that answers bytes with bytes.

    Outputs are lists of pieces in the order in which they go out; a piece that answers something is a `Reply`.
    """

    #: What ends a line of an answer; a fault that loses a line cuts here.
    line_end: bytes = b"\r\n"
    #: What an `error` fault makes the instrument report if it isn't told which.
    fault_code: int = 0

    def __init__(self, clock: MockClock) -> None:
        self.clock = clock
        self._fail_with: int | None = None
        self._done_at: float | None = None  # when what is under way ends, virtual seconds

    @abstractmethod
    def receive(self, data: bytes) -> list[bytes]:
        """Return what goes out at once when `data` comes in."""

    def quiet(self) -> list[bytes]:
        """Return what goes out when the host has been silent for `QUIET_S`."""
        return []

    @property
    def wait_s(self) -> float | None:
        """Virtual seconds until the instrument says something by itself; None if it won't."""
        return None if self._done_at is None else max(0.0, self._done_at - self.clock.now())

    def elapse(self) -> list[bytes]:
        """Return what goes out by itself by now."""
        if self._done_at is None or self.clock.now() < self._done_at:
            return []
        self._done_at = None
        return self._end()

    def _end(self) -> list[bytes]:
        """End what was under way; return what goes out then."""
        return []

    def fail_next(self, code: int | None) -> None:
        """Let the next command fail with this code (None: `fault_code`)."""
        self._fail_with = self.fault_code if code is None else code

    def fail_no_more(self) -> None:
        """Let the next command not fail."""
        self._fail_with = None

    def _failure(self) -> int | None:
        code, self._fail_with = self._fail_with, None
        return code


KINDS = ("late", "never", "half", "wrong", "error", "drop", "unplug")
#: What only a camera's frames do: one comes torn, one comes twice, a trigger isn't heard. `never` is a frame that is
#: dropped.
FRAME_KINDS = ("torn", "repeated", "missed")


class FaultSpecError(ValueError):
    """A fault that can't be understood; the message is one line."""


@dataclass(frozen=True)
class Fault:
    """One way to fail, at the N-th answer (`at`, from 1), or from there on (`onwards`).

    `value`: real seconds for `late` (3 if not said) and `unplug` (1), the instrument's code for `error` (its usual
    one)."""

    kind: str
    at: int = 1
    onwards: bool = False
    value: float | None = None

    def hits(self, number: int) -> bool:
        """Return whether it breaks the answer of this number."""
        return number == self.at or (self.onwards and number > self.at)


class FaultPlan:
    """Faults by the answers that they break: a bench that runs for a day has thousands."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._at: dict[int, list[Fault]] = {}
        self._onwards: list[Fault] = []
        for fault in faults:
            if fault.onwards:
                self._onwards.append(fault)
            else:
                self._at.setdefault(fault.at, []).append(fault)

    def __bool__(self) -> bool:
        return bool(self._at or self._onwards)

    def of(self, number: int) -> list[Fault]:
        """Return those that break the answer of this number."""
        return [*self._at.get(number, ()), *(fault for fault in self._onwards if fault.hits(number))]


def parse_faults(spec: str, frames: bool = False) -> tuple[Fault, ...]:
    """Return the faults of a mock's option `--fault`.

    spec : `KIND[=VALUE][@N[+]]`, several with commas: `half@3`, `late=5@2`, `error=120@1+`
    frames : those of a camera, too

    Raises `FaultSpecError`.

    >>> parse_faults("late=5@2")[0].value
    5.0
    """
    kinds = KINDS + FRAME_KINDS if frames else KINDS
    faults: list[Fault] = []
    for item in filter(None, (part.strip() for part in spec.split(","))):
        what, has_when, when = item.partition("@")
        kind, has_value, value = what.partition("=")
        kind = {"dropped": "drop", "half-reply": "half"}.get(kind, kind)
        if kind not in kinds:
            raise FaultSpecError(f"--fault {item}: no fault {kind!r}; choose from {', '.join(kinds)}")
        try:
            number = int(when.removesuffix("+")) if has_when else 1
            amount = float(value) if has_value else None
        except ValueError:
            raise FaultSpecError(
                f"--fault {item}: not understood; write KIND[=VALUE][@N[+]], as in half@3 or late=5@2+"
            ) from None
        if number < 1 or (amount is not None and math.isnan(amount)):
            raise FaultSpecError(f"--fault {item}: answers count from 1, and a value is a number; write as in half@3")
        faults.append(Fault(kind, number, when.endswith("+"), amount))
    return tuple(faults)


@dataclass(frozen=True)
class Output:
    """Bytes to be sent `delay_s` real seconds from now, or the line unplugged for `unplug_s`."""

    data: bytes = b""
    delay_s: float = 0.0
    unplug_s: float | None = None


class FaultyLine:
    """A grammar whose answers break where the faults say so."""

    def __init__(self, grammar: Grammar, faults: Iterable[Fault] = ()) -> None:
        self.grammar = grammar
        self.fail(faults)

    def fail(self, faults: Iterable[Fault]) -> None:
        """Break the answers to come, which count from 1. What was to fail before and hasn't yet is forgotten."""
        self.grammar.fail_no_more()
        self.faults = FaultPlan(faults)
        self.answers = 0
        self._arm()

    def receive(self, data: bytes) -> list[Output]:
        """Receive byte by byte, so that an error meant for one command doesn't hit another that came with it."""
        if not self.faults:
            return self._pass(self.grammar.receive(data))
        return list(itertools.chain.from_iterable(self._pass(self.grammar.receive(bytes((b,)))) for b in data))

    def quiet(self) -> list[Output]:
        return self._pass(self.grammar.quiet())

    def elapse(self) -> list[Output]:
        return self._pass(self.grammar.elapse())

    def _arm(self) -> None:
        for fault in self.faults.of(self.answers + 1):
            if fault.kind == "error":
                self.grammar.fail_next(None if fault.value is None else int(fault.value))

    def _pass(self, pieces: Sequence[bytes]) -> list[Output]:
        outputs: list[Output] = []
        for piece in pieces:
            if not isinstance(piece, Reply):
                outputs.append(Output(piece))
                continue
            self.answers += 1
            outputs.append(self._broken(piece))
            self._arm()
        return outputs

    def _broken(self, reply: Reply) -> Output:
        data, delay_s = bytes(reply), 0.0
        for fault in self.faults.of(self.answers):
            if fault.kind == "late":
                delay_s = 3.0 if fault.value is None else fault.value
            elif fault.kind == "never":
                data = b""
            elif fault.kind == "half":
                data = data[: len(data) // 2]
            elif fault.kind == "wrong":
                data = b"?" * max(1, len(data) - len(self.grammar.line_end)) + self.grammar.line_end
            elif fault.kind == "drop":
                data = _without_a_line(data, self.grammar.line_end)
            elif fault.kind == "unplug":
                return Output(unplug_s=1.0 if fault.value is None else fault.value)
        return Output(data, delay_s)


def _without_a_line(data: bytes, end: bytes) -> bytes:
    lines = data.split(end)
    del lines[(len(lines) - 1) // 2]
    return end.join(lines)


class AddressError(Exception):
    """A line that can't be opened there; the message is one line."""


class Endpoint(ABC):
    """A line that a host can open."""

    @abstractmethod
    def open(self) -> None:
        """Begin to listen. Raises `AddressError`."""

    @property
    @abstractmethod
    def address(self) -> str:
        """What a host opens; pyserial takes it."""

    @abstractmethod
    def read(self, timeout_s: float) -> bytes:
        """Return what the host sends within the time, or nothing."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send to the host; what it doesn't take in time is lost."""

    @abstractmethod
    def close(self) -> None:
        """Stop to listen, as if unplugged."""


class Pty(Endpoint):
    """A pseudo-terminal, raw; `link` becomes a symbolic link to it."""

    def __init__(self, link: Path | None = None) -> None:
        self.link = link
        self._master = self._slave = -1
        self._name = ""

    def open(self) -> None:
        self._master, self._slave = os.openpty()
        # The host's end is kept open here too: a host that closes and opens again finds the line as it was.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._name = os.ttyname(self._slave)
        if self.link is not None:
            try:
                if self.link.is_symlink():
                    self.link.unlink()
                self.link.symlink_to(self._name)
            except OSError as error:
                self.close()
                raise AddressError(
                    f"--link {self.link}: can't become a link ({error.strerror}); give a path that isn't a file, in a "
                    "folder that is there"
                ) from error

    @property
    def address(self) -> str:
        return self._name if self.link is None else str(self.link)

    def read(self, timeout_s: float) -> bytes:
        if not select.select([self._master], [], [], timeout_s)[0]:
            return b""
        try:
            return os.read(self._master, 4096)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b""
            raise

    def write(self, data: bytes) -> None:
        end = time.monotonic() + _UNREAD_S
        while data and time.monotonic() < end:
            if select.select([], [self._master], [], 0.1)[1]:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(self._master, data) :]

    def close(self) -> None:
        if self._master < 0:
            return
        if self.link is not None and self.link.is_symlink() and str(self.link.readlink()) == self._name:
            self.link.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1


class Tcp(Endpoint):
    """A TCP port with one host at a time; a new host takes the line over from the one before."""

    def __init__(self, host: str, port: int) -> None:
        self.host, self.port = host, port
        self._listener: socket.socket | None = None
        self._peer: socket.socket | None = None

    def open(self) -> None:
        try:
            self._listener = socket.create_server((self.host, self.port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise AddressError(
                f"--tcp {self.host}:{self.port}: can't listen there ({reason}); choose a free port of this machine"
            ) from error
        self.port = self._listener.getsockname()[1]

    @property
    def address(self) -> str:
        return f"socket://{self.host}:{self.port}"

    def read(self, timeout_s: float) -> bytes:
        assert self._listener is not None
        watched = [self._listener] if self._peer is None else [self._listener, self._peer]
        ready = select.select(watched, [], [], timeout_s)[0]
        if self._listener in ready:
            self._hang_up()
            self._peer = self._listener.accept()[0]
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._peer.settimeout(_UNREAD_S)
            return b""
        if self._peer in ready and self._peer is not None:
            try:
                data = self._peer.recv(4096)
            except OSError:
                data = b""
            if not data:
                self._hang_up()
            return data
        return b""

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            try:
                self._peer.sendall(data)
            except OSError:
                self._hang_up()

    def _hang_up(self) -> None:
        if self._peer is not None:
            self._peer.close()
            self._peer = None

    def close(self) -> None:
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
            self._listener = None


def serve(
    grammar: Grammar | FaultyLine,
    endpoint: Endpoint,
    stop: threading.Event,
    *,
    faults: Iterable[Fault] = (),
    announce: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve a grammar on an endpoint until `stop` is set; `announce` is called with the address each time it can be
    opened. A `FaultyLine` has faults of its own.
    """
    line = grammar if isinstance(grammar, FaultyLine) else FaultyLine(grammar, faults)
    grammar = line.grammar
    held: deque[tuple[float, Output]] = deque()
    quiet_since: float | None = None
    endpoint.open()
    try:
        announce(endpoint.address)
        while not stop.is_set():
            outputs: list[Output] = []
            wait_s = grammar.wait_s
            if wait_s is not None:
                # In steps, so that the host is heard while time passes.
                grammar.clock.sleep(min(wait_s, 0.1))
                outputs += line.elapse()
            data = endpoint.read(0.0 if wait_s is not None else 0.02)
            if data:
                quiet_since = time.monotonic()
                outputs += line.receive(data)
            elif quiet_since is not None and time.monotonic() - quiet_since > QUIET_S:
                quiet_since = None
                outputs += line.quiet()
            now = time.monotonic()
            held.extend((now + output.delay_s, output) for output in outputs)
            while held and held[0][0] <= now:
                _, output = held.popleft()
                if output.unplug_s is None:
                    endpoint.write(output.data)
                    continue
                held.clear()
                endpoint.close()
                stop.wait(min(output.unplug_s, threading.TIMEOUT_MAX))
                if not stop.is_set():
                    endpoint.open()
                    announce(endpoint.address)
    finally:
        endpoint.close()
