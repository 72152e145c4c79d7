"""Challenges over the network: made and scored by jobs, their truths out of reach until then. What is drawn and how it
is diagnosed have tests of their own: here both are stand-ins."""

from __future__ import annotations

import json
import stat
import threading
from pathlib import Path

import pytest

import evaluation.make
import evaluation.run
import lab.jobs
from api.client import ServiceClient, ServiceProblem
from api.schemas import ChallengeStart
from evaluation.kept import Challenges, carry_out
from evaluation.run import CaseRun
from evaluation.score import broken_seals
from evaluation.truth import FIRST_FRESH_SEED, CaseTruth, Seals, Truths, digest, load, seal
from lab.formats import recording_set as recording
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult
from lab.workers import Workers
from tests.api.conftest import Running

TRUTH = CaseTruth(kind="healthy", cfa="MONO", f_number=2.8, frames=2, rows=8, cols=10)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, little_set: RecordingSet) -> None:
    """A case is two darks, and a diagnosis finds nothing; all of it in this process."""

    def write(index: int, out: Path, *_: object) -> CaseTruth:
        folder = out / evaluation.make.case_name(index)
        recording.write(little_set, folder)
        return TRUTH.model_copy(update={"recordings_sha256": digest(folder)})

    def run(folder: Path, policy: object = None) -> CaseRun:
        found = DiagnosisResult(source=folder.name, verdict="no_mismatch")
        return CaseRun(case=folder.name, wall_s=1.0, cpu_s=1.0, memory_mib=1.0, diagnosis=found)

    monkeypatch.setattr(evaluation.make, "_write_case", write)
    monkeypatch.setattr(evaluation.run, "run_case", run)
    monkeypatch.setattr("evaluation.kept._workers", lambda tick: Workers(1))


def readable(running: Running, challenge_id: str) -> str:
    """All that the API answers to a `read` key about a challenge, and every list that could tell of it."""
    with running.client("read") as client:
        routes = [path for path, methods in client.get("/openapi.json").json()["paths"].items() if "get" in methods]
        job = client.get("/api/v1/jobs").json()[0]["id"]
        said = ""
        for path in routes:
            if path.endswith("/events") or "/devices" in path:
                continue
            filled = (
                path.replace("{challenge_id}", challenge_id).replace("{case}", "case-0001").replace("{job_id}", job)
            )
            if "{" not in filled:
                answer = client.get(filled)
                said += answer.content.decode("utf-8", "replace")
        return said


def test_truths_are_sealed_until_the_challenge_is_scored(running: Running) -> None:
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        job = client.wait_job(client.make_challenge(ChallengeStart(cases=2, size="small", name="nightly")).id)
        assert job.kind == "make-challenge" and job.session_id is None and job.challenge_id is not None
        id = job.challenge_id
        (found,) = client.challenges()
        assert found == client.challenge(id) and found.name == "nightly" and found.scored is None
        assert sorted(found.seals) == ["case-0001", "case-0002"]
        file = running.store.root / "challenges" / id / "truths.json"
        truths = load(Truths, file)
        assert truths.seed >= FIRST_FRESH_SEED and stat.S_IMODE(file.stat().st_mode) == 0o600
        secrets = [str(truths.seed), *(one.salt for one in truths.truths.values()), '"healthy"', "truths.json"]
        before = readable(running, id)
        assert id in before and [one for one in secrets if one in before] == []
        for what in (client.challenge_score, client.challenge_truths):
            with pytest.raises(ServiceProblem, match="isn't scored; its truths stay sealed") as refused:
                what(id)
            assert refused.value.status == 409

        scored = client.wait_job(client.start_challenge_job("score", id).id)
        assert scored.kind == "score-challenge" and client.challenge(id).scored is not None
        assert client.challenge_truths(id) == truths
        score = client.challenge_score(id)
        assert score.cases == 2 and score.broken_seals == () and score.false_alarms.count == 0
        assert {case: seal(one) for case, one in truths.truths.items()} == found.seals
        with running.client("read") as reader:
            assert reader.get(f"/api/v1/jobs/{scored.id}/result").status_code == 404

        client.delete_challenge(id)
        assert list(client.challenges()) == [] and not file.parent.exists()


