"""The mock monochromator: time, motion, and what the light path feels of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import serial

from mocks.bench import Bench
from mocks.cornerstone260 import MockCornerstone260
from mocks.lamp import Lamp
from mocks.wire import Grammar

Talk = Callable[[Grammar, bytes], bytes]


def test_a_move_takes_virtual_time_and_the_light_follows_at_its_end(talk: Talk) -> None:
    bench = Bench()
    mono = MockCornerstone260(bench)
    before_s = bench.clock.now()
    assert b"".join(mono.receive(b"HANDSHAKE 1\nGOWAVE 700\n")) == b"HANDSHAKE 1\n00\r\nGOWAVE 700\n"
    assert bench.light.wavelength_nm == 0
    assert mono.wait_s == pytest.approx(700 / 175 + 0.05)
    assert talk(mono, b"") == b"00\r\n"
    assert bench.light.wavelength_nm == 700
    assert bench.clock.now() - before_s == pytest.approx(4.05)


def test_the_whole_light_path_is_set(talk: Talk) -> None:
    bench = Bench()
    talk(MockCornerstone260(bench), b"GOWAVE 532\nFILTER 2\nSLIT1MICRONS 500\nSHUTTER O\n")
    assert (bench.light.wavelength_nm, bench.light.filter_place, bench.light.slit_um, bench.light.shutter_open) == (
        *(532.0, 2),
        *(500.0, True),
    )


def test_a_query_waits_for_the_motion_before_it(talk: Talk) -> None:
    mono = MockCornerstone260(Lamp())
    assert b"".join(mono.receive(b"GOWAVE 500\nWAVE?\n")) == b"GOWAVE 500\nWAVE?\n"
    assert talk(mono, b"") == b"500\r\n"


def test_abort_ends_the_motion_where_it_is(talk: Talk) -> None:
    mono = MockCornerstone260(Lamp())
    mono.receive(b"HANDSHAKE 1\nGOWAVE 500\n")
    assert b"".join(mono.receive(b"ABORT\n")) == b"ABORT\n00\r\n00\r\n"
    assert mono.wait_s is None
    assert talk(mono, b"WAVE?\n") == b"WAVE?\n0\r\n00\r\n"


def test_an_error_is_handed_over_at_once_in_handshake_mode() -> None:
    mono = MockCornerstone260(Lamp())
    mono.receive(b"HANDSHAKE 1\n")
    assert b"".join(mono.receive(b"GOWAVE 9999\n")) == b"GOWAVE 9999\n20\r\n"
    assert b"".join(mono.receive(b"ERROR?\n")) == b"ERROR?\n3\r\n00\r\n"


def test_a_program_that_reads_line_by_line_finds_echo_and_reply(talk: Talk) -> None:
    """As a client does that sends upper case with CR LF, reads the echo as a line and the reply as the next."""
    mono = MockCornerstone260(Lamp())

    def query(statement: str) -> str:
        echo, reply, rest = talk(mono, f"{statement}\r\n".encode()).split(b"\r\n")
        assert (echo.decode(), rest) == (statement, b"")
        return reply.decode()

    assert talk(mono, b"GOWAVE 500.000\r\n") == b"GOWAVE 500.000\r\n"
    assert float(query("WAVE?")) == 500.0
    assert [kind(part) for kind, part in zip((int, int, str), query("GRAT?").split(","), strict=True)] == [
        1,
        1200,
        "VIS",
    ]
    assert query("SHUTTER?") == "C"
    assert int(query("SLIT1MICRONS?")) == 3000
    assert query("INFO?").startswith("Cornerstone 260")


def test_a_serial_library_reaches_it_on_a_pseudo_terminal(served: Callable[[Grammar], str]) -> None:
    with serial.Serial(served(MockCornerstone260(Lamp())), 9600, timeout=30) as port:
        port.write(b"GOWAVE 500\n")
        assert port.read_until(b"\n") == b"GOWAVE 500\n"
        port.write(b"WAVE?\n")
        assert port.read_until(b"\r\n") == b"WAVE?\n500\r\n"
        for byte in b"WAVE?\n":
            port.write(bytes((byte,)))
            assert port.read(1) == bytes((byte,))
        assert port.read_until(b"\r\n") == b"500\r\n"
