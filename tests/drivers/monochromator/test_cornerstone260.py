"""The Cornerstone 260's driver: against the golden transcript, against the mock on a real line, and when things go
wrong."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import serial

from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, InUse, NoAnswer, Refused
from drivers.monochromator.cornerstone260 import Cornerstone260
from drivers.transport import Transport
from lab.capture.devices import shut
from mocks.bench import Bench, Clock
from mocks.cornerstone260 import MockCornerstone260, _Cs260Refusal
from mocks.cornerstone260 import MockCornerstone260 as Mock
from mocks.cornerstone260b_serial import MockCornerstone260BSerial
from mocks.lamp import Lamp
from mocks.peers import cornerstone260
from mocks.wire import Grammar, Pty, Tcp


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("cornerstone260-driver.txt")
    with Cornerstone260(peer.address) as mono:
        mono.move_nm(500)
        mono.open_shutter()
        assert mono.shutter_is_open()
        assert mono.wavelength_nm() == 500.0
        assert mono.bandwidth_nm() == pytest.approx(0.5 * 3.16, rel=1e-3)
        assert mono.identity().model == "Cornerstone 260"
    assert peer.strange == []
    assert b"FILTER 2\r\n" in peer.requests
    assert peer.requests[-4:] == [b"SHUTTER C\r\n", b"SHUTTER?\r\n", b"UNITS UM\r\n", b"HANDSHAKE 0\r\n"]


def test_a_cs260b_by_its_serial_port_is_asked_until_it_stands_still(scripted: Callable[[str], Any]) -> None:
    peer = scripted("cornerstone260b-serial-driver.txt")
    with Cornerstone260(peer.address, filters=[]) as mono:
        mono.move_nm(500)
        assert mono.identity().serial_number == "0815"
    assert peer.strange == []
    assert peer.requests.count(b"IDLE?\r\n") == 5 + 1  # twice connecting, three times moving, once closing
    assert b"HANDSHAKE 0\r\n" not in peer.requests  # the host before had it on


@pytest.mark.parametrize("echo", [True, False])
def test_a_cs260b_answers_before_it_arrives(served: Callable[..., str], echo: bool) -> None:
    bench = Bench()
    bench.clock = Clock(real_time_factor=0.1)
    with Cornerstone260(served(MockCornerstone260BSerial(bench, echo=echo), Pty())) as mono:
        mono.move_nm(700)  # 4 s, a tenth of it really
        assert (bench.light.wavelength_nm, bench.light.filter_place) == (pytest.approx(700, abs=0.0125), 3)


@pytest.mark.parametrize("kind", [Pty(), Tcp("127.0.0.1", 0)], ids=["pty", "tcp"])
@pytest.mark.parametrize(
    "left", [b"", b"HANDSHAKE 1\nGOWAVE 700\n", b"GOWA"], ids=["idle", "moving", "half a statement"]
)
def test_a_shutter_that_was_left_open_is_closed_before_anything_is_asked(
    served: Callable[..., str], kind: Pty | Tcp, left: bytes
) -> None:
    bench = Bench()
    mock = Mock(bench)
    mock.receive(b"SHUTTER O\n" + left)
    mono = Cornerstone260(served(mock, kind))
    mono.shut_at_once()
    until = time.monotonic() + 30.0
    while bench.light.shutter_open:
        assert time.monotonic() < until
        time.sleep(0.002)
    mono.connect()  # what it answered to that isn't taken for something else
    assert not mono.shutter_is_open()
    mono.close()


@pytest.mark.parametrize("found", [False, True], ids=["off", "on"])
def test_the_next_program_finds_the_handshake_as_it_was(served: Callable[..., str], found: bool) -> None:
    mock = Mock(Lamp())
    mock.receive(b"UNITS WN\nHANDSHAKE %d\n" % found)
    address = served(mock, Tcp("127.0.0.1", 0))
    mono = Cornerstone260(address)
    mono.move_nm(500)
    mono.close()
    with serial.serial_for_url(address, timeout=30) as port:
        port.write(b"WAVE?\n")
        assert port.read_until(b"\r\n") == b"WAVE?\n20000.00\r\n"
        port.timeout = 0.3
        assert port.read(4) == (b"00\r\n" if found else b"")


def test_a_motion_under_way_is_ended_on_connecting(served: Callable[..., str]) -> None:
    bench = Bench()
    bench.clock = Clock(real_time_factor=1.0)
    mock = Mock(bench)
    mock.receive(b"GOWAVE 1000\n")  # 5.8 s
    mono = Cornerstone260(served(mock, Pty()), timeout_s=1.0)
    mono.connect()
    assert mono.wavelength_nm() == 0
    mono.close()


class _Slow(Mock):
    """On a busy computer: what comes first is answered half a second late."""

    delay_s = 0.5

    def receive(self, data: bytes) -> list[bytes]:
        time.sleep(self.delay_s)
        self.delay_s = 0.0
        return super().receive(data)


@pytest.mark.parametrize("handshake", [False, True], ids=["off", "on"])
def test_late_answers_to_the_first_contact_are_skipped(served: Callable[..., str], handshake: bool) -> None:
    mock = _Slow(Lamp())
    Mock.receive(mock, b"HANDSHAKE %d\n" % handshake)
    with Cornerstone260(served(mock, Pty())) as mono:
        assert mono.identity().serial_number == "0427"
        mono.move_nm(500)
        assert mono.wavelength_nm() == 500.0
    assert Mock.receive(mock, b"WAVE?\r\n")[-1] == b"500\r\n" + b"00\r\n" * handshake


def test_two_instruments_on_one_port_are_told_so(served: Callable[..., str]) -> None:
    address = served(Mock(Lamp()), Pty())
    with Cornerstone260(address), pytest.raises(InUse, match="this port is in use, by another program or another"):
        Cornerstone260(address).connect()


@pytest.mark.parametrize("endpoint", [Pty, lambda: Tcp("127.0.0.1", 0)])
def test_round_trip_with_the_mock(served: Callable[..., str], endpoint: Callable[[], Any]) -> None:
    bench = Bench()
    mono = Cornerstone260(served(Mock(bench), endpoint()))
    mono.set_slit_um(1000)
    for wavelength_nm, place in ((400, 2), (532.1, 2), (720, 3), (0, 1)):
        mono.move_nm(wavelength_nm)
        assert mono.wavelength_nm() == pytest.approx(wavelength_nm, abs=0.0125)  # half a step
        assert (bench.light.wavelength_nm, bench.light.filter_place) == (
            pytest.approx(wavelength_nm, abs=0.0125),
            place,
        )
    mono.open_shutter()
    assert bench.light.shutter_open
    assert (mono.slit_um(), bench.light.slit_um, mono.bandwidth_nm()) == (1000, 1000, pytest.approx(3.16, rel=1e-3))
    assert mono.identity().serial_number == "0427"
    mono.close()
    assert not bench.light.shutter_open
    mono.close()


def test_refusals_carry_the_instruments_code_and_keep_the_line(served: Callable[..., str]) -> None:
    mono = Cornerstone260(served(Mock(Lamp()), Pty()), upper_nm=2000, filters=[])
    with pytest.raises(Refused, match="error 3, wavelength not allowed") as caught:
        mono.move_nm(1500)
    assert caught.value.code == 3
    with pytest.raises(Refused, match="error 2, bad parameter"):
        mono.select_filter(9)
    mono.move_nm(600)
    assert mono.wavelength_nm() == 600
    mono.close()


def test_a_host_before_that_left_half_a_statement_does_no_harm(served: Callable[..., str]) -> None:
    mock = Mock(Lamp())
    mock.receive(b"NONSENSE\nGOWA")
    mono = Cornerstone260(served(mock, Pty()))
    mono.move_nm(450)
    assert mono.wavelength_nm() == 450
    mono.close()


# When the driver connects, answers 1..6 are those to INFO?, ERROR?, IDLE?, ERROR?, UNITS? and UNITS NM (the mock's
# HANDSHAKE 1 answers, too).
@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never@8", NoAnswer, "no answer within 1 s"),
        ("late=4@8", NoAnswer, "no answer within"),
        ("half@8", NoAnswer, "only '00' within 1 s"),
        ("drop@8", NoAnswer, "no answer within"),
        ("wrong@8", Garbled, "answered 'SHUTTER O' with '"),
        ("error=8@8", Refused, "error 8, wavelength drive can't find home"),
        ("unplug=0.3@8", Disconnected, "the line broke"),
    ],
)
def test_every_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], tmp_path: Path, fault: str, error: type[Exception], message: str
) -> None:
    bench = Bench()
    address = served(Mock(bench), Pty(tmp_path / "mono"), fault)
    mono = Cornerstone260(address, timeout_s=1.0, move_timeout_s=3.0)
    mono.connect()
    with pytest.raises(error, match=message) as caught:
        mono.open_shutter()
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"Cornerstone 260 at {address}: ")
    assert works_again(mono.open_shutter)
    assert bench.light.shutter_open
    mono.close()
    assert not bench.light.shutter_open


def works_again(call: Callable[[], object], within_s: float = 30.0) -> bool:
    """The line may stay broken for a while; then a plain call reconnects."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            call()
        except InstrumentError:
            time.sleep(0.05)
        else:
            return True
    return False


