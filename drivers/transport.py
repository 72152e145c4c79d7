"""Connections to instruments: a serial port or TCP, with a time-out on every call and a transcript of every byte."""

from __future__ import annotations

import errno
import os
import re
import threading
import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import ClassVar

import serial

from drivers.errors import (
    PERMISSION_REMEDY,
    Disconnected,
    Garbled,
    InstrumentError,
    Interrupted,
    InUse,
    NoAnswer,
    Refused,
)
from drivers.instrument import Instrument, Recorder

#: Longest time between two looks at whether `interrupt` was called.
SLICE_S = 0.05
#: Within an answer characters follow each other: a pause of this length is where it broke off.
BETWEEN_S = 1.0
#: What the system says of a port that another program, or another driver of this one, holds.
_IN_USE = {errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY}
#: More than any instrument here says at once: what babbles on is not ours.
LONGEST_ANSWER = 1 << 20


def shown(data: bytes) -> str:
    """Write bytes as one line of a message: printable ASCII unchanged, the rest escaped, cut at 60 characters.

    >>> shown(bytes([79, 75, 13]))
    "'OK\\\\r'"
    """
    text = data.decode("latin-1").encode("unicode_escape").decode("ascii")
    return repr(data)[1:] if len(text) <= 60 else f"'{text[:57]}...'"


class Transport:
    """A byte stream to one instrument. `address` is a device path (`/dev/ttyUSB0`, `COM3`) or `socket://host:port`.

    `device` is the instrument's name in messages. `recorder` gets every piece sent and received. One thread talks at a
    time; only `interrupt` may be called from another.
    """

    def __init__(
        self,
        address: str,
        device: str,
        *,
        baudrate: int = 9600,
        timeout_s: float = 2.0,
        recorder: Recorder | None = None,
    ) -> None:
        self.address = address
        self.device = device
        self.baudrate = baudrate
        self.timeout_s = timeout_s
        self._record = recorder or (lambda direction, data: None)
        self._port: serial.SerialBase | None = None
        self._received = bytearray()
        self._interrupted = threading.Event()
        self._heeds = True  # interruptions

    @property
    def name(self) -> str:
        """The instrument and its address, for messages."""
        return f"{self.device} at {self.address}"

    def open(self) -> None:
        """Open the connection anew, 8N1 without flow control, and discard what is in it. Raises `Disconnected`."""
        self.close()
        options = {} if "://" in self.address else {"exclusive": True}
        try:
            self._port = serial.serial_for_url(
                self.address, baudrate=self.baudrate, timeout=0, write_timeout=self.timeout_s, **options
            )
        except (OSError, ValueError) as error:  # pyserial's SerialException is an OSError
            number = _number_of(error)
            reason = os.strerror(number) if number is not None else str(error).replace("\n", " ")
            if number in _IN_USE:
                raise InUse(
                    f"{self.name}: this port is in use, by another program or another instrument of the station; "
                    "one port serves one instrument: close the other, or correct the address in the station file"
                ) from error
            remedy = (
                PERMISSION_REMEDY
                if number in (errno.EACCES, errno.EPERM)
                else "check the cable, the power and the address in the station file"
            )
            raise Disconnected(f"{self.name}: can't be opened ({reason}); {remedy}") from error

    def close(self) -> None:
        """Close the connection; never raises."""
        port, self._port = self._port, None
        self._received.clear()
        if port is not None:
            connection = getattr(port, "_socket", None)
            with suppress(OSError):
                port.close()
            if connection is not None:  # pyserial leaves it open where the other side was quicker
                connection.close()

    def interrupt(self) -> None:
        """End the wait of another thread: it raises `Interrupted`."""
        self._interrupted.set()

    def resume(self) -> None:
        """Revoke `interrupt`."""
        self._interrupted.clear()

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Let no `interrupt` end a wait within: for a short exchange that is worse broken off than waited for."""
        self._heeds = False
        try:
            yield
        finally:
            self._heeds = True

    def pause(self, seconds: float, asked: str = "") -> None:
        """Let time pass before the next question. Raises `Interrupted`."""
        if self._interrupted.wait(seconds):
            raise self._stopped(asked)

    def write(self, data: bytes) -> None:
        """Send bytes. Raises `Disconnected`."""
        port = self._open_port()
        try:
            port.write(data)
        except OSError as error:
            raise self._gone(error) from error
        self._record("sent", data)

    def read(self, count: int, timeout_s: float | None = None, asked: str = "") -> bytes:
        """Return exactly `count` bytes. Raises `NoAnswer` with what was received instead, `Disconnected`,
        `Interrupted`.
        """
        deadline = self._deadline(timeout_s)
        while len(self._received) < count:
            self._fill(deadline, asked)
        return self._take(count)

    def read_until(self, end: bytes, timeout_s: float | None = None, asked: str = "") -> bytes:
        """Return everything up to and including the next `end`. Raises `NoAnswer`, `Disconnected`, `Garbled` or
        `Interrupted`."""
        deadline = self._deadline(timeout_s)
        while True:
            at = self._received.find(end)
            if at >= 0:
                return self._take(at + len(end))
            if len(self._received) > LONGEST_ANSWER:
                raise Garbled(f"{self.name}: sends without end; check that the right instrument is at this address")
            self._fill(deadline, asked)

    def drain(self, quiet_s: float = 0.05, limit_s: float = 1.0) -> bytes:
        """Discard what is received until the connection has been silent for `quiet_s`; returns it. Raises
        `Disconnected`."""
        end = time.monotonic() + limit_s
        last = time.monotonic()
        while time.monotonic() < min(end, last + quiet_s):
            if self._receive(quiet_s):
                last = time.monotonic()
        return self._take(len(self._received))

    def _deadline(self, timeout_s: float | None) -> tuple[float, float]:
        wait_s = self.timeout_s if timeout_s is None else timeout_s
        return time.monotonic() + wait_s, wait_s

    def _take(self, count: int) -> bytes:
        data = bytes(self._received[:count])
        del self._received[:count]
        return data

    def _fill(self, deadline: tuple[float, float], asked: str) -> None:
        """Wait for at least one more byte until the deadline; for `BETWEEN_S` where an answer has begun."""
        end, wait_s = deadline
        begun = bool(self._received) and end - time.monotonic() > BETWEEN_S
        if begun:
            end = time.monotonic() + BETWEEN_S
        while True:
            if self._heeds and self._interrupted.is_set():
                raise self._stopped(asked)
            left = end - time.monotonic()
            if self._receive(max(0.0, min(SLICE_S, left))):
                return
            if left <= 0:
                question = f" to {asked!r}" if asked else ""
                got = f"only {shown(bytes(self._received))}" if self._received else "no answer"
                remedy = "the power, the cable, the address, and that nothing else talks to it"
                if self._received:
                    remedy = "that it is this instrument that is connected there, and that nothing else talks to it"
                since = f"then nothing for {BETWEEN_S:g} s" if begun else f"within {wait_s:g} s"
                raise NoAnswer(f"{self.name}: {got}{', ' if begun else ' '}{since}{question}; check {remedy}")

    def _receive(self, timeout_s: float) -> bool:
        """Read the available bytes, waiting for at most `timeout_s`; False if there were none."""
        port = self._open_port()
        try:
            port.timeout = timeout_s
            data = port.read(max(1, port.in_waiting))
        except (OSError, TypeError) as error:  # TypeError: pyserial reads from a descriptor that was closed meanwhile
            raise self._gone(error) from error
        if data:
            self._record("received", data)
            self._received += data
        return bool(data)

    def _stopped(self, asked: str) -> Interrupted:
        return Interrupted(f"{self.name}: stopped while waiting{f' for {asked!r}' if asked else ''}; start again")

    def _open_port(self) -> serial.SerialBase:
        if self._port is None:
            raise Disconnected(f"{self.name}: not connected; connect first")
        return self._port

    def _gone(self, error: Exception) -> Disconnected:
        self.close()
        reason = str(error).replace("\n", " ")
        return Disconnected(f"{self.name}: the line broke ({reason}); plug it in again, the next call reconnects")


def _number_of(error: BaseException) -> int | None:
    """Return the system's number of an error; pyserial keeps that of a refused lock in its text alone."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    match = re.search(r"\[Errno (\d+)\]", str(error))
    return int(match[1]) if match else None


