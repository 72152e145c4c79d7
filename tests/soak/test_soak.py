"""A day in virtual time: darks and flats on a mock bench whose instruments fail at 1 % of their answers, in every way
they know.

Each failure ends the run with one line; the session is taken up again until it is finished. `make soak` takes 20,000
captures, SOAK_CAPTURES another number. The exposures are such that 20,000 captures take 24 hours on the bench's clock.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.errors import DeviceError
from lab.formats.recording_set import inspect
from mocks.bench import Bench
from mocks.cornerstone260 import MockCornerstone260
from mocks.specbos1211 import MockSpecbos1211
from mocks.stage import MockStage
from mocks.usb import serve_usbip, stereo_pair
from mocks.wire import FRAME_KINDS, KINDS, Endpoint, Fault, Grammar, Pty, Tcp, serve
from sim.memory import share_arenas

CAPTURES = int(os.environ.get("SOAK_CAPTURES", "48"))
#: Rows and columns of a frame: small, as drawing and writing them takes most of the time.
SHAPE = (240, 320)
#: Share of the answers that break.
RATE = 0.01
#: Exposures of the darks, half of the pairs: with these 10,000 pairs take 24 h.
DARK_S = (7.0, 17.0, 28.0)
#: What a resumed session may take: far more than 1 % of faults needs.
MOST_RUNS = 50 + CAPTURES


def faults(seed: int, answers: int, kinds: tuple[str, ...] = KINDS) -> tuple[Fault, ...]:
    """Faults of every kind at RATE of so many answers, after the first ones, with which a driver connects for the first
    time."""
    rng = np.random.default_rng(seed)
    seconds = {"late": 1.5, "unplug": 0.3}
    broken = np.flatnonzero(rng.random(answers) < RATE) + 20
    return tuple(
        Fault(kind, int(at), value=seconds.get(kind))
        for at, kind in zip(broken, rng.choice(kinds, broken.size), strict=True)
    )


class _Bench:
    """The mock bench in this process, its faults, and its station."""

    def __init__(self, folder: Path, running: contextlib.ExitStack) -> None:
        self.place = Bench(seed=11, shape=SHAPE)
        stop = threading.Event()
        running.callback(stop.set)
        answers = 60 * CAPTURES + 1000
        addresses = {}
        lines: list[tuple[str, Grammar, Endpoint]] = [
            ("monochromator", MockCornerstone260(self.place), Pty(folder / "mono")),
            ("spectroradiometer", MockSpecbos1211(self.place), Pty(folder / "radiometer")),
            ("stage", MockStage(self.place), Tcp("127.0.0.1", 0)),
        ]
        for seed, (name, grammar, endpoint) in enumerate(lines):
            ready = threading.Event()
            options = {"faults": faults(seed, answers), "announce": lambda address, ready=ready: ready.set()}
            thread = threading.Thread(target=serve, args=(grammar, endpoint, stop), kwargs=options, daemon=True)
            thread.start()
            assert ready.wait(30)
            addresses[name] = endpoint.address
        cameras = stereo_pair(self.place)
        for side in ("left", "right"):
            self.place.expose(side, 0.001)
        for seed, device in enumerate(cameras):
            device.fail(faults(102 + seed, answers, KINDS + FRAME_KINDS))
        server = running.enter_context(serve_usbip(cameras))
        quick = {"timeout_s": 0.7}
        sheets = self.place.station_cameras()
        self.station = Station.model_validate(
            {
                "monochromator": {
                    "driver": "cornerstone260",
                    "address": addresses["monochromator"],
                    "move_timeout_s": 2.0,
                    **quick,
                },
                "spectroradiometer": {
                    **{"driver": "specbos1211", "address": addresses["spectroradiometer"]},
                    **{"measure_timeout_s": 1.0, "fetch_timeout_s": 0.5, **quick},
                },
                "stage": {"driver": "operator", "address": addresses["stage"], "place_timeout_s": 1.0, **quick},
                "cameras": {
                    side: {
                        **{"driver": "u3v", "address": server.url(device.identity.serial_number), "timeout_s": 1.0},
                        **({"output_line": "Line1"} if side == "left" else {}),
                        "datasheet": sheets[side],
                    }
                    for side, device in zip(("left", "right"), cameras, strict=True)
                },
                "targets": {"cap": {"kind": "cap"}, "sphere": {"kind": "sphere"}},
                "limits": {"exposure_max_s": 30.0},
            }
        )


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[_Bench]:
    with contextlib.ExitStack() as running:
        yield _Bench(tmp_path, running)


@pytest.mark.slow
@pytest.mark.timeout(12 * 3600)
def test_a_day_of_captures_with_faults_ends_whole(
    tmp_path: Path, bench: _Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # pytest keeps every log record, and with the traceback of a run that ended all that run held: its journal first of
    # all.
    monkeypatch.setattr(logging.getLogger("bluesky"), "propagate", False)
    pairs = CAPTURES // 2
    flats = max(1, pairs // 8)
    plan = CapturePlan(
        (
            DarkSequence(exposures_s=DARK_S, frames=max(1, (pairs - 4 * flats) // len(DARK_S))),
            FlatSequence(levels=(0.2, 0.4, 0.6, 0.8), frames=flats),
        )
    )
    share_arenas()  # as the command line does
    process = psutil.Process()
    memory: list[tuple[int, int]] = []
    store = Store(tmp_path / "data")
    began_s = bench.place.clock.now()
    session = CaptureSession.start(store, bench.station, plan).id
    complaints: Counter[str] = Counter()
    retaken: Counter[str] = Counter()

    def note(progress: Progress) -> None:
        if progress.state == "running":  # to pack the session takes memory of its own, and gives it back
            memory.append((progress.done, process.memory_info().rss))
        if progress.remark:
            assert "\n" not in progress.remark
            retaken[re.sub(r"[\d.]+", "N", progress.remark)[:100]] += 1

    for _ in range(MOST_RUNS):
        running = CaptureSession(store, session, on_progress=note)
        try:
            if running.run().state == "finished":
                break
        except DeviceError as error:
            assert "\n" not in str(error)
            complaints[re.sub(r"[\d.]+", "N", str(error))[:100]] += 1
    assert store.session(session).state == "finished"
    recordings = store.recording_set(session)
    captures = recordings.captures()
    problems, _ = inspect(recordings)
    assert problems == []
    assert len({capture.frame for capture in captures}) == len(captures) == 2 * pairs_of(plan)
    assert not bench.place.light.shutter_open
    # Flat: once darks and flats have been drawn (after 60 %), memory grows by less than 64 bytes a capture and 32 MB of
    # caches.
    pairs_taken = pairs_of(plan)
    first = [rss for done, rss in memory if done >= 0.6 * pairs_taken][:5]
    growth = memory[-1][1] - min(first)
    done, rss = np.array([(2 * pairs, held) for pairs, held in memory if pairs >= 0.6 * pairs_taken], float).T
    slope = np.polyfit(done, rss, 1)[0] if np.ptp(done) > 0 else 0.0
    assert growth < 32e6 + 64 * CAPTURES
    with capsys.disabled():
        hours = (bench.place.clock.now() - began_s) / 3600
        print(
            f"\nsoak: {len(captures)} captures, {hours:.1f} h of virtual time, {sum(complaints.values())} runs ended "
            f"by faults, {sum(retaken.values())} frames "
            f"taken again, memory {growth / 1e6:+.1f} MB over the last two fifths, {slope / 1e3:+.2f} MB a thousand "
            "captures there"
        )
        for words, count in (complaints + retaken).most_common(16):
            print(f"  {count} x {words} ...")
    store.close()


def pairs_of(plan: CapturePlan) -> int:
    """Pairs of frames that a plan takes."""
    dark, flat = plan.sequences
    assert isinstance(dark, DarkSequence)
    assert isinstance(flat, FlatSequence)
    return len(dark.exposures_s) * dark.frames + len(flat.levels) * flat.frames
