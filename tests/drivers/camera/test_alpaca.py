"""ASCOM Alpaca cameras, on the server of alpaca-simulators; and on answers that no server ought to give."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest

from drivers.alpaca import AlpacaDevice
from drivers.camera.alpaca import AlpacaCamera
from drivers.errors import Disconnected, Garbled, InstrumentError, InUse, NoAnswer, Refused
from drivers.found_settings import FoundSettings
from mocks.peers import AlpacaSimulator
from tests.peers import missing

pytestmark = pytest.mark.extra  # a simulator of another maker's

#: As `mocks.peers.ALPACA_DEVICES` has them.
FOUND = {"binx": 2, "biny": 2, "startx": 8, "starty": 4, "numx": 200, "numy": 100, "connected": False}


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[AlpacaSimulator]:
    FoundSettings.keep_in(tmp_path / "instruments")
    try:
        found = AlpacaSimulator()
    except InstrumentError as error:
        missing(str(error))
    with found:
        yield found


@pytest.fixture
def stranger(peer: AlpacaSimulator) -> AlpacaDevice:
    """Another client of the server's camera."""
    return AlpacaDevice(peer.address, "camera", lambda: 10.0, lambda direction, data: None)


def test_frames_are_the_whole_sensors(peer: AlpacaSimulator) -> None:
    with AlpacaCamera(peer.address, **peer.settings) as camera:
        camera.configure(0.01)
        sensor, frame = camera.sensor(), camera.capture()
        assert camera.identity().model == "Simulator Camera"
        # Its colour filters are RGGB from one column further on.
        assert (sensor.rows, sensor.cols, sensor.cfa, sensor.bit_depth) == (480, 640, "GRBG", 12)
        assert sensor.pixel_pitch_um == 3.45
        assert (frame.raw.shape, frame.raw.dtype, frame.temperature_c) == ((480, 640), np.uint16, -5.0)
        np.testing.assert_array_equal(frame.raw, np.random.default_rng(1).integers(900, 1100, (480, 640)))
        assert camera.settings()["maxadu"] == 4095


def test_it_is_left_as_it_was_found(peer: AlpacaSimulator, stranger: AlpacaDevice, tmp_path: Path) -> None:
    assert {name: stranger.get(name) for name in FOUND} == FOUND
    camera = AlpacaCamera(peer.address, **peer.settings)
    camera.configure(0.01)
    assert {name: stranger.get(name) for name in FOUND} != FOUND
    (file,) = (tmp_path / "instruments").iterdir()
    kept = file.read_text()
    camera.close()
    assert {name: stranger.get(name) for name in FOUND} == FOUND
    assert not (tmp_path / "instruments").exists()
    # As a process left it that was killed: changed, and told on disk what it was.
    for name, argument in (("connected", "Connected"), ("binx", "BinX"), ("biny", "BinY")):
        stranger.put(name, **{argument: 1})
    file.parent.mkdir(parents=True)
    file.write_text(kept)
    with AlpacaCamera(peer.address, **peer.settings):
        pass
    assert {name: stranger.get(name) for name in FOUND} == FOUND


def test_it_goes_on_with_a_server_that_was_started_again(peer: AlpacaSimulator) -> None:
    with AlpacaCamera(peer.address, **peer.settings) as camera:
        camera.configure(0.01)
        peer.unplug()
        peer.plug()  # binned again, as it starts
        with pytest.raises(Garbled, match=r"a frame has \(100, 200\) pixels"):
            camera.capture()
        assert camera.capture().raw.shape == (480, 640)


def test_a_server_that_another_uses_stays_connected(peer: AlpacaSimulator, stranger: AlpacaDevice) -> None:
    stranger.put("connected", Connected=True)
    with AlpacaCamera(peer.address, **peer.settings):
        pass
    assert stranger.get("connected") is True


def test_a_gain_that_is_another_than_was_set_is_told(peer: AlpacaSimulator) -> None:
    """The simulator counts from 0 when it is set, and from 1 when it is asked."""
    with (
        AlpacaCamera(peer.address, gain_db_per_unit=1.0, **peer.settings) as camera,
        pytest.raises(InstrumentError, match="a gain of 2 was set and 3 is read; its driver counts otherwise"),
    ):
        camera.configure(0.01, 2.0)


def test_two_drivers_are_not_one_cameras(peer: AlpacaSimulator) -> None:
    with AlpacaCamera(peer.address, **peer.settings) as camera:
        with pytest.raises(InUse, match="another driver on this computer uses it"):
            AlpacaCamera(peer.address, **peer.settings).connect()
        camera.configure(0.01)
        assert camera.capture().raw.shape == (480, 640)
    with AlpacaCamera(peer.address, **peer.settings):
        pass


