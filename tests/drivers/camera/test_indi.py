"""INDI cameras, on the CCD simulator of INDI's own server; and on answers that no server ought to give."""

from __future__ import annotations

import socket
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from drivers.camera.indi import IndiCamera
from drivers.errors import Disconnected, Garbled, InstrumentError, InUse, NoAnswer
from drivers.found_settings import FoundSettings
from drivers.indi import IndiDevice
from mocks.peers import IndiSimulator
from tests.peers import missing

pytestmark = pytest.mark.extra  # a simulator of another maker's

FOUND = {
    "CCD_BINNING": "HOR_BIN=2;VER_BIN=2",
    "CCD_FRAME": "X=16;Y=8;WIDTH=256;HEIGHT=128",
    "CCD_FRAME_TYPE": "FRAME_DARK",
    "CCD_GAIN": "GAIN=20",
    "CONNECTION": "CONNECT",
}


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[IndiSimulator]:
    FoundSettings.keep_in(tmp_path / "instruments")
    try:
        found = IndiSimulator()
    except InstrumentError as error:
        missing(str(error))
    with found:
        yield found


@pytest.fixture
def stranger(peer: IndiSimulator) -> Iterator[IndiDevice]:
    """Another client, who left the camera set to what it wanted."""
    device = IndiDevice(peer.address, lambda: 10.0, lambda direction, data: None)
    device.open()
    device.connect(*FOUND)
    for name, value in FOUND.items():
        device.set(name, value)
    yield device
    device.close()


def _seen_by(device: IndiDevice) -> dict[str, object]:
    device.open()
    device.connect(*FOUND)
    return {name: device.get(name) for name in FOUND}


def test_frames_are_the_whole_sensors(peer: IndiSimulator) -> None:
    with IndiCamera(peer.address, **peer.settings) as camera:
        camera.configure(0.02)
        sensor, frames = camera.sensor(), [camera.capture() for _ in range(3)]
        assert camera.identity().maker == "indi_simulator_ccd"
        assert (sensor.rows, sensor.cols, sensor.cfa, sensor.bit_depth) == (512, 512, "MONO", 16)
        assert [frame.frame_id for frame in frames] == [0, 1, 2]
        assert frames[0].raw.shape == (512, 512)
        assert np.unique(frames[0].raw).size > 1
        assert camera.settings()["CCD_BINNING"] == "HOR_BIN=1;VER_BIN=1"


def test_it_is_left_as_it_was_found(peer: IndiSimulator, stranger: IndiDevice, tmp_path: Path) -> None:
    camera = IndiCamera(peer.address, gain_db_per_unit=0.1, gain_at_0_db=10.0, **peer.settings)
    camera.configure(0.02, 1.0)
    changed = _seen_by(stranger)
    assert (changed["CCD_BINNING"], changed["CCD_FRAME_TYPE"]) == ("HOR_BIN=1;VER_BIN=1", "FRAME_LIGHT")
    (file,) = (tmp_path / "instruments").iterdir()
    kept = file.read_text()
    camera.close()
    assert _seen_by(stranger) == FOUND
    assert not (tmp_path / "instruments").exists()
    # As a process left it that was killed: changed, and told on disk what it was.
    stranger.set("CCD_BINNING", "HOR_BIN=1;VER_BIN=1")
    file.parent.mkdir(parents=True)
    file.write_text(kept)
    with IndiCamera(peer.address, **peer.settings):
        pass
    assert _seen_by(stranger) == FOUND


def test_one_that_was_off_is_off_again(peer: IndiSimulator) -> None:
    device = IndiDevice(peer.address, lambda: 10.0, lambda direction, data: None)
    with IndiCamera(peer.address, **peer.settings):
        device.open()
        assert device.get("CONNECTION") == "CONNECT"
    device.open()
    assert device.get("CONNECTION") == "DISCONNECT"
    device.close()


