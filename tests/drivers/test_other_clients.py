"""Clients that know nothing of calibench, on each mock after the project's driver has used the instrument and let it
go.

They are packages of the index (the extra `peers`); those spectroradiometers for which the index has none that this
environment takes are told their makers' commands on a plain serial port. For USB3 Vision cameras it has none, either;
seabreeze is what the driver of the Ocean Optics spectrometers stands on.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
import usb.core

from drivers.monochromator.cornerstone260 import Cornerstone260
from drivers.monochromator.cornerstone260b import Cornerstone260B
from drivers.photodiode.scpi import ScpiPhotodiode
from drivers.spectroradiometer.cr300 import Cr300
from drivers.spectroradiometer.ocean_optics import OceanOptics
from drivers.spectroradiometer.pr655 import Pr655
from drivers.spectroradiometer.specbos1211 import Specbos1211
from mocks.bench import Bench
from mocks.cornerstone260 import MockCornerstone260
from mocks.cornerstone260b import MockCornerstone260B
from mocks.cr300 import ColorimetryResearch
from mocks.lamp import Lamp, tristimulus
from mocks.pr655 import PhotoResearch
from mocks.scpi_meter import AREA_M2, DARK_A, NOISE_A, MockScpiMeter
from mocks.scpi_meter import calibration_csv as diode_calibration
from mocks.specbos1211 import MockSpecbos1211
from mocks.usb import InProcessBackend
from mocks.usb2000plus import PIXELS, MockUsb2000Plus, calibration_csv
from mocks.wire import Pty, Tcp
from tests.peers import missing

pytestmark = pytest.mark.extra  # others' clients


def client(name: str) -> Any:
    """The module of that name."""
    try:
        __import__(name)
    except ImportError as error:
        missing(f"{error}; `make peers` installs it")
    return sys.modules[name]


def test_cornerstone260_by_oriel_cornerstone_260(served: Callable[..., str], tmp_path: Path) -> None:
    other = client("oriel_cornerstone_260")
    address = served(MockCornerstone260(Bench()), Pty(tmp_path / "mono"))
    with Cornerstone260(address) as mono:
        mono.move_nm(500.0)
        mono.open_shutter()
    theirs = other.Monochromator(address)
    try:
        # were the handshake still on, a stray status byte would stand in the place of an answer
        assert theirs.position == pytest.approx(500.0)
        assert theirs.shuttered
        assert theirs.goto(632.8) == pytest.approx(632.8, abs=0.1)
        theirs.shutter(close=False)
        assert not theirs.shuttered
        theirs.set_filter(3)
        assert theirs.filter == 3
        assert theirs.slit_width(1, 800) == 800
        assert theirs.grating["lines"] == 1200
    finally:
        theirs.disconnect()
    with Cornerstone260(address) as mono:
        assert mono.wavelength_nm() == pytest.approx(632.8, abs=0.1)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_cornerstone260b_by_python_usbtmc() -> None:
    other = client("usbtmc")
    backend = InProcessBackend([MockCornerstone260B(Bench())])
    device = usb.core.find(backend=backend)
    with Cornerstone260B("usb://mock", device=device) as mono:
        mono.move_nm(500.0)
    theirs = other.Instrument(usb.core.find(backend=backend))
    try:
        assert "CS260B" in theirs.ask("*idn?")
        assert float(theirs.ask("wave?")) == pytest.approx(500.0, abs=0.1)
        theirs.write("gowave 600")
        assert theirs.ask("*opc?").strip() == "1"
        assert float(theirs.ask("wave?")) == pytest.approx(600.0, abs=0.1)
        assert theirs.ask("system:error?").startswith("0")
        theirs.write("nonsense 1")
        assert theirs.ask("system:error?").startswith("-113")
    finally:
        theirs.close()
    with Cornerstone260B("usb://mock", device=usb.core.find(backend=backend)) as mono:
        assert mono.wavelength_nm() == pytest.approx(600.0, abs=0.1)


def ask_as_the_manual_has_it(port: serial.Serial, command: str, lines: int = 1) -> list[list[str]]:
    """The fields of each line of an answer; commands end CR, lines CR LF."""
    port.write(command.encode("ascii") + b"\r")
    told = [port.readline() for _ in range(lines)]
    assert all(line.endswith(b"\r\n") for line in told)
    return [line.decode("ascii").strip().split(",") for line in told]


@pytest.mark.parametrize(
    ("model", "step_nm", "dialect", "header_lines"),
    [("PR-655", 4.0, "one-line", 1), ("PR-655", 4.0, "two-lines", 2), ("PR-670", 2.0, "one-line", 1)],
)
def test_pr655_by_the_makers_commands(
    served: Callable[..., str], tmp_path: Path, model: str, step_nm: float, dialect: str, header_lines: int
) -> None:
    """The maker's sequence (PR-655 manual, remote mode) on a plain serial port: the index has no client of a free
    licence."""
    address = served(PhotoResearch(Lamp(20.0), model=model, dialect=dialect), Pty(tmp_path / "pr"))
    with Pr655(address) as ours:
        expected = ours.measure().radiance_w_sr_m2_nm
    with serial.Serial(address, 9600, timeout=10.0) as port:
        for letter in b"PHOTO":
            port.write(bytes((letter,)))
        assert port.readline() == b" REMOTE MODE\r\n"
        assert ask_as_the_manual_has_it(port, "D111") == [["00000", model]]
        ((quality, serial_number),) = ask_as_the_manual_has_it(port, "D110")
        assert quality == "00000"
        assert ask_as_the_manual_has_it(port, "SS0") == [["0000"]]
        assert ask_as_the_manual_has_it(port, "M0") == [["00000"]]
        ((quality, _, luminance, _, _),) = ask_as_the_manual_has_it(port, "D1")
        assert quality == "00000"
        # photopic luminance, Km = 683 lm/W; the lamp drifts between two measurements by less than 1 %
        assert float(luminance) == pytest.approx(tristimulus(expected)[1], rel=0.01)
        points = round(400.0 / step_nm) + 1
        spectrum = ask_as_the_manual_has_it(port, "D5", header_lines + points)[header_lines:]
        port.write(b"Q")
    told_nm, told = np.array(spectrum, float).T
    np.testing.assert_allclose(told_nm, np.arange(380.0, 780.1, step_nm))
    own_nm, own = expected.arrays
    # two measurements of one lamp: 1 % of the spectrum's mean
    assert told == pytest.approx(np.interp(told_nm, own_nm, own), abs=0.01 * own.mean())
    with Pr655(address) as ours:
        assert (ours.identity().model, ours.identity().serial_number) == (model, serial_number)


def test_cr300_by_the_makers_commands(served: Callable[..., str], tmp_path: Path) -> None:
    """As its SDK puts them on the line; `colour-specio`, which does the same, wants an older numpy."""
    address = served(ColorimetryResearch(Lamp(20.0)), Pty(tmp_path / "cr"))
    with Cr300(address) as ours:
        expected = ours.measure().radiance_w_sr_m2_nm
    with serial.Serial(address, 115200, timeout=10.0) as port:

        def ask(command: str) -> str:
            port.write(command.encode("ascii") + b"\n")
            return port.readline().decode("ascii").strip()

        assert ask("RC Model") == "OK:0:RC Model:CR-300"
        assert ask("SM Speed 1") == "OK:0:SM Speed:No errors"
        assert ask("M") == "OK:0:M:No errors"
        head, _, told_range = ask("RM Spectrum").rpartition(":")
        assert head == "OK:0:RM Spectrum"
        first_nm, last_nm, step_nm, count = map(float, told_range.split(","))
        told = np.array([float(port.readline()) for _ in range(int(count))])
    told_nm = np.linspace(first_nm, last_nm, int(count))
    assert np.diff(told_nm) == pytest.approx(step_nm)
    own_nm, own = expected.arrays
    # two measurements of one lamp: 1 % of the spectrum's mean
    assert told == pytest.approx(np.interp(told_nm, own_nm, own), abs=0.01 * own.mean())
    with Cr300(address) as ours:
        assert ours.identity().model == "CR-300"


def test_specbos_by_the_makers_commands(served: Callable[..., str], tmp_path: Path) -> None:
    """The maker's sequence (specbos 1211, interface commands) on a plain serial port."""
    address = served(MockSpecbos1211(Lamp(20.0)), Pty(tmp_path / "specbos"))
    with Specbos1211(address) as ours:
        expected = ours.measure().radiance_w_sr_m2_nm
    with serial.Serial(address, 921600, timeout=10.0) as port:

        def told(command: str, end: bytes) -> bytes:
            port.write(command.encode("ascii") + b"\r")
            return port.read_until(end)

        assert told("*idn?", b"\r") == b"JETI_SB1211\r"
        for command in ("*conf:default", "*conf:func 6", "*conf:form 4", "*conf:wran 380 780 1"):
            assert told(command, b"\x06") == b"\x06"
        assert told("*init", b"\x07") == b"\x06\x07"
        assert told("*fetch:XYZ", b"\r").startswith(b"X: ")
        luminance, _ = (float(port.read_until(b"\r").split()[1]) for _ in range(2))
        # photopic luminance of two measurements of one lamp
        assert luminance == pytest.approx(tristimulus(expected)[1], rel=0.01)
    with Specbos1211(address) as ours:
        assert ours.identity().model == "specbos 1211"


