"""Connected instruments are found, tested and written into a station file that can be read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.discovery import Found, probe, usbip_devices
from drivers.errors import Disconnected, InstrumentError, InUse
from drivers.instrument import Identity
from lab.capture.self_test import check_station, record_transcript, station_text
from lab.capture.station import Station, read_station
from lab.errors import DeviceError, InputError
from mocks.bench import Bench
from mocks.cornerstone260b import MockCornerstone260B
from mocks.peers import cornerstone260, pr655
from mocks.usb import UsbIpServer, serve_usbip, stereo_pair
from mocks.usb2000plus import MockUsb2000Plus


@pytest.fixture(scope="module")
def server() -> Iterator[UsbIpServer]:
    bench = Bench()
    with serve_usbip((*stereo_pair(bench), MockCornerstone260B(bench), MockUsb2000Plus(bench))) as server:
        yield server


def where(server: UsbIpServer) -> str:
    return "{}:{}".format(*server.address)


def test_usb_instruments_are_told_by_what_they_are(server: UsbIpServer) -> None:
    found = {one.address.rpartition("/")[2]: one.driver for one in usbip_devices(where(server))}
    assert found == {
        "CB-U3V-0001": "camera.u3v",
        "CB-U3V-0002": "camera.u3v",
        "CB-260B-01": "monochromator.cornerstone260b",
        "USB2+F00001": "spectroradiometer.ocean_optics",
    }
    with pytest.raises(Disconnected, match=r"no USB/IP server at 127\.0\.0\.1:1 \(Connection refused\); start"):
        list(usbip_devices("127.0.0.1:1"))


def test_a_station_file_of_what_is_connected_can_be_read(server: UsbIpServer, tmp_path: Path) -> None:
    file = tmp_path / "station.toml"
    file.write_text(station_text(usbip_devices(where(server))))
    station = read_station(file)
    assert {side: (c.datasheet.rows, c.datasheet.cols, c.datasheet.cfa) for side, c in station.cameras.items()} == {
        "left": (480, 640, "RGGB"),
        "right": (480, 640, "RGGB"),
    }
    assert (station.limits.exposure_min_s, station.limits.exposure_max_s) == (1e-5, 10.0)  # cameras of 10 us to 60 s
    assert [camera.settings for camera in station.cameras.values()] == [{}, {"trigger_line": "Software"}]
    assert station.monochromator is not None
    assert station.monochromator.driver == "cornerstone260b"
    assert station.spectroradiometer is not None
    assert station.spectroradiometer.settings == {"calibration": ""}  # to be filled in


def test_without_a_camera_there_is_no_station() -> None:
    with pytest.raises(DeviceError, match="no camera is connected that a driver here reaches"):
        station_text([Found("/dev/ttyUSB0", "serial port: adapter")])


def test_a_serial_port_is_asked_who_is_there() -> None:
    with pr655() as peer:
        answers = dict(probe(peer.address))
        assert list(answers)[-1] == "spectroradiometer.pr655"
        assert isinstance(answers["spectroradiometer.pr655"], Identity)
        assert isinstance(answers["spectroradiometer.cr300"], InstrumentError)


def station_of(server: UsbIpServer, monochromator: str) -> Station:
    camera = {
        "driver": "u3v",
        "address": server.url("CB-U3V-0001"),
        "timeout_s": 60.0,
        "datasheet": {"rows": 480, "cols": 640, "cfa": "RGGB", "bit_depth": 12},
    }
    mono = {"driver": "cornerstone260", "address": monochromator, "timeout_s": 0.5}
    return Station.model_validate({"cameras": {"left": camera}, "monochromator": mono})


def test_a_station_is_tested_in_words(server: UsbIpServer, tmp_path: Path) -> None:
    with cornerstone260() as peer:
        station = station_of(server, peer.address)
        assert [(test.name, test.works) for test in check_station(station)] == [
            ("monochromator", True),
            ("camera left", True),
        ]
        file = tmp_path / "mono.txt"
        assert record_transcript(station, "monochromator", file).works
        assert "> INFO?\\r\\n\n" in file.read_text()
        with pytest.raises(InputError, match=r"the station has no stage; it has monochromator, cameras\.left"):
            record_transcript(station, "stage", file)
        peer.mute(True)
        silent = check_station(station)[0]
        assert not silent.works
        assert "no answer within 0.5 s" in silent.words


def test_a_port_in_use_is_said_as_such() -> None:
    from drivers.monochromator.cornerstone260 import Cornerstone260

    with cornerstone260() as peer, Cornerstone260(peer.address), pytest.raises(InUse, match="this port is in use"):
        list(probe(peer.address))
