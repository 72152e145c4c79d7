"""What the engine itself takes of a stereo pair of 2 x 1280 x 960: plan, journal, documents, files, hashes. Wanted: 60
ms.

The cameras are objects of this process whose frames are ready, and nothing else moves: what is left is the engine's own
time, the disk's fsyncs among it. The wall time holds where the machine is idle; the CPU time holds anywhere.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from benchmarks.table import Row, show
from drivers.camera.base import Frame, SensorInfo
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import Drivers, Station
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from tests.lab import fake_bench

ROWS, COLS, PAIRS, WANTED_MS = 960, 1280, 200, 60.0
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


class ReadyCamera(fake_bench.FakeCamera):
    """A camera whose frames are there before they are asked for."""

    FRAMES = np.random.default_rng(1).integers(60, 4000, (4, ROWS, COLS), dtype=np.uint16)

    def sensor(self) -> SensorInfo:
        return SensorInfo(ROWS, COLS, "BayerRG12", "RGGB", 12)

    def collect(self) -> Frame:
        raw = self.FRAMES[self.bench.shots % len(self.FRAMES)]
        return Frame(raw, self.exposure_s, 0.0, 25.0, datetime.now(UTC), "BayerRG12", self.bench.shots)


def station() -> Station:
    """The fakes' station with cameras of this size."""
    document: dict[str, Any] = fake_bench.station().model_dump(mode="json")
    for camera in document["cameras"].values():
        camera["datasheet"] |= {"rows": ROWS, "cols": COLS}
    return Station.model_validate(document)


def connected(asked: Station) -> Drivers:
    bench = fake_bench.Bench()
    cameras = {"left": ReadyCamera(bench, "left"), "right": ReadyCamera(bench, "right")}
    return Drivers(**(vars(bench.drivers()) | {"cameras": cameras}))


def test_overhead_of_a_pair(tmp_path: Path) -> None:
    at: dict[str, tuple[float, float]] = {}

    def told(progress: Progress) -> None:
        if progress.state == "running" and progress.done == 0:
            at.setdefault("first", (time.perf_counter(), time.process_time()))
        if progress.state == "packing":
            at.setdefault("packing", (time.perf_counter(), time.process_time()))

    store = Store(tmp_path)
    plan = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=PAIRS),))
    session = CaptureSession.start(store, station(), plan, on_progress=told, connect=connected)
    info = session.run()
    assert info.steps_done == PAIRS and len(store.captures(session.id)) == 2 * PAIRS
    store.close()
    wall_s, cpu_s = (end - begin for begin, end in zip(at["first"], at["packing"], strict=True))
    show(
        f"The engine, {PAIRS} pairs of 2 x {COLS} x {ROWS}, load of the machine {psutil.getloadavg()[0]:.1f}",
        [
            Row("wall time of a pair", 1e3 * wall_s / PAIRS, WANTED_MS, "ms", "wanted"),
            Row("CPU time of a pair", 1e3 * cpu_s / PAIRS, WANTED_MS, "ms", "wanted"),
        ],
    )
