"""Sessions: every step exactly once through pauses, aborts, failures and kills, and all instruments safe at the end."""

from __future__ import annotations

import errno
import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from drivers.camera.base import SensorInfo
from drivers.errors import InstrumentError, NoAnswer
from drivers.instrument import Identity
from lab.capture import nexus
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.records import JournalEntry
from lab.capture.session import CaptureSession, Progress
from lab.capture.store import Store
from lab.capture.take_step import DUMMY_FRAMES
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandSequence
from lab.capture_kinds.screen import ScreenSequence
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import inspect, read, write
from tests.lab import fake_bench
from tests.lab.fake_bench import BLACK, SLOPE, Bench

STATION = fake_bench.station()
DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.002, 0.003, 0.004, 0.005), frames=4),))
LIT = CapturePlan(
    (
        DarkSequence(exposures_s=(0.001,), frames=1),
        FlatSequence(levels=(0.2, 0.5, 0.8), frames=2),
    )
)


def begin(
    store: Store, bench: Bench, calibration: CapturePlan, on_progress: Callable[[Progress], None] | None = None
) -> CaptureSession:
    return CaptureSession.start(store, STATION, calibration, connect=bench.drivers, on_progress=on_progress)


def assert_safe(bench: Bench) -> None:
    assert not bench.opened
    assert not bench.lit
    assert {"close monochromator", "close display", "close camera left", "close camera right"} <= set(bench.log)


def assert_whole(store: Store, session: str) -> None:
    """Every step done; every capture there once, with an intact frame of its own."""
    journal = store.journal(session)
    assert all(entry.finished for entry in journal)
    expected = Counter(capture.id for entry in journal for capture in entry.step.captures)
    assert Counter(capture.name for capture in store.captures(session)) == expected
    assert set(expected.values()) == {1}
    problems, _ = inspect(store.recording_set(session))
    assert problems == []


# --- a whole run ------------------------------------------------------------------------------------------------------


def test_a_whole_calibration(store: Store) -> None:
    bench, told = Bench(), []
    session = CaptureSession.start(
        store, STATION, full_plan(STATION, quick=True), connect=bench.drivers, on_progress=told.append
    )
    info = session.run()
    assert (info.state, info.packed, info.steps_done) == ("finished", True, info.steps)
    assert_whole(store, session.id)
    assert_safe(bench)
    assert told[0].state == "connecting"
    assert told[-1].state == "finished"
    assert [p.done for p in told if p.state == "running"] == list(range(info.steps))
    assert all(p.left_s is not None for p in told if p.state == "running" and p.done > 0)
    (run,) = store.runs(session.id)
    assert run.instruments["camera left"].serial_number == "SN-1"
    assert {"python", "bluesky", "numpy"} <= set(run.versions)
    recordings = store.recording_set(session.id)
    assert {c.bandwidth_nm for c in recordings.captures("narrowband")} == {9.48}
    assert all(c.temperature_c == 25.0 and c.time is not None for c in recordings.captures())


def test_flats_at_two_gains_have_exposures_of_their_own(store: Store) -> None:
    """At 12 dB, a factor 4, the same share of saturation takes a quarter of the exposure, within the searches'
    tolerance of 0.05 of 0.75 on either; the signal a second is four times as large."""
    two = CapturePlan((FlatSequence(levels=(0.2, 0.5), frames=2, gains_db=(12.0,)),))
    session = begin(store, Bench(), two)
    session.run()
    assert_whole(store, session.id)
    recordings = store.recording_set(session.id)
    for side in recordings.sides:
        flats = recordings.captures("flat", side)
        assert Counter(c.gain_db for c in flats) == {0.0: 4, 12.0: 4}
        exposure_s = {db: fmean(c.exposure_s for c in flats if c.gain_db == db) for db in (0.0, 12.0)}
        rate = {
            db: fmean((recordings.frame(c).mean() - BLACK) / c.exposure_s for c in flats if c.gain_db == db)
            for db in (0.0, 12.0)
        }
        factor = 10.0 ** (12.0 / 20.0)
        assert exposure_s[0.0] / exposure_s[12.0] == pytest.approx(factor, rel=2.0 * 0.05 / 0.75)
        # means of 4 frames of 2 DN noise, truncated by half a DN of some 500
        assert rate[12.0] / rate[0.0] == pytest.approx(factor, rel=0.01)


