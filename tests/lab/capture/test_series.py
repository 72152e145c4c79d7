"""Series of frames: steps that repeat an exposure become one series of streaming cameras, and lost frames are recorded
in the journal."""

from __future__ import annotations

import numpy as np
import pytest
import usb.core

from drivers.camera.u3v import U3vCamera
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import Drivers, Station
from lab.capture.store import Store
from lab.capture.take_step import DUMMY_FRAMES, repeats_ahead
from lab.capture_kinds.dark import DarkSequence
from mocks.ready_frames import ReadyFrames
from mocks.u3v import TriggerLine, U3vDevice
from mocks.usb import InProcessBackend
from mocks.wire import parse_faults
from tests.lab.fake_bench import Bench, FakeStage
from tests.lab.fake_bench import station as fake_station

FRAMES = 5
PLAN = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=FRAMES),))


@pytest.fixture
def devices() -> tuple[U3vDevice, U3vDevice]:
    line = TriggerLine()
    numbered = [np.full((24, 32), number, np.uint16) for number in range(64)]
    ready = ReadyFrames({"left": numbered, "right": numbered})
    return U3vDevice(ready, "left", "L", line), U3vDevice(ready, "right", "R", line)


def run(store: Store, devices: tuple[U3vDevice, U3vDevice]) -> tuple[CaptureSession, list[str]]:
    def connect(station: Station) -> Drivers:
        left, right = (usb.core.find(backend=InProcessBackend([device])) for device in devices)
        return Drivers(
            cameras={
                "left": U3vCamera("usb://L", device=left, output_line="Line1", timeout_s=1.0),
                "right": U3vCamera("usb://R", device=right, timeout_s=1.0),
            },
            stage=FakeStage(Bench()),
        )

    remarks: list[str] = []

    def note(progress: Progress) -> None:
        if progress.remark:
            remarks.append(progress.remark)

    station = fake_station(monochromator=None, spectroradiometer=None, display=None)
    session = CaptureSession.start(store, station, PLAN, connect=connect, on_progress=note)
    assert session.run().state == "finished"
    return session, remarks


def test_equal_steps_are_one_series_of_which_nothing_more_is_triggered(
    store: Store, devices: tuple[U3vDevice, U3vDevice]
) -> None:
    session, remarks = run(store, devices)
    assert remarks == []
    recordings = store.recording_set(session.id)
    for side in ("left", "right"):
        codes = [int(recordings.frame(capture)[0, 0]) for capture in recordings.captures("dark", side)]
        # the first frames are read and not kept; of one series, the others follow without a gap
        assert codes == list(range(DUMMY_FRAMES, DUMMY_FRAMES + FRAMES))
    assert [device._frame_id for device in devices] == [DUMMY_FRAMES + FRAMES] * 2


def test_frames_that_get_lost_are_taken_again_and_told(store: Store, devices: tuple[U3vDevice, U3vDevice]) -> None:
    devices[0].fail(parse_faults("torn@4", frames=True))
    devices[1].fail(parse_faults("repeated@2,wrong@6", frames=True))
    session, remarks = run(store, devices)
    assert len(remarks) == 3
    assert remarks[0] == "camera R: frame 1 came twice; it is dropped"
    assert remarks[1].startswith("camera L: frame 3 is torn")
    assert remarks[2].startswith("camera R: frame 5 is torn")
    assert [line for entry in store.journal(session.id) for line in entry.result.get("retaken", ())] == remarks
    recordings = store.recording_set(session.id)
    captures = recordings.captures("dark", "left"), recordings.captures("dark", "right")
    pairs = [[int(recordings.frame(capture)[0, 0]) for capture in pair] for pair in zip(*captures, strict=True)]
    assert pairs == [[number, number] for number in (2, 4, 6, 7, 8)]


def test_repeats_of_a_step_are_counted() -> None:
    station = fake_station()
    first, *others = DarkSequence(exposures_s=(0.001, 0.01), frames=2).steps(station)
    assert repeats_ahead([first, *others]) == [0, 1, 0, 0]  # the ladder turns: 0.01 s twice
    assert repeats_ahead([first, first, first]) == [2, 1, 0]
    assert repeats_ahead([first, None, first]) == [0, 0, 0]
    assert repeats_ahead([first, first.model_copy(update={"radiance": "spectra/x.csv"})]) == [0, 0]
    assert repeats_ahead([]) == []
