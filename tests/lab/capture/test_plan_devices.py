"""Our devices in bluesky plans as they stand, beside ophyd-async's; and sessions in a Tiled catalogue."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import numpy as np
import pytest
from bluesky import RunEngine

from lab import cli
from lab.capture.plan import CapturePlan
from lab.capture.plan_devices import plan_devices
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.errors import InputError
from lab.formats.recording_set import read
from tests.lab import fake_bench
from tests.lab.fake_bench import BLACK, SLOPE, Bench

STATION = fake_bench.station()


def test_a_plan_of_ones_own_scans_the_light(tmp_path: Path) -> None:
    bench, documents = Bench(), []
    engine = RunEngine({})
    engine.subscribe(lambda name, document: documents.append((name, document)))
    with plan_devices(STATION, tmp_path, bench.drivers) as devices:
        assert devices.light and devices.shutter and devices.target and devices.radiometer

        def plan() -> Any:
            yield from bps.mv(devices.target, "sphere", devices.shutter, True)
            yield from bps.prepare(devices.cameras, 0.01, wait=True)
            yield from bp.scan([devices.radiometer, devices.cameras], devices.light, 450.0, 650.0, 5)
            yield from bp.count([devices.cameras], num=2)

        engine(plan())
        assert devices.instruments["camera left"].serial_number == "SN-1"
    assert not bench.opened and "close monochromator" in bench.log
    events = [document["data"] for name, document in documents if name == "event"]
    assert [event["wavelength_nm"] for event in events[:5]] == [450.0, 500.0, 550.0, 600.0, 650.0]
    assert len({event["left_frame"] for event in events}) == 7
    for event in events[:5]:
        frame = np.load(tmp_path / event["left_frame"])
        wanted = BLACK + SLOPE["left"] * 0.05 * event["wavelength_nm"] / 500 * 0.01
        assert frame.mean() == pytest.approx(wanted, abs=2 + 3 * 2.0 / np.sqrt(frame.size))
        assert (tmp_path / event["radiance"]).read_text().startswith("wavelength_nm,value")


def test_cameras_without_an_exposure_say_so(tmp_path: Path) -> None:
    bench = Bench()
    with (
        plan_devices(STATION, tmp_path, bench.drivers) as devices,
        pytest.raises(InputError, match="no exposure is set"),
    ):
        devices.cameras.trigger()


@pytest.mark.filterwarnings("default")  # its own
def test_they_go_with_ophyd_asyncs_in_one_plan(tmp_path: Path) -> None:
    core = pytest.importorskip("ophyd_async.core", reason="ophyd-async isn't installed")
    engine, documents = RunEngine({}), []
    engine.subscribe(lambda name, document: documents.append((name, document)))
    with plan_devices(STATION, tmp_path, Bench().drivers) as devices:
        lamp = core.soft_signal_rw(float, name="lamp_current_a")
        light = devices.light

        def plan() -> Any:
            yield from bps.prepare(devices.cameras, 0.01, wait=True)
            yield from bp.scan([devices.cameras], light, 500.0, 600.0, lamp, 1.0, 2.0, num=2)

        async def ready() -> None:
            await lamp.connect()

        asyncio.run_coroutine_threadsafe(ready(), engine.loop).result(10)
        engine(plan())
    events = [document["data"] for name, document in documents if name == "event"]
    assert [(event["lamp_current_a"], event["wavelength_nm"]) for event in events] == [(1.0, 500.0), (2.0, 600.0)]


# --- Tiled ------------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("default")  # its own
def test_a_session_goes_into_a_tiled_catalogue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tiled.server", reason="Tiled isn't installed: calibench's extra tiled")
    from lab.capture.tiled_catalogue import open_catalogue, write_session

    bench, store = Bench(), Store(tmp_path / "data")
    bench.settings["camera left"] = {"PixelFormat": "BayerRG12"}
    plan = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=1), FlatSequence(levels=(0.5,), frames=2)))
    session = CaptureSession.start(store, STATION, plan, connect=bench.drivers, name="lens 3")
    session.run()
    documents = store.folder(session.id) / "documents.jsonl"
    with documents.open("a") as lines:  # a run that a power cut ended
        lines.write(json.dumps(["start", {"uid": "cut", "time": 1.0}]) + "\n" + '["descr')
    folder = str(tmp_path / "catalogue")
    assert cli.main(["export", session.id, "--as", "tiled", "--to", folder, "--data", str(tmp_path / "data")]) == 0
    capsys.readouterr()
    catalogue = open_catalogue(folder)
    found = catalogue[session.id]
    assert found.metadata["name"] == "lens 3"
    assert found.metadata["instruments"]["camera left"]["settings"] == {"PixelFormat": "BayerRG12"}
    recordings = store.recording_set(session.id)
    assert set(found["captures"]) == {capture.id for capture in recordings.captures()}
    for capture in recordings.captures():
        there = found["captures"][capture.id]
        np.testing.assert_array_equal(there.read(), recordings.frame(capture))
        assert there.metadata["exposure_s"] == capture.exposure_s
    runs = [found["runs"][uid] for uid in found["runs"]]
    assert {run.metadata["stop"]["exit_status"] for run in runs} == {"success", "abort"}
    (whole,) = [run for run in runs if run.metadata["stop"]["exit_status"] == "success"]
    assert whole.metadata["start"]["session"] == session.id and set(whole) == {"dark", "flat"}
    back = tmp_path / "back"
    assert cli.main(["import", f"{folder}/{session.id}", "--from", "tiled", "--out", str(back)]) == 0
    again = read(back)
    assert again.manifest.cameras == recordings.manifest.cameras
    assert again.manifest.captures == recordings.manifest.captures
    assert again.manifest.instruments == recordings.manifest.instruments
    for capture in recordings.captures():
        np.testing.assert_array_equal(again.frame(again.capture(capture.id)), recordings.frame(capture))
        if (radiance := getattr(capture, "radiance", None)) is not None:
            assert again.spectrum(radiance) == recordings.spectrum(radiance)
    assert cli.main(["import", f"{folder}/other", "--from", "tiled", "--out", str(tmp_path / "no")]) == 2
    assert "has no such session; it has" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(InputError, match="has it already"):
        write_session(catalogue, recordings, documents)


def test_tiled_that_is_not_installed_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tiled.catalog", None)
    store = Store(tmp_path)
    plan = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=1),))
    session = CaptureSession.start(store, STATION, plan, connect=Bench().drivers)
    session.run()
    assert cli.main(["export", session.id, "--as", "tiled", "--to", str(tmp_path / "c"), "--data", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "extra tiled" in " ".join(error.split()) and "Traceback" not in error
