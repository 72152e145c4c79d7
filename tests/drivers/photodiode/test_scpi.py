"""The photodiode on a SCPI meter: irradiance with a true uncertainty, through PyVISA on a real socket."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyvisa", reason="PyVISA isn't installed (the extra `visa`)")

from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from drivers.photodiode.scpi import ScpiPhotodiode
from mocks.lamp import Lamp
from mocks.scpi_meter import AREA_M2, DARK_A, NOISE_A, MockScpiMeter, calibration_csv
from mocks.wire import Reply, Tcp
from sim.spectrum import Spectrum


class Line(Lamp):
    """Light of one wavelength."""

    def __init__(self, wavelength_nm: float, radiance_w_sr_m2: float) -> None:
        super().__init__()
        self.level = radiance_w_sr_m2
        self._at = wavelength_nm

    def radiance(self) -> Spectrum:
        at = np.arange(self._at - 2.0, self._at + 2.5, 1.0)
        return Spectrum.of(at, self.level * np.array([0.0, 0.25, 0.5, 0.25, 0.0]))


def visa(address: str) -> str:
    host, _, port = address.removeprefix("socket://").partition(":")
    return f"TCPIP0::{host}::{port}::SOCKET"


@pytest.fixture
def calibration(tmp_path: Path) -> str:
    file = tmp_path / "diode.csv"
    file.write_text(calibration_csv(departure_percent=0.0))
    return str(file)


def diode_at(address: str, calibration: str, **settings: Any) -> ScpiPhotodiode:
    known = {"area_mm2": 1e6 * AREA_M2, "calibration_sd_percent": 0.5, "timeout_s": 2.0} | settings
    return ScpiPhotodiode(visa(address), calibration=calibration, **known)


def test_golden_transcript(scripted: Callable[[str], Any], tmp_path: Path) -> None:
    file = tmp_path / "diode.csv"
    file.write_text("wavelength_nm,responsivity_a_per_w\n500,0.2\n600,0.2\n")
    peer = scripted("scpi-meter-driver.txt")
    with diode_at(peer.address, str(file), readings=2, area_mm2=100.0, calibration_sd_percent=1.0) as diode:
        measured = diode.measure(550.0)
        assert diode.identity().serial_number == "1234567"
    # 2 uA / (0.2 A/W x 1e-4 m2) = 0.1 W/m2; readings scatter by sqrt(2) uA, their mean by 1 uA = 0.05 W/m2; 1 % of 0.1.
    assert measured.irradiance_w_m2 == pytest.approx(0.1)
    assert measured.sd_irradiance_w_m2 == pytest.approx(np.hypot(0.05, 0.001))
    assert peer.strange == []


def test_golden_transcript_of_an_electrometer(scripted: Callable[[str], Any], tmp_path: Path) -> None:
    file = tmp_path / "diode.csv"
    file.write_text("wavelength_nm,responsivity_a_per_w\n500,0.2\n600,0.2\n")
    peer = scripted("scpi-electrometer-driver.txt")
    with diode_at(peer.address, str(file), readings=2, area_mm2=100.0, calibration_sd_percent=1.0) as diode:
        assert diode.measure(550.0).current_a == pytest.approx(2e-6, rel=1e-12)
        with pytest.raises(Garbled, match=r"answered 'READ\?' with .*ZADC.*: zero check is on"):
            diode.measure(550.0)
    assert peer.strange == []


class Answering(MockScpiMeter):
    """A meter whose readings are this text."""

    def __init__(self, reading: str) -> None:
        super().__init__(Line(550.0, 1.0))
        self.reading = reading

    def receive(self, data: bytes) -> list[bytes]:
        return [Reply(self.reading.encode() + b"\n")] if b"READ?" in data else super().receive(data)


@pytest.mark.parametrize(
    ("reading", "current_a"), [("12.5uA", 12.5e-6), ("1.25 mA", 1.25e-3), ("830 pA", 830e-12), (".5E-06", 5e-7)]
)
def test_readings_have_the_unit_that_the_meter_states(
    served: Callable[..., str], calibration: str, reading: str, current_a: float
) -> None:
    with diode_at(served(Answering(reading), Tcp("127.0.0.1", 0)), calibration, readings=2) as diode:
        assert diode.measure(550.0).current_a == pytest.approx(current_a, rel=1e-12)


@pytest.mark.parametrize(
    ("reading", "error", "reason"),
    [
        ("+1.2E-03NVDC", Garbled, "its unit is 'VDC', not A; .* `setup` has it measure a direct current"),
        ("1.25E-06 W", Garbled, "its unit is 'W', not A"),
        ("1,25E-06", Garbled, "it may have a decimal comma"),
        ("-9.910000E+37", Refused, "beyond its range; dim the light"),
        ("9.9E37,+1,+0", Refused, "beyond its range; dim the light"),
        ("NAN", Refused, "beyond its range; dim the light"),
    ],
)
def test_what_isnt_a_current_is_refused_in_one_line(
    served: Callable[..., str], calibration: str, reading: str, error: type[Exception], reason: str
) -> None:
    with diode_at(served(Answering(reading), Tcp("127.0.0.1", 0)), calibration, readings=2) as diode:
        with pytest.raises(error, match=reason) as refused:
            diode.measure(550.0)
        assert "\n" not in str(refused.value)


def test_irradiance_is_radiance_times_solid_angle(served: Callable[..., str], calibration: str) -> None:
    light = Line(550.0, 2.0)
    with diode_at(served(MockScpiMeter(light), Tcp("127.0.0.1", 0)), calibration) as diode:
        assert diode.identity().model == "MODEL 6485"
        light.level = 0.0
        # 10 readings: the dark current comes out within 4 sigma / sqrt(10).
        assert diode.measure_dark() == pytest.approx(DARK_A, abs=4 * NOISE_A / np.sqrt(10))
        light.level = 2.0
        measured = diode.measure(550.0)
    # 2 W/sr/m2 under 0.1 sr; the calibration is a line through points 10 nm apart, and the light is 2 nm wide: below
    # 1e-4.
    assert measured.irradiance_w_m2 == pytest.approx(0.2, rel=2e-4)
    assert measured.sd_irradiance_w_m2 == pytest.approx(0.005 * 0.2, rel=0.01)


def test_the_uncertainty_of_weak_light_is_that_of_the_readings(served: Callable[..., str], calibration: str) -> None:
    light = Line(550.0, 0.0)
    with diode_at(served(MockScpiMeter(light), Tcp("127.0.0.1", 0)), calibration, readings=5) as diode:
        diode.measure_dark()
        light.level = 1e-6
        found = [diode.measure(550.0) for _ in range(20)]
    # Without the dark's own error, which all share, 20 means of 5 scatter as sigma / sqrt(5); their sd is known to 1 /
    # sqrt(38).
    factor = found[0].irradiance_w_m2 / found[0].current_a
    scatter = np.std([one.irradiance_w_m2 for one in found], ddof=1)
    assert scatter == pytest.approx(NOISE_A / np.sqrt(5) * factor, rel=4 / np.sqrt(38))
    # Each says that, and the dark's: sqrt(2) of it; a sd from 4 + 4 degrees of freedom is good to 1 / sqrt(16), their
    # root mean square better.
    told = np.sqrt(np.mean([one.sd_irradiance_w_m2**2 for one in found]))
    assert told == pytest.approx(np.sqrt(2) * NOISE_A / np.sqrt(5) * factor, rel=0.75)


@pytest.mark.parametrize(
    ("fault", "error"),
    # *IDN? and SYST:ERR? when it connects; then a reading.
    [
        ("never@3", NoAnswer),
        ("wrong@3", InstrumentError),
        ("half@3", InstrumentError),
        ("unplug=0.3@3", InstrumentError),
    ],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], calibration: str, fault: str, error: type[Exception]
) -> None:
    address = served(MockScpiMeter(Line(550.0, 1.0)), Tcp("127.0.0.1", 0), fault)
    diode = diode_at(address, calibration, readings=2, timeout_s=0.5)
    diode.connect()
    with pytest.raises(error) as caught:
        diode.measure(550.0)
    assert "\n" not in str(caught.value)
    for _ in range(100):
        try:
            assert diode.measure(550.0).irradiance_w_m2 > 0
            break
        except InstrumentError:
            time.sleep(0.05)
    diode.close()


def test_a_wavelength_or_light_out_of_range_is_refused(served: Callable[..., str], calibration: str) -> None:
    with diode_at(served(MockScpiMeter(Line(550.0, 1e6)), Tcp("127.0.0.1", 0)), calibration) as diode:
        with pytest.raises(InstrumentError, match=r"1200 nm is outside its calibration's 300\.\.1100 nm"):
            diode.measure(1200)
        with pytest.raises(Refused, match="beyond its range; dim the light"):
            diode.measure(550)


def test_nobody_there_is_one_line(calibration: str) -> None:
    with pytest.raises(Disconnected, match=r"the line broke|can't be (opened|reached)"):
        diode_at("socket://127.0.0.1:1", calibration).connect()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"area_mm2": 0.0}, "area_mm2 = 0.0 isn't above 0"),
        ({"readings": 1}, "readings = 1 isn't above 1"),
        ({"calibration": "none.csv"}, "none.csv"),
    ],
)
def test_settings_are_checked(calibration: str, settings: dict[str, Any], said: str) -> None:
    with pytest.raises(InstrumentError, match=said):
        diode_at("socket://127.0.0.1:1", settings.pop("calibration", calibration), **settings)


@pytest.mark.timeout(60)
def test_a_line_that_never_ends_is_given_up(calibration: str) -> None:
    """A fast talker without line ends: PyVISA itself would read on for ever."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def babble() -> None:
            with listener.accept()[0] as host:
                try:
                    while True:
                        host.sendall(b"x" * 65536)
                except OSError:
                    return

        talker = threading.Thread(target=babble)
        talker.start()
        diode = diode_at(f"socket://127.0.0.1:{listener.getsockname()[1]}", calibration, timeout_s=0.5)
        with pytest.raises(Garbled, match="sends without end, 'xxx"):
            diode.connect()
        talker.join(30)
        assert not talker.is_alive()


def test_a_late_first_answer_fails_one_call_alone(served: Callable[..., str], calibration: str) -> None:
    address = served(MockScpiMeter(Line(550.0, 1.0)), Tcp("127.0.0.1", 0), "late=0.8@1")
    diode = diode_at(address, calibration, readings=2, timeout_s=0.5)
    with pytest.raises(NoAnswer):
        diode.connect()
    assert diode.measure(550.0).irradiance_w_m2 > 0
    diode.close()


class _Behind(MockScpiMeter):
    """One that answers what an earlier connection asked before it tells its identity, and tells it that one, too."""

    def receive(self, data: bytes) -> list[bytes]:
        answers = super().receive(data)
        return [Reply(b"+1.2E-06A,+0.0,0\n"), *answers, *answers] if b"*IDN?" in data else answers


def test_late_answers_to_an_earlier_connection_are_left_out(served: Callable[..., str], calibration: str) -> None:
    with diode_at(served(_Behind(Line(550.0, 1.0)), Tcp("127.0.0.1", 0)), calibration) as diode:
        assert diode.identity().model == "MODEL 6485"
        assert diode.measure(550.0).readings == 10
