"""The driver that measures through Argyll's spotread: against the golden transcript, against the mock as a program, and
when things go wrong. `tests/drivers/test_spotread.py` has spotread itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.errors import Disconnected, Garbled, InstrumentError, InUse, NoAnswer, Refused
from drivers.spectroradiometer import argyll
from drivers.spectroradiometer.argyll import Argyll
from mocks.lamp import Lamp
from mocks.peers import spotread_command
from mocks.spotread import MockSpotread
from mocks.wire import Tcp


def tcp() -> Tcp:
    return Tcp("127.0.0.1", 0)


@pytest.fixture
def program(served: Callable[..., str]) -> Callable[..., str]:
    """Start a mock; gives the program that speaks for it."""

    def start(mock: MockSpotread, faults: str = "") -> str:
        return spotread_command(served(mock, tcp(), faults))

    return start


def test_golden_transcript(scripted: Callable[[str], Any]) -> None:
    peer = scripted("spotread-driver.txt")
    with Argyll("1", program=spotread_command(peer.address), high_resolution=True) as radiometer:
        measured = radiometer.measure()
        identity = radiometer.identity()
        assert radiometer.departures() == ("it has no spectra in finer steps: high_resolution is ignored",)
    assert (identity.model, identity.serial_number, identity.firmware) == ("JETI_SDCM3 1501427", "1211427", "V2.1.4")
    radiance = measured.radiance_w_sr_m2_nm
    assert radiance.wavelength_nm == tuple(np.arange(350.0, 831.0))
    assert (radiance.value[0], radiance.value[-1]) == pytest.approx((0.0321767e-3, 1.77495e-3), rel=1e-12)
    assert measured.serial_number == "1211427"
    assert peer.strange == [] and peer.requests[0] == b"spotread -v -e -s -N -H -c 1\n"


@pytest.mark.parametrize(("high", "steps"), [(False, 36), (True, 106)])
@pytest.mark.parametrize("address", ["1", "i1 pro"])
def test_round_trip_with_the_mock(program: Callable[..., str], high: bool, steps: int, address: str) -> None:
    lamp = Lamp(20.0)
    with Argyll(address, program=program(MockSpotread(lamp)), high_resolution=high) as radiometer:
        assert radiometer.identity().model == "i1 Pro" and radiometer.identity().serial_number == "310427"
        wavelength_nm, value = radiometer.measure().radiance_w_sr_m2_nm.arrays
        assert radiometer.settings() == {"mode": "emissive", "high_resolution": high}
        assert radiometer.departures() == ()
    np.testing.assert_allclose(wavelength_nm, np.linspace(380.0, 730.0, steps))
    np.testing.assert_allclose(value, lamp.radiance().at(wavelength_nm), rtol=6e-6)  # six digits are printed


# Starting is the first answer, a reading the second.
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("never@2", NoAnswer), ("half@2", NoAnswer), ("error=2@1", Refused), ("error=4@1", Disconnected),
    ],
)  # fmt: skip
def test_a_fault_is_one_error_and_then_it_works_again(
    program: Callable[..., str], fault: str, error: type[InstrumentError]
) -> None:
    radiometer = Argyll("1", program=program(MockSpotread(Lamp(20.0)), fault), timeout_s=5.0, measure_timeout_s=1.0)
    radiometer.connect()
    with pytest.raises(error) as caught:
        radiometer.measure()
    assert "\n" not in str(caught.value)
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 36
    radiometer.close()


def test_a_misread_is_tried_again_and_two_are_refused(program: Callable[..., str]) -> None:
    mock = MockSpotread(Lamp(20.0))
    with Argyll("1", program=program(mock)) as radiometer:
        mock.fail_next(None)
        assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 36
    with Argyll("1", program=program(MockSpotread(Lamp(1e6)))) as bright:
        with pytest.raises(Refused, match=r"misread \(Overexposure\); dim the light") as caught:
            bright.measure()
        assert caught.value.code == argyll.MISREAD


def test_a_sensor_in_the_wrong_position_is_told_with_its_remedy(program: Callable[..., str]) -> None:
    mock = MockSpotread(Lamp(20.0))
    with Argyll("1", program=program(mock)) as radiometer:
        mock.fail_next(2)
        with pytest.raises(Refused, match="wrong position; turn it to where it measures"):
            radiometer.measure()
        assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 36


def test_a_calibration_is_asked_of_a_person_and_the_port_is_let_go(program: Callable[..., str]) -> None:
    asked = (
        r"needs a calibration \(Place the instrument on its reflective white reference S/N 310427\); run `spotread -e`"
    )
    uncalibrated = Argyll("1", program=program(MockSpotread(Lamp(20.0), calibrated=False)))
    with pytest.raises(Refused, match=asked):
        uncalibrated.connect()
    mock = MockSpotread(Lamp(20.0))
    radiometer = Argyll("1", program=program(mock))
    radiometer.connect()
    mock.fail_next(3)
    with pytest.raises(Refused, match=asked) as caught:
        radiometer.measure()
    assert caught.value.code == argyll.NEEDS_CALIBRATION
    assert radiometer._line.pid is None  # who calibrates has the port
    with pytest.raises(Refused, match=asked):
        radiometer.measure()
    mock._calibrated = True  # a person did, with spotread
    assert len(radiometer.measure().radiance_w_sr_m2_nm.value) == 36
    radiometer.close()


def test_what_is_not_there_is_one_line(program: Callable[..., str]) -> None:
    here = program(MockSpotread(Lamp(20.0)))
    for made, error, message in (
        (Argyll("2", program=here), Disconnected, "no instrument there; plug it in, and compare the address"),
        (Argyll("Spyder", program=here), Disconnected, r"0 of the instruments .*\(1 = usb:/bus1/dev5 \(GretagMacbeth"),
        (Argyll("1", program="none-such"), Disconnected, r"none-such can't be started \(No such file or directory\)"),
        (Argyll("i1", program="none-such"), Disconnected, r"none-such can't be started \(No such file or directory\)"),
        (Argyll("1", program="sh -c 'echo Unknown, inappropriate or no instrument detected' sh"), Disconnected,
         "no instrument there"),
        (Argyll("1", program="sh -c 'echo Setting up; echo Device or resource busy' sh"), InUse, "close the other"),
        (Argyll("1", program="sh -c 'echo good morning' sh"), Disconnected, "its program ended: good morning"),
        (Argyll("1", program="true"), Disconnected, "its program ended without a word"),
        (Argyll("1", program="sleep 60 #", timeout_s=0.5), Disconnected, "its program ended"),  # wrong arguments
        (Argyll("1", program="sh -c 'exec sleep 60' sh", timeout_s=0.5), NoAnswer, "no answer within 0.5 s"),
        (Argyll("i1", program="sh -c 'exec sleep 60' sh", timeout_s=0.5), NoAnswer, "no list of instruments within"),
    ):  # fmt: skip
        with pytest.raises(error, match=message) as caught:
            made.connect()
        assert "\n" not in str(caught.value)
        made.close()
    with pytest.raises(InstrumentError, match="mode 'ambient' isn't one of emissive, telephoto"):
        Argyll("1", mode="ambient")  # type: ignore[arg-type]


READING = "printf 'any other key to take a reading: '; read key; printf '{}any other key to take a reading: '; read key"


@pytest.mark.parametrize(
    ("printed", "error", "message"),
    [
        ("Spectrum from 380 to 400 nm in 3 steps\\n1, 2\\n", Garbled, "for a spectrum; check that `program`"),
        ("Spectrum from 380 to 400 nm in 3 steps\\n1, 2, nan\\n", Garbled, "for a spectrum; check that `program`"),
        ("Spectrum from 400 to 380 nm in 2 steps\\n1, 2\\n", Garbled, "for a spectrum; check that `program`"),
        ("Spectrum from x to 400 nm in 2 steps\\n1, 2\\n", Garbled, "for a spectrum; check that `program`"),
        (" Result is XYZ: 1 2 3, D50 Lab: 1 2 3\\n", Refused, "colours and no spectrum; a spectrometer is needed"),
        ("good morning\\n", Garbled, "printed 'good morning"),
    ],
)
def test_what_is_no_spectrum_is_one_line(printed: str, error: type[InstrumentError], message: str) -> None:
    script = READING.format(printed).replace('"', '\\"')
    radiometer = Argyll("1", program=f'sh -c "{script}" sh')
    with pytest.raises(error, match=message) as caught:
        radiometer.measure()
    assert "\n" not in str(caught.value)
    radiometer.close()
