"""Series of frame pairs on mock cameras with prepared frames: the frames of a trigger stay together, and lost frames
are taken again."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
import usb.core

from drivers.camera.base import capture_together
from drivers.camera.basler import BaslerCamera
from drivers.camera.stream import MOST_LOST, FrameStream, frames_between
from drivers.camera.u3v import U3vCamera
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer
from mocks.peers import EmulatedBasler
from mocks.ready_frames import ReadyFrames
from mocks.u3v import TriggerLine, U3vDevice
from mocks.usb import InProcessBackend
from mocks.wire import parse_faults
from tests.peers import missing

ROWS, COLS = 32, 64
#: Every trigger's frames are filled with its own number, on both sides.
FRAMES = [np.full((ROWS, COLS), number, np.uint16) for number in range(64)]


@dataclass
class Pair:
    """Two wired cameras, their mocks, and what they said got lost."""

    cameras: tuple[U3vCamera, U3vCamera]
    devices: tuple[U3vDevice, U3vDevice]
    lost: list[str] = field(default_factory=list)

    def impatient(self) -> None:
        """Wait for 0.3 s beyond an exposure, where a frame is to be waited for that never comes."""
        for camera in self.cameras:
            camera._timeout_s = 0.3

    def series(self, count: int, in_flight: int = 1, interval_s: float = 0.0) -> FrameStream:
        return FrameStream(self.cameras, count, in_flight=in_flight, interval_s=interval_s, on_loss=self.lost.append)


@pytest.fixture
def pair() -> Iterator[Pair]:
    line = TriggerLine()
    ready = ReadyFrames({"left": FRAMES, "right": FRAMES})
    devices = U3vDevice(ready, "left", "L", line), U3vDevice(ready, "right", "R", line)
    left, right = (usb.core.find(backend=InProcessBackend([device])) for device in devices)
    with (
        U3vCamera("usb://L", device=left, timeout_s=30.0, output_line="Line1") as leads,
        U3vCamera("usb://R", device=right, timeout_s=30.0) as follows,
    ):
        for camera in (leads, follows):
            camera.configure(0.001)
        yield Pair((leads, follows), devices)


def moments(series: FrameStream) -> list[int]:
    """When the pairs that came were exposed, on the wire's clock: both frames of a pair at the same moment."""
    came = []
    for left, right in series:
        assert left.camera_time_ns == right.camera_time_ns is not None
        assert left.time == right.time
        came.append(left.camera_time_ns)
    return came


@pytest.mark.parametrize("in_flight", [1, 3])
def test_pairs_come_in_the_order_of_their_triggers(pair: Pair, in_flight: int) -> None:
    pairs = [*pair.series(10, in_flight, 0.002), *pair.series(3)]  # nothing is triggered beyond what is asked for
    assert [[frame.raw[0, 0] for frame in frames] for frames in pairs] == [[number] * 2 for number in range(13)]
    assert all(left.camera_time_ns == right.camera_time_ns for left, right in pairs)
    assert pair.lost == []
    frames = capture_together(pair.cameras)
    assert [frame.frame_id for frame in frames] == [13, 13]
    assert frames[0].raw[0, 0] == 13


