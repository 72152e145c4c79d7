"""Memory of the service and of the mock bench over several sessions, and of all processes of `calibench run --quick`,
with the CPU time that those take.

CALIBENCH_BENCH_SESSIONS (3) quick sessions, one after the other, the last with its report, while their curves are
looked at as the operator's page does. Wanted of a quick run: 1.5 GB in all processes."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from api.client import ServiceClient
from api.keys import Permission, create_key
from api.local_service import service_process
from api.schemas import SessionStart, Then
from benchmarks.process_memory import MemoryWatch, by_kind
from benchmarks.table import Row, show
from lab.bench_process import mock_bench
from lab.capture.store import Store

MB = 1e6
#: Limits (MB, PSS) of the service and of the mock bench, and what is wanted of a quick run, MB and s.
IDLE_MB, SERVICE_MB, BENCH_MB = 320.0, 400.0, 700.0
WANTED_TOGETHER_MB, WANTED_CPU_S = 1500.0, 100.0
SESSIONS = int(os.environ.get("CALIBENCH_BENCH_SESSIONS", "3"))
SETTLE_S, CURVES_EVERY_S = 10.0, 2.0
pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


def watch_session(client: ServiceClient, then: Then | None) -> None:
    """Take a quick session, look at its curves every two seconds, and wait for what follows it."""
    session_id = client.start_session(SessionStart(station="bench", quick=True, then=then)).id
    while (state := client.session(session_id).state) != "finished":
        assert state not in ("failed", "interrupted"), state
        client.curves(session_id)
        time.sleep(CURVES_EVERY_S)
    if then is not None:
        while (following := client.session(session_id).then) is None or following.state in ("waiting", "running"):
            time.sleep(CURVES_EVERY_S)
        assert following.state == "done", following.words


def test_service_and_bench_over_sessions(tmp_path: Path) -> None:
    with contextlib.closing(Store(tmp_path)) as store:
        key = create_key(store, "bench", Permission.ADMIN)
    (tmp_path / "stations").mkdir()
    us = psutil.Process()
    rows = []
    with service_process(tmp_path) as url, ServiceClient(url, key, timeout_s=300.0) as client:
        time.sleep(SETTLE_S)
        rows.append(Row("service, idle, nothing stored", by_kind(us)["service"] / MB, IDLE_MB, "MB", "limit"))
        with mock_bench(()) as file, MemoryWatch(us.pid) as watch:
            (tmp_path / "stations" / "bench.toml").symlink_to(file)
            rows.append(Row("bench, before a session", by_kind(us)["mock bench"] / MB, BENCH_MB, "MB", "limit"))
            for number in range(SESSIONS):
                watch_session(client, Then(kind="pipeline") if number == SESSIONS - 1 else None)
                time.sleep(SETTLE_S)
                found = by_kind(us)
                for kind, limit in (("service", SERVICE_MB), ("mock bench", BENCH_MB)):
                    rows.append(Row(f"{kind}, after session {number + 1}", found[kind] / MB, limit, "MB", "limit"))
            for kind in ("service", "mock bench", "curves of a running session", "one side's fit and diagnosis"):
                rows.append(Row(f"{kind}, at most", watch.peak[kind] / MB, None, "MB"))
    show("Proportional set size of the service and of the mock bench", rows)
    assert all(row.beside is None or row.ours <= row.beside for row in rows)


def test_quick_run(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "calibench", "run", "--quick", "--out", str(tmp_path)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began_s = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    with MemoryWatch(process.pid) as watch:
        printed, _ = process.communicate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert process.returncode in (0, 1), printed
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    rows = [
        Row("CPU time of all processes", cpu_s, WANTED_CPU_S, "s", "wanted"),
        Row("wall clock", time.perf_counter() - began_s, None, "s"),
        Row("all processes, at most", watch.together / MB, WANTED_TOGETHER_MB, "MB", "wanted"),
        *(Row(f"of these {kind}", size / MB, None, "MB") for kind, size in watch.then.items()),
        *(Row(f"{kind}, at most", size / MB, None, "MB") for kind, size in watch.peak.items()),
    ]
    show("calibench run --quick: proportional set size and CPU time", rows)
