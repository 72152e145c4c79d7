"""The tethered camera's driver, on DNG files that a mock of such a camera's software writes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.camera.raw_folder import RawFolderCamera
from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer
from mocks.bench import Bench
from mocks.tethered import TetheredCamera, write_dng
from mocks.wire import parse_faults


@pytest.fixture(scope="module")
def bench() -> Bench:
    bench = Bench(seed=4)
    bench.place("sphere")
    bench.set_shutter(True)
    return bench


@pytest.fixture
def tethered(tmp_path: Path, bench: Bench) -> Iterator[TetheredCamera]:
    mock = TetheredCamera(tmp_path, bench)
    mock.start()
    yield mock
    mock.close()


@pytest.fixture
def camera(tethered: TetheredCamera) -> RawFolderCamera:
    return RawFolderCamera(str(tethered.folder), settle_s=0.1, timeout_s=2.0, **tethered.settings)


def test_codes_come_back_as_they_were_written(tmp_path: Path) -> None:
    raw = np.random.default_rng(1).integers(0, 4096, (48, 64), dtype=np.uint16)
    raw[0, 0] = 4095
    write_dng(tmp_path / "a.dng", raw, 0.0125)
    camera = RawFolderCamera(str(tmp_path))
    sensor = camera.sensor()
    assert (sensor.rows, sensor.cols, sensor.cfa, sensor.bit_depth, sensor.black_level) == (48, 64, "RGGB", 12, 64.0)
    assert camera._sample is not None
    np.testing.assert_array_equal(camera._sample.raw, raw)
    assert camera._sample.exposure_s == pytest.approx(0.0125)


def test_each_trigger_is_one_frame_of_the_time_asked_for(camera: RawFolderCamera) -> None:
    with camera:
        for frame_id, exposure_s in enumerate((0.002, 0.004, 0.004)):
            camera.configure(exposure_s)
            frame = camera.capture()
            assert (frame.frame_id, frame.exposure_s) == (frame_id, pytest.approx(exposure_s))
            assert frame.raw.shape == (480, 640)


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never", NoAnswer, "no raw file within 2 s"),
        ("half", Garbled, "can't be read"),
        ("wrong", Garbled, "can't be read"),
    ],
)
def test_a_fault_is_one_error_and_then_it_works_again(
    camera: RawFolderCamera, tethered: TetheredCamera, fault: str, error: type[Exception], message: str
) -> None:
    with camera:
        camera.configure(0.002)
        tethered.fail(parse_faults(fault))
        with pytest.raises(error, match=message) as caught:
            camera.capture()
        assert "\n" not in str(caught.value)
        assert camera.capture().raw.mean() > 64


def test_a_camera_that_chose_its_own_time_is_told(tethered: TetheredCamera) -> None:
    camera = RawFolderCamera(str(tethered.folder), settle_s=0.1, trigger_command=tethered.settings["trigger_command"])
    camera.configure(0.5)  # nobody sets the camera: it stands at 0.01 s
    with pytest.raises(InstrumentError, match=r"exposed for 0.01 s, and 0.5 s were asked for: set the camera"):
        camera.capture()


def test_what_cannot_be_used_is_one_line(tmp_path: Path, camera: RawFolderCamera) -> None:
    with pytest.raises(Disconnected, match=r"can't be read \(No such file"):
        RawFolderCamera(str(tmp_path / "none")).connect()
    (tmp_path / "empty").mkdir()
    with pytest.raises(InstrumentError, match="no raw file in it; take one picture"):
        RawFolderCamera(str(tmp_path / "empty")).connect()
    camera.trigger_command = "no-such-program"
    camera.configure(0.01)
    with pytest.raises(InstrumentError, match="no-such-program can't be run"):
        camera.capture()
    camera.trigger_command = "false"
    with pytest.raises(InstrumentError, match="false failed with code 1"):
        camera.capture()