@pytest.mark.parametrize("after_s", [0.0, 0.5], ids=["before its echo", "under way"])
def test_stop_ends_a_motion_and_closes_the_shutter(served: Callable[..., str], after_s: float) -> None:
    bench = Bench()
    bench.clock = Clock(real_time_factor=1.0)
    asked = threading.Event()
    mono = Cornerstone260(
        served(Mock(bench), Pty()),
        recorder=lambda direction, data: asked.set() if data.startswith(b"GOWAVE") else None,
    )
    mono.open_shutter()
    errors: list[Exception] = []

    def move() -> None:
        try:
            mono.move_nm(1000)  # 5.8 s
        except InstrumentError as error:
            errors.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    assert asked.wait(30)
    time.sleep(after_s)
    mono.stop()
    mover.join(30)
    assert [type(error) for error in errors] == [Interrupted]
    assert not bench.light.shutter_open
    assert bench.light.wavelength_nm == 0
    bench.clock.real_time_factor = 0.0
    mono.move_nm(500)
    assert mono.wavelength_nm() == 500
    mono.close()


def test_a_wrong_instrument_at_the_address_is_named(scripted: Callable[[str], Any]) -> None:
    peer = scripted("specbos1211-driver.txt")
    with pytest.raises(InstrumentError, match=r"^Cornerstone 260 at socket://"):
        Cornerstone260(peer.address, timeout_s=0.2).connect()


