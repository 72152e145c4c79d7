"""kill -9 of the service, of a job's worker, and of the bench, at random moments: nothing is captured twice or lost,
the shutter closes.

Real processes: `calibench serve`, `calibench bench`, a Dask scheduler with a worker. After each kill the session and
the job tell the reason and go on, and every finished session is read back: each capture of its plan once, each frame
with its hash. `make kills` takes KILLS of them, by default 20."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import psutil
import pytest
from distributed import LocalCluster

from api.client import ServiceClient
from api.keys import Permission, create_key
from api.schemas import SessionStart
from lab.bench_process import mock_bench
from lab.capture.store import Store
from tests.api.conftest import served, shutter_is_open

KILLS = int(os.environ.get("KILLS", "20"))
SEED = int(os.environ.get("KILLS_SEED", "1"))
#: Wanted: the shutter is closed so long (s) after the service is started again. And the longest wait for anything.
CLOSED_S, PATIENCE_S = 5.0, 120.0
WHAT = ("service", "worker", "bench")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(60 * KILLS + 600)]


class Laboratory:
    """The processes, and what was seen of them."""

    def __init__(self, data: Path, cluster: LocalCluster) -> None:
        self.data, self.cluster = data, cluster
        (data / "stations").mkdir(parents=True)
        self.station = data / "stations" / "bench.toml"
        store = Store(data)
        self.key = create_key(store, "kills", Permission.ADMIN)
        store.close()
        self.bench, self.service = ExitStack(), ExitStack()
        self.seen: Counter[str] = Counter()
        self.closed_s: list[float] = []  # until the shutter was closed
        self.safe_s: list[float] = []  # until all instruments were safe
        self.told_s: list[float] = []  # until that was recorded
        self.start_bench()
        self.start_service()

    def start_bench(self) -> None:
        before = {one.pid for one in psutil.Process().children()}
        file = self.bench.enter_context(mock_bench(()))
        (self.bench_pid,) = {one.pid for one in psutil.Process().children()} - before
        self.station.write_text(file.read_text())

    def start_service(self) -> None:
        url, self.process, self.output = self.service.enter_context(served(self.data))
        self.client = self.service.enter_context(ServiceClient(url, self.key))

    def close(self) -> None:
        self.service.close()
        self.bench.close()

    def until_running(self, session_id: str) -> None:
        until = time.monotonic() + PATIENCE_S
        while (state := self.client.session(session_id).state) != "running":
            assert state in ("connecting", "packing", "finished") and time.monotonic() < until, state
            if state == "finished":
                return
            time.sleep(0.02)

    def kill_service(self, session_id: str) -> None:
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait(10.0)
        self.service.close()
        opened = shutter_is_open(self.station)
        self.seen["shutter left open"] += opened
        store = Store(self.data)
        ended_badly = session_id in store.under_way()
        stuck: list[str] = []
        said_s: dict[str, float] = {}

        def watch() -> None:
            """When the service says that the shutter is closed and that the station is safe, and when the registry
            does: it answers some time after that."""
            began_s = time.monotonic()
            until = began_s + PATIENCE_S
            while session_id in store.under_way() and time.monotonic() < until:
                for line in ("its shutter was closed", "its station was made safe"):
                    if line in self.output.read_text():
                        said_s.setdefault(line, time.monotonic() - began_s)
                time.sleep(0.02)
            stuck.extend(store.under_way())
            said_s["recorded"] = time.monotonic() - began_s

        self.output.write_text("")  # what the service said before
        watching = threading.Thread(target=watch)
        watching.start()
        try:
            self.start_service()
        finally:
            watching.join()
            store.close()
        if ended_badly:
            recorded_s = said_s["recorded"]
            self.closed_s.append(said_s.get("its shutter was closed", recorded_s))
            self.safe_s.append(said_s.get("its station was made safe", recorded_s))
            self.told_s.append(recorded_s)
        assert session_id not in stuck and not shutter_is_open(self.station)
        found = self.client.session(session_id)
        if ended_badly and found.state == "interrupted":
            assert found.error is not None and "kill -9" in found.error and "made safe" in found.error
            self.seen["session told why"] += 1

    def kill_bench(self, session_id: str) -> None:
        os.kill(self.bench_pid, signal.SIGKILL)
        until = time.monotonic() + PATIENCE_S
        while (found := self.client.session(session_id)).state not in ("failed", "interrupted", "finished"):
            assert time.monotonic() < until, found
            time.sleep(0.05)
        if found.state != "finished":
            assert found.error
            self.seen["session told why"] += 1
        self.bench.close()
        self.start_bench()
        assert not shutter_is_open(self.station)

    def kill_worker(self, finished: str | None, rng: random.Random) -> None:
        """While it does a job on a session that is finished; the job is started again."""
        job = self.client.start_job("fit", finished).id if finished is not None else None
        while job is not None and self.client.job(job).state == "queued":
            time.sleep(0.02)
        time.sleep(rng.uniform(0.0, 1.0))
        for worker in self.cluster.workers.values():
            os.kill(worker.pid, signal.SIGKILL)
        if job is None:
            return
        until = time.monotonic() + PATIENCE_S
        while (found := self.client.job(job)).state not in ("done", "failed"):
            assert time.monotonic() < until, found
            time.sleep(0.05)
        if found.state == "failed":
            assert found.error is not None and "worker" in found.error
            self.seen["job told why"] += 1
        again = self.client.wait_job(self.client.start_job("fit", finished or "").id, PATIENCE_S)
        assert again.state == "done"

    def go_on(self, session_id: str) -> None:
        """Resume the session on the station where it is now."""
        if self.client.session(session_id).state in ("interrupted", "failed"):
            self.client.request("POST", f"/sessions/{session_id}/resume", json={"station": "bench"})

    def check(self, session_id: str) -> int:
        """Every capture of the plan is there once, with the hash of its frame; how many there are."""
        store = Store(self.data)
        try:
            planned = [capture.id for entry in store.journal(session_id) for capture in entry.step.captures]
            taken = [capture.name for capture in store.captures(session_id)]
            assert Counter(taken) == Counter(planned) and max(Counter(taken).values()) == 1
            recordings = store.recording_set(session_id)
            for capture in recordings.captures():
                recordings.frame(capture)  # raises where the SHA-256 differs
        finally:
            store.close()
        return len(taken)


@contextmanager
def laboratory(data: Path) -> Iterator[Laboratory]:
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as cluster,
        pytest.MonkeyPatch.context() as patched,
    ):
        patched.setenv("CALIBENCH_SCHEDULER", cluster.scheduler_address)
        made = Laboratory(data, cluster)
        try:
            yield made
        finally:
            made.close()


def test_nothing_is_lost_and_the_shutter_closes(tmp_path: Path) -> None:
    rng = random.Random(SEED)
    finished: list[str] = []
    captures = 0
    with laboratory(tmp_path / "data") as lab:
        start = SessionStart(station="bench", quick=True, sequences=("dark", "flat"))
        session_id = ""
        for at in range(KILLS):
            state = lab.client.session(session_id).state if session_id else "finished"
            if state == "finished":
                if session_id:
                    captures += lab.check(session_id)
                    finished.append(session_id)
                session_id = lab.client.start_session(start).id
            lab.until_running(session_id)
            time.sleep(rng.uniform(0.0, 2.5))
            what = WHAT[at % 3]
            lab.seen[f"kills of the {what}"] += 1
            if what == "service":
                lab.kill_service(session_id)
            elif what == "bench":
                lab.kill_bench(session_id)
            else:
                lab.kill_worker(finished[-1] if finished else None, rng)
            lab.go_on(session_id)
        lab.client.wait_session(session_id, PATIENCE_S)
        captures += lab.check(session_id)
        runs = len(lab.client.session(session_id).runs)
    print(
        f"\n{dict(lab.seen)}; {len(finished) + 1} sessions, {captures} captures, each once and intact; runs of the "
        f"last: {runs}"
    )
    for what, seconds in (
        ("the shutter was closed", sorted(lab.closed_s)),
        ("the station was safe", sorted(lab.safe_s)),
        ("that was recorded", sorted(lab.told_s)),
    ):
        within = sum(one <= CLOSED_S for one in seconds)
        print(
            f"{what} {seconds[len(seconds) // 2]:.1f} s after the restart (median), {seconds[-1]:.1f} s at most; "
            f"within the {CLOSED_S:g} s "
            f"that are wanted in {within} of {len(seconds)}"
        )
    print(f"load of the machine {os.getloadavg()[0]:.1f}")
    assert captures > 0 and lab.seen["session told why"] > 0
