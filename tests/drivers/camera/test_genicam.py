"""Cameras through the makers' libraries, on cameras that these libraries bring along: pypylon's emulation, Aravis' fake
GigE camera."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.camera.aravis import AravisCamera, AravisDevice
from drivers.camera.base import capture_together
from drivers.camera.basler import BaslerCamera
from drivers.errors import Disconnected, InstrumentError, InUse, NoAnswer
from mocks.peers import AravisFakeCamera, EmulatedBasler
from tests.peers import missing

pytestmark = pytest.mark.extra  # the library's stand-in of a GigE camera

LEFT, RIGHT = "0815-0000", "0815-0001"


@pytest.fixture
def emulated() -> None:
    try:
        EmulatedBasler()
    except InstrumentError as error:
        missing(str(error))


@pytest.mark.usefixtures("emulated")
class TestBasler:
    def test_both_cameras_are_a_pair_by_software(self) -> None:
        with BaslerCamera(LEFT) as left, BaslerCamera(RIGHT, trigger_line="Software") as right:
            for camera in (left, right):
                camera.configure(0.002)
            pairs = [capture_together([left, right]) for _ in range(3)]
        ids = [[frame.frame_id for frame in pair] for pair in pairs]
        assert np.diff(ids, axis=0).tolist() == [[1, 1], [1, 1]]
        for frame in pairs[0]:
            assert frame.raw.shape == (1040, 1024)
            assert frame.raw.min() == frame.raw.max() > 0  # its test image is switched off; what is left is grey

    @pytest.mark.parametrize(
        ("name", "cfa", "bits"), [("BayerRG12", "RGGB", 12), ("BayerGB8", "GBRG", 8), ("Mono12", "MONO", 12)]
    )
    def test_formats_are_the_cameras_own(self, name: str, cfa: str, bits: int) -> None:
        with BaslerCamera(LEFT, pixel_format=name) as camera:
            camera.configure(0.002)
            sensor = camera.sensor()
            assert (sensor.pixel_format, sensor.cfa, sensor.bit_depth) == (name, cfa, bits)
            assert camera.capture().raw.max() < 2**bits

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"trigger_line": "Line7"}, "no trigger line Line7; it has Line1, Line2, Line3"),
            ({"output_line": "Line9"}, "no line Line9; it has Line1, Line2, Line3"),
            ({"pixel_format": "Yuv"}, "pixel format Yuv isn't offered or known"),
        ],
    )
    def test_features_that_it_lacks_are_named(self, settings: dict[str, str], message: str) -> None:
        with pytest.raises(InstrumentError, match=message):
            BaslerCamera(LEFT, **settings).connect()

    def test_line0_which_it_lacks_is_not_taken_for_granted(self) -> None:
        with BaslerCamera(LEFT) as camera:
            camera.configure(0.002)
            with pytest.raises(
                InstrumentError, match="no trigger line Line0; it has Line1, Line2, Line3: name the one that is wired"
            ):
                camera.arm("line")

    def test_a_pulse_that_never_comes(self) -> None:
        with BaslerCamera(LEFT, trigger_line="Line1", timeout_s=0.3) as camera:
            camera.configure(0.002)
            camera.arm("line")
            with pytest.raises(NoAnswer, match="it waited for Line1: the camera that leads needs output_line"):
                camera.collect()
            assert camera.capture().raw.shape == (1040, 1024)

    def test_limits_are_the_cameras_own(self) -> None:
        with BaslerCamera(LEFT) as camera:
            with pytest.raises(InstrumentError, match=r"ExposureTime 1e\+09 us is outside 1\.\.1e\+07 us"):
                camera.configure(1000.0)
            with pytest.raises(InstrumentError, match="Gain 60 dB is outside 0"):
                camera.configure(0.01, 60.0)

    def test_another_serial_number_is_told(self) -> None:
        with pytest.raises(Disconnected, match="pypylon finds no such camera; there are: 0815-0000, 0815-0001"):
            BaslerCamera("4711").connect()
        assert LEFT in dict(BaslerCamera.enumerate_cameras())


@pytest.fixture
def fake() -> Iterator[AravisFakeCamera]:
    try:
        peer = AravisFakeCamera()
    except InstrumentError as error:
        missing(str(error))
    with peer:
        yield peer


def test_frames_of_a_gige_camera_come_one_a_trigger(fake: AravisFakeCamera) -> None:
    with AravisCamera(fake.address, pixel_format="Mono16") as camera:
        assert camera.identity().maker == "Aravis"
        camera.configure(0.002)
        frames = [camera.capture() for _ in range(5)]
        assert all(frame.raw.shape == (512, 512) and frame.raw.dtype == np.uint16 for frame in frames)
        assert np.diff([frame.frame_id for frame in frames]).tolist() == [1] * 4
        assert frames[0].exposure_s == pytest.approx(0.002)
        with pytest.raises(InstrumentError, match=r"ExposureTimeAbs 1e\+09 us is outside 10\.\.1e\+07 us"):
            camera.configure(1000.0)
        with pytest.raises(InUse, match="another program controls it"):
            AravisCamera(fake.address).connect()


def _used_again(camera: AravisCamera) -> None:
    """A dead controller keeps a GigE camera until its heartbeat is missed: 3 s."""
    for _ in range(100):
        with contextlib.suppress(InstrumentError):
            camera.configure(0.002)
            assert camera.capture().raw.shape == (512, 512)
            return
        time.sleep(0.2)
    camera.capture()


def test_a_frozen_camera_is_given_up_and_controlled_again(fake: AravisFakeCamera) -> None:
    with AravisCamera(fake.address, timeout_s=2.0) as camera:
        camera.configure(0.002)
        camera.capture()
        fake.mute(True)
        for _ in range(2):
            with pytest.raises(InstrumentError) as raised:
                camera.configure(0.002)
            assert "\n" not in str(raised.value)
        fake.mute(False)
        _used_again(camera)


def test_a_camera_that_forgot_its_controller_is_controlled_again_by_the_next_call(fake: AravisFakeCamera) -> None:
    with AravisCamera(fake.address, timeout_s=2.0) as camera:
        camera.configure(0.002)
        camera.capture()
        fake.unplug()
        fake.plug()  # switched off and on: it hears no trigger
        with pytest.raises(InstrumentError, match="no frame within 2 s"):
            camera.capture()
        assert camera.capture().raw.shape == (512, 512)


def test_a_camera_that_died_is_controlled_again_by_the_same_driver(fake: AravisFakeCamera) -> None:
    with AravisCamera(fake.address, timeout_s=2.0) as camera:
        camera.configure(0.002)
        camera.capture()
        fake.unplug()
        with pytest.raises(InstrumentError):
            camera.capture()
        fake.plug()
        _used_again(camera)


def test_nobody_at_the_address(fake: AravisFakeCamera) -> None:
    with pytest.raises(Disconnected, match=r"Aravis finds no such camera \(Can't connect"):
        AravisCamera("127.0.0.9").connect()


def test_an_empty_buffer_is_no_frame() -> None:
    class Stream:
        """A stream whose buffers come back as they were queued."""

        def __init__(self) -> None:
            self.queued = [self]

        def get_status(self) -> int:
            return 1

        def timeout_pop_buffer(self, timeout_us: int) -> Stream:
            return self.queued.pop()

        def push_buffer(self, buffer: Stream) -> None:
            self.queued.append(buffer)

    device = AravisDevice("nowhere")
    device._stream = Stream()
    assert device.grab(0.1) is None
    assert device._stream.queued == [device._stream]
