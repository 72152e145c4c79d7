"""The Cornerstone 260's driver: against the golden transcript, against the mock on a real line, and when things go wrong."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.monochromator.cornerstone260 import Cornerstone260
from mocks.bench import Bench, Clock
from mocks.cornerstone260 import MockCornerstone260 as Mock
from mocks.lamp import Lamp
from mocks.wire import Pty, Tcp


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("cornerstone260-driver.txt")
    with Cornerstone260(peer.address) as mono:
        mono.move_nm(500)
        mono.open_shutter()
        assert mono.shutter_is_open()
        assert mono.wavelength_nm() == 500.0
        assert mono.bandwidth_nm() == pytest.approx(0.5 * 3.16)
        assert mono.identity().model == "Cornerstone 260"
    assert peer.strange == []
    assert b"FILTER 2\n" in peer.requests
    assert peer.requests[-1] == b"SHUTTER C\n"


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
    assert (mono.slit_um(), bench.light.slit_um, mono.bandwidth_nm()) == (1000, 1000, pytest.approx(3.16))
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
        mono.set_slit_um(1)
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


# Answers 1..4 are those to HANDSHAKE 1, ERROR?, INFO? and UNITS NM when the driver connects.
@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never@5", NoAnswer, "no answer within 1 s"),
        ("late=1.5@5", NoAnswer, "no answer within"),
        ("half@5", NoAnswer, "only '00' within"),
        ("drop@5", NoAnswer, "no answer within"),
        ("wrong@5", Garbled, "answered 'SHUTTER O' with '"),
        ("error=8@5", Refused, "error 8, wavelength drive can't find home"),
        ("unplug=0.3@5", Disconnected, "the line broke"),
    ],
)
def test_every_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], tmp_path: Path, fault: str, error: type[Exception], message: str
) -> None:
    bench = Bench()
    address = served(Mock(bench), Pty(tmp_path / "mono"), fault)
    mono = Cornerstone260(address, timeout_s=1.0, move_timeout_s=1.0)
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
