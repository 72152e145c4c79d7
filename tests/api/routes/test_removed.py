"""What earlier versions had: routes answer what took their place, and a data folder of theirs still opens."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from api.client import ServiceClient
from lab.capture.records import now
from lab.capture.store import Store
from lab.capture.tables import JobRow
from lab.errors import InputError
from lab.jobs import JobRunner
from tests.api.conftest import Running, serving

CHALLENGE = "0123456789abcdef"


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "challenges"),
        ("POST", "challenges"),
        ("GET", f"challenges/{CHALLENGE}"),
        ("DELETE", f"challenges/{CHALLENGE}"),
        ("POST", f"challenges/{CHALLENGE}/jobs"),
        ("GET", f"challenges/{CHALLENGE}/cases/case-0001/archive.zip"),
        ("GET", f"challenges/{CHALLENGE}/score"),
        ("GET", f"challenges/{CHALLENGE}/truths"),
    ],
)
def test_routes_of_challenges_are_gone(shared: Running, method: str, path: str) -> None:
    with shared.client("read") as client:
        answer = client.request(method, f"/api/v1/{path}")
    assert answer.status_code == 410 and answer.headers["content-type"] == "application/problem+json"
    detail = answer.json()["detail"]
    assert "python -m evaluation" in detail and "\n" not in detail
    with shared.client(None) as stranger:
        assert stranger.request(method, f"/api/v1/{path}").status_code == 401


def an_earlier_version_s_folder(root: Path) -> Path:
    """A data folder with a challenge and jobs on it: one is done, one was queued when the process ended."""
    folder = root / "challenges" / CHALLENGE
    (folder / "set").mkdir(parents=True)
    (folder / "challenge.json").write_text(json.dumps({"id": CHALLENGE, "cases": 2, "size": "small"}))
    store = Store(root)
    with store.transaction() as db:
        for id, kind, state in (("a" * 16, "make-challenge", "done"), ("b" * 16, "score-challenge", "queued")):
            db.add(JobRow(id=id, kind=kind, source=str(folder), state=state, runner="gone", created=now()))
    store.close()
    return folder


def test_jobs_of_challenges_are_listed_and_not_done(tmp_path: Path) -> None:
    folder = an_earlier_version_s_folder(tmp_path)
    store = Store(tmp_path)
    with JobRunner(store) as runner:
        assert {job.id[0]: (job.kind, job.state) for job in runner.jobs()} == {
            "a": ("make-challenge", "done"),
            "b": ("score-challenge", "failed"),
        }
        with pytest.raises(InputError, match="no such work"):
            runner.submit("make-challenge", str(folder))  # type: ignore[arg-type]
    store.close()


def test_a_service_on_a_folder_with_challenges_lists_their_jobs(tmp_path: Path) -> None:
    an_earlier_version_s_folder(tmp_path)
    with serving(tmp_path) as running, ServiceClient(running.url, running.keys["read"]) as client:
        jobs = {job.kind: job for job in client.jobs()}
        assert set(jobs) == {"make-challenge", "score-challenge"}
        for job in jobs.values():
            assert job.session_id is None and job.recordings_id is None and job.steps == ()
            assert client.job(job.id) == job
        assert jobs["score-challenge"].state == "failed"
        with running.client("read") as plain:
            answer = plain.get(f"/api/v1/jobs/{'a' * 16}/result")
        assert answer.status_code == 404 and "was removed" in answer.json()["detail"]