def test_closing_what_was_never_opened_touches_nothing() -> None:
    Cornerstone260("/dev/no-such-line").close()
    Cornerstone260("/dev/no-such-line").stop()


@pytest.mark.parametrize("fault", range(9, 21))
def test_closing_leaves_the_shutter_closed_or_says_so(served: Callable[..., str], fault: int) -> None:
    bench = Bench()
    mono = Cornerstone260(served(Mock(bench), Pty(), f"error@{fault}"), timeout_s=20.0)
    with suppress(InstrumentError):
        mono.connect()
        mono.open_shutter()
    mono.close()
    assert not bench.light.shutter_open


def test_a_silent_instrument_is_told_to_close_again_without_meeting_it_anew() -> None:
    """A second first contact would take the close beyond twice its time-out."""
    sent: list[bytes] = []
    with cornerstone260() as peer:
        mono = Cornerstone260(peer.address, **peer.settings, recorder=lambda way, data: sent.append(data))
        mono.open_shutter()
        peer.mute(True)
        sent.clear()
        with pytest.raises(InstrumentError, match=r"its shutter may be open \(.*no answer"):
            mono.close()
    said = b"".join(sent)
    assert said.count(b"SHUTTER C\r\n") == 1 + said.count(b"ABORT\r\nSHUTTER C\r\n") == 2
    assert b"INFO?" not in said


def test_a_shutter_that_sticks_is_told_on_closing(served: Callable[..., str]) -> None:
    class Stuck(Mock):
        _shutter = property(lambda self: "O", lambda self, text: None)

    mono = Cornerstone260(served(Stuck(Bench()), Pty()))
    mono.open_shutter()
    with pytest.raises(InstrumentError, match=r"its shutter may be open .*; block the light by hand"):
        mono.close()
    with pytest.raises(ValueError, match="of the body") as caught, mono:
        mono.open_shutter()
        raise ValueError("of the body")
    assert "its shutter may be open" in caught.value.__notes__[0]


