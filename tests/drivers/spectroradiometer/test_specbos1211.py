"""The specbos 1211's driver: against the golden transcript, against the mock on a real line, and when things go wrong."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.spectroradiometer.specbos1211 import Specbos1211
from mocks.lamp import Lamp, LampClock
from mocks.specbos1211 import MockSpecbos1211 as Mock
from mocks.wire import Pty, Tcp


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    """With a fetch that broke off, which is asked for again without a word."""
    peer = scripted("specbos1211-driver.txt")
    with Specbos1211(peer.address, from_nm=500, to_nm=503) as radiometer:
        measured = radiometer.measure()
        assert radiometer.identity().model == "specbos 1211"
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == (500.0, 501.0, 502.0, 503.0)
    assert measured.radiance_w_sr_m2_nm.value == (1e-3, 2e-3, 3e-3, 4e-3)
    assert (measured.integration_time_s, measured.serial_number) == (0.025, "4711")
    assert peer.strange == []
    assert peer.requests.count(b"*fetch:sprad\r") == 2


@pytest.mark.parametrize("endpoint", [Pty, lambda: Tcp("127.0.0.1", 0)])
def test_round_trip_with_the_mock(served: Callable[..., str], endpoint: Callable[[], Any]) -> None:
    lamp = Lamp(20.0)
    with Specbos1211(served(Mock(lamp), endpoint())) as radiometer:
        measured = radiometer.measure()
    wavelength_nm = np.arange(350, 1001)
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == tuple(wavelength_nm)
    # Seven digits go over the wire.
    np.testing.assert_allclose(measured.radiance_w_sr_m2_nm.value, lamp.radiance().at(wavelength_nm), rtol=5e-7)
    assert measured.serial_number == "1211427"
    assert measured.integration_time_s is not None
    assert 0.01 < measured.integration_time_s <= 3.0


def test_over_exposure_is_a_refusal_with_its_code(served: Callable[..., str]) -> None:
    radiometer = Specbos1211(served(Mock(Lamp(1e8)), Pty()))
    with pytest.raises(Refused, match="error 120, over-exposed; dim the light") as caught:
        radiometer.measure()
    assert caught.value.code == 120
    with pytest.raises(Refused):
        radiometer.measure()
    radiometer.close()


def test_a_range_outside_the_calibration_is_refused(served: Callable[..., str]) -> None:
    radiometer = Specbos1211(served(Mock(Lamp()), Pty()), from_nm=300)
    with pytest.raises(Refused, match="error 141, outside the calibrated range"):
        radiometer.measure()
    radiometer.close()


# Connecting takes 11 answers (*idn?, *para:spnum?, *vers?, 8 settings); then *init (12), its end (13), the fetch (14).
@pytest.mark.parametrize("fault", ["half@14", "drop@14", "wrong@14", "never@14", "half@14,half@15,half@16,half@17"])
def test_a_broken_fetch_is_asked_for_again(served: Callable[..., str], fault: str) -> None:
    radiometer = Specbos1211(served(Mock(Lamp()), Pty(), fault), timeout_s=1.0, fetch_timeout_s=1.0)
    radiometer.connect()
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 651
    radiometer.close()


def test_a_fetch_that_stays_broken_is_given_up_after_five(served: Callable[..., str]) -> None:
    radiometer = Specbos1211(served(Mock(Lamp()), Pty(), "half@14+"), timeout_s=1.0, fetch_timeout_s=0.2)
    radiometer.connect()
    with pytest.raises(Garbled, match=r"asked 5 times"):
        radiometer.measure()
    radiometer.close()


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never@12,never@13", NoAnswer, "no answer within 1 s to '*init'"),
        ("never@12", Garbled, r"answered '*init' with '\x07'"),
        ("never@13", NoAnswer, "no answer within 1.2 s to '*init'"),
        ("late=1.8@13", NoAnswer, "no answer within 1.2 s to '*init'"),
        ("wrong@12", Garbled, "answered '*init' with '?'"),
        ("error@13", Refused, "error 120"),
        ("error=123@13", Refused, "error 123, no integration time fits"),
        ("unplug=0.3@13", Disconnected, "the line broke"),
        ("unplug=0.3@14", Disconnected, "the line broke"),
    ],
)
def test_every_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], tmp_path: Path, fault: str, error: type[Exception], message: str
) -> None:
    address = served(Mock(Lamp()), Pty(tmp_path / "radiometer"), fault)
    radiometer = Specbos1211(address, timeout_s=1.0, measure_timeout_s=1.2, fetch_timeout_s=1.0)
    radiometer.connect()
    with pytest.raises(error) as caught:
        radiometer.measure()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    end = time.monotonic() + 30
    measured = None
    while measured is None and time.monotonic() < end:
        try:
            measured = radiometer.measure()
        except InstrumentError:
            time.sleep(0.05)
    assert measured is not None
    radiometer.close()


def test_stop_ends_a_measurement(served: Callable[..., str]) -> None:
    asked = threading.Event()
    radiometer = Specbos1211(
        served(Mock(Lamp(0.001, LampClock(real_time_factor=1.0))), Pty()),
        recorder=lambda direction, data: asked.set() if data.startswith(b"*init") else None,
    )
    radiometer.connect()
    errors: list[Exception] = []

    def measure() -> None:
        try:
            radiometer.measure()
        except InstrumentError as error:
            errors.append(error)

    thread = threading.Thread(target=measure)
    thread.start()
    assert asked.wait(30)
    radiometer.stop()
    thread.join(30)
    assert [type(error) for error in errors] == [Interrupted]
    radiometer.close()
