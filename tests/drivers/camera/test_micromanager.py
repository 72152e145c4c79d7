"""Cameras through Micro-Manager, on its own DemoCamera: a real adapter in a process of its own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.camera.micromanager import Core, MicroManagerCamera
from drivers.errors import Disconnected, InstrumentError, Interrupted, NoAnswer
from drivers.found_settings import FoundSettings
from mocks.peers import DemoCamera
from tests.peers import missing

pytestmark = pytest.mark.extra  # the library's own cameras


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[DemoCamera]:
    FoundSettings.keep_in(tmp_path / "instruments")
    try:
        found = DemoCamera()
    except InstrumentError as error:
        missing(str(error))
    with found:
        yield found


@pytest.fixture
def camera(peer: DemoCamera) -> Iterator[MicroManagerCamera]:
    with MicroManagerCamera(peer.address, **peer.settings) as made:
        yield made


def test_frames_are_the_converters_codes_of_the_whole_sensor(camera: MicroManagerCamera) -> None:
    camera.configure(0.005)
    sensor, frames = camera.sensor(), [camera.capture() for _ in range(3)]
    assert camera.identity().maker == "DemoCamera"
    assert (sensor.rows, sensor.cols, sensor.bit_depth, sensor.exposure_s) == (512, 512, 12, (0.0, 10.0))
    assert [frame.frame_id for frame in frames] == [0, 1, 2]
    assert frames[0].raw.dtype == np.uint16
    assert 2**6 < frames[0].raw.max() < 2**12
    assert frames[0].temperature_c == 0.0
    assert camera.settings()["Binning"] == "1"


def test_what_was_found_is_kept_and_restored(peer: DemoCamera, tmp_path: Path) -> None:
    heard: list[str] = []

    def hear(direction: str, data: bytes) -> None:
        if direction == "sent":
            heard.append(data.decode())

    with MicroManagerCamera(peer.address, recorder=hear, **peer.settings) as camera:
        camera.configure(0.02)
        (file,) = (tmp_path / "instruments").iterdir()
        kept = file.read_text()
        assert "set Binning 1" in heard
        heard.clear()
    assert [line for line in heard if line.startswith("set")] == [
        "set core:exposure_ms 10.0",
        "set TransposeMirrorX 1",
        "set TransposeCorrection 1",
        "set Binning 2",
        "set core:region 0 0 256 256",
    ]
    assert not (tmp_path / "instruments").exists()
    # As a process that was killed left it: the next one restores before it sets.
    file.parent.mkdir(parents=True)
    file.write_text(kept)
    heard.clear()
    with MicroManagerCamera(peer.address, recorder=hear, **peer.settings):
        assert heard.index("set TransposeMirrorX 1") < heard.index("set TransposeMirrorX 0")
    assert not (tmp_path / "instruments").exists()


def test_a_crash_of_an_adapter_ends_its_process_alone(camera: MicroManagerCamera) -> None:
    camera.configure(0.005)
    with (
        pytest.raises(Disconnected, match=r"process ended \(SIGSEGV\) during 'set'") as raised,
        camera._used() as found,
    ):
        found.set("SimulateCrash", "Dereference Null Pointer")
    assert "\n" not in str(raised.value)
    assert camera.capture().raw.shape == (512, 512)


def test_a_frozen_adapter_is_given_up_and_started_anew(peer: DemoCamera, camera: MicroManagerCamera) -> None:
    camera.configure(0.005)
    camera.capture()
    peer.mute(True)
    with pytest.raises(NoAnswer, match=r"no answer within \S+ s to"):
        camera.capture()
    assert camera.capture().frame_id == 1


def test_a_stop_ends_an_exposure(camera: MicroManagerCamera) -> None:
    camera.configure(1.5)
    camera.arm()
    camera.fire()
    camera._stopped.set()
    with pytest.raises(Interrupted, match="stopped while waiting for a frame"):
        camera.collect()
    camera.stop()
    camera.configure(0.005)
    assert camera.capture().exposure_s == 0.005


def test_the_shutter_is_open_during_an_exposure_alone(peer: DemoCamera) -> None:
    file, _, label = peer.address.partition("#")
    core = Core(file, label, "Shutter", peer.settings["adapters"], "2.0")
    try:
        core.set("core:exposure_ms", 1000.0)
        core.expose()
        assert core._core.getShutterOpen("Shutter")
        assert core.abort() is False
        assert not core._core.getShutterOpen("Shutter")
    finally:
        core.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pixel_type": "32bitRGB"}, r"4 values of 8 bits .*; one of 8 or 16 bits is wanted: set pixel_type to one of"),
        ({"pixel_type": "64"}, "camera .*: set PixelType 64 failed"),
        ({"properties": {"Brightness": "3"}}, "it has no property 'Brightness'; correct it in the station file"),
        ({"shutter": "Lamp"}, "can't be loaded"),
        ({"trigger_line": "Line1"}, "trigger_line 'Line1' can't be waited for"),
        ({"gain_db_per_unit": 0.0}, "gain_db_per_unit is 0.0; give a number above 0"),
    ],
)
def test_what_it_lacks_is_named(peer: DemoCamera, settings: dict[str, object], message: str) -> None:
    with pytest.raises(InstrumentError, match=message) as raised:
        MicroManagerCamera(peer.address, **(peer.settings | settings)).connect()
    assert "\n" not in str(raised.value)


def test_a_configuration_without_a_camera(peer: DemoCamera) -> None:
    file = Path(peer.address.partition("#")[0])
    file.write_text("Property,Core,Initialize,1\n")
    with pytest.raises(InstrumentError, match="has no camera; name it after `#` in the address"):
        MicroManagerCamera(str(file), **peer.settings).connect()


def test_gain_has_a_unit_of_its_own(peer: DemoCamera) -> None:
    with (
        MicroManagerCamera(peer.address, **peer.settings) as camera,
        pytest.raises(InstrumentError, match="3 dB can't be set; state gain_db_per_unit"),
    ):
        camera.configure(0.005, 3.0)
    with MicroManagerCamera(peer.address, gain_db_per_unit=0.5, **peer.settings) as other:
        other.configure(0.005, 3.0)
        assert other.settings()["Gain"] == "6"
        with pytest.raises(InstrumentError, match=r"Gain 12 is outside -5\.\.8"):
            other.check(0.005, 6.0)
