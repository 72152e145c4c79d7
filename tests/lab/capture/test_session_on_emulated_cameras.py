"""Short sessions on cameras that no mock of ours stands behind: the pair that pypylon emulates, and Aravis' fake GigE
camera."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import InstrumentError
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.errors import DeviceError
from lab.formats.recording_set import inspect
from mocks.peers import AravisFakeCamera, EmulatedBasler, operator_stage
from tests.peers import missing

pytestmark = pytest.mark.extra  # makers' emulated cameras

SHEET = {"rows": 1040, "cols": 1024, "cfa": "RGGB", "bit_depth": 12}


def test_darks_of_an_emulated_pair_are_a_recording_set(tmp_path: Path) -> None:
    try:
        EmulatedBasler()
    except InstrumentError as error:
        missing(str(error))
    camera = {"driver": "basler", "pixel_format": "BayerRG12", "datasheet": SHEET}
    with operator_stage() as stage:
        station = Station.model_validate(
            {
                "cameras": {
                    "left": {**camera, "address": "0815-0000"},
                    "right": {**camera, "address": "0815-0001", "trigger_line": "Software"},
                },
                "stage": {"driver": "operator", "address": stage.address, **stage.settings},
                "targets": {"cap": {"kind": "cap"}},
            }
        )
        store = Store(tmp_path / "data")
        session = CaptureSession.start(
            store, station, CapturePlan((DarkSequence(exposures_s=(0.001, 0.01), frames=2),))
        )
        assert session.run().state == "finished"
    recordings = store.recording_set(session.id)
    problems, _ = inspect(recordings)
    assert problems == []
    assert [(c.side, c.exposure_s) for c in recordings.captures("dark")].count(("left", 0.01)) == 2
    assert len(recordings.captures()) == 2 * 2 * 2
    assert recordings.frame(recordings.captures("dark", "right")[0]).shape == (1040, 1024)
    assert store.runs(session.id)[-1].instruments["camera left"].model == "Emulation"
    store.close()


def test_darks_of_a_gige_camera_are_a_recording_set(tmp_path: Path) -> None:
    try:
        peer = AravisFakeCamera()
    except InstrumentError as error:
        missing(str(error))
    sheet = {"rows": 512, "cols": 512, "cfa": "MONO", "bit_depth": 16}
    with peer, operator_stage() as stage:
        camera = {"driver": "aravis", "address": peer.address, "pixel_format": "Mono16", "datasheet": sheet}
        station = Station.model_validate(
            {
                "cameras": {"left": camera},
                "stage": {"driver": "operator", "address": stage.address, **stage.settings},
                "targets": {"cap": {"kind": "cap"}},
            }
        )
        store = Store(tmp_path / "data")
        plan = CapturePlan((DarkSequence(exposures_s=(0.001, 0.01), frames=2),))
        session = CaptureSession.start(store, station, plan)
        assert session.run().state == "finished"
        beyond = CapturePlan((DarkSequence(exposures_s=(100.0,), frames=1),))
        with pytest.raises(DeviceError, match=r"ExposureTimeAbs 1e\+08 us is outside .*; the sequence dark needs it"):
            CaptureSession.start(store, station, beyond).run()
    recordings = store.recording_set(session.id)
    assert inspect(recordings)[0] == []
    captures = recordings.captures("dark", "left")
    assert [capture.exposure_s for capture in captures] == pytest.approx([0.001, 0.01, 0.01, 0.001])
    assert recordings.frame(captures[0]).shape == (512, 512)
    assert store.runs(session.id)[-1].instruments["camera left"].maker == "Aravis"
    store.close()
