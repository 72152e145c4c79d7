"""Faults, lines, and the golden transcripts of every grammar."""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transcript import parse
from mocks.command import INSTRUMENTS
from mocks.lamp import Lamp
from mocks.wire import (
    KINDS,
    AddressError,
    Endpoint,
    Fault,
    FaultSpecError,
    FaultyLine,
    Grammar,
    Pty,
    Reply,
    Tcp,
    parse_faults,
    serve,
)

GOLDEN = Path(__file__).parent.parent / "wire"


def conversations() -> Iterator[tuple[str, int]]:
    for name in (
        "cornerstone260",
        "specbos1211",
        "pr655",
        "cr300",
        "cs2000",
        "sp2150",
        "cm110",
        "pe4000",
        "spotread",
        "stage",
    ):
        for number, _ in enumerate(parse((GOLDEN / f"{name}.txt").read_text(encoding="ascii"))):
            yield name, number


@pytest.mark.parametrize(("name", "number"), list(conversations()))
def test_mock_speaks_the_golden_transcript(name: str, number: int, talk: Callable[[Grammar, bytes], bytes]) -> None:
    pieces = list(parse((GOLDEN / f"{name}.txt").read_text(encoding="ascii")))[number]
    mock = INSTRUMENTS[name](Lamp())
    for at, piece in enumerate(pieces):
        if piece.direction == "sent":
            answered = at + 1 < len(pieces) and pieces[at + 1].direction == "received"
            assert talk(mock, piece.data) == (pieces[at + 1].data if answered else b""), f"after {piece.line()}"


@pytest.mark.parametrize("name", sorted(INSTRUMENTS))
def test_pacing_does_not_matter(name: str, talk: Callable[[Grammar, bytes], bytes]) -> None:
    """A character at a time, a line at a time and all at once are the same conversation."""
    commands = b"PHOTO\rGOWAVE 500\r\n*idn?\rD111\rRC Model\nPLACE sphere\n*init\rWAVE?\n"
    at_once, in_pieces = INSTRUMENTS[name](Lamp()), INSTRUMENTS[name](Lamp())
    assert talk(at_once, commands) == b"".join(talk(in_pieces, bytes((byte,))) for byte in commands) or name == (
        "cornerstone260"  # its echo of a later line overtakes the answer to one before, as on the instrument
    )


FRAGMENTS = [
    *(b"GOWAVE ", b"WAVE?", b"500", b"-1e9", b"HANDSHAKE 1", b"FILTER ", b"FILTER9LABEL", b"STEP 99999999", b"ABORT"),
    *(b"UNITS WN", b"CALIBRATE 0", b"SLIT1MICRONS ", b"GRAT 2", b"GRAT1FACTOR 1e400", b"SHUTTER O", b"ERROR?", b"STB?"),
    *(b"*idn?", b"*init", b"*fetch:sprad", b"*fetch:XYZ 7", b"*conf:wran ", b"*conf:wran 350 830 1", b"*para:expo 0"),
    *(
        b"*para:tint 0",
        b"*contr:laser 1",
        b"*stat:err?",
        b"\x1b",
        b"nan",
        b"inf",
        b"PHOTO",
        b"Q",
        b"M5",
        b"D5",
        b"D601",
    ),
    *(b"SS1", b"E", b"M", b"RM Spectrum", b"RM XYZ", b"SM ExposureX 50", b"SM Speed 9", b"PLACE ", b"sphere", b"LIST?"),
    *(b"CSSASN050", b"CSS", b"CSSA", b"LOAD:385", b"LOAD:", b"LAMS", b"PORT:P=OFF"),
    *(b"\r", b"\n", b"\r\n", b" ", b"\x00", b"\xff", b"\xb2", b";D024\r\n", b"x" * 600),
]