def test_scpi_meter_by_pyvisa(served: Callable[..., str], tmp_path: Path) -> None:
    other = client("pyvisa")
    host, _, port = served(MockScpiMeter(Lamp(0.0)), Tcp("127.0.0.1", 0)).removeprefix("socket://").partition(":")
    address = f"TCPIP0::{host}::{port}::SOCKET"
    file = tmp_path / "diode.csv"
    file.write_text(diode_calibration())
    with ScpiPhotodiode(address, calibration=str(file), area_mm2=1e6 * AREA_M2, calibration_sd_percent=0.5) as ours:
        ours.measure_dark()
    manager = other.ResourceManager("@py")
    theirs = manager.open_resource(address, read_termination="\n", write_termination="\n", timeout=5000)
    try:
        assert theirs.query("*IDN?").split(",")[1] == "MODEL 6485"
        # 5 standard deviations of one reading
        assert float(theirs.query("READ?").split("A")[0]) == pytest.approx(DARK_A, abs=5.0 * NOISE_A)
        assert theirs.query("SYST:ERR?").startswith("0")
        # as pymeasure asks: a leading colon, long forms, and what IEEE 488.2 has of every instrument
        assert theirs.query(":SYSTem:ZCHeck?") == "0"
        assert float(theirs.query(":READ?").split("A")[0]) == pytest.approx(DARK_A, abs=5.0 * NOISE_A)
        assert theirs.query("*OPC?") == "1"
        assert int(theirs.query("*ESR?")) == 0  # our driver cleared it
        assert int(theirs.query("*STB?")) == 0
        theirs.write(":NONSENSE 1")
        assert int(theirs.query("*STB?")) & 0x04
        assert int(theirs.query("*ESR?")) & 0x20
        assert theirs.query(":SYST:ERR?").startswith("-113")
    finally:
        theirs.close()
        manager.close()


