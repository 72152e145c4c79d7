"""Cameras that stream: 30 pairs a second of 1280 x 960 at 12 bits to numpy, what the computer has to do for it, and
what gets lost.

From the mock U3V pair with frames that are ready, in a process of its own over USB/IP, and from pypylon's emulation,
which draws its frames in this process: what it costs alone is measured beside. Wanted: less than one core.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
import usb.core

from benchmarks.table import Row, show
from drivers.camera.base import StreamingCamera
from drivers.camera.basler import BaslerCamera
from drivers.camera.stream import FrameStream
from drivers.camera.u3v import U3vCamera
from drivers.errors import InstrumentError
from mocks.bench import Bench
from mocks.peers import EmulatedBasler
from mocks.usb import InProcessBackend, stereo_pair

ROWS, COLS, PAIRS_PER_S, SECONDS = 960, 1280, 30, 6
WANTED_CORES = 1.0
EXPOSURE_S = 0.005
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def addresses(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[str]]:
    """Of the mock pair."""
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(1)
    for side in ("left", "right"):
        for number in range(8):
            np.save(folder / f"{number}-{side}.npy", rng.integers(0, 4096, (ROWS, COLS), np.uint16))
    command = [sys.executable, "-m", "calibench", "mock", "u3v-stereo", "--frames", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        yield [running.stdout.readline().split()[1] for _ in range(2)]
        running.terminate()


def _measured(name: str, cameras: Sequence[StreamingCamera], alone: float = 0.0) -> None:
    lost: list[str] = []
    for camera in cameras:
        camera.configure(EXPOSURE_S)
    count = PAIRS_PER_S * SECONDS
    series = FrameStream(cameras, count, interval_s=1 / PAIRS_PER_S, in_flight=2, on_loss=lost.append)
    series.next()
    begun, began = time.process_time(), time.perf_counter()
    shapes = {frame.raw.shape for pair in series for frame in pair}
    cores = (time.process_time() - begun) / (time.perf_counter() - began)
    show(
        f"{name}: 2 x {COLS} x {ROWS} x 12 bit",
        [
            Row("pairs", (count - 1) / (time.perf_counter() - began), PAIRS_PER_S, "a second", "asked for"),
            Row("cores", cores - alone, WANTED_CORES, "", "wanted"),
            *([Row("cores of the emulation alone", alone)] if alone else []),
            Row("triggers lost and given again", len(lost)),
        ],
    )
    assert shapes == {(ROWS, COLS)}
    assert cores - alone < WANTED_CORES


@pytest.mark.parametrize("pixel_format", ["BayerRG12", "BayerRG12p"])
def test_mock_pair(addresses: list[str], pixel_format: str) -> None:
    with (
        U3vCamera(addresses[0], pixel_format=pixel_format, output_line="Line1") as left,
        U3vCamera(addresses[1], pixel_format=pixel_format) as right,
    ):
        _measured(f"mock U3V, {pixel_format}", [left, right])


def test_emulated_pair() -> None:
    try:
        EmulatedBasler()
    except InstrumentError as error:
        pytest.skip(str(error))
    with (
        BaslerCamera("0815-0000", pixel_format="BayerRG12") as left,
        BaslerCamera("0815-0001", pixel_format="BayerRG12", trigger_line="Software") as right,
    ):
        for camera in (left, right):
            assert camera._features is not None
            camera._features.set("Width", COLS)
            camera._features.set("Height", ROWS)
        _measured("pypylon's emulation", [left, right], _emulation_alone([left, right]))


def _emulation_alone(cameras: Sequence[BaslerCamera]) -> float:
    """Cores that the emulation takes for the same triggers when nobody looks at the frames."""
    for camera in cameras:
        camera.configure(EXPOSURE_S)
        camera.arm("software")
    begun, began = time.process_time(), time.perf_counter()
    for turn in range(2 * PAIRS_PER_S):
        for camera in cameras:
            camera.fire()
        for camera in cameras:
            camera._camera.RetrieveResult(1000).Release()
        time.sleep(max(0.0, began + (turn + 1) / PAIRS_PER_S - time.perf_counter()))
    cores = (time.process_time() - begun) / (time.perf_counter() - began)
    for camera in cameras:
        camera.disarm()
    return cores


@pytest.mark.parametrize("target", ["sphere", "screen"])
def test_drawn_pair(target: str) -> None:
    """Pairs that the mock bench draws, light, shot noise and read noise anew in each, from its cameras to numpy, all in
    this process."""
    bench = Bench(seed=1, shape=(ROWS, COLS))
    bench.compile_loops()
    bench.place(target)
    bench.set_shutter(True)
    bench.show((np.indices((108, 192)).sum(0) % 2).astype(np.uint8), 10)
    for side in ("left", "right"):
        bench.expose(side, EXPOSURE_S)  # its light is drawn once and kept
    found = [usb.core.find(backend=InProcessBackend([device])) for device in stereo_pair(bench)]
    with (
        U3vCamera("usb://left", device=found[0], output_line="Line1") as left,
        U3vCamera("usb://right", device=found[1]) as right,
    ):
        for camera in (left, right):
            camera.configure(EXPOSURE_S)
        series = FrameStream([left, right], 40)
        series.next()
        begun, began = time.process_time(), time.perf_counter()
        assert len(list(series)) == 39
        cpu_s, wall_s = time.process_time() - begun, time.perf_counter() - began
    show(
        f"the mock bench draws {target}: 2 x {COLS} x {ROWS}",
        [
            Row("pairs, as busy as this machine is", 39 / wall_s, 10.0, "a second", "wanted"),
            Row("CPU a pair", cpu_s / 39, 0.2, "s", "two cores at 10 a second"),
        ],
    )
    assert cpu_s / 39 < 0.2
