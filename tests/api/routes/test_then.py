"""What follows a session's end, the queue's expected times, and requests that are edited and copied."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from datetime import datetime
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from api.then import ThenRunner
from tests.api.conftest import Running, until, until_state
from tests.lab.calibration.test_life import fitted, limits

DARKS = {"station": "fakes", "quick": True, "sequences": ["dark"]}


@pytest.fixture
def hook() -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """A webhook's address, and what it was told."""
    told: list[dict[str, Any]] = []

    class Listens(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            told.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Say nothing."""

    server = HTTPServer(("127.0.0.1", 0), Listens)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/hook", told
    server.shutdown()
    thread.join()
    server.server_close()


def tells(running: Running) -> ThenRunner:
    """The runner, which may tell this computer."""
    runner: ThenRunner = running.app.state.service.then
    runner.hosts = frozenset({"127.0.0.1"})
    return runner


def test_a_session_is_analysed_compared_and_told(
    running: Running, hook: tuple[str, list[dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit itself is a stand-in: it is stored as a job of that kind stores it."""

    def carried_out(request: Any, *_: Any, store: Any, **__: Any) -> None:
        store.add_result("fit", request.source, fitted(2.3).model_dump(mode="json"), job_id=request.job_id)

    monkeypatch.setattr("lab.jobs.run_pipeline", carried_out)
    tells(running)
    url, told = hook
    with running.client() as client:
        first = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        until_state(client, first, "finished")
        certified = running.store.add_result("fit", first, fitted(2.0).model_dump(mode="json"))
        body = {"limits": limits().model_dump(mode="json")}
        assert client.post(f"/api/v1/calibrations/{certified}/certify", json=body).status_code == 200
        then = {"kind": "fit", "compare": True, "webhook": url}
        second = client.post("/api/v1/sessions", json=DARKS | {"name": "second", "then": then}).json()["id"]
        found = until(client, f"/api/v1/sessions/{second}", lambda one: one["then"]["state"] == "done")["then"]
        # Read noise of both cameras by 0.3 e at 0.01 e; nothing else differs.
        assert "2 of " in found["words"] and certified in found["words"] and found["told"] == "told, answered 204"
        assert client.get(found["comparison"]).status_code == 200
        assert client.get(f"/api/v1/jobs/{found['job_id']}").json()["session_id"] == second
        assert [one["then"] for one in told] == ["done"] and told[0]["session"] == second


def test_a_session_that_ends_early_is_told_once(running: Running, hook: tuple[str, list[dict[str, Any]]]) -> None:
    runner = tells(running)
    url, told = hook
    with running.client() as client:
        running.bench.delay_s = 0.1
        session = client.post("/api/v1/sessions", json=DARKS | {"then": {"webhook": url}}).json()["id"]
        until_state(client, session, "running")
        client.post("/api/v1/halt")
        until_state(client, session, "interrupted")
        until(client, f"/api/v1/sessions/{session}", lambda one: one["then"]["told"] is not None)
        runner.look()
        assert [one["state"] for one in told] == ["interrupted"]
        running.bench.delay_s = 0.0
        client.post(f"/api/v1/sessions/{session}/resume")
        until(client, f"/api/v1/sessions/{session}", lambda one: one["then"]["state"] == "done")
        assert [one["state"] for one in told] == ["interrupted", "finished"]


@pytest.mark.parametrize(
    ("then", "scope", "status", "said"),
    [
        ({"webhook": "http://127.0.0.1:1/x"}, "admin", 422, "isn't a host that the service tells; it has none"),
        ({"webhook": "ftp://lab.example"}, "admin", 422, "webhook"),
        ({"kind": "fit", "resolve": True}, "admin", 422, "resolve: goes with kind = pipeline"),
        ({"compare": True}, "admin", 422, "compare: needs a fit"),
        ({}, "admin", 422, "asks for nothing"),
        ({"kind": "fit"}, "operate", 403, "this needs 'admin'"),
    ],
)
def test_what_cannot_follow_is_refused(
    shared: Running, then: dict[str, Any], scope: str, status: int, said: str
) -> None:
    with shared.client(scope) as client:
        refused = client.post("/api/v1/sessions", json=DARKS | {"then": then})
        assert refused.status_code == status and said in refused.json()["detail"], refused.text


def test_what_waits_is_edited_in_its_place_and_copied(running: Running) -> None:
    late = "2999-01-01T00:00:00Z"
    with running.client() as client:
        ids = [
            client.post("/api/v1/sessions", json=DARKS | {"name": name, "queue": True, "not_before": late}).json()["id"]
            for name in ("first", "second")
        ]
        asked = client.get(f"/api/v1/sessions/{ids[0]}/request").json()
        assert asked["sequences"] == ["dark"] and asked["name"] == "first" and asked["not_before"] == late
        asked |= {"name": "edited", "sequences": ["dark", "flat"], "then": {"kind": "fit"}}
        changed = client.put(f"/api/v1/sessions/{ids[0]}/request", json=asked)
        assert changed.status_code == 200 and changed.json()["id"] not in ids
        queue = client.get("/api/v1/queue").json()
        assert [(one["place"], one["name"], one["then"]) for one in queue] == [
            (1, "edited", "fit"),
            (2, "second", None),
        ]
        assert client.get(f"/api/v1/sessions/{ids[0]}").status_code == 404
        assert changed.json()["steps"] > client.get(f"/api/v1/sessions/{ids[1]}").json()["steps"]
        copied = client.post("/api/v1/sessions", json=client.get(f"/api/v1/sessions/{queue[0]['id']}/request").json())
        assert copied.status_code == 201 and copied.json()["state"] == "queued"
        client.put(f"/api/v1/sessions/{ids[1]}/queue", json={})  # now
        until_state(client, ids[1], "finished")
        refused = client.put(f"/api/v1/sessions/{ids[1]}/request", json=asked)
        assert refused.status_code == 409 and "copy it" in refused.json()["detail"]
        wrong = client.put(f"/api/v1/sessions/{queue[0]['id']}/request", json=asked | {"station": "nowhere"})
        assert wrong.status_code == 404 and client.get(f"/api/v1/sessions/{queue[0]['id']}").status_code == 200


def test_a_queue_says_when_each_is_expected(running: Running) -> None:
    """One after the other on the same instruments; what is held isn't expected at all."""
    with running.client() as client:
        running.bench.delay_s = 0.05
        runs = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        until_state(client, runs, "running")
        for name in ("a", "b"):
            client.post("/api/v1/sessions", json=DARKS | {"name": name, "queue": True})

        def known(queue: Any) -> bool:
            return all(one["expected_end"] for one in queue)

        first, second = until(client, "/api/v1/queue", known)  # type: ignore[arg-type]
        starts, ends = (
            [datetime.fromisoformat(one[key]) for one in (first, second)] for key in ("expected_start", "expected_end")
        )
        assert starts[0] < ends[0] == starts[1] < ends[1]
        client.post("/api/v1/halt")
        held = until(client, "/api/v1/queue", lambda queue: all(one["held"] for one in queue))  # type: ignore[arg-type]
        assert [one["expected_start"] for one in held] == [None, None]