@pytest.mark.parametrize("name", sorted(INSTRUMENTS))
@given(st.lists(st.one_of(st.sampled_from(FRAGMENTS), st.binary(max_size=12)), max_size=25))
def test_no_input_upsets_a_mock(name: str, talk: Callable[[Grammar, bytes], bytes], pieces: list[bytes]) -> None:
    """Whatever came before, it comes to rest, and a host that starts over is answered."""
    mock = INSTRUMENTS[name](Lamp())
    for piece in pieces:
        talk(mock, piece)
    mock.quiet()
    start_over, question, answer = {
        "cornerstone260": (b"\nHANDSHAKE 0\n", b"GRAT?\n", b",VIS\r\n"),
        "cornerstone260b-serial": (b"\r\nHANDSHAKE 0\r\n", b"GRAT?\r\n", b",VIS\r\n"),
        "scpi-meter": (b"\n", b"*IDN?\n", b"MODEL 6485,1234567,B03\n"),
        "specbos1201": (b"\x1b\r", b"*idn?\r", b"SB05\r"),
        "specbos1211": (b"\x1b\r", b"*idn?\r", b"JETI_SB1211\r"),
        "spectraval1501": (b"\x1b\r", b"*idn?\r", b"JETI_SDCM3 1501427\r"),
        "pr655": (b"\rQPHOTO\r", b"D111\r", b"00000,PR-655\r\n"),
        "pr670": (b"\rQPHOTO\r", b"D111\r", b"00000,PR-670\r\n"),
        "cr250": (b"\n", b"RC Model\n", b"OK:0:RC Model:CR-250\r\n"),
        "cr300": (b"\n", b"RC Model\n", b"OK:0:RC Model:CR-300\r\n"),
        "cs2000": (b"\n", b"IDDR\n", b"OK00,CS-2000,0,10004711\r\n"),
        "cm110": (b"\x1b" * 5, b"8\x0d", b"\x18"),
        "sp2150": (b"\r", b"SERIAL\r", b"SERIAL 21500427  ok\r\n"),
        "pe4000": (b"\r", b"XMODEL\r", b"XMODEL=pE-4000\r\n"),
        "spotread": (b"\nspotread -e -c 1\n", b" \n", b"any other key to take a reading: "),
        "stage": (b"\n", b"LIST?\n", b"cap,sphere,colorchecker,screen\r\n"),
    }[name]
    talk(mock, start_over)
    said = talk(mock, question)
    assert said.endswith(answer) or (name.startswith("cornerstone") and said.endswith(b",NIR\r\n"))


# --- faults -----------------------------------------------------------------------------------------------------------


def test_fault_specs_are_read() -> None:
    assert parse_faults("half@3") == (Fault("half", 3),)
    assert parse_faults("late=0.5@2+, error=120") == (Fault("late", 2, True, 0.5), Fault("error", 1, False, 120.0))
    assert parse_faults("") == ()


@pytest.mark.parametrize("spec", ["explode", "half@", "half@0", "half@x", "late=soon", "late=nan@2", "@3", "half@-1+"])
def test_bad_fault_specs_are_refused_in_one_line(spec: str) -> None:
    with pytest.raises(FaultSpecError) as caught:
        parse_faults(spec)
    assert "\n" not in str(caught.value)
    assert spec.strip() in str(caught.value)


class Parrot(Grammar):
    """Answers every line by itself, in two lines."""

    def receive(self, data: bytes) -> list[bytes]:
        return [b"echo", Reply(data + b"\r\nmore\r\n")] if self._failure() is None else [Reply(b"bad\r\n")]


def test_each_kind_of_fault_breaks_the_answer_it_is_told_to() -> None:
    def second(spec: str) -> list[bytes]:
        line = FaultyLine(Parrot(Lamp().clock), parse_faults(spec))
        line.receive(b"a")
        return [output.data for output in line.receive(b"b")]

    assert second("half@1") == [b"echo", b"b\r\nmore\r\n"]
    assert second("half@2") == [b"echo", b"b\r\nm"]
    assert second("never@2") == [b"echo", b""]
    assert second("drop@2") == [b"echo", b"b\r\n"]
    assert second("wrong@1+") == [b"echo", b"?" * 7 + b"\r\n"]
    assert second("error@2") == [b"bad\r\n"]
    late = FaultyLine(Parrot(Lamp().clock), parse_faults("late=4@1")).receive(b"a")
    assert [(output.data, output.delay_s) for output in late] == [(b"echo", 0.0), (b"a\r\nmore\r\n", 4.0)]
    unplugged = FaultyLine(Parrot(Lamp().clock), parse_faults("unplug=9@1")).receive(b"a")
    assert unplugged[-1].unplug_s == 9.0
    assert set(KINDS) == {"half", "never", "drop", "wrong", "error", "late", "unplug"}


def test_an_error_that_no_command_met_is_over_with_its_faults() -> None:
    line = FaultyLine(Parrot(Lamp().clock), parse_faults("error@1"))
    line.fail(())
    assert [output.data for output in line.receive(b"a")] == [b"echo", b"a\r\nmore\r\n"]


