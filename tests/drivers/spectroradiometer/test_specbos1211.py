"""The specbos 1211's driver: against the golden transcript, against the mock on a real line, and when things go
wrong."""

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


def test_golden_transcript_of_a_spectraval(scripted: Callable[[str], Any]) -> None:
    peer = scripted("spectraval1501-driver.txt")
    with Specbos1211(peer.address, from_nm=500, to_nm=502) as radiometer:
        measured = radiometer.measure()
        assert radiometer.identity().model == "spectraval 1501"
    assert measured.radiance_w_sr_m2_nm.wavelength_nm == (500.0, 501.0, 502.0)
    assert measured.radiance_w_sr_m2_nm.value == (1e-3, 2e-3, 3e-3)
    assert measured.integration_time_s is None
    assert peer.strange == []


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


def test_a_range_outside_the_calibration_is_refused_before_it_measures(served: Callable[..., str]) -> None:
    radiometer = Specbos1211(served(Mock(Lamp()), Pty()), from_nm=300)
    with pytest.raises(
        InstrumentError, match=r"300\.\.1000 nm isn't within the 350\.\.1000 nm for which it is calibrated"
    ):
        radiometer.measure()
    radiometer.close()


@pytest.mark.parametrize("model", ["specbos 1201", "specbos 1211", "spectraval 1501"])
def test_every_model_measures_as_far_as_it_is_calibrated(served: Callable[..., str], model: str) -> None:
    """A 1201 with firmware 1.8.3 doesn't know maxtin; a spectraval has other commands."""
    lamp = Lamp(20.0)
    with Specbos1211(served(Mock(lamp, model=model, calibrated_nm=(380.0, 780.0)), Pty())) as radiometer:
        assert radiometer.identity().model == model
        measured = radiometer.measure().radiance_w_sr_m2_nm
    assert (measured.wavelength_nm[0], measured.wavelength_nm[-1]) == (380.0, 780.0)
    # Half of the last digit: a spectraval sends one fewer.
    rtol = 5e-6 if model.startswith("spectraval") else 5e-7
    np.testing.assert_allclose(measured.value, lamp.radiance().at(np.arange(380, 781)), rtol=rtol)


def test_a_unit_that_claims_more_than_it_is_calibrated_for_is_asked_for_less(served: Callable[..., str]) -> None:
    lamp = Lamp(20.0)
    unit = Mock(lamp, calibrated_nm=(360.0, 800.0), told_nm=(330.0, 1020.0))
    with Specbos1211(served(unit, Pty())) as radiometer:
        measured = radiometer.measure().radiance_w_sr_m2_nm
        assert (measured.wavelength_nm[0], measured.wavelength_nm[-1]) == (380.0, 780.0)
        np.testing.assert_allclose(measured.value, lamp.radiance().at(np.arange(380, 781)), rtol=5e-7)
        # once it has measured, a range that gets narrower by itself would be a session of two kinds of spectra
        unit.fail_next(141)
        with pytest.raises(Refused, match="error 141, outside the calibrated range"):
            radiometer.measure()
        assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 401


def test_a_range_that_the_station_asks_for_isnt_narrowed(served: Callable[..., str]) -> None:
    unit = Mock(Lamp(20.0), calibrated_nm=(360.0, 800.0), told_nm=(350.0, 1000.0))
    with (
        Specbos1211(served(unit, Pty()), from_nm=380, to_nm=900) as radiometer,
        pytest.raises(Refused, match="error 141, outside the calibrated range; ask for wavelengths within"),
    ):
        radiometer.measure()


def test_enq_inside_replies_is_passed_over(served: Callable[..., str]) -> None:
    class Enquiring(Mock):
        def receive(self, data: bytes) -> list[bytes]:
            return [type(piece)(b"\x05" + piece[:3] + b"\x05" + piece[3:]) for piece in super().receive(data)]

    with Specbos1211(served(Enquiring(Lamp()), Pty())) as radiometer:
        assert radiometer.identity().serial_number == "1211427"
        assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 651


# Connecting takes 13 answers (*idn?, *para:spnum?, *vers?, 7 settings, both ends of the range, the range); then *init
# (14), its end (15), the fetch (16).
@pytest.mark.parametrize("fault", ["half@16", "drop@16", "wrong@16", "never@16", "half@16,half@17,half@18,half@19"])
def test_a_broken_fetch_is_asked_for_again(served: Callable[..., str], fault: str) -> None:
    radiometer = Specbos1211(served(Mock(Lamp()), Pty(), fault), timeout_s=1.0, fetch_timeout_s=1.0)
    radiometer.connect()
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 651
    radiometer.close()


def test_a_fetch_that_stays_broken_is_given_up_after_five(served: Callable[..., str]) -> None:
    radiometer = Specbos1211(served(Mock(Lamp()), Pty(), "half@16+"), timeout_s=1.0, fetch_timeout_s=0.2)
    radiometer.connect()
    with pytest.raises(Garbled, match=r"asked 5 times"):
        radiometer.measure()
    radiometer.close()


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never@14,never@15", NoAnswer, "no answer within 1 s to '*init'"),
        ("never@14", Garbled, r"answered '*init' with '\x07'"),
        ("never@15", NoAnswer, "no answer within 1.2 s to '*init'"),
        ("late=1.8@15", NoAnswer, "no answer within 1.2 s to '*init'"),
        ("wrong@14", Garbled, "answered '*init' with '?'"),
        ("error@15", Refused, "error 120"),
        ("error=123@15", Refused, "error 123, no integration time fits"),
        ("unplug=0.3@15", Disconnected, "the line broke"),
        ("unplug=0.3@16", Disconnected, "the line broke"),
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