def test_dark_frames_follow_bright_flats_with_the_shutter_closed(store: Store) -> None:
    """The three flats before them have 0.9 of saturation, within the search's tolerance of 0.05 of 0.75; the darks have
    the black level, within 4 standard deviations of the mean of the frame's pixels of 2 DN and the half DN of
    truncation."""
    plan = CapturePlan((FlatSequence(levels=(0.2, 0.5), frames=1, darks_after=4, dark_after_s=0.5),))
    bench = Bench()
    session = begin(store, bench, plan)
    session.run()
    assert_whole(store, session.id)
    assert_safe(bench)
    recordings = store.recording_set(session.id)
    for side in recordings.sides:
        last = sorted(recordings.captures(side=side), key=lambda c: c.time)[-7:]
        assert [c.kind for c in last] == ["flat"] * 3 + ["dark"] * 4
        assert {c.exposure_s for c in last[3:]} == {0.5}
        means = [float(recordings.frame(c).mean()) - BLACK for c in last]
        levels = [float(recordings.frame(c).mean()) - BLACK for c in recordings.captures("flat", side)[:2]]
        assert means[0] / levels[1] == pytest.approx(0.9 / 0.5, rel=0.02)
        pixels = recordings.frame(last[-1]).size
        assert means[3:] == pytest.approx([-0.5] * 4, abs=4.0 * 2.1 / np.sqrt(pixels))


def test_a_session_has_a_snapshot_of_its_instruments_and_says_what_changed(store: Store, tmp_path: Path) -> None:
    bench, told = Bench(), []
    bench.settings["camera left"] = {"PixelFormat": "BayerRG12", "BalanceRatio[Red]": 1.0, "ExposureTime": 100.0}
    bench.found["camera left"] = {"BalanceRatio[Red]": 1.8}
    bench.departures["camera left"] = ("Gamma = 0.8: its codes aren't the converter's",)
    first = begin(store, bench, DARKS)
    first.run()
    recordings = store.recording_set(first.id)
    there = recordings.manifest.instruments["camera left"]
    assert (there.serial_number, there.settings["BalanceRatio[Red]"], there.found) == (
        "SN-1",
        1.0,
        {"BalanceRatio[Red]": 1.8},
    )
    assert there.departures == ("Gamma = 0.8: its codes aren't the converter's",)
    assert {"monochromator", "display", "stage"} <= set(recordings.manifest.instruments)
    assert read(write(recordings, tmp_path / "set")).manifest.instruments == recordings.manifest.instruments
    assert (store.runs(first.id)[0].compared_with, store.runs(first.id)[0].changes) == ("", ())

    bench.settings["camera left"] = {"PixelFormat": "BayerRG10", "BalanceRatio[Red]": 1.0, "ExposureTime": 300.0}
    bench.serials["spectroradiometer"] = "SN-2"
    second = begin(store, bench, DARKS, told.append)
    second.run()
    (run,) = store.runs(second.id)
    changes = (
        "spectroradiometer: serial number was SN-1, is SN-2",
        "camera left: PixelFormat was BayerRG12, is BayerRG10",
    )
    assert (run.compared_with, run.changes) == (first.id, changes)
    assert store.recording_set(second.id).manifest.changes == changes
    assert [p.remark for p in told if p.remark] == [f"{line} (in session {first.id})" for line in changes]
    assert all(p.done == 0 for p in told if p.remark)  # before the first capture


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (SensorInfo(fake_bench.ROWS, fake_bench.COLS, "BayerRG8", "RGGB", 8), "its codes have 8 bits, .* says 12"),
        (SensorInfo(12, 16, "BayerRG12", "RGGB", 12), "has 12 x 16 pixels"),
    ],
)
def test_a_camera_that_contradicts_its_data_sheet_takes_no_capture(
    store: Store, monkeypatch: pytest.MonkeyPatch, sensor: SensorInfo, said: str
) -> None:
    bench = Bench()
    monkeypatch.setattr(fake_bench.FakeCamera, "sensor", lambda self: sensor)
    session = begin(store, bench, DARKS)
    with pytest.raises(DeviceError, match=said) as caught:
        session.run()
    assert "\n" not in str(caught.value)
    assert (bench.shots, store.captures(session.id)) == (0, [])
    assert_safe(bench)


