"""The CM110's driver: against the golden transcript, against the mock on a real line, and when things go wrong."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from drivers.monochromator.cm110 import Cm110
from mocks.cm110 import MockCm110
from mocks.lamp import Lamp, LampClock
from mocks.wire import Pty


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("cm110-driver.txt")
    with Cm110(peer.address, dark_nm=200.0) as mono:
        assert mono.identity().serial_number == "11042"
        mono.move_nm(546.1)  # parked: nothing moves yet
        assert not any(request.startswith(b"\x10") for request in peer.requests)
        mono.open_shutter()
    assert peer.strange == []
    assert [request for request in peer.requests if request[:1] == b"\x10"] == [b"\x10\x15\x55", b"\x10\x07\xd0"]
    assert peer.requests[-1] == b"2\x01"


@pytest.mark.parametrize("late_status", [False, True])
@pytest.mark.parametrize("ended_echo", [False, True])
@pytest.mark.parametrize("units", [0, 1, 2])
def test_round_trip_with_the_mock(served: Callable[..., str], late_status: bool, ended_echo: bool, units: int) -> None:
    mock = MockCm110(Lamp(), late_status=late_status, ended_echo=ended_echo, units=units)
    with Cm110(served(mock, Pty()), dark_nm=200.0, slit_um=300.0, dispersion_nm_per_mm=7.0) as mono:
        mono.move_nm(632.8)
        mono.open_shutter()
        assert (mono.wavelength_nm(), mono.shutter_is_open()) == (632.8, True)
        mono.move_nm(0.0)
        assert mono.wavelength_nm() == 0.0
        mono.close_shutter()
        assert (mono.wavelength_nm(), mono.shutter_is_open()) == (200.0, False)
        assert mono.settings() == {"bandwidth_nm": pytest.approx(2.1), "grating": 1, "lines_per_mm": 1200}
        with pytest.raises(InstrumentError, match="200 nm is where it is parked"):
            mono.move_nm(200.0)
        mono.upper_nm = 6000.0
        mono.move_nm(5000.0)
        with pytest.raises(Refused, match="status 130, too large"):
            mono.open_shutter()
    assert mock.units == units  # as it was found


def test_units_are_restored_by_the_next_after_a_process_that_was_killed(served: Callable[..., str]) -> None:
    mock = MockCm110(Lamp())
    address = served(mock, Pty())
    killed = Cm110(address, dark_nm=200.0)
    killed.connect()
    killed._transport.close()  # all that a killed process does
    with Cm110(address, dark_nm=200.0):
        assert mock.units == 2
    assert mock.units == 1


def test_without_a_dark_wavelength_it_says_that_light_may_get_out(served: Callable[..., str]) -> None:
    mono = Cm110(served(MockCm110(Lamp()), Pty()))
    mono.move_nm(500.0)
    mono.open_shutter()
    assert any("the bandwidth of its light isn't known" in line for line in mono.departures())
    with pytest.raises(InstrumentError, match=r"its shutter may be open \(.*state in the station file a dark_nm"):
        mono.close()


# Connecting takes 5 answers (echo, serial number, units, their setting, units); then the position (6), GOTO (7), an
# echo (8), the position (9).
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        *(
            ("never@7", NoAnswer),
            ("half@7", NoAnswer),
            ("wrong@7", Garbled),
            ("error@7", Refused),
            ("drop@7", NoAnswer),
        ),
        *(("never@9", NoAnswer), ("half@9", NoAnswer), ("wrong@9", Garbled), ("late=1.5@9", NoAnswer)),
        *(("wrong@8", Garbled), ("unplug=0.3@7", Disconnected)),
    ],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], tmp_path: Path, fault: str, error: type[Exception]
) -> None:
    line = Pty(tmp_path / "line")
    mono = Cm110(served(MockCm110(Lamp()), line, fault), timeout_s=0.5, move_timeout_s=1.0)
    mono.connect()
    assert mono.wavelength_nm() == 0.0
    with pytest.raises(error) as caught:
        mono.move_nm(500.0)
    assert "\n" not in str(caught.value)
    until = time.monotonic() + 30.0
    while True:
        try:
            mono.move_nm(500.0)
            break
        except InstrumentError:
            assert time.monotonic() < until
            time.sleep(0.05)
    assert mono.wavelength_nm() == 500.0
    mono.close()


def test_a_lost_echo_is_asked_for_again(served: Callable[..., str]) -> None:
    mono = Cm110(served(MockCm110(Lamp()), Pty(), "never@8"), timeout_s=0.5)
    assert mono.wavelength_nm() == 0.0
    mono.move_nm(500.0)
    assert mono.wavelength_nm() == 500.0
    mono.close()


@pytest.mark.parametrize("late_status", [False, True])
def test_a_motion_longer_than_an_answer_is_waited_for_and_ends_before_a_stop_parks(
    served: Callable[..., str], late_status: bool
) -> None:
    mock = MockCm110(Lamp(20.0, LampClock(1.0)), late_status=late_status)
    mono = Cm110(served(mock, Pty()), dark_nm=200.0, timeout_s=0.3)
    mono.move_nm(390.0)  # 2.3 s from 0
    assert mono.wavelength_nm() == 390.0
    ended: list[str] = []

    def move() -> None:
        try:
            mono.move_nm(700.0)
        except InstrumentError as error:
            ended.append(str(error))

    worker = threading.Thread(target=move)
    worker.start()
    worker.join(0.5)
    mono.stop()
    worker.join(30)
    assert "stopped while waiting for" in ended[0]
    assert not mono.shutter_is_open()
    mono.close()
