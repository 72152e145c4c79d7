"""A short session on cameras that pypylon emulates itself: a stereo pair that no mock of ours stands behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import InstrumentError
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.formats.recording_set import inspect
from mocks.peers import EmulatedBasler, operator_stage

SHEET = {"rows": 1040, "cols": 1024, "cfa": "RGGB", "bit_depth": 12}


def test_darks_of_an_emulated_pair_are_a_recording_set(tmp_path: Path) -> None:
    try:
        EmulatedBasler()
    except InstrumentError as error:
        pytest.skip(str(error))
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
    assert store.runs(session.id)[-1].instruments["camera left"]["model"] == "Emulation"
    store.close()
