"""Stations, sessions and captures over REST, on fake instruments."""

from __future__ import annotations

import io
import threading
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from api.client import ServiceClient
from drivers.errors import Disconnected
from lab.capture.tables import IdempotentRow
from tests.api.conftest import Running, events, serving, until, until_state
from tests.lab.calibration.test_life import fitted
from tests.lab.fake_bench import BLACK, COLS, ROWS

DARKS = {"station": "fakes", "name": "darks", "quick": True, "sequences": ["dark"]}


def start(client: httpx.Client, **changes: Any) -> str:
    response = client.post("/api/v1/sessions", json=DARKS | changes)
    assert response.status_code == 201, response.text
    session_id: str = response.json()["id"]
    assert response.headers["location"] == f"/api/v1/sessions/{session_id}"
    return session_id


def only_session(shared: Running) -> str:
    return shared.store.sessions()[0].id


# --- stations ---------------------------------------------------------------------------------------------------------


def test_stations_are_the_files_of_the_folder(running: Running) -> None:
    folder: Path = running.store.root / "stations"
    (folder / "broken.toml").write_text("name = ")
    (folder / "notes.txt").write_text("not a station")
    (running.store.root / "outside.toml").write_text((folder / "fakes.toml").read_text())
    with running.client("read") as client:
        broken, fakes = client.get("/api/v1/stations").json()
    assert broken["name"] == "broken" and "TOML" in broken["problem"]
    assert fakes["name"] == "fakes" and fakes["title"] == "a bench of fakes" and fakes["problem"] is None
    assert fakes["cameras"] == ["left", "right"]
    assert fakes["sequences"] == ["dark", "flat", "narrowband"]  # neither a screen nor a chart, an edge, a board
    assert fakes["busy_with"] is None


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({"station": "nowhere"}, 404, "nowhere"),
        ({"station": "../outside"}, 404, "outside"),
        ({"station": "broken"}, 422, "TOML"),
        ({"sequences": ["dark", "screen"]}, 422, "screen"),
        ({"sequences": []}, 422, "sequences"),
        ({"sequences": ["light"]}, 422, "sequences"),
        ({"name": "x" * 200}, 422, "name"),
    ],
)
def test_a_session_that_cannot_start_is_refused_in_one_line(
    shared: Running, changes: dict[str, Any], status: int, said: str
) -> None:
    (shared.store.root / "stations" / "broken.toml").write_text("name = ")
    (shared.store.root / "outside.toml").write_text("")
    before = len(shared.store.sessions())
    with shared.client("operate") as client:
        response = client.post("/api/v1/sessions", json=DARKS | changes)
    assert response.status_code == status
    assert said in response.json()["detail"] and "\n" not in response.json()["detail"]
    assert len(shared.store.sessions()) == before


# --- sessions ---------------------------------------------------------------------------------------------------------


def test_a_session_from_its_start_to_its_captures(running: Running) -> None:
    with running.client("operate") as client:
        session_id = start(client, notes="by a test")
        found = until_state(client, session_id, "finished")
        assert found["notes"] == "by a test" and found["error"] is None
        assert found["steps_done"] == found["steps"] > 0
        assert found["station"] == "a bench of fakes" and found["progress"] is None
        assert found["runs"][0]["instruments"]["camera left"]["serial_number"] == "SN-1"
        assert found["created"].endswith("Z") and found["closed"].endswith("Z")
        listed = client.get("/api/v1/sessions").json()
        assert [one["id"] for one in listed] == [session_id] and listed[0]["state"] == "finished"
        assert client.post(f"/api/v1/sessions/{session_id}/resume").status_code == 409
        assert client.post(f"/api/v1/sessions/{session_id}/pause").status_code == 409
        assert client.post(f"/api/v1/sessions/{session_id}/abort").status_code == 409


def test_events_tell_each_step_and_the_end(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=0.02) as running, running.client("operate") as client:
        session_id = start(client)
        told = events(client, f"/api/v1/sessions/{session_id}/events")
    names = [name for name, _ in told]
    assert names[0] == "state" and names[-1] == "end" and set(names) == {"state", "progress", "end"}
    steps = [data for name, data in told if name == "progress" and data["state"] == "running"]
    assert [data["done"] for data in steps] == sorted(data["done"] for data in steps)
    assert all(data["total"] == told[-1][1]["steps"] and data["session"] == session_id for data in steps)
    assert any(data["left_s"] is not None and data["left_s"] >= 0 for data in steps)
    assert told[-1][1]["state"] == "finished"
    states = [data["state"] for name, data in told if name == "state"]
    assert states[-1] == "finished" and "running" in states


