"""The service while a session captures: 50 clients that poll and 10 that follow its events, in one run with and without them.

Service and mock bench are processes of their own. The bench doesn't wait, so that a session is as fast as this machine can be: the worst case for
its pace. The clients are a third process, whose own time is part of what is measured. Wanted on two cores: reads answered within 100 ms
(99th percentile), the pace within 10 %. Sessions with and without clients are taken in turn, CALIBENCH_BENCH_ROUNDS (3) of each.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import numpy as np
import psutil
import pytest

from api.client import ServiceClient
from api.keys import Permission, create_key
from api.pytest_plugin import service_process
from api.schemas import SessionStart
from benchmarks.table import Row, show
from lab.capture.store import Store
from lab.cli.bench_process import mock_bench

POLLING, STREAMING, EVERY_S = 50, 10, 1.0
WANTED_P99_MS, WANTED_SLOWER, WANTED_PAGE_MS = 100.0, 0.10, 300.0
SEQUENCES = ("dark", "flat", "narrowband")
ROUNDS = int(os.environ.get("CALIBENCH_BENCH_ROUNDS", "3"))
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@contextlib.contextmanager
def lab(data: Path) -> Iterator[tuple[ServiceClient, str]]:
    """A service with the mock bench as its station; a client of it, and its key."""
    with contextlib.closing(Store(data)) as store:
        key = create_key(store, "bench", Permission.ADMIN)
    (data / "stations").mkdir()
    with mock_bench(()) as station:
        (data / "stations" / "bench.toml").symlink_to(station)
        with service_process(data) as url, ServiceClient(url, key) as client:
            yield client, key


def session(client: ServiceClient, key: str, clients: bool) -> tuple[float, dict[str, list[float]]]:
    """Steps a second of a session, and how long each answer took (ms)."""
    start = SessionStart(station="bench", quick=True, sequences=SEQUENCES, name="with" if clients else "without")
    id = client.start_session(start).id
    asking = None
    if clients:
        port = str(urlsplit(client.url).port)
        command = [
            sys.executable,
            "-m",
            "benchmarks.service_clients",
            port,
            id,
            str(POLLING),
            str(STREAMING),
            str(EVERY_S),
        ]
        asking = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert asking.stdin is not None and asking.stdout is not None
        asking.stdin.write(f"{key}\n")
        asking.stdin.flush()
        assert asking.stdout.readline() == "ready\n"
    while client.session(id).steps_done < 5:  # connected, and every client is there
        time.sleep(0.2)
    began_s, first = time.perf_counter(), client.session(id).steps_done
    while (found := client.session(id)).state not in ("packing", "finished"):
        assert found.state == "running", found
        time.sleep(0.2)
    pace = (found.steps_done - first) / (time.perf_counter() - began_s)
    told: dict[str, list[float]] = {}
    if asking is not None:
        said, _ = asking.communicate()
        assert asking.returncode == 0
        told = json.loads(said)
    client.wait_session(id)
    return pace, told


def test_reads_and_pace_with_clients(tmp_path: Path) -> None:
    paces: dict[bool, list[float]] = {False: [], True: []}
    answers: list[dict[str, list[float]]] = []
    with lab(tmp_path) as (client, key):
        session(client, key, False)  # libraries are loaded
        for _ in range(ROUNDS):
            for clients in (False, True):
                pace, told = session(client, key, clients)
                paces[clients].append(pace)
                answers += [told] if clients else []
    reads = [[ms for name, of in told.items() if name != "events" for ms in of] for told in answers]
    p99 = [float(np.percentile(of, 99)) for of in reads]
    slower = [1.0 - b / a for a, b in zip(paces[False], paces[True], strict=True)]
    rows = [
        Row("p99 of reads, median of the rounds", statistics.median(p99), WANTED_P99_MS, "ms", "wanted"),
        Row("p99 of reads, best and worst round", min(p99), max(p99), "ms", "the worst"),
        Row("median of reads", statistics.median(ms for of in reads for ms in of), None, "ms"),
        Row("reads a second", len(reads[0]) / (len(reads[0]) / POLLING * EVERY_S), None, "1/s"),
        Row("pace without clients", statistics.median(paces[False]), None, "steps/s"),
        Row("pace with clients", statistics.median(paces[True]), statistics.median(paces[False]), "steps/s", "without"),
        Row("slower by, median of the pairs", 100 * statistics.median(slower), 100 * WANTED_SLOWER, "%", "wanted"),
        Row("slower by, best and worst pair", 100 * min(slower), 100 * max(slower), "%", "the worst"),
    ]
    for name in sorted(answers[0]):
        if name != "events":
            every = [ms for told in answers for ms in told.get(name, [])]
            rows.append(
                Row(f"p99 of {name} ({len(every)})", float(np.percentile(every, 99)), WANTED_P99_MS, "ms", "wanted")
            )
    load = psutil.getloadavg()[0]
    show(f"{POLLING} polling and {STREAMING} streaming clients, {ROUNDS} rounds, load of the machine {load:.1f}", rows)
    assert all(told["events"] for told in answers)


def test_the_first_page(tmp_path: Path) -> None:
    with lab(tmp_path) as (client, _), httpx.Client(base_url=client.url, trust_env=False) as browser:
        times = []
        for _ in range(20):
            began_s = time.perf_counter()
            page = browser.get("/").text
            for name in ("operator.css", "operator.js", "page.js", "charts.js", "stations.js", "queue.js", "watch.js"):
                assert browser.get(f"/static/{name}").status_code == 200
            times.append(1e3 * (time.perf_counter() - began_s))
            assert "operator.js" in page
    show(
        "The first page, its files one after the other",
        [Row("median", statistics.median(times), WANTED_PAGE_MS, "ms", "wanted")],
    )