def test_what_it_lacks_is_named(peer: AlpacaSimulator) -> None:
    for settings, message in (
        ({"readout_mode": "Slow"}, "no readout mode 'Slow'; it has Fast, Normal"),
        ({"gain_db_per_unit": 1.0}, r"gain 5 is outside 0\.\.2; ask for another"),
        ({}, "the unit of its gain isn't known, so 5 dB can't be set"),
    ):
        with (
            pytest.raises(InstrumentError, match=message) as raised,
            AlpacaCamera(peer.address, **(peer.settings | settings)) as camera,
        ):
            camera.configure(0.01, 5.0)
        assert "\n" not in str(raised.value)
    with pytest.raises(Refused, match=r"'interfaceversion' failed with 0x400"):
        AlpacaCamera(peer.address.replace("/0", "/7"), **peer.settings)._device.get("interfaceversion")


@pytest.mark.parametrize("address", ["", "host:port/0", "https://host/0", "host:11111/first"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(InstrumentError, match="isn't an Alpaca device's address; write host:port/NUMBER"):
        AlpacaCamera(address)


def test_no_server(tmp_path: Path) -> None:
    with pytest.raises(Disconnected, match="check that its server runs at this address"):
        AlpacaCamera("127.0.0.1:9/0", timeout_s=1.0).connect()


@pytest.fixture
def answering() -> Iterator[Callable[[str, bytes, float], AlpacaDevice]]:
    """A server that answers everything alike: a content type, a body, and how long (s) it takes for each byte."""
    servers: list[HTTPServer] = []

    def start(kind: str, body: bytes, a_byte_s: float = 0.0) -> AlpacaDevice:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.end_headers()
                for value in [body] if not a_byte_s else [body[k : k + 1] for k in range(len(body))]:
                    try:
                        self.wfile.write(value)
                    except OSError:
                        return
                    if threading.Event().wait(a_byte_s):
                        return

            def log_message(self, format: str, *args: object) -> None:
                """Quiet."""

        servers.append(HTTPServer(("127.0.0.1", 0), Handler))
        threading.Thread(target=servers[-1].serve_forever, args=(0.05,), daemon=True).start()
        host, port = servers[-1].server_address[:2]
        return AlpacaDevice(f"{host!s}:{port}/0", "camera", lambda: 0.5, lambda direction, data: None)

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def _image_bytes(sent_as: int, rank: int, cols: int, rows: int, pixels: bytes, error: int = 0) -> bytes:
    return struct.pack("<11i", 1, error, 0, 0, 44, 2, sent_as, rank, cols, rows, 0) + pixels


def test_a_picture_in_each_form(answering: Callable[..., AlpacaDevice]) -> None:
    wanted = np.arange(6).reshape(2, 3)  # two rows of three
    columns = np.ascontiguousarray(wanted.T)
    for code, kind in {1: "<i2", 2: "<i4", 6: "u1", 8: "<u2", 9: "<u4"}.items():
        device = answering("application/imagebytes", _image_bytes(code, 2, 3, 2, columns.astype(kind).tobytes()))
        np.testing.assert_array_equal(device.image(), wanted)
    device = answering("application/json", b'{"Value": [[0, 3], [1, 4], [2, 5]], "Rank": 2, "ErrorNumber": 0}')
    np.testing.assert_array_equal(device.image(), wanted)


@pytest.mark.parametrize(
    ("kind", "body", "raised", "message"),
    [
        ("application/imagebytes", _image_bytes(8, 2, 3, 2, b"\0" * 10), Garbled, "a picture of 5 pixels, 3 x 2"),
        ("application/imagebytes", _image_bytes(8, 3, 3, 2, b""), Garbled, "a picture of rank 3"),
        ("application/imagebytes", _image_bytes(8, 2, 0, 0, b"too hot", 0x500), Refused, r"0x500 \(too hot\)"),
        ("application/imagebytes", b"short", Garbled, "a picture of 5 bytes"),
        ("text/html", b"<html>\n<h1>Router</h1>", Garbled, "is an Alpaca server at this address"),
        ("application/json", b"[1]", Garbled, "is an Alpaca server at this address"),
        ("application/json", b'{"ErrorNumber": 1031, "ErrorMessage": "gone"}', Disconnected, "has lost it"),
        ("application/json", b'{"ErrorNumber": 1036, "ErrorMessage": "a\\nb"}', Refused, r"0x40c \(a b\)"),
    ],
)
def test_answers_that_are_none(
    answering: Callable[..., AlpacaDevice], kind: str, body: bytes, raised: type[InstrumentError], message: str
) -> None:
    with pytest.raises(raised, match=message) as found:
        answering(kind, body).image()
    assert "\n" not in str(found.value)


def test_an_answer_that_drips_is_given_up(answering: Callable[..., AlpacaDevice]) -> None:
    """A limit between bytes alone would wait 100 s for it."""
    with pytest.raises(NoAnswer, match=r"no answer within 0\.5 s to 'gain'"):
        answering("application/json", b'{"Value": 1}' + b" " * 1000, 0.1).get("gain")