class WireInstrument(Instrument):
    """An instrument on a `Transport`: one conversation at a time, and a new connection after one that failed."""

    #: Whether its address is a serial port or TCP, where whoever looks for instruments may knock.
    on_a_port: ClassVar[bool] = True

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._lock = threading.RLock()
        self._stopping = threading.Lock()  # a stop ends what others wait for, but no stop
        self._live = False
        self._met = False
        self._out_of_step = False  # a stop ended a wait: what was waited for may still come

    @abstractmethod
    def _establish(self) -> None:
        """Identify the instrument on a connection just opened, and bring it into a known state."""

    @abstractmethod
    def _make_safe(self) -> None:
        """Bring the instrument into its safe state, within a conversation."""

    def _gets_in_step(self) -> bool:
        """Make sure that no answer is outstanding, on the same connection, after a stop ended a wait.

        Returns False where the instrument has no way to tell: the connection is opened anew, which takes longer.
        """
        return False

    def _let_go(self) -> None:
        """Leave it as it was found, within a conversation: other programs may talk to it next."""

    def connect(self) -> None:
        with self._conversation():
            pass

    def stop(self) -> None:
        if not self._met:
            return
        with self._stopping:
            self._transport.interrupt()
            with self._lock:
                self._transport.resume()
                with self._conversation():
                    self._make_safe()

    def close(self) -> None:
        unsafe = self._make_safe_for_good() if self._met else None
        with self._lock:
            if self._live:
                with suppress(InstrumentError):
                    self._let_go()
            self._live = self._met = False
            self._transport.close()
        if unsafe is not None:
            raise unsafe

    def _make_safe_for_good(self) -> InstrumentError | None:
        """Return the safe state before the connection ends. Returns what is to be raised afterwards: light may get
        out."""
        with suppress(InstrumentError):
            self.stop()
        return None

    @contextmanager
    def _conversation(self) -> Iterator[Transport]:
        """Hold the connection; after any failure but a refusal, the next conversation opens it anew, so that a late
        answer is never taken for the answer to a later question."""
        with self._lock:
            if self._out_of_step:
                self._resynchronise()
            if not self._live:
                self._meet()
            try:
                yield self._transport
            except Refused:
                raise
            except Interrupted:
                self._out_of_step = True
                raise
            except InstrumentError:
                self._live = False
                self._transport.close()
                raise

    def _resynchronise(self) -> None:
        """Go on with the connection if the instrument gets in step; close it if not."""
        try:
            with self._transport.undisturbed():
                self._live = self._live and self._gets_in_step()
        except InstrumentError:
            self._live = False
        self._out_of_step = False
        if not self._live:
            self._transport.close()

    def _meet(self) -> None:
        """Open the connection and identify the instrument; twice if it was known before, as a late answer may still
        arrive."""
        for last in (not self._met, True):
            self._transport.open()
            try:
                self._establish()
            except (NoAnswer, Garbled):
                self._transport.close()
                if last:
                    raise
            except InstrumentError:
                self._transport.close()
                raise
            else:
                self._live = self._met = True
                return
