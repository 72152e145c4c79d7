"""Jobs over REST. The work is a stub; `lab.pipeline` and `lab.jobs` have tests of their own."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import BaseModel

import lab.diagnose
import lab.fit
import lab.jobs
import lab.predict.validate
import lab.report
from api.client import ServiceClient
from api.routes.jobs import steps_of
from api.security import REPORT_POLICY
from lab.capture.store import Store
from lab.diagnose import Diagnosis
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import RecordingSet
from lab.formats.results import CameraFit, DiagnosisResult, FitResult, NoiseFit, ReportFile, ValidationResult
from lab.jobs import JobInfo
from lab.pipeline import CaptureRequest, PipelineProgress, PipelineRequest, Tell
from tests.api.conftest import Running, events, serving, until, until_state
from tests.lab.doubts import doubt, offered

FIT = FitResult(source="x", cameras={"left": CameraFit(noise=NoiseFit(read_noise_e=2.0, read_noise_e_std=0.1))})
PAGE = "<!doctype html><title>a report</title><script>1</script>"


@pytest.fixture
def with_task(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., BaseModel]], None]:
    """`with_task(task)`: jobs do `task(tell)` in place of the pipeline; what it returns is kept as the job's result."""

    def change(task: Callable[..., BaseModel]) -> None:
        def pipeline(request: PipelineRequest, tell: Tell, *, store: Store, capturer: object) -> None:
            store.add_result(request.goal, request.source, task(tell).model_dump(mode="json"), request.job_id)

        monkeypatch.setattr(lab.jobs, "run_pipeline", pipeline)

    return change