def test_a_late_follower_gets_the_present_state(shared: Running) -> None:
    with shared.client("read") as client:
        told = events(client, f"/api/v1/sessions/{only_session(shared)}/events")
    assert [name for name, _ in told] == ["state", "end"]
    assert told[0][1] == told[1][1] and told[0][1]["state"] == "finished"


def test_pause_resume_and_abort(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=0.05) as running, running.client("operate") as client:
        session_id = start(client)
        here = f"/api/v1/sessions/{session_id}"
        until_state(client, session_id, "running")
        assert client.post(f"{here}/resume").status_code == 409  # it runs
        busy = client.get("/api/v1/stations").json()[0]["busy_with"]
        second = client.post("/api/v1/sessions", json=DARKS)
        assert busy == session_id and second.status_code == 409 and session_id in second.json()["detail"]

        paused = client.post(f"{here}/pause")
        assert paused.status_code == 202 and paused.json()["state"] in ("pausing", "paused")
        found = until_state(client, session_id, "paused")
        assert not running.bench.opened
        assert client.post(f"{here}/pause").status_code == 409
        # A follower of a paused session hears that at once.
        assert events(client, f"{here}/events", "progress")[-1][1]["state"] == "paused"

        assert client.post(f"{here}/resume").status_code == 202
        until(client, here, lambda now: now["steps_done"] > found["steps_done"])
        assert client.post(f"{here}/abort").status_code == 202
        found = until_state(client, session_id, "interrupted")
        assert "aborted" in found["error"] and 0 < found["steps_done"] < found["steps"]
        assert not running.bench.opened
        assert client.get("/api/v1/stations").json()[0]["busy_with"] is None

        running.bench.delay_s = 0.0
        resumed = client.post(f"{here}/resume")
        assert resumed.status_code == 202 and resumed.json()["error"] is None
        found = until_state(client, session_id, "finished")
        assert len(found["runs"]) == 2
        names = [one["name"] for one in client.get(f"{here}/captures").json()]
        assert len(names) == len(set(names)) == 2 * found["steps"]  # nothing twice, nothing missing


def test_a_paused_session_can_be_aborted(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=0.05) as running, running.client("operate") as client:
        session_id = start(client)
        until_state(client, session_id, "running")
        client.post(f"/api/v1/sessions/{session_id}/pause")
        until_state(client, session_id, "paused")
        assert client.post(f"/api/v1/sessions/{session_id}/abort").status_code == 202
        until_state(client, session_id, "interrupted")