def test_what_it_lacks_is_named(peer: IndiSimulator) -> None:
    for settings, message in (
        ({"capture_format": "RAW16"}, "CCD_CAPTURE_FORMAT can't be 'RAW16'; it has INDI_MONO"),
        ({"gain_db_per_unit": 0.01}, r"gain 500 is outside 0\.\.100; ask for another"),
    ):
        with (
            pytest.raises(InstrumentError, match=message) as raised,
            IndiCamera(peer.address, **(peer.settings | settings)) as camera,
        ):
            camera.configure(0.02, 5.0)
        assert "\n" not in str(raised.value)
    with pytest.raises(Disconnected, match="no such device; it has CCD Simulator, Light Panel Simulator"):
        IndiCamera(peer.address.replace("CCD", "Webcam"), timeout_s=1.0).connect()
    with IndiCamera(peer.address, **peer.settings), pytest.raises(InUse, match="another driver on this computer"):
        IndiCamera(peer.address, **peer.settings).connect()


def test_a_crash_of_its_driver_is_told(peer: IndiSimulator) -> None:
    """The server stays, and takes the device's properties back."""
    with IndiCamera(peer.address, **peer.settings) as camera:
        camera.configure(0.02)
        camera.capture()
        with pytest.raises(InstrumentError) as raised:
            camera._device.execute("CCD_SIMULATE_CRASH")
            camera.capture()
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize("address", ["", "localhost:7624", "localhost:port/CCD Simulator"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(InstrumentError, match="isn't an INDI device's address; write host:port/NAME"):
        IndiCamera(address)


@pytest.fixture
def answering() -> Iterator[Callable[[bytes], IndiDevice]]:
    """A server that says one thing to everybody, and then nothing."""
    sockets: list[socket.socket] = []

    def start(said: bytes) -> IndiDevice:
        server = socket.create_server(("127.0.0.1", 0))
        sockets.append(server)

        def serve() -> None:
            try:
                line, _ = server.accept()
            except OSError:
                return
            sockets.append(line)
            line.sendall(said)

        threading.Thread(target=serve, daemon=True).start()
        return IndiDevice(f"127.0.0.1:{server.getsockname()[1]}/C", lambda: 0.5, lambda direction, data: None)

    yield start
    for one in sockets:
        one.close()


@pytest.fixture
def heard() -> Iterator[Callable[..., IndiDevice]]:
    """A server that says each of several things once it has heard what comes before it."""
    threads: list[threading.Thread] = []

    def start(*steps: tuple[bytes, str]) -> IndiDevice:
        def serve() -> None:
            with server, server.accept()[0] as line:
                asked = b""
                for awaited, said in steps:
                    while awaited not in asked:
                        asked += line.recv(1 << 16)
                    line.sendall(said.encode())
                    time.sleep(0.2)
                line.recv(1 << 16)

        server = socket.create_server(("127.0.0.1", 0))
        threads.append(threading.Thread(target=serve, daemon=True))
        threads[-1].start()
        device = IndiDevice(f"127.0.0.1:{server.getsockname()[1]}/C", lambda: 5.0, lambda direction, data: None)
        device.open()
        return device

    yield start
    for thread in threads:
        thread.join(30.0)


def _connection(kind: str, on: str) -> str:
    """Return the property CONNECTION as it is defined (`def`) or set (`one`), with one of its switches on."""
    ones = "".join(
        f"<{kind}Switch name='{name}'>{'On' if name == on else 'Off'}</{kind}Switch>"
        for name in ("CONNECT", "DISCONNECT")
    )
    tag = "defSwitchVector" if kind == "def" else "setSwitchVector"
    return f"<{tag} device='C' name='CONNECTION'>{ones}</{tag}>"


def _number(name: str) -> str:
    return f"<defNumberVector device='C' name='{name}'><defNumber name='V'>0</defNumber></defNumberVector>"


def test_a_definition_for_another_client_is_no_answer(heard: Callable[..., IndiDevice]) -> None:
    """A server tells definitions to all clients when one of them asks: one with the old value comes before the new
    one."""
    old = _connection("def", "CONNECT")
    device = heard((b"getProperties", old), (b"newSwitchVector", old), (b"", _connection("one", "DISCONNECT")))
    device.set("CONNECTION", "DISCONNECT")
    told = device.get("CONNECTION")
    device.close()
    assert told == "DISCONNECT"


def test_an_order_to_disconnect_may_be_heard_after_the_next_client_came(heard: Callable[..., IndiDevice]) -> None:
    """A server that was busy heard the next client first, and then what the one before had told it."""
    taken = "".join(f"<delProperty device='C' name='{name}'/>" for name in ("E", "F"))
    device = heard(
        (b"getProperties", _connection("def", "CONNECT") + _number("E")),
        (b"", _number("F") + _connection("one", "DISCONNECT") + taken),
        (b"newSwitchVector", _connection("one", "CONNECT") + _number("E") + _number("F")),
    )
    device.connect("E", "F")
    assert device.get("F") == "V=0"
    device.close()


def test_a_picture_may_come_with_the_first_word_of_its_exposure(heard: Callable[..., IndiDevice]) -> None:
    """A short exposure is over before a busy computer reads that it has begun; one before it ended meanwhile."""
    defined = "<defBLOBVector device='C' name='P'><defBLOB name='P'/></defBLOBVector>"
    busy = "<setNumberVector device='C' name='E' state='Busy'><oneNumber name='V'>1</oneNumber></setNumberVector>"
    earlier, its = (
        "<setBLOBVector device='C' name='P'><oneBLOB name='P' format='.x'>"
        f"{b64encode(data).decode()}</oneBLOB></setBLOBVector>"
        for data in (b"earlier", b"its")
    )
    device = heard(
        (b"getProperties", _connection("def", "CONNECT") + _number("E") + defined),
        (b"newNumberVector", earlier + busy + its),
    )
    device.connect("P")
    device.begin("E", "V=1", picture="P")
    assert device.blob("P", 5.0) == b"its"
    device.close()


DEFINED = b"<defSwitchVector device='C' name='CONNECTION'><defSwitch name='CONNECT'>On</defSwitch></defSwitchVector>"


@pytest.mark.parametrize(
    ("said", "raised", "message"),
    [
        (b"", NoAnswer, r"no answer within 0\.5 s to 'CONNECTION'"),
        (b"220 mail.example ESMTP\r\n</x>", Garbled, "says what isn't INDI"),
        (b"<defSwitchVector device='C' name='CONNECTION'><defSwi", NoAnswer, "no answer within"),
        (
            DEFINED + b"<setBLOBVector device='C' name='CCD1'><oneBLOB name='CCD1'>===A</oneBLOB></setBLOBVector>",
            Garbled,
            "isn't INDI",
        ),
    ],
)
def test_answers_that_are_none(
    answering: Callable[[bytes], IndiDevice], said: bytes, raised: type[InstrumentError], message: str
) -> None:
    device = answering(said)
    with pytest.raises(raised, match=message) as found:
        device.open()
        device.connect("CCD1")
    device.close()
    assert "\n" not in str(found.value)


def _fits(codes: np.ndarray, **header: object) -> bytes:
    file, unit = BytesIO(), fits.PrimaryHDU(codes)
    unit.header.update(header)
    unit.writeto(file)
    return file.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"JPEG", "a frame of 4 bytes isn't FITS"),
        (_fits(np.zeros((3, 512, 512), np.uint16)), r"a frame has \(3, 512, 512\) pixels, the sensor \(512, 512\)"),
        (_fits(np.zeros((512, 512), np.uint16), EXPTIME=4.0), r"a frame says 4 s, 0\.02 s were asked for"),
        (_fits(np.full((512, 512), 70000, np.int32)), "codes of 70000..70000; 16 bits are wanted"),
    ],
)
def test_pictures_that_are_none(peer: IndiSimulator, data: bytes, message: str) -> None:
    with IndiCamera(peer.address, **peer.settings) as camera:
        camera.configure(0.02)
        camera.arm()
        camera.fire()
        camera._await_exposed(0.02)
        camera._device._vectors["CCD1"].blob = data
        with pytest.raises(Garbled, match=message):
            camera.collect()
        assert camera.capture().raw.shape == (512, 512)