@pytest.fixture
def quick_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The steps of the pipeline find what costs nothing."""
    diagnosis = DiagnosisResult(source="x", verdict="no_mismatch")
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: FIT)
    monkeypatch.setattr(lab.predict.validate, "validate", lambda *_, **__: ValidationResult(source="x", checks=()))
    monkeypatch.setattr(lab.diagnose, "examine", lambda *_, **__: Diagnosis(diagnosis, {}))
    monkeypatch.setattr(lab.report, "write_report", lambda file, *_: file.write_text(PAGE) and file)


def submit(client: httpx.Client, running: Running, kind: str) -> dict[str, Any]:
    session_id = running.store.sessions()[0].id
    response = client.post(f"/api/v1/sessions/{session_id}/jobs", json={"kind": kind})
    assert response.status_code == 202, response.text
    job: dict[str, Any] = response.json()
    assert response.headers["location"] == f"/api/v1/jobs/{job['id']}"
    assert job["kind"] == kind and job["session_id"] == session_id and job["recordings_id"] is None
    return job


def test_a_job_diagnoses_by_the_engine_that_is_asked_for(
    shared: Running, quick_steps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def examine(*_: object, **more: object) -> Diagnosis:
        asked.append(more["engine"])
        return Diagnosis(DiagnosisResult(source="x", verdict="no_mismatch"), {})

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    session_id = shared.store.sessions()[0].id
    with shared.client("calibrate") as client:
        for more in ({}, {"engine": "evidence"}):
            job = client.post(f"/api/v1/sessions/{session_id}/jobs", json={"kind": "diagnose", **more}).json()
            until(client, f"/api/v1/jobs/{job['id']}", lambda now: now["state"] == "done")
        refused = client.post(f"/api/v1/sessions/{session_id}/jobs", json={"kind": "fit", "engine": "evidence"})
    assert asked == ["today", "evidence"]
    assert refused.status_code == 422, refused.text
    assert "a job of the kind fit makes no diagnosis" in refused.text


def test_a_result_is_what_the_command_line_writes(shared: Running, with_task: Callable[..., None]) -> None:
    with_task(lambda tell: FIT)
    with shared.client("calibrate") as client:
        job = submit(client, shared, "fit")
        path = f"/api/v1/jobs/{job['id']}"
        found = until(client, path, lambda now: now["state"] == "done")
        assert found["progress"] == 1.0 and found["finished"].endswith("Z")
        assert client.get(f"{path}/result").json() == FIT.model_dump(mode="json")
        assert client.get(f"{path}/report").status_code == 404
        assert client.get("/api/v1/jobs").json()[0] == found
        assert client.post(f"{path}/cancel").json()["state"] == "done"


def test_progress_is_told_and_a_cancelled_job_has_no_result(shared: Running, with_task: Callable[..., None]) -> None:
    def slow(tell: Tell) -> FitResult:
        for step in range(1000):
            tell(PipelineProgress("fit", f"step {step}", step / 1000))
            time.sleep(0.02)
        return FIT

    with_task(slow)
    with shared.client("calibrate") as client:
        path = f"/api/v1/jobs/{submit(client, shared, 'fit')['id']}"
        until(client, path, lambda now: now["state"] == "running" and now["message"] != "")
        assert client.get(f"{path}/result").status_code == 409
        assert client.post(f"{path}/cancel").status_code == 202
        told = events(client, f"{path}/events")
        assert told[-1][1]["state"] == "cancelled" and told[0][0] == "progress"
        assert "cancelled" in client.get(f"{path}/result").json()["detail"]


@pytest.mark.parametrize(
    ("state", "message", "captures", "expected"),
    [
        ("queued", "", True, "capture waiting, fit waiting, validate waiting, diagnose waiting, report waiting"),
        ("running", "", False, "fit running, validate waiting, diagnose waiting, report waiting"),
        (
            "running",
            "resolve: a dark series: 3 of 40",
            True,
            "capture done, fit done, validate done, diagnose done, resolve running, report waiting",
        ),
        ("failed", "diagnose: draws", False, "fit done, validate done, diagnose failed, report waiting"),
        ("cancelled", "validate: left", False, "fit done, validate cancelled, diagnose waiting, report waiting"),
        ("done", "", True, "capture done, fit done, validate done, diagnose done, report done"),
    ],
)
def test_the_steps_of_a_job_follow_from_its_message(state: str, message: str, captures: bool, expected: str) -> None:
    at = datetime(2030, 1, 1, tzinfo=UTC)
    info = JobInfo.model_validate(
        {"id": "a", "kind": "pipeline", "source": "s", "state": state, "progress": 0.5, "message": message}
        | {"error": None, "cancel_requested": False, "created": at, "started": at, "finished": None}
    )
    assert ", ".join(f"{step.name} {step.state}" for step in steps_of(info, captures=captures)) == expected


def test_a_job_that_fails_says_why(shared: Running, with_task: Callable[..., None]) -> None:
    def failing(tell: Tell) -> FitResult:
        raise InputError("flat-3: saturated; expose less")

    with_task(failing)
    with shared.client("calibrate") as client:
        path = f"/api/v1/jobs/{submit(client, shared, 'fit')['id']}"
        told = events(client, f"{path}/events")
        assert told[-1][1]["state"] == "failed" and told[-1][1]["error"] == "flat-3: saturated; expose less"
        response = client.get(f"{path}/result")
        assert response.status_code == 409 and "saturated" in response.json()["detail"]


def test_a_report_runs_its_scripts_and_reaches_nothing(shared: Running, with_task: Callable[..., None]) -> None:
    def report(tell: Tell) -> ReportFile:
        file = shared.store.root / "reports" / "r.html"
        file.parent.mkdir(exist_ok=True)
        file.write_text(PAGE)
        return ReportFile(path="reports/r.html")

    with_task(report)
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
def test_jobs_open_no_door_to_the_network(shared: Running, with_task: Callable[..., None]) -> None:
    """Dask has HTTP servers of its own, which by default listen to everyone."""
    with_task(lambda tell: FIT)
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
        assert client.get("/api/v1/jobs/abc").status_code == 404


def test_a_job_on_a_session_that_is_not_finished_is_refused_and_nothing_changes(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=0.05) as running, running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        session_id = client.post("/api/v1/sessions", json=asked).json()["id"]
        for state in ("running", "interrupted"):
            until_state(client, session_id, state)
            response = client.post(f"/api/v1/sessions/{session_id}/jobs", json={"kind": "fit"})
            assert response.status_code == 409 and f"is {state}, not finished" in response.json()["detail"]
            client.post(f"/api/v1/sessions/{session_id}/abort")
        assert client.get("/api/v1/jobs").json() == []


# --- pipelines --------------------------------------------------------------------------------------------------------


def test_a_pipeline_captures_and_brings_all_results_and_the_report(running: Running, quick_steps: None) -> None:
    with running.client("admin") as client:
        asked = {"station": "fakes", "name": "all", "quick": True, "sequences": ["dark"], "resolve": True}
        response = client.post("/api/v1/pipelines", json=asked)
        assert response.status_code == 202, response.text
        job = response.json()
        assert response.headers["location"] == f"/api/v1/jobs/{job['id']}" and job["kind"] == "pipeline"
        path = f"/api/v1/jobs/{job['id']}"
        told = events(client, f"{path}/events")
        assert told[-1][1]["state"] == "done" and told[-1][1]["error"] is None
        session = client.get(f"/api/v1/sessions/{job['session_id']}").json()
        assert (session["name"], session["state"]) == ("all", "finished")
        result = client.get(f"{path}/result").json()
        assert result["fit"] == FIT.model_dump(mode="json")
        assert result["validation"]["format"] == "calibench-validation"
        assert result["diagnosis"]["verdict"] == "no_mismatch"
        assert client.get(f"{path}/report").text == PAGE
        # Again on the same session, which is finished: no instrument is needed, and so no more than `calibrate`.
        again = f"/api/v1/sessions/{job['session_id']}/jobs"
        with running.client("calibrate") as other:
            assert other.post(again, json={"kind": "pipeline", "resolve": True}).status_code == 403
            started = other.post(again, json={"kind": "pipeline"})
            assert started.status_code == 202
        until(client, f"/api/v1/jobs/{started.json()['id']}", lambda now: now["state"] == "done")


def test_a_pipeline_resolves_and_its_session_tells_the_journal(
    running: Running, quick_steps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [doubt(offered("more darks")), []]
    ready = iter([*left, []])

    def examine(*_: object, **__: object) -> Diagnosis:
        found = tuple(next(ready))
        return Diagnosis(DiagnosisResult(source="x", verdict="unexplained" if found else "explained"), {}, found)

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    with running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"], "resolve": True, "resolve_minutes": 20}
        job = client.post("/api/v1/pipelines", json=asked).json()
        until(client, f"/api/v1/jobs/{job['id']}", lambda now: now["state"] == "done")
        told = client.get(f"/api/v1/jobs/{job['id']}/result").json()["diagnosis"]
        journal = client.get(f"/api/v1/sessions/{job['session_id']}").json()["resolving"]
        (step,) = journal["resolutions"]
        assert client.get(f"/api/v1/sessions/{step['session']}").json()["resolving"] is None
    assert (journal["budget_min"], journal["most_rounds"]) == (20.0, 6)
    assert (journal["end"], journal["reason"]) == ("settled", "no rivals are left")
    assert step["capture"] == "more darks" and step["rivals_after"] == []
    assert step["rivals"] == [{"name": "defocus", "probability": 0.7}, {"name": "coma", "probability": 0.3}]
    assert told["resolutions"] == journal["resolutions"] and told["resolve_end"] == "settled"


def test_recordings_are_settled_on_the_station_that_made_them(
    running: Running, quick_steps: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def examine(recordings: RecordingSet, *_: object, **__: object) -> Diagnosis:
        left = tuple(doubt(offered("more darks"))) if len(recordings.captures()) == first else ()
        return Diagnosis(DiagnosisResult(source="x", verdict="unexplained" if left else "explained"), {}, left)

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    asked = {"kind": "pipeline", "resolve": True, "station": "fakes"}
    (running.store.root / "reports").mkdir()  # the page is a stand-in
    with running.client("admin") as client, ServiceClient(running.url, running.keys["admin"]) as sender:
        made = client.post("/api/v1/sessions", json={"station": "fakes", "quick": True, "sequences": ["dark"]}).json()
        until_state(client, made["id"], "finished")
        sent = sender.send_recordings(sender.fetch_session(made["id"], running.store.root / "made.zip"))
        here, first = f"/api/v1/recordings/{sent.id}/jobs", sent.captures
        with running.client("calibrate") as other:
            assert other.post(here, json=asked).status_code == 403
        for half in ({"resolve": True}, {"station": "fakes"}):
            refused = client.post(here, json={"kind": "pipeline"} | half)
            assert refused.status_code == 422 and "give both, or none" in refused.json()["detail"]
        running.bench.serials["camera left"] = "SN-2"
        refused = client.post(here, json=asked)
        assert refused.status_code == 422 and "the station has SN-2" in refused.json()["detail"]
        running.bench.serials.clear()
        job = client.post(here, json=asked).json()
        ended = until(client, f"/api/v1/jobs/{job['id']}", lambda now: now["state"] not in ("queued", "running"))
        assert ended["state"] == "done", ended["error"]
        told = client.get(f"/api/v1/jobs/{job['id']}/result").json()["diagnosis"]
    assert [one["capture"] for one in told["resolutions"]] == ["more darks"] and told["resolve_end"] == "settled"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"resolve": True, "resolve_minutes": -5}, "greater than 0"),
        ({"resolve": True, "resolve_rounds": 0}, "greater than or equal to 1"),
        ({"resolve_minutes": 5}, "go with resolve"),
    ],
)
def test_a_budget_that_cannot_be_kept_starts_nothing(running: Running, more: dict[str, Any], said: str) -> None:
    with running.client("admin") as client:
        before = client.get("/api/v1/sessions").json()
        response = client.post("/api/v1/pipelines", json={"station": "fakes", "sequences": ["dark"]} | more)
        assert response.status_code == 422 and said in response.text
        assert client.get("/api/v1/sessions").json() == before


def test_cancelling_a_pipeline_ends_its_capture_and_another_goes_on_from_there(
    tmp_path: Path, quick_steps: None
) -> None:
    with serving(tmp_path, delay_s=0.05) as running, running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        job = client.post("/api/v1/pipelines", json=asked).json()
        here = f"/api/v1/sessions/{job['session_id']}"
        assert client.post("/api/v1/pipelines", json=asked).status_code == 409  # on the same instruments
        until(client, here, lambda now: now["steps_done"] > 0)
        assert client.post(f"/api/v1/jobs/{job['id']}/cancel").status_code == 202
        assert (
            until(client, f"/api/v1/jobs/{job['id']}", lambda now: now["state"] not in ("queued", "running"))["state"]
            == "cancelled"
        )
        session = client.get(here).json()
        assert session["state"] == "interrupted" and session["steps_done"] < session["steps"]
        assert not running.bench.opened
        with running.client("calibrate") as other:  # capturing needs more
            assert other.post(f"{here}/jobs", json={"kind": "pipeline"}).status_code == 403
        started = client.post(f"{here}/jobs", json={"kind": "pipeline", "station": "fakes"}).json()
        until(client, f"/api/v1/jobs/{started['id']}", lambda now: now["state"] == "done")
        assert client.get(here).json()["state"] == "finished"


def test_an_aborted_session_fails_its_pipeline(tmp_path: Path, quick_steps: None) -> None:
    with serving(tmp_path, delay_s=0.05) as running, running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        job = client.post("/api/v1/pipelines", json=asked).json()
        until_state(client, job["session_id"], "running")
        assert client.post(f"/api/v1/sessions/{job['session_id']}/abort").status_code == 202
        ended = until(client, f"/api/v1/jobs/{job['id']}", lambda now: now["state"] not in ("queued", "running"))
        assert ended["state"] == "failed" and "aborted over the network; resume it" in ended["error"]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"kind": "fit", "resolve": True}, "leave resolve out"),
        ({"kind": "fit", "station": "fakes"}, "doesn't capture"),
        ({"kind": "capture"}, "kind"),
    ],
)
def test_only_pipelines_capture(shared: Running, body: dict[str, Any], said: str) -> None:
    session_id = shared.store.sessions()[0].id
    with shared.client("admin") as client:
        response = client.post(f"/api/v1/sessions/{session_id}/jobs", json=body)
    assert response.status_code == 422 and said in response.json()["detail"]


def test_a_session_that_was_aborted_before_its_pipeline_began_is_not_resumed(tmp_path: Path) -> None:
    """On a busy machine the job's thread may begin after the abort."""
    with serving(tmp_path, delay_s=0.05) as running, running.client("admin") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
        session_id = client.post("/api/v1/sessions", json=asked).json()["id"]
        service = running.app.state.service
        capture = service.live.capturer(service.station("fakes"))
        until_state(client, session_id, "running")
        assert client.post(f"/api/v1/sessions/{session_id}/abort").status_code == 202
        until_state(client, session_id, "interrupted")
        with pytest.raises(DeviceError, match="aborted over the network; resume it"):
            capture(CaptureRequest(session=session_id), lambda _: None)
        assert client.get(f"/api/v1/sessions/{session_id}").json()["state"] == "interrupted"
