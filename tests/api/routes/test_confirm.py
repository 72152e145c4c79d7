"""An operator's step is asked for and confirmed over REST: what a session waits for, halts, time-outs, kills."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from api.client import ServiceClient
from lab.capture.by_hand import left_by_session
from lab.capture.plan import CapturePlan
from lab.capture.questions import question_of
from lab.capture.session import CaptureSession, Progress
from lab.capture.station import read_station
from lab.capture_kinds.dark import DarkSequence
from lab.cli.entry import app
from lab.errors import Cancelled
from lab.pipeline import CaptureRequest
from tests.api.conftest import STATION, Running, events, serving, until, until_state

WARM = """
[targets."usual temperature"]
kind = "sensor_temperature"

[targets."35 C"]
kind = "sensor_temperature"
sensor_c = 35.0
"""
FAKE = 'driver = "fake"\naddress = "stage"'
PERSON = STATION.replace(FAKE, 'driver = "prompt"') + WARM
DARKS = {"station": "fakes", "name": "darks", "quick": True, "sequences": ["dark"]}


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Running]:
    """A service whose station has a person as stage."""
    with serving(tmp_path) as running:
        (running.store.root / "stations" / "fakes.toml").write_text(PERSON)
        yield running


def begun(client: httpx.Client, **changes: Any) -> str:
    response = client.post("/api/v1/sessions", json=DARKS | changes)
    assert response.status_code == 201, response.text
    session_id: str = response.json()["id"]
    return session_id


def asked(client: httpx.Client, session_id: str) -> dict[str, Any]:
    """What a session waits for, when it does."""
    found = until(client, f"/api/v1/sessions/{session_id}", lambda one: one["asks"] is not None)
    question: dict[str, Any] = found["asks"]
    return question


def confirm(client: httpx.Client, session_id: str, target: str, **more: Any) -> httpx.Response:
    return client.post(f"/api/v1/sessions/{session_id}/confirm", json={"target": target, **more})


def refused(response: httpx.Response) -> str:
    assert response.status_code == 409, response.text
    detail: str = response.json()["detail"]
    assert "\n" not in detail
    return detail


def test_a_step_is_asked_for_and_confirmed(desk: Running) -> None:
    with desk.client("operate") as client, desk.client("read") as reader, desk.client("calibrate") as other:
        id = begun(client)
        question = asked(reader, id)
        assert question["target"] == "cap" and "cap" in question["instruction"]
        assert question["since"] < question["until"]
        assert reader.get("/api/v1/stations/fakes").json()["asks"] == question
        assert reader.get(f"/api/v1/sessions/{id}").json()["progress"]["asks"] == question
        assert confirm(reader, id, "cap").status_code == confirm(other, id, "cap").status_code == 403
        assert "asks for 'cap' now; 'sphere'" in refused(confirm(client, id, "sphere"))
        assert "since" in refused(confirm(client, id, "cap", since="2026-01-01T00:00:00Z"))
        assert reader.get(f"/api/v1/sessions/{id}").json()["asks"] == question  # still
        assert confirm(client, id, "cap", since=question["since"]).status_code == 200
        assert "asks for nothing now" in refused(confirm(client, id, "cap"))
        told = events(client, f"/api/v1/sessions/{id}/events")
        assert told[-1][1]["state"] == "finished"
        assert reader.get(f"/api/v1/sessions/{id}").json()["asks"] is None
        assert "asks for nothing now" in refused(confirm(client, id, "cap"))
        assert confirm(client, "20200101-000000-aaaaaa", "cap").status_code == 404
        assert not (desk.store.root / "sessions" / "20200101-000000-aaaaaa").exists()


def test_who_follows_hears_of_the_question_and_of_who_answered_it(desk: Running) -> None:
    with desk.client() as client, ServiceClient(desk.url, desk.keys["operate"]) as operator:
        id = begun(client)
        question = asked(client, id)
        threading.Timer(0.5, operator.confirm, (id, "cap")).start()
        told = [one for name, one in events(client, f"/api/v1/sessions/{id}/events") if name == "progress"]
    assert told[0]["asks"] == question and told[-1]["asks"] is None


def test_what_a_hand_changes_and_puts_back_is_asked_for_in_turn(desk: Running) -> None:
    """A session that waits in the queue asks, too, once its turn has come."""
    with desk.client("operate") as client:
        id = begun(client, queue=True, parameters={"dark": {"sensor_c": 35.0}})
        seen = []
        while client.get(f"/api/v1/sessions/{id}").json()["state"] != "finished":
            if (question := client.get(f"/api/v1/sessions/{id}").json()["asks"]) is None:
                time.sleep(0.05)
                continue
            left = left_by_session(desk.store.root, id)
            seen.append((question["target"], left is not None))
            assert confirm(client, id, question["target"], since=question["since"]).status_code == 200
    assert seen == [("35 C", True), ("cap", True), ("usual temperature", True)]
    assert left_by_session(desk.store.root, id) is None


def test_a_job_that_captures_asks_too(desk: Running) -> None:
    """As resolving does: a session is registered, and captured by a job. Cancelling the job ends the wait."""
    station = read_station(desk.store.root / "stations" / "fakes.toml")
    plan = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=1, sensor_c=35.0),))
    id = CaptureSession.start(desk.store, station, plan, name="resolves a doubt").id
    seen: list[str] = []
    cancelled = threading.Event()

    def tell(progress: Progress) -> None:
        if cancelled.is_set():
            raise Cancelled

    with desk.client("operate") as client, ThreadPoolExecutor() as pool:
        captured = pool.submit(desk.app.state.service.live.capturer(station), CaptureRequest(session=id), tell)
        asked(client, id)
        cancelled.set()
        assert isinstance(captured.exception(30.0), Cancelled)
        cancelled.clear()
        captured = pool.submit(desk.app.state.service.live.capturer(station), CaptureRequest(session=id), tell)
        for _ in range(3):
            question = asked(client, id)
            seen.append(question["target"])
            assert confirm(client, id, question["target"], since=question["since"]).status_code == 200
        assert captured.result(30.0) == id
    assert seen == ["35 C", "cap", "usual temperature"]


def test_a_halt_while_it_waits_is_confirmed_and_the_session_asks_again(desk: Running) -> None:
    with desk.client("operate") as client:
        id = begun(client)
        asked(client, id)
        (station,) = client.post("/api/v1/halt").json()["stations"]
        assert station["safety"]["shutter"] == "closed"
        assert until_state(client, id, "interrupted")["error"].startswith("halted by the key 'operate' at ")
        assert client.get(f"/api/v1/sessions/{id}").json()["asks"] is None
        assert "asks for nothing now" in refused(confirm(client, id, "cap"))
        assert client.post(f"/api/v1/sessions/{id}/resume").status_code == 202
        assert confirm(client, id, asked(client, id)["target"]).status_code == 200
        until_state(client, id, "finished")


def test_a_pause_waits_for_the_answer(desk: Running) -> None:
    with desk.client("operate") as client:
        id = begun(client)
        asked(client, id)
        assert client.post(f"/api/v1/sessions/{id}/pause").json()["state"] == "pausing"
        assert confirm(client, id, "cap").status_code == 200
        until_state(client, id, "paused")
        client.post(f"/api/v1/sessions/{id}/resume")
        until_state(client, id, "finished")


def test_who_does_not_come_in_time_interrupts_the_session_and_loses_nothing(desk: Running) -> None:
    station = desk.store.root / "stations" / "fakes.toml"
    station.write_text(PERSON.replace('driver = "prompt"', 'driver = "prompt"\nplace_timeout_s = 0.3'))
    with desk.client("operate") as client:
        id = begun(client)
        found = until_state(client, id, "interrupted")
        assert "nobody confirmed cap within 0.3 s (place_timeout_s under [stage]" in found["error"]
        assert found["asks"] is None
        station.write_text(PERSON)
        client.post(f"/api/v1/sessions/{id}/resume", json={"station": "fakes"})
        asked(client, id)
        assert confirm(client, id, "cap").status_code == 200
        until_state(client, id, "finished")


def test_the_command_line_lists_and_confirms_it(desk: Running) -> None:
    def told(*words: str) -> tuple[int, str]:
        found = CliRunner().invoke(app, ["confirm", *words, "--data", str(desk.store.root)])
        return found.exit_code, " ".join(found.output.split()) or str(found.exception)

    with desk.client("operate") as client:
        assert told() == (0, "no session waits for an operator")
        id = begun(client)
        instruction = asked(client, id)["instruction"]
        assert f"session {id}: cap: {instruction} (since" in told()[1]
        assert "give the target" in told(id)[1]
        assert "asks for 'cap' now" in told(id, "sphere")[1]
        assert told(id, "cap") == (0, f"session {id}: cap is there")
        until_state(client, id, "finished")


def test_a_person_is_not_checked_as_a_machine(desk: Running) -> None:
    with desk.client("operate") as client:
        assert client.post("/api/v1/stations/fakes/devices/stage/check").status_code == 202
        found = until(client, "/api/v1/stations/fakes/devices/stage", lambda one: one["state"] != "checking")
    assert found["state"] == "works" and "asked on the operator's page" in found["words"]


CODE = """
import sys
from api.live import LiveSessions
from lab.capture.store import Store
from tests.lab.fake_bench import Bench
store = Store(sys.argv[1])
live = LiveSessions(store, Bench().drivers)
live.resume(sys.argv[2])
live.find(sys.argv[2]).join(60.0)
"""


def test_a_kill_while_it_waits_loses_nothing(desk: Running) -> None:
    """A process that waits is killed; a question of a process that is gone isn't shown, and the session asks anew."""
    with desk.client("operate") as client:
        id = begun(client)
        client.post(f"/api/v1/sessions/{id}/abort")
        until_state(client, id, "interrupted")
        process = subprocess.Popen([sys.executable, "-c", CODE, str(desk.store.root), id])
        question = asked(client, id)  # of another process
        process.kill()
        process.wait(30.0)
        assert question_of(desk.store, id) is None and (desk.store.folder(id) / "asks.json").exists()
        assert "asks for nothing now" in refused(confirm(client, id, "cap"))
        until(client, f"/api/v1/sessions/{id}", lambda one: "kill -9" in (one["error"] or ""))
        assert client.post(f"/api/v1/sessions/{id}/resume").status_code == 202
        again = asked(client, id)
        assert again["target"] == question["target"] and again["since"] > question["since"]
        assert "since" in refused(confirm(client, id, "cap", since=question["since"]))
        assert confirm(client, id, "cap", since=again["since"]).status_code == 200
        until_state(client, id, "finished")