# --- lines ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def served() -> Iterator[Callable[..., list[str]]]:
    """Serve a grammar on an endpoint in a thread; gives the list of announced addresses, filled as they come."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def start(grammar: Grammar, endpoint: Endpoint, faults: tuple[Fault, ...] = ()) -> list[str]:
        announced: list[str] = []
        first = threading.Event()

        def announce(address: str) -> None:
            announced.append(address)
            first.set()

        kwargs = {"faults": faults, "announce": announce}
        threads.append(threading.Thread(target=serve, args=(grammar, endpoint, stop), kwargs=kwargs))
        threads[-1].start()
        assert first.wait(30)
        return announced

    yield start
    stop.set()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()


def answer_of(descriptor: int, question: bytes, until: bytes, within_s: float = 30.0) -> bytes:
    os.write(descriptor, question)
    said = b""
    end = time.monotonic() + within_s
    while until not in said and time.monotonic() < end:
        if select.select([descriptor], [], [], 0.05)[0]:
            said += os.read(descriptor, 4096)
    return said


def hangs_up(descriptor: int, within_s: float = 30.0) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            if select.select([descriptor], [], [], 0.05)[0] and not os.read(descriptor, 4096):
                return True
        except OSError:
            return True
    return False


def test_pseudo_terminal_is_raw_and_its_link_comes_and_goes(served: Callable[..., list[str]], tmp_path: Path) -> None:
    link = tmp_path / "mono"
    announced = served(INSTRUMENTS["cornerstone260"](Lamp()), Pty(link), parse_faults("unplug=0.2@2"))
    assert announced == [str(link)]
    host = os.open(link, os.O_RDWR | os.O_NOCTTY)
    assert answer_of(host, b"WAVE?\n", b"0\r\n") == b"WAVE?\n0\r\n"
    os.write(host, b"WAVE?\n")
    assert hangs_up(host)
    os.close(host)
    end = time.monotonic() + 30
    while len(announced) < 2 and time.monotonic() < end:
        time.sleep(0.02)
    host = os.open(link, os.O_RDWR | os.O_NOCTTY)
    assert answer_of(host, b"SHUTTER?\n", b"C\r\n") == b"SHUTTER?\nC\r\n"
    os.close(host)


def test_carriage_return_alone_ends_a_line_when_the_host_falls_silent(served: Callable[..., list[str]]) -> None:
    (address,) = served(INSTRUMENTS["cornerstone260"](Lamp()), Pty())
    host = os.open(address, os.O_RDWR | os.O_NOCTTY)
    assert answer_of(host, b"WAVE?\r", b"\r\n") == b"WAVE?\r0\r\n"
    os.close(host)


def test_long_answers_pass_a_pseudo_terminal_whole(served: Callable[..., list[str]]) -> None:
    (address,) = served(INSTRUMENTS["specbos1211"](Lamp()), Pty())
    host = os.open(address, os.O_RDWR | os.O_NOCTTY)
    answer_of(host, b"*conf:wran 350 1000 1\r*init\r", b"\x07")
    said = answer_of(host, b"*fetch:sprad\r", b"\r\r")
    assert said.count(b"\r") == 2 + 651 + 1
    os.close(host)


def test_tcp_serves_one_host_after_the_other(served: Callable[..., list[str]]) -> None:
    (address,) = served(INSTRUMENTS["stage"](Lamp()), Tcp("127.0.0.1", 0))
    where = ("127.0.0.1", int(address.rpartition(":")[2]))
    for _ in range(3):
        with socket.create_connection(where, timeout=30) as host:
            host.sendall(b"PLACED?\n")
            assert host.recv(100) == b"cap\r\n"
    with socket.create_connection(where, timeout=30) as first, socket.create_connection(where, timeout=30) as second:
        second.sendall(b"PLACED?\n")
        assert second.recv(100) == b"cap\r\n"
        assert first.recv(100) == b""


def test_a_link_never_replaces_a_file(tmp_path: Path) -> None:
    taken = tmp_path / "notes.txt"
    taken.write_text("precious")
    with pytest.raises(AddressError, match="can't become a link"):
        Pty(taken).open()
    assert taken.read_text() == "precious"


def test_a_taken_port_is_refused_in_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(AddressError, match=f"127.0.0.1:{port}") as caught:
            Tcp("127.0.0.1", port).open()
    assert "\n" not in str(caught.value)
