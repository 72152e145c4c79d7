"""Tethered cameras through libgphoto2, on the virtual camera of its wheel."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.camera.gphoto2 import Gphoto2Camera, seconds
from drivers.errors import Disconnected, InstrumentError
from drivers.found_settings import FoundSettings
from mocks.peers import VirtualCamera
from mocks.tethered import write_dng
from tests.peers import missing

pytestmark = pytest.mark.extra  # the library's own camera


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[VirtualCamera]:
    FoundSettings.keep_in(tmp_path / "instruments")
    try:
        found = VirtualCamera()
    except InstrumentError as error:
        missing(str(error))
    with found:
        yield found


def test_codes_come_back_as_they_were_written(peer: VirtualCamera) -> None:
    with Gphoto2Camera(peer.address, **peer.settings) as camera:
        camera.configure(0.005)
        frames, sensor = [camera.capture() for _ in range(3)], camera.sensor()
        assert camera.identity().model == "VC"
        assert (sensor.rows, sensor.cols, sensor.cfa, sensor.bit_depth) == (48, 64, "RGGB", 12)
        assert [frame.frame_id for frame in frames] == [0, 1, 2]
        assert frames[0].exposure_s == 0.005
        wanted = np.random.default_rng(1).integers(64, 4096, (48, 64), dtype=np.uint16)
        np.testing.assert_array_equal(frames[2].raw, wanted)
        assert camera.settings()["shutterspeed"] == "0.0050s"


def test_what_was_found_is_kept_and_restored(peer: VirtualCamera, tmp_path: Path) -> None:
    heard: list[str] = []

    def hear(direction: str, data: bytes) -> None:
        if data.startswith(b"set"):
            heard.append(data.decode())

    with Gphoto2Camera(peer.address, recorder=hear, settings={"f-number": "f/8"}, **peer.settings) as camera:
        camera.configure(0.02)
        assert heard == ["set autofocus Off", "set f-number f/8", "set shutterspeed 0.0200s"]
        (file,) = (tmp_path / "instruments").iterdir()
        kept = file.read_text()
        heard.clear()
    assert heard == ["set shutterspeed 0.0100s", "set f-number f/2.8", "set autofocus On"]
    assert not (tmp_path / "instruments").exists()
    file.parent.mkdir(parents=True)
    file.write_text(kept)  # as a process left it that was killed
    heard.clear()
    with Gphoto2Camera(peer.address, recorder=hear, **peer.settings):
        assert heard == ["set shutterspeed 0.0100s", "set f-number f/2.8", "set autofocus On", "set autofocus Off"]


def test_what_it_lacks_is_named(peer: VirtualCamera) -> None:
    for settings, exposure_s, gain_db, message in (
        ({}, 0.007, 0.0, r"no exposure of 0\.007 s, the nearest is 0\.005 s"),
        ({}, 0.005, 6.0, "it has no ISO to set for 6 dB"),
        ({"settings": {"f-number": "f/7"}}, 0.005, 0.0, "f-number can't be 'f/7'; it has f/2.8"),
        ({"settings": {"mirror": "up"}}, 0.005, 0.0, "it has no setting 'mirror'"),
    ):
        with (
            pytest.raises(InstrumentError, match=message) as raised,
            Gphoto2Camera(peer.address, **(peer.settings | settings)) as camera,
        ):
            camera.configure(exposure_s, gain_db)
        assert "\n" not in str(raised.value)
    with pytest.raises(Disconnected, match=r"no camera '12345'; it finds \w.* at usb:"):
        Gphoto2Camera("12345", **peer.settings).connect()


def test_a_camera_that_chose_its_own_time_is_told(peer: VirtualCamera) -> None:
    with Gphoto2Camera(peer.address, **peer.settings) as camera:
        camera.configure(0.005)
        camera.capture()
        write_dng(peer.picture, np.zeros((48, 64), np.uint16), 0.02)  # of the size before: its camera knows no other
        with pytest.raises(InstrumentError, match=r"exposed for 0\.02 s, and 0\.005 s were asked for: set the camera"):
            camera.capture()
        write_dng(peer.picture, np.full((48, 64), 99, np.uint16), 0.005)
        assert camera.capture().raw.max() == 99


@pytest.mark.parametrize(
    ("choice", "time_s"),
    [
        ("1/60", 1 / 60),
        ("0.0100s", 0.01),
        ("2.5", 2.5),
        ('30"', 30.0),
        ("13/10", 1.3),
        ("1/0", None),
        ("Bulb", None),
        ("0", None),
    ],
)
def test_exposure_times_as_cameras_write_them(choice: str, time_s: float | None) -> None:
    assert seconds(choice) == (None if time_s is None else pytest.approx(time_s))
