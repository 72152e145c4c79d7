"""The mock bench in an OS process of its own, for commands that are given no station."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from lab.errors import DeviceError, InputError

BENCH_START_S, BENCH_END_S = 60.0, 10.0


@contextlib.contextmanager
def mock_bench(conceal: Sequence[str], options: Sequence[str] = ()) -> Iterator[Path]:
    """Start `calibench bench` and give its station file; the bench ends with the block, or with this process.

    `conceal`: what the bench's option of that name takes, one item an effect; `options`: others of its options. Raises
    InputError with the bench's own line where it refuses an option, DeviceError where it doesn't start.
    """
    with tempfile.TemporaryDirectory(prefix="calibench-bench-") as folder:
        file = Path(folder) / "station.toml"
        command = [sys.executable, "-m", "calibench", "bench", "--station", str(file), "--with-parent"]
        command += [*(f"--conceal={item}" for item in conceal), *options]
        # A session of its own: Ctrl-C ends this process alone, and the bench serves until the shutter is closed.
        bench = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            try:
                _await_ready(bench)
            except BaseException:  # it holds nothing yet, and looks at standard input only once it is ready
                bench.kill()
                raise
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
    """Wait until the bench prints `ready`. Afterwards its output is dropped, and its errors go to our stderr."""
    ready, ended = threading.Event(), threading.Event()
    complaints: list[str] = []

    def listen(lines: IO[str]) -> None:
        with lines:
            for line in lines:
                if line.strip() == "ready":
                    ready.set()
        ended.set()
        ready.set()

    def complain(lines: IO[str]) -> None:
        with lines:
            for line in lines:
                if ready.is_set() and not ended.is_set():
                    print(line, end="", file=sys.stderr)
                else:
                    complaints.append(line.strip())

    assert bench.stdout is not None
    assert bench.stderr is not None
    threading.Thread(target=listen, args=(bench.stdout,), daemon=True).start()
    complaining = threading.Thread(target=complain, args=(bench.stderr,), daemon=True)
    complaining.start()
    if not ready.wait(BENCH_START_S):
        raise DeviceError(f"mock bench: not ready within {BENCH_START_S:g} s; see what `calibench bench` prints")
    if not ended.is_set():
        return
    code = bench.wait(BENCH_END_S)
    complaining.join(BENCH_END_S)
    why = "\n".join(line.removeprefix("calibench: ") for line in complaints if line)
    if code == InputError.exit_code and why:
        raise InputError(why)
    raise DeviceError(f"mock bench: it doesn't start ({why or f'exit code {code}'}); see what `calibench bench` prints")