def test_the_temperature_is_read_beside_the_stream(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    nodes = pair.cameras[0].nodes
    get = nodes.get
    monkeypatch.setattr(nodes, "get", lambda name: (asked.append(name), get(name))[1])
    clock = pair.devices[0]._bench.clock
    at_s = [0.0]
    monkeypatch.setattr(clock, "now", lambda: at_s[0])
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    series = pair.series(20)
    for left, _ in series:
        assert left.temperature_c is not None
        at_s[0] += 0.1
    # 20 frames in 2 s of the camera's clock, read where 250 ms have passed: every third frame
    assert asked.count("DeviceTemperature") == 7


LOST = {
    "torn": r"frame \d is torn: 0 of 4096 bytes came; use another cable or port; it is taken again",
    "short": r"frame \d is torn: 2048 of 4096 bytes came",
    "lost-trailer": r"frame \d is torn: its trailer was lost",
    "damaged": r"frame \d is torn: data discarded",
    "never": r"no frame within|1 frame before frame \d got lost",
    "missed": "no frame within|it didn't hear a trigger",
    "repeated": r"frame \d came twice; it is dropped",
    "halt": "halted its endpoint",
}


@pytest.mark.parametrize(("side", "in_flight"), [(0, 3), (1, 1)])
@pytest.mark.parametrize("fault", LOST)
def test_what_gets_lost_is_told_in_one_line_and_taken_again(pair: Pair, fault: str, side: int, in_flight: int) -> None:
    pair.impatient()
    series = pair.series(8, in_flight, interval_s=0.004)
    left, _ = series.next()
    pair.devices[side].inject(fault)
    came = [left.camera_time_ns, *moments(series)]
    assert len(came) == 8
    assert came == sorted(set(came))
    assert re.search(rf"^camera {'LR'[side]}: ({LOST[fault]})", pair.lost[0])
    assert all("\n" not in line for line in pair.lost)


@pytest.mark.parametrize("fault", ["busy", "garbled", "silent"])
def test_a_trigger_that_fails_is_given_again(pair: Pair, fault: str) -> None:
    pair.impatient()
    series = pair.series(6)
    first, _ = series.next()
    pair.devices[0].inject(fault)
    assert len([first, *moments(series)]) == 6
    assert len(pair.lost) == 1


def test_cameras_that_lose_every_frame_end_a_series_with_the_last_failure(pair: Pair) -> None:
    series = pair.series(5)
    series.next()
    pair.devices[1].fail(parse_faults("torn@1+", frames=True))
    with pytest.raises(Garbled, match=r"camera R: frame \d+ is torn"):
        series.next()
    assert len(pair.lost) == MOST_LOST
    pair.devices[1].fail(())
    assert len(moments(pair.series(3))) == 3


def test_a_camera_that_is_unplugged_ends_a_series_and_the_next_one_works(pair: Pair) -> None:
    series = pair.series(9)
    series.next()
    pair.devices[1].inject("unplug")
    with pytest.raises(Disconnected, match="the connection was lost"):
        moments(series)
    pair.devices[1].plug()
    assert len(moments(pair.series(3))) == 3


def test_stop_ends_the_wait_of_another_thread(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    pair.devices[1].fail(parse_faults("never@1+"))
    waits = threading.Event()
    wait = pair.cameras[1]._await_frame
    monkeypatch.setattr(pair.cameras[1], "_await_frame", lambda *asked: (waits.set(), wait(*asked))[1])
    told: list[InstrumentError] = []

    def take() -> None:
        try:
            pair.series(3).next()
        except InstrumentError as error:
            told.append(error)

    waiting = threading.Thread(target=take)
    waiting.start()
    assert waits.wait(30)
    pair.cameras[1].stop()
    waiting.join(30)
    assert isinstance(told[0], Interrupted)
    pair.devices[1].fail(())
    assert len(moments(pair.series(2))) == 2


def test_a_series_that_is_left_leaves_no_frame_for_the_next_shot(pair: Pair) -> None:
    with pytest.raises(ValueError, match=r"3 triggers in flight at an interval of 0\.0 s"):
        pair.series(9, 3)
    series = pair.series(9)
    series.next()  # and the next trigger is given
    series.close()
    for camera in pair.cameras:
        camera.configure(0.002)
    frames = capture_together(pair.cameras)
    assert [frame.exposure_s for frame in frames] == [pytest.approx(0.002)] * 2
    assert [frame.frame_id for frame in frames] == [0, 0]
    assert frames[0].camera_time_ns == frames[1].camera_time_ns


def test_a_single_shot_isnt_taken_from_a_frame_that_came_twice(pair: Pair) -> None:
    pair.devices[0].inject("repeated")
    for number in range(3):
        frames = capture_together(pair.cameras)
        assert [frame.raw[0, 0] for frame in frames] == [number, number]


@pytest.mark.extra  # a maker's library
def test_series_of_emulated_cameras_with_a_torn_frame() -> None:
    try:
        EmulatedBasler()
    except InstrumentError as error:
        missing(str(error))
    lost: list[str] = []
    with (
        BaslerCamera("0815-0000", pixel_format="BayerRG12") as left,
        BaslerCamera("0815-0001", pixel_format="BayerRG12", trigger_line="Software") as right,
    ):
        for camera in (left, right):
            camera.configure(0.002)
        series = FrameStream([left, right], 6, on_loss=lost.append)
        pairs = [series.next()]
        assert right._features is not None
        right._features.set("ForceFailedBufferCount", 1)
        right._features.execute("ForceFailedBuffer")
        pairs += list(series)
    assert len(pairs) == 6
    assert all(frame.raw.shape == (1040, 1024) for pair in pairs for frame in pair)
    assert len(lost) == 1
    assert "is torn: The buffer was incompletely grabbed" in lost[0]


def test_a_series_that_nobody_answers_ends(pair: Pair) -> None:
    pair.impatient()
    pair.devices[0].fail(parse_faults("never@1+"))
    with pytest.raises(NoAnswer, match=r"no frame within 0\.3 s of its exposure of 0\.001 s"):
        pair.series(2).next()


@pytest.mark.parametrize(
    ("before", "now", "between"),
    [(0, 1, 0), (4, 7, 2), (65535, 1, 0), (65534, 2, 2), (7, 6, -2), (70000, 70001, 0), (0, 0, 0)],
)
def test_numbers_of_16_bits_begin_again_at_1(before: int, now: int, between: int) -> None:
    assert frames_between(before, now) == between


def test_an_acquisition_that_doesnt_start_is_started_again(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = pair.cameras[0].nodes
    execute, failing = nodes.execute, ["AcquisitionStart"]

    def once(name: str) -> None:
        if name in failing:
            failing.remove(name)
            raise NoAnswer("camera L: no answer")
        execute(name)

    monkeypatch.setattr(nodes, "execute", once)
    with pytest.raises(NoAnswer):
        capture_together(pair.cameras)
    assert [frame.frame_id for frame in capture_together(pair.cameras)] == [0, 0]
