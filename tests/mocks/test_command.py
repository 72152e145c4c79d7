"""The processes `calibench mock` and `calibench bench`: what they print, where they answer, how they end."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import Disconnected
from drivers.registry import driver
from lab.capture.station import drivers_of, read_station
from mocks.command import station_toml

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a command; whatever still runs at the end of the test is ended."""
    running: list[subprocess.Popen[str]] = []

    def begin(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", "from mocks.command import commands; commands()", *arguments]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        root = Path(__file__).parent.parent.parent
        running.append(subprocess.Popen(command, text=True, cwd=root, **pipes))  # type: ignore[call-overload]
        return running[-1]

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def lines_until_ready(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    lines: list[str] = []
    for line in process.stdout:
        lines.append(line.rstrip("\n"))
        if lines[-1].startswith("ready"):
            return lines
    raise AssertionError(f"ended without being ready: {process.communicate()[1]}")


def test_a_mock_alone_answers_at_its_link_and_leaves_nothing_behind(start: Start, tmp_path: Path) -> None:
    link = tmp_path / "radiometer"
    process = start("mock", "specbos1211", "--link", str(link))
    assert lines_until_ready(process) == [f"ready {link}"]
    with serial.Serial(str(link), 921600, timeout=30) as port:
        port.write(b"*idn?\r")
        assert port.read_until(b"\r") == b"JETI_SB1211\r"
        port.write(b"*init\r")
        assert port.read(2) == b"\x06\x07"
        port.write(b"*fetch:XYZ\r")
        x, y, z = (float(port.read_until(b"\r").split()[1]) for _ in range(3))
    assert x > y > z > 0  # a tungsten lamp
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0
    assert not link.is_symlink()


def test_a_mock_alone_answers_on_a_tcp_port(start: Start) -> None:
    process = start("mock", "cornerstone260", "--tcp", "127.0.0.1:0", "--fault", "half@2")
    (ready,) = lines_until_ready(process)
    with serial.serial_for_url(ready.removeprefix("ready "), timeout=30) as port:
        port.write(b"WAVE?\r\n")
        assert port.read(10) == b"WAVE?\r\n0\r\n"
        port.write(b"GRAT?\n")
        assert port.read(12) == b"GRAT?\n1,1200"
        port.timeout = 0.3
        assert port.read(1) == b""
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0


def test_a_usb_mock_alone_is_exported_over_usbip(start: Start, tmp_path: Path) -> None:
    calibration = tmp_path / "calibration.csv"
    process = start("mock", "usb2000plus", "--calibration", str(calibration))
    (ready,) = lines_until_ready(process)
    make = driver("spectroradiometer", "usb2000plus")
    with make(ready.removeprefix("ready "), calibration=str(calibration), averages=1) as meter:
        assert meter.measure().radiance_w_sr_m2_nm.integral() > 0
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


def test_a_tethered_camera_says_what_its_table_needs(start: Start, tmp_path: Path) -> None:
    process = start("mock", "tethered", "--folder", str(tmp_path / "raws"), "--fault", "unplug=0.5@1")
    *table, ready = lines_until_ready(process)
    make = driver("camera", "raw_folder")
    with make(ready.removeprefix("ready "), settle_s=0.1, **tomllib.loads("\n".join(table))) as camera:
        camera.configure(0.005)
        with pytest.raises(Disconnected, match=r"can't be read \(No such file or directory\)"):
            camera.capture()
        end = time.monotonic() + 30
        while not (tmp_path / "raws").is_dir() and time.monotonic() < end:
            time.sleep(0.02)
        assert camera.capture().exposure_s == pytest.approx(0.005)
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("mock", "toaster"), "mock toaster: no such instrument; choose from cornerstone260"),
        (("mock", "pr655", "--fault", "sulk"), "no fault 'sulk'; choose from late"),
        (("mock", "pr655", "--tcp", "nowhere"), "write HOST:PORT"),
        (("mock", "pr655", "--tcp", "127.0.0.1:1", "--link", "/tmp/x"), "exclude one another"),
        (("mock", "pr655", "--link", "/no/such/folder/x"), "can't become a link"),
        (("mock", "u3v", "--link", "/tmp/x"), "no line that a path could name"),
        (("mock", "cr300", "--calibration", "x.csv"), "no calibration file comes with it"),
        (("mock", "tethered"), "name the folder that its software writes into: --folder"),
        (("mock", "tethered", "--folder", "x", "--fault", "error"), "a folder has no error code"),
        (("bench", "--fault", "half@3"), "write INSTRUMENT:SPEC"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_exit_code_2(
    start: Start, arguments: tuple[str, ...], complaint: str
) -> None:
    process = start(*arguments)
    said, errors = process.communicate(timeout=30)
    assert process.returncode == 2
    assert said == ""
    assert complaint in errors
    assert errors.count("\n") == 1


def test_the_bench_is_a_whole_station(start: Start, tmp_path: Path) -> None:
    """Every instrument is reached through its driver and the station file alone."""
    station_file = tmp_path / "station.toml"
    process = start("bench", "--station", str(station_file))
    lines = lines_until_ready(process)
    assert lines[-2:] == [f"station {station_file}", "ready"]
    assert {line.split()[0] for line in lines[:-2]} == {
        *("monochromator", "spectroradiometer", "light_source", "display", "stage"),
        *("cameras.left", "cameras.right"),
    }
    station = read_station(station_file)
    lab = drivers_of(station)
    assert lab.monochromator and lab.spectroradiometer and lab.display and lab.stage
    try:
        lab.stage.place("sphere")
        lab.monochromator.move_nm(550)
        lab.monochromator.open_shutter()
        lit = lab.spectroradiometer.measure().radiance_w_sr_m2_nm
        assert abs(lit.wavelength_nm[int(np.argmax(lit.value))] - 550) <= 2
        for camera in lab.cameras.values():
            camera.connect()
            camera.configure(0.01)
            assert camera.capture().raw.dtype == np.uint16
        lab.monochromator.close_shutter()
        assert max(lab.spectroradiometer.measure().radiance_w_sr_m2_nm.value) < 1e-3 * max(lit.value)
        assert lab.light_source is not None
        for channel, share in station.lights["3000 K"].channels.items():
            lab.light_source.set_level(share, channel)
        shone = lab.spectroradiometer.measure().radiance_w_sr_m2_nm
        assert abs(shone.wavelength_nm[int(np.argmax(shone.value))] - 635) <= 2  # the narrowest of the bright LEDs
        lab.light_source.stop()
        assert max(lab.spectroradiometer.measure().radiance_w_sr_m2_nm.value) < 1e-3 * max(shone.value)
        lab.stage.place("screen")
        lab.display.show(np.ones((8, 8), np.uint8), 64)
        assert max(lab.spectroradiometer.measure().radiance_w_sr_m2_nm.value) > 0
        lab.monochromator.move_nm(0)
        lab.monochromator.open_shutter()
    finally:
        for instrument in lab.all.values():
            instrument.close()
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert process.stderr is not None
    assert process.stderr.read() == ""


def test_the_bench_ends_with_its_parent(start: Start) -> None:
    process = start("bench", "--with-parent", "--serial-over-tcp")
    lines = lines_until_ready(process)
    assert re.fullmatch(r"monochromator cornerstone260 socket://127\.0\.0\.1:\d+", lines[0])
    assert process.poll() is None
    assert process.stdin is not None
    process.stdin.close()
    process.stdin = None
    assert process.wait(10) == 0


KEYS = st.text(st.characters(codec="utf-8"), min_size=1, max_size=6)
VALUES = st.recursive(
    st.one_of(
        st.integers(-(2**62), 2**62),
        st.floats(allow_nan=False, allow_infinity=False),
        st.booleans(),
        st.text(st.characters(codec="utf-8"), max_size=6),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(KEYS, st.dictionaries(KEYS, VALUES, max_size=4), max_size=3))
def test_a_station_file_says_what_it_was_told(targets: dict[str, object]) -> None:
    addresses = {"stage": {"driver": "operator", "address": "socket://h:1"}, "cameras.left": {"driver": "u3v"}}
    read = tomllib.loads(station_toml(addresses, {"targets": targets, "cameras": {"left": {"rows": 2, "lens": None}}}))
    assert read["targets"] == targets
    assert read["stage"] == addresses["stage"]
    assert read["cameras"] == {"left": {"driver": "u3v", "datasheet": {"rows": 2}}}
