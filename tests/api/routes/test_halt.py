"""A halt is confirmed by the shutter's own answer, whatever runs; what isn't confirmed never reads as free."""

from __future__ import annotations

import re
import sqlite3
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest

from lab.capture import nexus
from tests.api.conftest import STATION, Running, serving, until, until_state
from tests.lab import fake_bench

DARKS = {"station": "fakes", "quick": True, "sequences": ["dark"]}


def safety(client: httpx.Client) -> dict[str, Any] | None:
    found: dict[str, Any] | None = client.get("/api/v1/stations/fakes").json()["safety"]
    return found


def halt(client: httpx.Client) -> dict[str, Any]:
    """The `safety` of the station in the answer."""
    response = client.post("/api/v1/halt")
    assert response.status_code == 200, response.text
    (station,) = response.json()["stations"]
    assert station["name"] == "fakes"
    found: dict[str, Any] = station["safety"]
    return found


@pytest.mark.parametrize("scope", ["operate", "calibrate"])
def test_a_halt_is_confirmed_while_a_camera_exposes(
    tmp_path: Path, scope: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera exposes until the halt has been answered."""
    exposes, go_on = threading.Event(), threading.Event()

    def fire(self: fake_bench.FakeCamera) -> None:
        exposes.set()
        assert go_on.wait(30.0)

    monkeypatch.setattr(fake_bench.FakeCamera, "fire", fire)
    with serving(tmp_path) as running, running.client("admin") as client, running.client(scope) as halting:
        assert safety(client) is None  # nothing has answered yet
        session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        assert exposes.wait(30.0)
        assert halt(halting)["shutter"] == "closed" and not running.bench.opened
        go_on.set()
        assert until_state(client, session, "interrupted")["error"].startswith(f"halted by the key {scope!r} at ")
        at_last = until(client, "/api/v1/stations/fakes", lambda now: now["busy_with"] is None)["safety"]
        assert at_last["state"] == "safe" and at_last["shutter"] == "closed"


def test_a_halt_while_a_session_is_packed(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    packs, go_on = threading.Event(), threading.Event()
    chunk = nexus._chunk

    def slow(frame: Any) -> bytes:
        packs.set()
        assert go_on.wait(30.0)
        return chunk(frame)

    monkeypatch.setattr(nexus, "_chunk", slow)
    with running.client("operate") as client:
        session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        assert packs.wait(30.0)
        running.bench.opened = True  # by hand
        assert halt(client)["shutter"] == "closed" and not running.bench.opened
        go_on.set()
        until_state(client, session, "interrupted")


def test_a_halt_where_nothing_runs_makes_the_station_safe(running: Running) -> None:
    with running.client("operate") as client:
        running.bench.opened = True
        assert halt(client)["shutter"] == "closed" and not running.bench.opened
        assert until(client, "/api/v1/stations/fakes", lambda now: now["safety"]["state"] == "safe")


def test_a_station_that_was_not_made_safe_says_so_until_it_is(tmp_path: Path) -> None:
    """Also after a restart of the service."""
    with serving(tmp_path, delay_s=0.05) as running, running.client("operate") as client:
        session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        until_state(client, session, "running")
        running.bench.unplugged.add("monochromator")
        found = halt(client)
        assert (found["state"], found["shutter"]) == ("not confirmed", "unknown") and "the line is gone" in found[
            "words"
        ]
        ended = until_state(client, session, "failed")
        assert re.search(r"by the key 'operate' at [\d:]{8} UTC; not brought into a safe state: mono", ended["error"])
        assert client.get("/api/v1/stations/fakes").json()["safety"]["state"] == "not confirmed"
        stored = running.store.keys()
        for name, _, _ in stored:
            running.store.remove_key(name)
    with serving(tmp_path) as running, running.client("operate") as client:
        known = safety(client)
        assert known is not None and known["state"] == "not confirmed" and session in known["words"]
        assert halt(client)["shutter"] == "closed"
        assert until(client, "/api/v1/stations/fakes", lambda now: now["safety"]["state"] == "safe")


def test_an_instrument_that_does_not_answer_is_not_waited_for(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    stop = fake_bench.FakeMonochromator.stop

    def silent(self: fake_bench.FakeMonochromator) -> None:
        assert answers.wait(30.0)
        stop(self)

    monkeypatch.setattr(fake_bench.FakeMonochromator, "stop", silent)
    with running.client("operate") as client:
        found = halt(client)
        assert found["state"] == "not confirmed" and "no answer" in found["words"]
        answers.set()
        assert until(client, "/api/v1/stations/fakes", lambda now: now["safety"]["state"] == "safe")


def test_a_key_that_may_only_read_halts_nothing(shared: Running) -> None:
    with shared.client("read") as client:
        refused = client.post("/api/v1/halt")
        assert refused.status_code == 403 and "'operate' or 'calibrate'" in refused.json()["detail"]


def test_two_stations_at_one_shutter_are_asked_once(running: Running) -> None:
    (running.store.root / "stations" / "twin.toml").write_text(STATION)
    with running.client("operate") as client:
        found = client.post("/api/v1/halt").json()["stations"]
        assert [(one["name"], one["safety"]["shutter"]) for one in found] == [("fakes", "closed"), ("twin", "closed")]


def test_a_run_that_only_packs_is_halted_and_its_station_asked(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes no instrument up: a connection of the halt's own asks. A second halt shares it."""
    packs, go_on, connects, answers = (threading.Event() for _ in range(4))
    chunk, connect = nexus._chunk, fake_bench.FakeMonochromator.connect

    def slow(frame: Any) -> bytes:
        packs.set()
        assert go_on.wait(30.0)
        return chunk(frame)

    def held_up(self: fake_bench.FakeMonochromator) -> None:
        connects.set()
        assert answers.wait(30.0)
        connect(self)

    monkeypatch.setattr(nexus, "_chunk", slow)
    with running.client("operate") as client:
        session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        assert packs.wait(30.0)
        client.post(f"/api/v1/sessions/{session}/abort")
        go_on.set()
        until_state(client, session, "interrupted")
        packs.clear(), go_on.clear()
        assert client.post(f"/api/v1/sessions/{session}/resume").status_code == 202
        assert packs.wait(30.0)
        running.bench.opened = True  # by hand
        monkeypatch.setattr(fake_bench.FakeMonochromator, "connect", held_up)
        live = running.app.state.service.live
        station = running.app.state.service.station("fakes")
        first = live.halt(None, "one")[session]
        assert connects.wait(30.0)
        shared = live.make_safe(station)
        answers.set()
        first.result(30.0), shared.result(30.0)
        assert (found := live.safety.find(station)).state == "safe" and found.shutter == "closed", found
        assert not running.bench.opened and running.bench.log.count("stop monochromator") <= 4
        go_on.set()
        until_state(client, session, "interrupted")


def test_a_page_halts_after_a_restart_of_the_service_and_does_nothing_else(tmp_path: Path) -> None:
    with serving(tmp_path) as running, running.client(None) as page, running.client(None) as reader:
        assert page.get("/halt").json() == {"may_halt": False} and page.post("/api/v1/halt").status_code == 401
        login = page.post("/login", json={"key": running.keys["operate"]})
        stated = next(one for one in login.headers.get_list("set-cookie") if one.startswith("calibench_halt="))
        assert "httponly" in stated.lower() and "samesite=strict" in stated.lower()
        assert reader.post("/login", json={"key": running.keys["read"]}).status_code == 200
        assert "calibench_halt" not in reader.cookies and not reader.get("/halt").json()["may_halt"]
        token, keys = page.cookies["calibench_halt"], running.keys
        rows = (tmp_path / "registry.sqlite").read_bytes() + (tmp_path / "registry.sqlite-wal").read_bytes()
        assert token.encode() not in rows  # only its hash is kept
    with serving(tmp_path, keys=keys) as running, running.client(None) as page:
        page.cookies.set("calibench_halt", token)
        running.bench.opened = True
        assert page.get("/halt").json() == {"may_halt": True}
        assert halt(page)["shutter"] == "closed" and not running.bench.opened
        assert page.get("/api/v1/stations").status_code == 401
        assert page.post("/api/v1/sessions", json=DARKS).status_code == 401
        assert page.post("/api/v1/halt", headers={"Origin": "https://elsewhere.example"}).status_code == 403
        running.store.remove_key("operate")  # it takes its tokens with it
        assert page.post("/api/v1/halt").status_code == 401
        page.cookies.clear()
        assert page.post("/login", json={"key": keys["admin"]}).status_code == 200
        other = page.cookies["calibench_halt"]
        assert page.post("/logout").status_code == 204
        page.cookies.clear()
        page.cookies.set("calibench_halt", other)
        assert page.post("/api/v1/halt").status_code == 401


def test_a_halt_names_every_station_also_one_whose_file_is_gone_or_broken(running: Running) -> None:
    stations = running.store.root / "stations"
    with running.client("operate") as client:
        running.bench.delay_s = 0.05
        session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        until_state(client, session, "running")
        (stations / "fakes.toml").rename(stations / "fakes.bak")
        (stations / "broken.toml").write_text("not a station")
        found = {one["name"]: one["safety"] for one in client.post("/api/v1/halt").json()["stations"]}
        assert found[f"session {session}"]["shutter"] == "closed"
        assert found["broken"]["state"] == "not confirmed" and "can't be used" in found["broken"]["words"]


def test_a_halt_is_confirmed_while_the_registry_is_locked(running: Running) -> None:
    """By another process that writes: what waits is held as soon as it lets go."""
    with running.client("operate") as client:
        waits = client.post(
            "/api/v1/sessions", json=DARKS | {"queue": True, "not_before": "2999-01-01T00:00:00Z"}
        ).json()["id"]
        running.bench.opened = True
        with sqlite3.connect(running.store.root / "registry.sqlite") as other:
            other.execute("BEGIN IMMEDIATE")
            assert halt(client)["shutter"] == "closed" and not running.bench.opened
            assert client.get(f"/api/v1/sessions/{waits}").json()["error"] is None
        other.close()
        until(client, f"/api/v1/sessions/{waits}", lambda now: "held: halted by the key" in (now["error"] or ""))