def test_blueskys_documents_are_kept(store: Store) -> None:
    session = begin(store, Bench(), LIT)
    session.run()
    lines = (store.folder(session.id) / "documents.jsonl").read_text().splitlines()
    documents = [json.loads(line) for line in lines]
    names = Counter(name for name, _ in documents)
    assert (names["start"], names["stop"], names["event"]) == (1, 1, store.session(session.id).steps)
    assert documents[0][1]["session"] == session.id
    assert documents[-1][1]["exit_status"] == "success"


def test_exposures_are_found_for_each_camera(store: Store) -> None:
    session = begin(store, Bench(), LIT)
    session.run()
    results = {entry.step.id: entry.result for entry in store.journal(session.id)}
    for side, slope in SLOPE.items():
        exposure_s = results["flat/exposure"]["exposure_s"][side]
        level = slope * exposure_s / (4095 - BLACK)
        assert level == pytest.approx(0.75, abs=0.05)
        # Flats are shares of saturation: the mean of the frame at 0.5 is half of the range, to 5 % (the search's
        # tolerance).
        recordings = store.recording_set(session.id)
        flat = next(c for c in recordings.captures("flat", side) if "level-02" in c.id)  # type: ignore[arg-type]
        assert recordings.frame(flat).mean() == pytest.approx(BLACK + 0.5 * (4095 - BLACK), rel=0.08)


def test_no_capture_follows_a_frame_of_other_light_that_is_not_kept(store: Store) -> None:
    """Image lag of such a frame couldn't be predicted: dummy frames come first, and the manifest says how many."""
    bench = Bench()
    plan = CapturePlan((*LIT.sequences, NarrowbandSequence(from_nm=500, to_nm=510, step_nm=10, passes=2)))
    session = begin(store, bench, plan)
    session.run()
    dummies = {c.id: c.dummy_frames for c in store.recording_set(session.id).captures(side="left")}
    in_series = {name for name in dummies if name.startswith("flat-")} - {"flat-level-01-1-left"}
    in_series |= {"narrowband-510nm-2-left"}  # the way back begins where the way there ended
    assert {name for name, count in dummies.items() if count is None} == in_series
    assert set(dummies.values()) == {None, DUMMY_FRAMES}


@pytest.mark.parametrize("slope", [1.0, 500.0, 1e7])
def test_exposures_are_found_from_far_off_or_at_a_limit(
    store: Store, slope: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SLOPE, "left", slope)
    session = begin(store, Bench(), CapturePlan((FlatSequence(levels=(0.5,), frames=1),)))
    session.run()
    exposure_s = store.journal(session.id)[0].result["exposure_s"]["left"]
    wanted = 0.75 * (4095 - BLACK) / slope
    if wanted <= STATION.limits.exposure_max_s:
        assert exposure_s == pytest.approx(wanted, rel=0.08)
    else:
        assert exposure_s == STATION.limits.exposure_max_s


def test_a_sensor_that_saturates_below_its_data_sheet_is_not_taken_for_well_exposed(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SLOPE, "left", 1e5)
    monkeypatch.setattr(
        fake_bench, "WHITE", 3490
    )  # 85 % of the range: above the wanted level, below the limit for saturation
    session = begin(store, Bench(), CapturePlan((FlatSequence(levels=(0.5,), frames=1),)))
    session.run()
    found = store.journal(session.id)[0].result
    assert found["level"]["left"] == pytest.approx(0.75, abs=0.05)
    assert found["exposure_s"]["left"] == pytest.approx(0.75 * (4095 - BLACK) / 1e5, rel=0.08)


def test_a_wavelength_that_the_radiometer_refuses_is_left_out_with_the_reason(store: Store) -> None:
    bench, told = Bench(), []
    bench.refused_nm = 410.0
    session = begin(store, bench, CapturePlan((NarrowbandSequence(to_nm=420),)), told.append)
    assert session.run().state == "finished"
    assert {c.wavelength_nm for c in store.recording_set(session.id).captures("narrowband")} == {400.0, 420.0}
    assert {entry.result.get("skipped") is not None for entry in store.journal(session.id)} == {False, True}
    assert sum("under-exposed" in (p.remark or "") for p in told) == 2
    bench.refused_nm = 0.0  # later steps use a flat's spectrum
    with pytest.raises(DeviceError, match="under-exposed"):
        begin(store, bench, LIT).run()