class MicrometerSlits(Mock):
    """Slits without motors."""

    def _slit_at(self, number: str) -> int:
        raise _Cs260Refusal(6)


def test_slits_set_by_hand(served: Callable[..., str]) -> None:
    address = served(MicrometerSlits(Bench()), Pty())
    with Cornerstone260(address) as mono:
        mono.move_nm(500.0)
        assert mono.bandwidth_nm() == 0.0
        assert "the bandwidth of its light isn't known" in mono.departures()[0]
        with pytest.raises(InstrumentError, match="turn them to 500 um and state that"):
            mono.set_slit_um(500.0)
    with Cornerstone260(address, slit_um=500.0) as mono:
        mono.set_slit_um(500.0)
        assert mono.departures() == ()
        assert mono.slit_um() == 500.0


def test_the_bandwidth_is_that_of_the_grating_in_use(served: Callable[..., str]) -> None:
    with Cornerstone260(served(Mock(Bench()), Pty()), grating=2) as mono:
        mono.set_slit_um(500.0)
        assert mono.bandwidth_nm() == pytest.approx(0.5 * 2 * 3.16, rel=1e-3)


# ----------------------------------------------------------------------------------------------------------------------
# What a halt asks of a Cornerstone 260: the shutter's answer on the connection that is there, from several threads.


@pytest.mark.parametrize("kind", [MockCornerstone260, MockCornerstone260BSerial])
def test_a_stop_under_way_of_a_motion_keeps_the_connection(
    served: Callable[..., str], kind: type[Grammar], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Meeting the instrument anew takes quiet periods, which add up with every stop of a halt."""
    bench, opened, moves = Bench(), [], threading.Event()
    bench.clock = Clock(real_time_factor=1.0)
    open_port = Transport.open
    monkeypatch.setattr(Transport, "open", lambda self: (opened.append(1), open_port(self))[1])
    mono = Cornerstone260(
        served(kind(bench), Pty()),  # type: ignore[call-arg, arg-type]
        recorder=lambda direction, data: moves.set() if data.startswith(b"GOWAVE") else None,
    )
    mono.open_shutter()
    told: list[InstrumentError] = []

    def move() -> None:
        try:
            mono.move_nm(1000)  # 5.8 s
        except InstrumentError as error:
            told.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    assert moves.wait(30.0)
    halting = [threading.Thread(target=shut, args=(mono,)) for _ in range(4)]
    for one in halting:
        one.start()
    for one in (*halting, mover):
        one.join(30.0)
    assert [type(error) for error in told] == [Interrupted]
    assert not bench.light.shutter_open and not mono.shutter_is_open()
    assert len(opened) == 1
    mono.close()


@pytest.mark.parametrize("left", [b"", b"HANDSHAKE 1\nGOWAVE 700\n"], ids=["idle", "moving"])
def test_a_shutter_answers_before_the_first_contact(
    served: Callable[..., str], left: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench()
    mock = MockCornerstone260(bench)
    mock.receive(b"SHUTTER O\n" + left)
    mono = Cornerstone260(served(mock, Pty()))
    monkeypatch.setattr(Transport, "drain", lambda *_, **__: pytest.fail("it waited for silence"))
    assert mono.shut_at_once() and not bench.light.shutter_open
    monkeypatch.undo()
    mono.close()


def test_a_late_answer_to_an_earlier_program_is_not_the_shutters(served: Callable[..., str]) -> None:
    """One that says `C` comes first; the shutter itself is stuck, and never says it."""

    class Stuck(MockCornerstone260):
        def receive(self, data: bytes) -> list[bytes]:
            late, self.late = self.late, []
            return [*late, *super().receive(data.replace(b"SHUTTER C", b"SHUTTER O"))]

        late: list[bytes] = [b"C\r\n00\r\n"]

    mono = Cornerstone260(served(Stuck(Bench()), Pty()), timeout_s=0.3)
    assert not mono.shut_at_once()
