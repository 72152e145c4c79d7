"""The serial line: time-outs, left-over bytes, the transcript, and a line that breaks."""

from __future__ import annotations

import errno
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from drivers.errors import Disconnected, InstrumentError, Interrupted, NoAnswer
from drivers.instrument import Identity
from drivers.transport import Transport, WireInstrument


class Line:
    """The far end of a pseudo-terminal."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.address = os.ttyname(self.slave)
        self.ends = [self.master, self.slave]
        self.lock = threading.Lock()

    def say(self, data: bytes, after_s: float = 0.0) -> None:
        timer = threading.Timer(after_s, os.write, (self.master, data))
        timer.daemon = True
        timer.start()

    def break_off(self) -> None:
        """Once; a timer's thread may be at it when the test ends."""
        with self.lock:
            for end in self.ends:
                os.close(end)
            self.ends.clear()


@pytest.fixture
def line() -> Iterator[Line]:
    far_end = Line()
    yield far_end
    far_end.break_off()


def test_reads_by_end_and_by_count_and_keeps_what_follows(line: Line) -> None:
    transport = Transport(line.address, "toy")
    transport.open()
    line.say(b"one\r\ntwo\r\nthr")
    line.say(b"ee", 0.05)
    assert transport.read_until(b"\r\n") == b"one\r\n"
    assert transport.read(5) == b"two\r\n"
    assert transport.read(5) == b"three"
    transport.close()


def test_a_time_out_is_kept_and_says_what_came(line: Line) -> None:
    transport = Transport(line.address, "toy", timeout_s=0.2)
    transport.open()
    line.say(b"hal")
    begun = time.monotonic()
    with pytest.raises(NoAnswer) as caught:
        transport.read_until(b"\n", asked="WHO?")
    assert time.monotonic() - begun >= 0.2
    assert str(caught.value).startswith(f"toy at {line.address}: only 'hal' within 0.2 s to 'WHO?'; check")
    transport.close()


def test_an_opened_line_has_nothing_left_over(line: Line) -> None:
    transport = Transport(line.address, "toy", timeout_s=0.1)
    os.write(line.master, b"from before")
    transport.open()
    with pytest.raises(NoAnswer, match="no answer within"):
        transport.read(1)
    line.say(b"late")
    assert transport.drain() == b"late"
    transport.close()


def test_the_transcript_has_every_byte_in_order(line: Line) -> None:
    pieces: list[tuple[str, bytes]] = []
    transport = Transport(line.address, "toy", recorder=lambda direction, data: pieces.append((direction, data)))
    transport.open()
    transport.write(b"hello\n")
    line.say(b"hi\n")
    transport.read_until(b"\n")
    transport.close()
    assert pieces[0] == ("sent", b"hello\n")
    assert b"".join(data for direction, data in pieces if direction == "received") == b"hi\n"


def test_a_wait_can_be_interrupted_from_another_thread(line: Line) -> None:
    transport = Transport(line.address, "toy")
    transport.open()
    threading.Timer(0.1, transport.interrupt).start()
    with pytest.raises(Interrupted):
        transport.read(1, timeout_s=30)
    transport.resume()
    line.say(b"x")
    assert transport.read(1) == b"x"
    transport.close()


def test_a_broken_line_is_one_error_and_opens_again(line: Line) -> None:
    transport = Transport(line.address, "toy", timeout_s=5)
    transport.open()
    threading.Timer(0.1, line.break_off).start()
    with pytest.raises(Disconnected, match=r"^toy at .*: the line broke .*plug it in again") as caught:
        transport.read(1)
    assert "\n" not in str(caught.value)
    with pytest.raises(Disconnected, match="not connected"):
        transport.write(b"x")


@pytest.mark.parametrize("address", ["/dev/no-such-line", "socket://127.0.0.1:9", "socket://nonsense", "no-such:///x"])
def test_an_address_without_a_line_is_one_error(address: str) -> None:
    with pytest.raises(Disconnected) as caught:
        Transport(address, "toy").open()
    assert str(caught.value).startswith(f"toy at {address}: can't be opened (")
    assert "\n" not in str(caught.value)


def test_a_file_is_no_line(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("not a terminal")
    with pytest.raises(InstrumentError, match="can't be opened"):
        Transport(str(tmp_path / "notes"), "toy").open()


def test_a_host_that_hangs_up_is_one_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        transport = Transport(f"socket://127.0.0.1:{server.getsockname()[1]}", "toy")
        transport.open()
        server.accept()[0].close()
        with pytest.raises(Disconnected, match="the line broke"):
            transport.read(1)


class _Lamp(WireInstrument):
    """Says `off` and waits for `ok`."""

    def identity(self) -> Identity:
        return Identity("", "lamp")

    def _establish(self) -> None:
        pass

    def _make_safe(self) -> None:
        self._transport.write(b"off\n")
        self._transport.read_until(b"ok\n", timeout_s=30)


def test_a_stop_is_not_ended_by_another_stop(line: Line) -> None:
    """A run that ends and a halt stop the same instrument at once: both are told that it is safe."""
    transport = Transport(line.address, "lamp")
    lamp = _Lamp(transport)
    lamp.connect()
    failures: list[Exception] = []

    def stop() -> None:
        try:
            lamp.stop()
        except InstrumentError as error:
            failures.append(error)

    threads = [threading.Thread(target=stop) for _ in range(2)]
    for thread in threads:
        thread.start()
        assert os.read(line.master, 4) == b"off\n" if thread is threads[0] else True
    threads[1].join(0.2)  # while the first waits for its answer
    os.write(line.master, b"ok\n")
    threads[0].join(30)
    assert os.read(line.master, 4) == b"off\n"
    os.write(line.master, b"ok\n")
    threads[1].join(30)
    assert failures == []
    lamp._met = False  # its close would stop it once more
    lamp.close()


def test_a_refused_permission_names_the_udev_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port /dev/ttyUSB0: Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(Disconnected) as caught:
        Transport("/dev/ttyUSB0", "toy").open()
    assert "(Permission denied); install deploy/70-calibench.rules" in str(caught.value)
    assert (Path(__file__).parents[2] / "deploy" / "70-calibench.rules").is_file()