def test_a_case_is_fetched_as_a_recording_set(running: Running, tmp_path: Path) -> None:
    with ServiceClient(running.url, running.keys["admin"]) as client:
        id = client.wait_job(client.make_challenge(ChallengeStart(cases=1)).id).challenge_id
        assert id is not None
        archive = client.fetch_case(id, "case-0001", tmp_path / "case.zip")
        assert client.send_recordings(archive).captures == 2
        with pytest.raises(ServiceProblem, match="no case 'case-0002' is made"):
            client.fetch_case(id, "case-0002", tmp_path / "none.zip")
        with running.client() as raw:
            for case in ("..", "set", "truths.json", "case-1", "%2e%2e%2ftruths.json"):
                assert raw.get(f"/api/v1/challenges/{id}/cases/{case}/archive.zip").status_code in (404, 422)


def test_what_is_not_made_is_not_scored(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that is cancelled after the first case leaves the rest to a job that goes on with the same seed."""
    write, begun, go_on = evaluation.make._write_case, threading.Event(), threading.Event()

    def slow(index: int, *rest: object) -> CaseTruth:
        if index == 2:
            begun.set()
            go_on.wait(30.0)
        return write(index, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(evaluation.make, "_write_case", slow)
    monkeypatch.setattr(lab.jobs, "_WRITE_EVERY_S", 0.0)
    with ServiceClient(running.url, running.keys["calibrate"]) as client:
        job = client.make_challenge(ChallengeStart(cases=3))
        id = str(job.challenge_id)
        assert begun.wait(30.0)
        for refused in (lambda: client.start_challenge_job("score", id), lambda: client.delete_challenge(id)):
            with pytest.raises(ServiceProblem, match=f"job {job.id}") as conflict:
                refused()
            assert conflict.value.status == 409
        client.cancel(job.id)
        go_on.set()
        with pytest.raises(ServiceProblem, match="is cancelled"):
            client.wait_job(job.id)
        seed = load(Truths, running.store.root / "challenges" / id / "truths.json").seed
        with pytest.raises(ServiceProblem, match="2 of 3 cases are made"):
            client.start_challenge_job("score", id)
        client.wait_job(client.start_challenge_job("make", id).id)
        made = running.store.root / "challenges" / id
        truths = load(Truths, made / "truths.json")
        assert truths.seed == seed and len(client.challenge(id).seals) == 3
        assert broken_seals(made / "set", load(Seals, made / "set" / "seals.json"), truths) == ()


def test_wrong_orders_make_nothing(shared: Running) -> None:
    with shared.client("calibrate") as client, shared.client("operate") as operator:
        for wrong in (
            {},
            {"cases": 0},
            {"cases": 2, "size": "huge"},
            {"cases": 2, "cfa": "XYZ"},
            {"cases": 2, "seed": 5},
        ):
            assert client.post("/api/v1/challenges", json=wrong).status_code == 422
        assert operator.post("/api/v1/challenges", json={"cases": 2}).status_code == 403
        assert client.get("/api/v1/challenges").json() == []
        for path in ("", "/score", "/truths", "/cases/case-0001/archive.zip"):
            assert client.get(f"/api/v1/challenges/0123456789abcdef{path}").status_code == 404
        assert client.post("/api/v1/challenges/0123456789abcdef/jobs", json={"kind": "score"}).status_code == 404


def test_the_order_of_a_list_is_by_time(tmp_path: Path) -> None:
    kept = Challenges(tmp_path)
    ids = [kept.begin(1, "small", None, "") for _ in range(3)]
    assert [one.order.id for one in kept.all()] == ids[::-1]
    carry_out("make-challenge", kept.folder(ids[0]), lambda *_: None)
    assert json.loads((kept.folder(ids[0]) / "set" / "seals.json").read_text())["seals"].keys() == {"case-0001"}
