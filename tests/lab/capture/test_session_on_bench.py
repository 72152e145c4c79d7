"""A session on the mock bench over its wires: a few steps of most sequences, a kill -9, and a bench that ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import read_station
from lab.capture.store import Store
from lab.capture_kinds.chart import ChartSequence
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandSequence
from lab.capture_kinds.screen import ScreenSequence
from lab.errors import DeviceError
from lab.formats.recording_set import inspect

ROOT = Path(__file__).parents[3]
RUN = """
import sys
from lab.capture.session import CaptureSession
from lab.capture.store import Store
CaptureSession(Store(sys.argv[1]), sys.argv[2], on_progress=lambda p: print(p.done, flush=True)).run()
"""
FEW = CapturePlan(
    (
        DarkSequence(exposures_s=(0.001, 1.0), frames=2),
        FlatSequence(levels=(0.25, 0.5, 0.75), frames=2),
        NarrowbandSequence(from_nm=500, to_nm=600, step_nm=100, passes=2),
        ChartSequence(frames=1),
        ScreenSequence(frames=1),
    )
)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    file = tmp_path / "station.toml"
    command = [sys.executable, "-m", "calibench", "bench", "--station", str(file), "--with-parent"]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "ready":
            break
    yield process, file
    with suppress(BrokenPipeError):
        process.stdin.close()
    process.wait(30)
    process.stdout.close()


def test_a_session_on_the_wires_survives_kill_9_and_says_when_the_bench_dies(
    tmp_path: Path, bench: tuple[subprocess.Popen[str], Path]
) -> None:
    process, file = bench
    station = read_station(file)
    store = Store(tmp_path / "data")
    session = CaptureSession.start(store, station, FEW).id
    total = store.session(session).steps

    client = subprocess.Popen(
        [sys.executable, "-c", RUN, str(store.root), session],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert client.stdout is not None
    for line in client.stdout:
        if int(line) >= 7:  # among the flats, with the shutter open
            client.kill()
    client.wait(30)
    client.stdout.close()
    before = store.session(session)
    assert before.state == "interrupted"
    assert 7 <= before.steps_done < total

    assert CaptureSession(store, session).run().state == "finished"
    recordings = store.recording_set(session)
    problems, _ = inspect(recordings)
    assert problems == []
    assert (
        len(recordings.captures())
        == len({c.frame for c in recordings.captures()})
        == 2 * (4 + 6 + 4 + 1 + len(ScreenSequence.kinds()))
    )
    for side in recordings.sides:
        camera = recordings.camera(side)
        assert camera.black_level_dn is not None
        darks = [recordings.frame(c).mean() for c in recordings.captures("dark", side)]
        assert max(darks) < camera.black_level_dn + 50
        # Flats at a quarter, a half, three quarters of saturation: equal steps of the mean, to 3 % (linearity, dark
        # current).
        mean = {c.id.split("-")[2]: recordings.frame(c).mean() for c in recordings.captures("flat", side)}
        assert (mean["03"] - mean["02"]) / (mean["02"] - mean["01"]) == pytest.approx(1.0, abs=0.03)
        # The screen with half of its cells lit is half as bright, to 10 % (the border of the pattern).
        frames = {
            kind: recordings.frame(recordings.captures(kind, side)[0]) for kind in ("white", "black", "checkerboard")
        }  # type: ignore[call-overload]
        middle = {kind: np.mean(frame[200:280, 280:360]) for kind, frame in frames.items()}
        half = (middle["checkerboard"] - middle["black"]) / (middle["white"] - middle["black"])
        assert half == pytest.approx(0.5, abs=0.1)
    red = recordings.captures("narrowband", "left")[0]
    assert recordings.spectrum(red.radiance).at(red.wavelength_nm) > 0
    assert red.bandwidth_nm is not None
    assert {"monochromator", "spectroradiometer", "display", "stage", "camera left"} <= set(
        store.runs(session)[-1].instruments
    )

    def die(progress: Progress) -> None:
        if progress.done == 6:
            process.kill()

    second = CaptureSession.start(store, station, FEW, on_progress=die)
    with pytest.raises(DeviceError) as caught:
        second.run()
    assert "\n" not in str(caught.value)
    info = store.session(second.id)
    assert (info.state, info.steps_done) == ("failed", 6)
    assert len(store.captures(second.id)) == 2 * 4
    store.close()
