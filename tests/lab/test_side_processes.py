"""The sides in processes: the same findings as in one process, and a clean end in all cases."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab import side_processes
from lab.diagnose import diagnose
from lab.errors import InputError
from lab.formats.recording_set import Manifest, RecordingSet, read, write
from lab.side_processes import kept_processes

ROWS, COLS, BLACK_DN = 40, 48, 64.0


def _darks() -> RecordingSet:
    """Eight dark frames of each side."""
    rng = np.random.default_rng(5)
    camera: dict[str, Any] = {
        "rows": ROWS,
        "cols": COLS,
        "cfa": "MONO",
        "bit_depth": 12,
        "conversion_gain_dn_per_e": 0.4,
    }
    captures, frames = [], {}
    for side in ("left", "right"):
        for k in range(8):
            name = f"dark-{side}-{k}"
            captures.append(
                {"id": name, "kind": "dark", "side": side, "frame": f"frames/{name}.npy", "exposure_s": (0.01,
                0.4)[k % 2],
                 "time": f"2026-03-01T10:{5 * k:02d}:00Z", "temperature_c": 25.0}
            )  # fmt: skip
            frames[f"frames/{name}.npy"] = np.round(rng.normal(BLACK_DN, 2.0, (ROWS, COLS))).astype(np.uint16)
    manifest = {"cameras": {"left": camera, "right": camera}, "captures": captures}
    return RecordingSet(Manifest.model_validate(manifest), frames)


def test_processes_find_what_one_process_finds() -> None:
    recordings = _darks()
    told: list[tuple[str, float]] = []
    apart = diagnose(recordings, progress=lambda text, share: told.append((text, share)))
    assert apart == diagnose(recordings, at_once=False)
    assert {curve.side for curve in apart.curves} == {"left", "right"}
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert {text.rsplit("(", 1)[1] for text, _ in told[:-1]} == {"left)", "right)"}


def test_an_error_in_a_process_is_the_callers(tmp_path: Path) -> None:
    """The same type and words as in one process; a frame that is missing is found when it is read."""
    folder = write(_darks(), tmp_path / "set")
    recordings = pickle.loads(pickle.dumps(read(folder)))  # without the frames that were read already
    (folder / "frames" / "dark-right-3.npy").unlink()
    with pytest.raises(InputError) as alone:
        diagnose(recordings, at_once=False)
    with pytest.raises(InputError) as apart:
        diagnose(recordings)
    assert str(apart.value) == str(alone.value)
    assert "dark-right-3" in str(apart.value)


def test_what_the_callers_progress_raises_ends_all_processes() -> None:
    class Enough(Exception):
        pass

    def stop(text: str, share: float) -> None:
        raise Enough

    with pytest.raises(Enough):
        diagnose(_darks(), progress=stop)
    assert not _children()


def test_a_process_that_was_killed_is_told_in_one_line() -> None:
    def kill(text: str, share: float) -> None:
        for child in _children():
            os.kill(child, signal.SIGKILL)

    with pytest.raises(InputError, match="ended with signal 9; where memory was short"):
        diagnose(_darks(), progress=kill)
    assert not _children()


def test_kept_processes_take_the_next_task_and_a_dead_one_is_replaced() -> None:
    recordings = _darks()
    with kept_processes():
        first = diagnose(recordings)
        kept = _children()
        assert len(kept) == 2
        assert diagnose(recordings) == first
        assert _children() == kept
        os.kill(kept[0], signal.SIGKILL)
        os.waitid(os.P_PID, kept[0], os.WEXITED | os.WNOWAIT)
        assert diagnose(recordings) == first
        assert len(_children()) == 2
        assert kept[0] not in _children()
    assert not _children()


def test_a_process_that_was_ended_carries_nothing_out() -> None:
    """Ctrl-C while the listening thread is being started: the thread finds closed pipes."""
    process = side_processes._Process()
    process.end()
    said: list[object] = []
    process.carry_out(int, said.append)
    assert not said
    assert not _children()


def test_ctrl_c_ends_cleanly(tmp_path: Path) -> None:
    """One line, exit code 130, and no process is left."""
    write(_darks(), tmp_path / "set")
    line = [sys.executable, "-m", "calibench", "diagnose", str(tmp_path / "set")]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    # one is enough: on a busy machine the first may be done before the second begins
    while not (begun := _children(process.pid)) and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err.strip()) == (130, "calibench: interrupted"), out
    assert begun
    # one that had just been started ends by itself when it finds nobody to hand it work
    ends = time.monotonic() + 20.0
    while (left := [child for child in begun if Path(f"/proc/{child}").exists()]) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not left


def _children(of: int | None = None) -> list[int]:
    """Processes of the diagnosis that a process (this one) started."""
    parent = of or os.getpid()
    found = []
    for task in Path(f"/proc/{parent}/task").iterdir():
        with suppress(FileNotFoundError):  # a thread that has just ended
            found += [int(child) for child in (task / "children").read_text().split()]
    return [child for child in found if b"lab.side_processes" in Path(f"/proc/{child}/cmdline").read_bytes()]
