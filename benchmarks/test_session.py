"""All fits of a whole session and its diagnosis, as a user runs them: wall clock, CPU time and memory of `calibench
fit` and `diagnose`.

Two cameras of 1280 x 960, some 190 frames of each (`benchmarks.big_session`, 1 GB, in a temporary folder), of which all
are read and looked through. Wanted on two cores: 90 s for the fits, 240 s for the diagnosis with them. And the
diagnosis of one camera of 600 frames of a megapixel (`benchmarks.many_frames`, 1.2 GB): 90 s.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import psutil
import pytest

from benchmarks.table import Row, show
from lab.fit.geometry import fit_geometry
from lab.fit.mtf import fit_mtf
from lab.fit.noise.noise_fit import fit_noise
from lab.fit.psf.recordings import fit_psf_field
from lab.fit.spectral.recordings import fit_spectral
from lab.formats import recording_set as recording

T = TypeVar("T")
WANTED_S, WANTED_BYTES = {"fit": 90.0, "diagnose": 240.0}, 3 << 30
MANY_FRAMES_S, MANY_FRAMES_BYTES = 90.0, 3 << 29
pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session's folder: CALIBENCH_BENCH_SESSION if that names one made before, else a new one."""
    made = os.environ.get("CALIBENCH_BENCH_SESSION")
    if made:
        return Path(made)
    folder = tmp_path_factory.mktemp("session")
    subprocess.run([sys.executable, "-m", "benchmarks.big_session", str(folder)], check=True)
    return folder


def _most_held_bytes(command: list[str]) -> int:
    """Run a command: the most that it and its processes held together, shared pages counted once, looked at twice a
    second."""
    most = 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as running:
        while running.poll() is None:
            held = 0
            with contextlib.suppress(psutil.NoSuchProcess):
                first = psutil.Process(running.pid)
                for one in (first, *first.children(recursive=True)):
                    held += one.memory_full_info().pss
            most = max(most, held)
            time.sleep(0.5)
    assert running.returncode == 0
    return most


@pytest.mark.parametrize("name", WANTED_S)
def test_the_command(session: Path, tmp_path: Path, name: str) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begun = time.perf_counter()
    command = [sys.executable, "-m", "calibench", name, str(session), "--json", str(tmp_path / "found.json")]
    memory = _most_held_bytes(command)
    wall = time.perf_counter() - begun
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    captures = json.loads((session / "manifest.json").read_text())["captures"]
    frames = len({capture["frame"] for capture in captures})
    show(
        f"calibench {name}: 2 cameras of 1280 x 960, {frames} frames, {len(captures)} captures",
        [
            Row("wall clock, as busy as this machine is", wall, WANTED_S[name], "s", "wanted on two free cores"),
            Row("CPU", cpu, 2.0 * WANTED_S[name], "s", "two cores for as long"),
            Row("of that in the kernel", after.ru_stime - before.ru_stime, None, "s"),
            Row("memory of all its processes", memory / 2**30, WANTED_BYTES / 2**30, "GiB", "wanted"),
        ],
    )
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["skipped"] == [] if name == "fit" else found["verdict"] == "explained"
    assert memory < WANTED_BYTES


def test_many_frames(tmp_path: Path) -> None:
    """Every frame is read a few times: memory is that of single frames, and of the 256 MB that a set keeps."""
    folder = tmp_path / "set"
    command = [sys.executable, "-m", "benchmarks.many_frames"]
    try:
        subprocess.run([*command, "write", str(folder)], check=True)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        begun = time.perf_counter()
        memory = _most_held_bytes([*command, "diagnose", str(folder)])
        wall = time.perf_counter() - begun
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    show(
        "diagnosis of one camera of 1024 x 1024: 300 darks and 300 flats",
        [
            Row("wall clock, as busy as this machine is", wall, MANY_FRAMES_S, "s", "wanted on free cores"),
            Row("CPU", cpu, MANY_FRAMES_S, "s", "one core for as long"),
            Row("memory", memory / 2**30, MANY_FRAMES_BYTES / 2**30, "GiB", "wanted"),
        ],
    )
    assert memory < MANY_FRAMES_BYTES


def test_the_steps(session: Path) -> None:
    rows: list[Row] = []

    def spent(name: str, work: Callable[[], T]) -> T:
        begun = time.process_time()
        found = work()
        rows.append(Row(name, time.process_time() - begun, None, "CPU s"))
        return found

    recordings = spent("reading and looking through, both cameras", lambda: recording.read(session))
    noise = spent("noise", lambda: fit_noise(recordings, "left"))
    spent("spectral", lambda: fit_spectral(recordings, "left", noise))
    spent("MTF", lambda: fit_mtf(recordings, "left", noise))
    spent("PSF", lambda: fit_psf_field(recordings, "left"))
    spent("geometry", lambda: fit_geometry(recordings, "left"))
    show("the steps, of one camera", rows)