# --- interruptions ----------------------------------------------------------------------------------------------------


def test_an_unplugged_camera_is_one_clear_line_and_the_rest_is_kept(store: Store) -> None:
    bench = Bench()

    def unplug(progress: Progress) -> None:
        if progress.done == 5:
            bench.unplugged.add("camera right")

    session = begin(store, bench, LIT, unplug)
    with pytest.raises(DeviceError) as caught:
        session.run()
    line = str(caught.value)
    assert "camera right at here: the line is gone; plug it in again" in line
    assert "\n" not in line
    assert not bench.opened
    assert "close monochromator" in bench.log
    info = store.session(session.id)
    assert (info.state, info.steps_done) == ("failed", 5)
    assert info.error == line
    bench.unplugged.clear()
    assert CaptureSession(store, session.id, connect=bench.drivers).run().state == "finished"
    assert_whole(store, session.id)


def test_a_shutter_that_cannot_be_closed_is_said(store: Store) -> None:
    bench = Bench()

    def unplug(progress: Progress) -> None:
        if progress.done == 3:
            bench.unplugged |= {"monochromator", "camera left"}

    session = begin(store, bench, LIT, unplug)
    with pytest.raises(DeviceError, match=r"not brought into a safe state: .*monochromator"):
        session.run()


def test_a_shutter_that_says_open_is_not_taken_for_closed(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fake_bench.FakeMonochromator, "shutter_is_open", lambda self: True)
    session = begin(store, Bench(), DARKS)
    with pytest.raises(DeviceError, match=r"not brought into a safe state: .*its shutter is open"):
        session.run()
    assert session.safe is not None and session.safe.shutter == "unknown"


