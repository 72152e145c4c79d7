"""Jobs over REST; the work itself is a stand-in, that of `lab.jobs` is tested there."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

import lab.jobs
from api.security import REPORT_POLICY
from lab.errors import InputError
from lab.formats.results import CameraFit, FitResult, NoiseFit
from lab.jobs import ReportFile
from tests.api.conftest import Running, events, until

FIT = FitResult(source="x", cameras={"left": CameraFit(noise=NoiseFit(read_noise_e=2.0, read_noise_e_std=0.1))})
PAGE = "<!doctype html><title>a report</title><script>1</script>"


@pytest.fixture
def with_tasks(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`with_tasks(fit=...)`: what the kinds of work do instead."""

    def change(**tasks: Any) -> None:
        for kind, task in tasks.items():
            monkeypatch.setitem(lab.jobs.TASKS, kind, task)

    return change


def submit(client: httpx.Client, running: Running, kind: str) -> dict[str, Any]:
    session_id = running.store.sessions()[0].id
    response = client.post(f"/api/v1/sessions/{session_id}/jobs", json={"kind": kind})
    assert response.status_code == 202, response.text
    job: dict[str, Any] = response.json()
    assert response.headers["location"] == f"/api/v1/jobs/{job['id']}"
    assert job["kind"] == kind and job["session_id"] == session_id and job["recordings_id"] is None
    return job


def test_a_result_is_what_the_command_line_writes(shared: Running, with_tasks: Callable[..., None]) -> None:
    with_tasks(fit=lambda task: FIT)
    with shared.client("calibrate") as client:
        job = submit(client, shared, "fit")
        path = f"/api/v1/jobs/{job['id']}"
        found = until(client, path, lambda now: now["state"] == "done")
        assert found["progress"] == 1.0 and found["finished"].endswith("Z")
        assert client.get(f"{path}/result").json() == FIT.model_dump(mode="json")
        assert client.get(f"{path}/report").status_code == 404
        assert client.get("/api/v1/jobs").json()[0] == found
        assert client.post(f"{path}/cancel").json()["state"] == "done"


def test_progress_is_told_and_a_cancelled_job_has_no_result(shared: Running, with_tasks: Callable[..., None]) -> None:
    def slow(task: Any) -> FitResult:
        for step in range(1000):
            task.progress(f"step {step}", step / 1000)
            time.sleep(0.02)
        return FIT

    with_tasks(fit=slow)
    with shared.client("calibrate") as client:
        path = f"/api/v1/jobs/{submit(client, shared, 'fit')['id']}"
        until(client, path, lambda now: now["state"] == "running" and now["message"] != "")
        assert client.get(f"{path}/result").status_code == 409
        assert client.post(f"{path}/cancel").status_code == 202
        told = events(client, f"{path}/events")
        assert told[-1][1]["state"] == "cancelled" and told[0][0] == "progress"
        assert "cancelled" in client.get(f"{path}/result").json()["detail"]


def test_a_job_that_fails_says_why(shared: Running, with_tasks: Callable[..., None]) -> None:
    def failing(task: Any) -> FitResult:
        raise InputError("flat-3: saturated; expose less")

    with_tasks(fit=failing)
    with shared.client("calibrate") as client:
        path = f"/api/v1/jobs/{submit(client, shared, 'fit')['id']}"
        told = events(client, f"{path}/events")
        assert told[-1][1]["state"] == "failed" and told[-1][1]["error"] == "flat-3: saturated; expose less"
        response = client.get(f"{path}/result")
        assert response.status_code == 409 and "saturated" in response.json()["detail"]


def test_a_report_runs_its_scripts_and_reaches_nothing(shared: Running, with_tasks: Callable[..., None]) -> None:
    def report(task: Any) -> ReportFile:
        file = shared.store.root / "reports" / "r.html"
        file.parent.mkdir(exist_ok=True)
        file.write_text(PAGE)
        return ReportFile(path="reports/r.html")

    with_tasks(report=report)
    with shared.client("calibrate") as client:
        path = f"/api/v1/jobs/{submit(client, shared, 'report')['id']}"
        until(client, path, lambda now: now["state"] == "done")
        response = client.get(f"{path}/report")
        assert response.text == PAGE and response.headers["content-type"].startswith("text/html")
        assert response.headers["content-security-policy"] == REPORT_POLICY
        assert client.get(f"{path}/result").status_code == 404
        (shared.store.root / "reports" / "r.html").unlink()
        assert client.get(f"{path}/report").status_code == 404
    # Sandboxed: no cookie of ours, no request to anywhere.
    assert "sandbox allow-scripts" in REPORT_POLICY and "allow-same-origin" not in REPORT_POLICY
    assert "default-src 'none'" in REPORT_POLICY and "connect-src" not in REPORT_POLICY


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux's list of sockets")
def test_jobs_open_no_door_to_the_network(shared: Running, with_tasks: Callable[..., None]) -> None:
    """Dask has HTTP servers of its own, which by default listen to everyone."""
    with_tasks(fit=lambda task: FIT)
    with shared.client("calibrate") as client:
        path = f"/api/v1/jobs/{submit(client, shared, 'fit')['id']}"
        until(client, path, lambda now: now["state"] == "done")
    mine = {str(entry.readlink()) for entry in Path("/proc/self/fd").iterdir() if entry.is_symlink()}
    rows = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()[1:]]
    listening = {row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in mine}
    assert listening == {"0100007F"}  # 127.0.0.1, as Linux writes it on a little-endian machine


def test_unknown_work_is_refused(shared: Running) -> None:
    session_id = shared.store.sessions()[0].id
    with shared.client("calibrate") as client:
        assert client.post(f"/api/v1/sessions/{session_id}/jobs", json={"kind": "guess"}).status_code == 422
        assert client.post("/api/v1/sessions/none/jobs", json={"kind": "fit"}).status_code == 404
        assert client.get("/api/v1/jobs/" + "0" * 16).status_code == 404
        assert client.get("/api/v1/jobs/abc").status_code == 422