def test_usb2000plus_by_seabreeze(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from seabreeze import pyseabreeze
    from seabreeze.pyseabreeze.devices import SeaBreezeDevice
    from seabreeze.pyseabreeze.transport import USBTransportHandle
    from seabreeze.spectrometers import Spectrometer

    monkeypatch.setattr(Spectrometer, "_backend", pyseabreeze)  # that of pyusb, which takes a device
    backend = InProcessBackend([MockUsb2000Plus(Lamp(20.0))])
    file = tmp_path / "response.csv"
    file.write_text(calibration_csv())
    with OceanOptics("usb://mock", calibration=str(file), device=usb.core.find(backend=backend), averages=1) as ours:
        serial_number = ours.identity().serial_number
        ours.measure()
    theirs = Spectrometer(SeaBreezeDevice(USBTransportHandle(usb.core.find(backend=backend))))
    try:
        assert (theirs.model, theirs.serial_number) == ("USB2000PLUS", serial_number)
        theirs.integration_time_micros(1_000_000)
        counts = theirs.intensities()
        assert counts.size == PIXELS
        assert counts.max() > 2.0 * counts.min() > 0.0
    finally:
        theirs.close()
    with OceanOptics("usb://mock", calibration=str(file), device=usb.core.find(backend=backend), averages=1) as ours:
        assert ours.identity().serial_number == serial_number