def test_the_shutter_is_closed_before_the_step_under_way_ends(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera exposes, and doesn't return until the shutter was closed: nothing of the run opens it again."""
    bench, exposes, shut = Bench(), threading.Event(), threading.Event()

    def fire(self: fake_bench.FakeCamera) -> None:
        if bench.opened:
            exposes.set()
            assert shut.wait(30.0)

    monkeypatch.setattr(fake_bench.FakeCamera, "fire", fire)
    session = begin(store, bench, LIT)
    worker = threading.Thread(target=session.run)
    worker.start()
    assert exposes.wait(30.0)
    instruments = session._instruments
    assert session.shut("halted") and not bench.opened and instruments is not None and instruments.shutter is not None
    again = instruments.shutter.set(True).exception(30.0)
    assert "halted" in str(again) and not bench.opened
    session.abort("halted")
    shut.set()
    worker.join(30.0)
    assert store.session(session.id).state == "interrupted" and not bench.opened
    assert session.safe is not None and session.safe.shutter == "closed" and not session.safe.complaints


def test_an_abort_ends_the_packing_which_goes_on_later(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    packed: list[int] = []
    chunk = nexus._chunk

    def slow(frame: Any) -> bytes:
        packed.append(1)
        session.abort("halted")
        time.sleep(0.05)  # the thread that packs sees the abort before the next frame
        return chunk(frame)

    monkeypatch.setattr(nexus, "_chunk", slow)
    session = begin(store, Bench(), DARKS)
    info = session.run()
    assert (info.state, info.error) == ("interrupted", "halted") and info.steps_done == info.steps
    # Those that a thread had begun, two at a time, and no other of the 40 frames.
    assert len(packed) < 10
    monkeypatch.setattr(nexus, "_chunk", chunk)
    assert CaptureSession(store, session.id, connect=Bench().drivers).run().state == "finished"
    assert_whole(store, session.id)


def test_a_run_that_failed_frees_its_journal(store: Store) -> None:
    """At once, without Python's search for cycles: of a session of 20,000 captures it is 70 MB, and a day has many such
    runs."""
    bench = Bench()

    def unplug(progress: Progress) -> None:
        if progress.done == 3:
            bench.unplugged.add("camera left")

    session = begin(store, bench, LIT, unplug)
    gc.collect()
    before = _journal_entries()
    gc.disable()
    try:
        with pytest.raises(DeviceError, match="camera left"):
            session.run()
        assert _journal_entries() <= before + 1  # the step that failed, which the exception's frames hold
    finally:
        gc.enable()


def _journal_entries() -> int:
    return sum(isinstance(one, JournalEntry) for one in gc.get_objects())


def test_an_instrument_that_is_not_there_fails_before_anything_is_taken(store: Store) -> None:
    bench = Bench()
    bench.unplugged.add("spectroradiometer")
    session = begin(store, bench, LIT)
    with pytest.raises(DeviceError, match="spectroradiometer at here"):
        session.run()
    assert bench.shots == 0
    assert store.session(session.id).steps_done == 0


def _refusing(of: type, method: str, message: str, when: Callable[..., bool]) -> Callable[[pytest.MonkeyPatch], None]:
    """A fake instrument one of whose methods refuses what `when` says."""

    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        own = getattr(of, method)

        def asked(instrument: Any, *values: Any) -> Any:
            if when(*values):
                raise InstrumentError(message)
            return own(instrument, *values)

        monkeypatch.setattr(of, method, asked)

    return patch


@pytest.mark.parametrize(
    ("refuses", "message"),
    [
        (
            _refusing(fake_bench.FakeCamera, "check", "camera left: 10 s is too long", lambda s, gain: s > 1.0),
            r"camera left: 10 s is too long; exposure_max_s and gain_db under \[limits\]",
        ),
        (
            _refusing(fake_bench.FakeCamera, "check", "camera left: too short", lambda s, gain: s < 1e-4),
            r"too short; exposure_min_s and gain_db under \[limits\]",
        ),
        (
            _refusing(fake_bench.FakeCamera, "check", "camera left: not 1 ms", lambda s, gain: s == 0.001),
            r"not 1 ms; the sequence dark needs it, with gain_db under \[limits\]",
        ),
        (
            _refusing(fake_bench.FakeCamera, "check_trigger", "camera: no trigger line", lambda line: line == "line"),
            "no trigger line$",
        ),
        (
            _refusing(fake_bench.FakeMonochromator, "check_nm", "monochromator: no white light", lambda nm: nm == 0.0),
            "no white light; the sequence flat needs it: give it other wavelengths",
        ),
        (
            _refusing(fake_bench.FakeMonochromator, "check_slit_um", "monochromator: 5 mm", lambda um: um == 5000.0),
            r"5 mm; it stands as slit_um under \[limits\]",
        ),
        (
            lambda patch: patch.setattr(fake_bench.FakeDisplay, "screen_px", lambda display: (540, 960)),
            (
                r"display: its screen has 540 x 960 px, \[targets.screen\] in the station file says 1080 x 1920: the "
                r"system scales"
            ),
        ),
    ],
)
def test_what_the_plan_needs_and_an_instrument_refuses_is_told_before_anything_moves(
    store: Store,
    monkeypatch: pytest.MonkeyPatch,
    refuses: Callable[[pytest.MonkeyPatch], None],
    message: str,
) -> None:
    bench = Bench()
    refuses(monkeypatch)
    monkeypatch.setattr(fake_bench.FakeStage, "place", lambda stage, target: bench.log.append("moved"))
    station = fake_bench.station(limits={"slit_um": 5000.0})
    plan = CapturePlan((*LIT.sequences, NarrowbandSequence(to_nm=410), ScreenSequence(frames=1)))
    session = CaptureSession.start(store, station, plan, connect=bench.drivers)
    with pytest.raises(DeviceError, match=message) as caught:
        session.run()
    assert "\n" not in str(caught.value)
    assert bench.shots == 0
    assert "moved" not in bench.log
    assert store.session(session.id).steps_done == 0


def test_a_lost_frame_is_taken_once_more(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    collect, lost = fake_bench.FakeCamera.collect, []

    def flaky(camera: Any) -> Any:
        if camera.bench.shots == 3 and not lost:
            lost.append(1)
            raise NoAnswer("camera left: no frame came")
        return collect(camera)

    monkeypatch.setattr(fake_bench.FakeCamera, "collect", flaky)
    session = begin(store, Bench(), DARKS)
    assert session.run().state == "finished"
    assert lost
    assert_whole(store, session.id)


def test_pause_closes_the_shutter_and_resume_goes_on(store: Store) -> None:
    bench, states, shutter = Bench(), [], []

    def follow(progress: Progress) -> None:
        states.append(progress.state)
        if progress.done == 6 and "paused" not in states:
            session.pause()  # takes effect after this step
        if progress.state == "paused":
            shutter.append((bench.opened, bench.lit, store.session(session.id).state))
            threading.Timer(0.2, session.resume).start()

    session = begin(store, bench, LIT, lambda progress: _elsewhere(follow, progress))
    worker = threading.Thread(target=session.run)
    worker.start()
    worker.join(60)
    assert not worker.is_alive()
    assert shutter == [(False, False, "paused")]
    assert store.session(session.id).state == "finished"
    assert_whole(store, session.id)
    assert_safe(bench)


def _elsewhere(call: Callable[[Progress], None], progress: Progress) -> None:
    """Call in another thread: `pause` waits for the run's loop, and this callback runs in that loop."""
    thread = threading.Thread(target=call, args=(progress,))
    thread.start()
    if progress.state == "paused":
        thread.join()


@pytest.mark.parametrize("paused", [False, True])
def test_abort_drops_the_step_under_way_and_keeps_the_rest(store: Store, paused: bool) -> None:
    bench = Bench(delay_s=0.05)
    session = begin(store, bench, DARKS)
    worker = threading.Thread(target=session.run)
    worker.start()
    _until(lambda: store.session(session.id).steps_done >= 3)
    if paused:
        session.pause()
        _until(lambda: store.session(session.id).state == "paused")
    session.abort("enough")
    worker.join(30)
    assert not worker.is_alive()
    info = store.session(session.id)
    assert (info.state, info.error) == ("interrupted", "enough")
    assert 3 <= info.steps_done < 20
    assert_safe(bench)
    assert CaptureSession(store, session.id, connect=bench.drivers).run().state == "finished"
    assert_whole(store, session.id)


def test_a_camera_that_comes_back_after_an_abort_touches_nothing(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, waits, go_on = Bench(), threading.Event(), threading.Event()
    fire = fake_bench.FakeCamera.fire

    def slow(camera: fake_bench.FakeCamera) -> None:
        fire(camera)
        if camera.bench is bench and bench.shots == 4:
            waits.set()
            assert go_on.wait(30)

    monkeypatch.setattr(fake_bench.FakeCamera, "fire", slow)
    session = begin(store, bench, DARKS)
    worker = threading.Thread(target=session.run)
    worker.start()
    assert waits.wait(20)
    session.abort("enough")
    worker.join(30)
    assert CaptureSession(store, session.id, connect=Bench().drivers).run().state == "finished"
    late = [thread for thread in threading.enumerate() if thread.name == "instrument"]
    assert late
    go_on.set()
    for thread in late:
        thread.join(10)
    assert_whole(store, session.id)
    assert not list((store.folder(session.id) / "frames").glob("*"))


def _until(reached: Callable[[], bool], patience_s: float = 20.0) -> None:
    until = time.monotonic() + patience_s
    while not reached():
        assert time.monotonic() < until
        time.sleep(0.01)


def test_an_error_of_the_callback_ends_the_run_safely(store: Store) -> None:
    bench = Bench()

    def broken(progress: Progress) -> None:
        if progress.done == 4:
            raise ValueError("no screen")

    session = begin(store, bench, LIT, broken)
    with pytest.raises(ValueError, match="no screen"):
        session.run()
    assert_safe(bench)
    assert store.session(session.id).state == "failed"


def test_two_processes_do_not_run_one_session(store: Store) -> None:
    session = begin(store, Bench(), DARKS)
    lock = store.lock(session.id)
    assert lock.acquire()
    with pytest.raises(InputError, match="another process runs it"):
        session.run()
    lock.release()


def test_an_exchanged_instrument_is_refused(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()

    def unplug(progress: Progress) -> None:
        if progress.done == 2:
            bench.unplugged.add("camera left")

    session = begin(store, bench, DARKS, unplug)
    with pytest.raises(DeviceError):
        session.run()
    bench.unplugged.clear()
    monkeypatch.setattr(fake_bench.FakeCamera, "identity", lambda camera: Identity("fake", camera.who, "SN-2"))
    with pytest.raises(InputError, match=r"camera left has the serial number SN-2, the session began with\s+SN-1"):
        CaptureSession(store, session.id, connect=bench.drivers).run()


def test_a_camera_of_another_size_is_refused(store: Store) -> None:
    sheet = STATION.cameras["left"].datasheet.model_copy(update={"rows": 48})
    cameras = dict(STATION.cameras) | {"left": STATION.cameras["left"].model_copy(update={"datasheet": sheet})}
    station = STATION.model_copy(update={"cameras": cameras})
    session = CaptureSession.start(store, station, DARKS, connect=Bench().drivers)
    with pytest.raises(DeviceError, match=r"camera left: has 24 x 32 pixels, its data sheet .* 48 x 32"):
        session.run()


def test_on_a_full_disk_the_session_pauses_and_goes_on(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    bench, shown = Bench(), []
    session = begin(store, bench, DARKS)
    session._on_progress = shown.append
    with monkeypatch.context() as broken:

        def full(*_: object) -> None:
            if bench.shots == 5:
                raise OSError(28, "No space left on device")

        broken.setattr("os.fsync", full)
        assert session.run().state == "finished"
    assert_safe(bench)
    assert_whole(store, session.id)
    (paused,) = [now for now in shown if now.state == "paused"]
    assert "No space left on device" in (paused.remark or "")
    # What the page shows of the shutter: closed, while it is paused and while it is packed.
    for now in shown:
        if now.state in ("paused", "packing"):
            assert now.bench is not None and now.bench.shutter_open is False


def test_a_quota_that_takes_no_frame_ends_the_run_with_its_reason(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk has room, and yet no file is taken: the step is tried three times."""
    bench, tries = Bench(), []
    session = begin(store, bench, DARKS)

    def full(*_: object) -> None:
        tries.append(bench.shots)
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    with monkeypatch.context() as broken:
        broken.setattr("os.fsync", full)
        broken.setattr("lab.capture.session.ROOM_S", 0.0)
        with pytest.raises(InputError, match="Disk quota exceeded"):
            session.run()
    assert_safe(bench)
    assert "Disk quota exceeded" in (store.session(session.id).error or "")
    assert CaptureSession(store, session.id, connect=bench.drivers).run().state == "finished"
    assert_whole(store, session.id)


# --- kills ------------------------------------------------------------------------------------------------------------


def _spawn(store: Store, session: str, delay_s: float) -> subprocess.Popen[str]:
    root = Path(__file__).parents[3]
    script = [sys.executable, "-m", "tests.lab.fake_bench", str(store.root), session, str(delay_s)]
    return subprocess.Popen(
        script, cwd=root, stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )


def test_kill_9_loses_nothing_and_repeats_nothing(store: Store) -> None:
    calibration = CapturePlan((DarkSequence(exposures_s=tuple(0.001 * n for n in range(1, 11)), frames=4),))
    session = store.create_session(STATION, calibration.steps(STATION))
    assert store.session(session).steps == 40
    hashes: dict[str, str] = {}
    for at in (6, 22):  # a first run and a resumed one
        process = _spawn(store, session, 0.004)
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= at:
                process.kill()
        process.wait(30)
        process.stdout.close()
        info = store.session(session)
        assert info.state == "interrupted"
        assert at <= info.steps_done < 40
        now = {file.path: file.sha256 for file in store.files(session)}
        assert hashes.items() <= now.items()  # what was finished stays as it was
        hashes = now
    process = _spawn(store, session, 0.0)
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert store.session(session).state == "finished"
    assert len(store.captures(session)) == 80
    assert hashes.items() <= {file.path: file.sha256 for file in store.files(session)}.items()
    assert_whole(store, session)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_in_good_order(store: Store, number: signal.Signals) -> None:
    session = store.create_session(STATION, DARKS.steps(STATION))
    process = _spawn(store, session, 0.2)
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) == 4:
            process.send_signal(number)
    process.wait(30)
    process.stdout.close()
    assert process.returncode != 0
    info = store.session(session)
    assert info.state == "interrupted"
    assert info.error == f"ended by {number.name}"
    assert 4 <= info.steps_done < 20