def test_an_instrument_that_fails_is_said_and_the_session_resumes(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    running.bench.unplugged.add("stage")
    with running.client("operate") as client:
        session_id = start(client)
        told = events(client, f"/api/v1/sessions/{session_id}/events")
        assert told[-1][1]["state"] == "failed" and "stage" in told[-1][1]["error"]
        running.bench.unplugged.clear()
        here = f"/api/v1/sessions/{session_id}/resume"
        assert client.post(here, json={"station": "nowhere"}).status_code == 404
        stations: Path = running.store.root / "stations"
        text = (stations / "fakes.toml").read_text()
        (stations / "moved.toml").write_text(text.replace('address = "left"', 'address = "further left"'))
        assert client.post(here, json={"station": "moved"}).status_code == 202
        live = running.app.state.service.live._live[session_id]
        assert live.station.cameras["left"].address == "further left"
        until_state(client, session_id, "finished")
    assert Disconnected.__name__ not in told[-1][1]["error"]


def test_stopping_the_service_leaves_sessions_resumable(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=0.05) as running, running.client("operate") as client:
        session_id = start(client)
        until(client, f"/api/v1/sessions/{session_id}", lambda now: now["steps_done"] > 1)
        bench = running.bench
    assert not bench.opened and "close monochromator" in bench.log
    from lab.capture.store import Store

    store = Store(tmp_path)
    info = store.session(session_id)
    store.close()
    assert info.state == "interrupted" and info.error == "the service was stopped"
    assert 1 < info.steps_done < info.steps


def test_one_of_two_followers_may_disconnect(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=0.02) as running, running.client("operate") as client:
        session_id = start(client)
        path = f"/api/v1/sessions/{session_id}/events"
        heard: list[str] = []

        def listen() -> None:
            with running.client("read") as other:
                heard.extend(name for name, _ in events(other, path))

        listener = threading.Thread(target=listen)
        listener.start()
        assert events(client, path, "progress")  # leaves after the first word
        listener.join(30.0)
    assert heard[-1] == "end"


# --- once -------------------------------------------------------------------------------------------------------------


def test_a_request_that_is_sent_twice_is_carried_out_once(running: Running) -> None:
    asked = {"station": "fakes", "quick": True, "sequences": ["dark"]}
    once = {"Idempotency-Key": "b7e1-1"}
    with running.client("operate") as client:
        first = client.post("/api/v1/sessions", json=asked, headers=once)
        again = client.post("/api/v1/sessions", json=asked, headers=once)
        assert (first.status_code, again.status_code) == (201, 201)
        assert again.json() == first.json() and again.headers["location"] == first.headers["location"]
        assert again.headers["idempotency-replayed"] == "true" and "idempotency-replayed" not in first.headers
        other = client.post("/api/v1/sessions", json=asked | {"name": "another"}, headers=once)
        assert other.status_code == 422 and "another request" in other.json()["detail"]
        assert client.post("/api/v1/sessions", json=asked, headers={"Idempotency-Key": "a b"}).status_code == 422
        with running.client(None) as nobody:  # a key opens nothing
            assert nobody.post("/api/v1/sessions", json=asked, headers=once).status_code == 401
        assert len(running.store.sessions()) == 1
        # What was refused changed nothing, so the same key may be used again.
        unknown = {"Idempotency-Key": "b7e1-2"}
        assert client.post("/api/v1/sessions", json={"station": "none"}, headers=unknown).status_code == 404
        until_state(client, first.json()["id"], "finished")
        assert client.post("/api/v1/sessions", json=asked, headers=unknown).status_code == 201
        with running.store.transaction() as db:  # a day later
            for row in db.query(IdempotentRow):
                row.created -= timedelta(days=1, seconds=1)
        until_state(client, running.store.sessions()[0].id, "finished")
        assert "idempotency-replayed" not in client.post("/api/v1/sessions", json=asked, headers=once).headers
        assert len(running.store.sessions()) == 3


# --- captures ---------------------------------------------------------------------------------------------------------


def test_captures_by_kind_and_side(shared: Running) -> None:
    here = f"/api/v1/sessions/{only_session(shared)}/captures"
    with shared.client("read") as client:
        every = client.get(here).json()
        left = client.get(here, params={"side": "left"}).json()
        assert len(every) == 2 * len(left) and {one["side"] for one in left} == {"left"}
        assert client.get(here, params={"kind": "dark"}).json() == every
        assert client.get(here, params={"kind": "flat"}).json() == []
        assert client.get(here, params={"kind": "soup"}).status_code == 422
        newest = client.get(here, params={"order": "newest", "limit": 3}).json()
        assert newest == every[::-1][:3]
        one = client.get(f"{here}/{every[0]['id']}").json()
        assert one == every[0]
        assert one["document"]["kind"] == "dark" and one["document"]["exposure_s"] == one["exposure_s"]


def test_lists_come_in_pages_with_their_total(shared: Running) -> None:
    here = f"/api/v1/sessions/{only_session(shared)}/captures"
    with shared.client("read") as client:
        every = client.get(here).json()
        found, path = [], f"{here}?limit=5&side=left"
        while path:
            response = client.get(path)
            assert int(response.headers["x-total-count"]) == len(every) // 2
            found += response.json()
            path = response.links.get("next", {}).get("url", "")
        assert found == [one for one in every if one["side"] == "left"]
        assert client.get(here, params={"after": every[-1]["id"]}).json() == []
        counts = client.get(f"/api/v1/sessions/{only_session(shared)}").json()["captures"]
        assert sum(one["captures"] for one in counts) == len(every)
        assert client.get("/api/v1/sessions").headers["x-total-count"] == "1"
        assert client.get("/api/v1/sessions", params={"after": only_session(shared)}).json() == []
        for path in ("/api/v1/sessions", "/api/v1/jobs"):
            response = client.get(path, params={"after": "nothing"})
            assert response.status_code == 422 and "nothing" in response.json()["detail"]


def test_a_frame_is_what_was_captured(shared: Running) -> None:
    session_id = only_session(shared)
    with shared.client("read") as client:
        one = client.get(f"/api/v1/sessions/{session_id}/captures").json()[0]
        response = client.get(one["frame"])
    frame = np.load(io.BytesIO(response.content), allow_pickle=False)
    assert frame.dtype == np.uint16 and frame.shape == (ROWS, COLS)
    np.testing.assert_array_equal(frame, shared.store.frame(one["id"]))
    assert "attachment" in response.headers["content-disposition"]


def test_a_preview_is_a_small_picture_that_browsers_keep(shared: Running) -> None:
    session_id = only_session(shared)
    with shared.client("read") as client:
        one = client.get(f"/api/v1/sessions/{session_id}/captures").json()[0]
        response = client.get(one["preview"])
        assert response.headers["content-type"] == "image/png"
        assert "immutable" in response.headers["cache-control"] and "private" in response.headers["cache-control"]
        picture = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert picture.shape == (ROWS // 2, COLS // 2, 3)
        # Black within read noise of 2 DN: (3 sigma / (4095 - 64)) ** (1 / 2.2) * 255 < 13.
        assert picture.mean() < 13 and BLACK == 64
        again = client.get(one["preview"], headers={"If-None-Match": response.headers["etag"]})
        assert again.status_code == 304 and not again.content
        assert client.get(one["preview"], params={"width": 2}).status_code == 422
        stretched = client.get(one["preview"], params={"stretch": True}).content
        assert cv2.imdecode(np.frombuffer(stretched, np.uint8), cv2.IMREAD_UNCHANGED).max() > 200


def test_a_capture_belongs_to_its_session(shared: Running) -> None:
    session_id = only_session(shared)
    with shared.client("read") as client:
        one = client.get(f"/api/v1/sessions/{session_id}/captures").json()[0]["id"]
        for path in (f"other/captures/{one}", f"other/captures/{one}/preview.png", f"{session_id}/captures/99999"):
            assert client.get(f"/api/v1/sessions/{path}").status_code == 404
        for odd in ("0", "-1", "x", str(2**70), "1.5"):
            assert client.get(f"/api/v1/sessions/{session_id}/captures/{odd}").status_code == 404


def test_figures_and_curves_of_what_was_captured(shared: Running) -> None:
    here = f"/api/v1/sessions/{only_session(shared)}"
    with shared.client("read") as client:
        capture = client.get(f"{here}/captures", params={"limit": 1}).json()[0]
        answer = client.get(f"{here}/captures/{capture['id']}/figures")
        frame = shared.store.frame(capture["id"])
        found = answer.json()["channels"]
        assert answer.headers["cache-control"].endswith("immutable")
        assert found[0]["channel"] == "R" and found[0]["mean_dn"] == pytest.approx(frame[::2, ::2].mean())
        assert all(sum(one["counts"]) == frame.size / 4 for one in found)
        assert client.get(f"{here}/captures/99999/figures").status_code == 404
        looked = until(client, f"{here}/curves", lambda now: 0 < now["captures"] == now["looked_at"])
        assert looked["transfer"] == []  # darks alone
        with ServiceClient(shared.url, shared.keys["read"]) as typed:
            assert typed.curves(only_session(shared)).looked_at == looked["looked_at"]
        assert client.get("/api/v1/sessions/none/curves").status_code == 404


def test_sessions_are_searched_and_described(running: Running) -> None:
    """A list tells what was calibrated; a search finds notes, tags, and what the instruments reported."""
    with running.client("operate") as client:
        asked = {"station": "fakes", "quick": True, "sequences": ["dark"], "notes": "before #lens-a"}
        one, other = (
            client.post("/api/v1/sessions", json=asked | {"name": name, "queue": name == "b"}) for name in "ab"
        )
        ids = [one.json()["id"], other.json()["id"]]
        for id in ids:
            until_state(client, id, "finished")
        fit = running.store.add_result("fit", ids[0], fitted(2.0).model_dump(mode="json"))
        running.store.add_result("diagnose", ids[0], {"verdict": "unexplained"})
        changed = client.patch(f"/api/v1/sessions/{ids[1]}", json={"notes": "after #lens-b"})
        assert (
            changed.status_code == 200 and changed.json()["notes"] == "after #lens-b" and changed.json()["name"] == "b"
        )

        def found(**query: str) -> list[str]:
            answer = client.get("/api/v1/sessions", params=query)
            assert int(answer.headers["x-total-count"]) == len(answer.json())
            return [session["id"] for session in answer.json()]

        assert found() == found(search="SN-1 bench") == ids[::-1]
        assert found(search="#lens-b") == [ids[1]] and found(verdict="unexplained") == [ids[0]]
        assert found(search="#lens-b", verdict="unexplained") == []
        listed = {session["id"]: session for session in client.get("/api/v1/sessions").json()}
        assert listed[ids[0]]["calibration_id"] == fit and listed[ids[0]]["mtf50_cy_per_px"] == {"left": 0.25}
        assert listed[ids[1]]["tags"] == ["lens-b"] and listed[ids[1]]["cameras"]["left"] == "fake camera left SN-1"
        assert client.get("/api/v1/sessions", params={"verdict": "wrong"}).status_code == 422
        assert client.patch(f"/api/v1/sessions/{ids[0]}", json={"name": "x" * 121}).status_code == 422
        assert client.patch("/api/v1/sessions/nothing", json={}).status_code == 404
    with running.client("read") as reader:
        assert reader.patch(f"/api/v1/sessions/{ids[0]}", json={"name": "x"}).status_code == 403
