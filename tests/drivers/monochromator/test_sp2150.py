"""The SP2150's driver: against the golden transcript, against the mock on a real line, and when things go wrong."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import Garbled, InstrumentError, NoAnswer, Refused
from drivers.monochromator.sp2150 import Sp2150
from mocks.lamp import Lamp, LampClock
from mocks.sp2150 import MockSp2150
from mocks.wire import Pty


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("sp2150-driver.txt")
    with Sp2150(peer.address, dark_place=6, slit_um=500.0) as mono:
        assert mono.identity().model == "SP-2-150i"
        mono.move_nm(546.07)
        assert mono.wavelength_nm() == 546.07
        assert not mono.shutter_is_open()
        # 0.5 mm x 1e6 nm/mm / 1200 x cos(12.4 deg) / 150 mm
        assert mono.bandwidth_nm() == pytest.approx(2.713, abs=1e-3)
    assert peer.strange == []


@pytest.mark.parametrize("echo", [True, False])
def test_the_blank_goes_in_and_the_filter_of_the_wavelength_comes_back(served: Callable[..., str], echo: bool) -> None:
    with Sp2150(served(MockSp2150(Lamp(), echo=echo), Pty()), dark_place=6) as mono:
        assert mono.shutter_is_open()  # as it was found
        mono.move_nm(500.0)
        assert mono.selected_filter() == 2
        mono.close_shutter()
        mono.move_nm(700.0)
        assert mono.selected_filter() == 6
        mono.open_shutter()
        assert mono.selected_filter() == 3
        assert mono.bandwidth_nm() == 0.0  # nothing is stated of its slits
        assert "the bandwidth of its light isn't known" in mono.departures()[0]


def test_without_a_blank_it_says_that_light_may_get_out(served: Callable[..., str]) -> None:
    mono = Sp2150(served(MockSp2150(Lamp()), Pty()))
    mono.connect()
    mono.open_shutter()
    with pytest.raises(InstrumentError, match=r"its shutter may be open \(.*put a blank in its filter wheel"):
        mono.close()
    with pytest.raises(InstrumentError, match="dark_place 2 is an order-sorting filter's place"):
        Sp2150("/dev/null", dark_place=2)


# Connecting takes 2 answers (MODEL, SERIAL); then ?FILTER (3), FILTER (4), ?FILTER (5), GOTO (6), ?NM (7).
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        *(("never@6", NoAnswer), ("half@6", NoAnswer), ("wrong@6", Refused), ("error@6", Refused)),
        *(("never@7", NoAnswer), ("half@7", NoAnswer), ("wrong@3", Refused), ("late=1.5@7", NoAnswer)),
        *(("never@4", NoAnswer), ("unplug=0.3@6", InstrumentError)),
    ],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], tmp_path: Path, fault: str, error: type[Exception]
) -> None:
    line = Pty(tmp_path / "line")
    mono = Sp2150(served(MockSp2150(Lamp()), line, fault), dark_place=6, timeout_s=0.5, move_timeout_s=1.0)
    mono.connect()
    began = time.monotonic()
    with pytest.raises(error) as caught:
        mono.move_nm(500.0)
    assert "\n" not in str(caught.value)
    until = began + 30.0
    while True:
        try:
            mono.move_nm(500.0)
            assert (mono.wavelength_nm(), mono.selected_filter()) == (500.0, 2)
            break
        except InstrumentError:
            assert time.monotonic() < until
            time.sleep(0.05)
    mono.close()


def test_another_instrument_is_told(scripted: Callable[[str], Any]) -> None:
    with pytest.raises(Garbled, match="answered 'MODEL' with 'DK240'; check that an SP2150 is at this address"):
        Sp2150(scripted_dk240(scripted)).connect()


def scripted_dk240(scripted: Callable[[str], Any]) -> str:
    peer = scripted("sp2150-driver.txt")
    peer.answers[b"MODEL\r"] = [b"MODEL DK240  ok\r\n"]
    return str(peer.address)


def test_a_motion_that_is_stopped_ends_before_the_blank_goes_in(served: Callable[..., str]) -> None:
    mono = Sp2150(served(MockSp2150(Lamp(20.0, LampClock(1.0))), Pty()), dark_place=6, timeout_s=1.0)
    mono.connect()
    ended: list[str] = []

    def move() -> None:
        try:
            mono.move_nm(399.0)
        except InstrumentError as error:
            ended.append(str(error))

    worker = threading.Thread(target=move)
    worker.start()
    worker.join(0.5)
    mono.stop()
    worker.join(30)
    assert "stopped while waiting for '399.00 GOTO'" in ended[0]
    assert not mono.shutter_is_open()
    assert mono.wavelength_nm() == 399.0
    mono.close()
