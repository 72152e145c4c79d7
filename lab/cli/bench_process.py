"""The mock bench in an OS process of its own, for commands that are given no station."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from lab.errors import DeviceError

BENCH_START_S, BENCH_END_S = 60.0, 10.0


@contextlib.contextmanager
def mock_bench() -> Iterator[Path]:
    """Start the mock bench as a process of its own, and give its station file; it ends with the block, or with us."""
    with tempfile.TemporaryDirectory(prefix="calibench-bench-") as folder:
        file = Path(folder) / "station.toml"
        command = [sys.executable, "-m", "lab.cli", "bench", "--station", str(file), "--with-parent"]
        # Of its own session: Ctrl-C is for us, and the bench has to be there while the shutter closes.
        bench = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        try:
            _await_ready(bench)
            yield file
        finally:
            assert bench.stdin is not None
            bench.stdin.close()
            try:
                bench.wait(BENCH_END_S)
            except subprocess.TimeoutExpired:
                bench.kill()
                bench.wait()


def _await_ready(bench: subprocess.Popen[str]) -> None:
    """Wait until the bench says that it is ready; what it says afterwards is read and dropped."""
    ready = threading.Event()

    def listen() -> None:
        assert bench.stdout is not None
        for line in bench.stdout:
            if line.strip() == "ready":
                ready.set()
        ready.set()

    threading.Thread(target=listen, daemon=True).start()
    if not ready.wait(BENCH_START_S) or bench.poll() is not None:
        raise DeviceError("mock bench: it doesn't start; see what `calibench bench` says")
