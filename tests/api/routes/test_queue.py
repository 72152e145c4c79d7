"""Sessions that wait for their turn, the halt of everything, sessions fetched and deleted."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from api.client import ServiceClient, ServiceProblem
from api.schemas import QueuePlace, SessionStart
from lab.capture.queue import put_into_queue, queue
from lab.capture.store import Store
from lab.formats import recording_set as recording
from tests.api.conftest import STATION, Running, serving
from tests.lab.calibration.test_life import fitted, limits

SLOW_S = 0.05


def darks(name: str, **more: object) -> SessionStart:
    return SessionStart.model_validate(
        {"station": "fakes", "quick": True, "sequences": ["dark"], "name": name, "queue": True} | more
    )


@pytest.fixture
def client(running: Running) -> Iterator[ServiceClient]:
    with ServiceClient(running.url, running.keys["admin"]) as made:
        yield made


def names(client: ServiceClient) -> list[str]:
    return [one.name for one in client.queue()]


def test_sessions_wait_in_their_order_and_survive_the_service(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=SLOW_S) as running, ServiceClient(running.url, running.keys["admin"]) as client:
        first = client.start_session(darks("first")).id
        ids = {name: client.start_session(darks(name)).id for name in ("a", "b", "c")}
        late = datetime.now(UTC) + timedelta(days=1)
        ids["late"] = client.start_session(darks("late", not_before=late)).id
        assert client.session(ids["a"]).state == "queued" and names(client)[-4:] == ["a", "b", "c", "late"]
        assert [one.name for one in client.queue_session(ids["c"], QueuePlace(place=1))][-4:] == ["c", "a", "b", "late"]
        assert [one.name for one in client.unqueue_session(ids["b"])][-3:] == ["c", "a", "late"]
        assert client.session(ids["b"]).state == "created"
        with pytest.raises(ServiceProblem, match=r"409: .* isn't in the queue"):
            client.unqueue_session(ids["b"])
        client.wait_session(first)
    # The service was stopped: what waits still does; what ran then holds it until it has finished.
    store = Store(tmp_path)
    try:
        left = [one.name for one in queue(store)]
        assert left in (["a", "late"], ["c", "a", "late"])
        held = queue(store)[0].held
        begun = store.session(ids["c"]).state
        assert begun == "queued" or (begun == "interrupted" and held is not None and "interrupted" in held)
    finally:
        store.close()


def test_the_queue_goes_on_when_the_service_is_back(tmp_path: Path) -> None:
    with serving(tmp_path, delay_s=SLOW_S) as running, ServiceClient(running.url, running.keys["admin"]) as client:
        late = datetime.now(UTC) + timedelta(days=1)
        waiting = client.start_session(darks("waits", not_before=late)).id
    store = Store(tmp_path)
    put_into_queue(store, waiting)  # its time has come
    every = store.keys()
    for name, _, _ in every:
        store.remove_key(name)
    store.close()
    with serving(tmp_path) as running, ServiceClient(running.url, running.keys["admin"]) as client:
        assert client.wait_session(waiting).state == "finished" and client.queue() == []
        with pytest.raises(ServiceProblem, match=r"409: .* is finished"):
            client.queue_session(waiting)


def test_a_halt_holds_queued_sessions_until_they_are_released(running: Running, client: ServiceClient) -> None:
    running.bench.delay_s = SLOW_S
    runs = client.start_session(darks("runs", queue=False)).id
    waits = client.start_session(darks("waits")).id
    with pytest.raises(ServiceProblem, match="404: no station"):
        client.halt("elsewhere")
    assert client.halt("fakes") == (runs,)
    with pytest.raises(ServiceProblem, match="is interrupted: halted by the key 'admin' at "):
        client.wait_session(runs)
    running.bench.delay_s = 0.0
    assert not running.bench.opened
    (held,) = client.queue()
    assert held.held is not None and f"session {runs} is interrupted: halted by the key 'admin' at " in held.held
    running.app.state.service.waiting.look()
    assert client.session(waits).state == "queued"
    client.resume(runs)  # it finishes after all
    client.wait_session(runs)
    assert client.wait_session(waits).state == "finished"


def test_a_session_that_cannot_begin_holds_queued_ones_until_it_has_finished(
    running: Running, client: ServiceClient
) -> None:
    good = client.start_session(darks("good", not_before=datetime.now(UTC) + timedelta(days=1))).id
    running.bench.unplugged = {"stage"}
    bad = client.start_session(darks("bad")).id  # whose time has come: it overtakes
    with pytest.raises(ServiceProblem, match=r"is failed: .*the line is gone"):
        client.wait_session(bad)
    running.bench.unplugged = set()
    (held,) = client.queue()
    assert held.id == good and held.held is not None and f"session {bad} is failed" in held.held
    client.resume(bad)
    client.wait_session(bad)
    assert [one.held for one in client.queue()] == [None]  # released by the one that held it
    client.queue_session(good)
    assert client.wait_session(good).state == "finished"


def test_two_stations_do_not_wait_for_each_other(running: Running, client: ServiceClient) -> None:
    other = STATION.replace('address = "', 'address = "other ').replace("a bench of fakes", "another bench")
    (running.store.root / "stations" / "other.toml").write_text(other)
    running.bench.delay_s = SLOW_S
    here = client.start_session(darks("here")).id
    waits = client.start_session(darks("waits")).id
    there = client.start_session(darks("there", station="other")).id
    running.bench.delay_s = 0.0
    ended = {one: client.wait_session(one) for one in (here, waits, there)}
    closed = ended[here].closed
    assert closed is not None
    assert ended[there].runs[0].started < closed < ended[waits].runs[0].started


def test_sessions_that_cannot_be_queued_are_refused(shared: Running) -> None:
    with shared.client("operate") as client:
        begun = {"station": "fakes", "queue": False, "not_before": "2030-01-01T00:00:00Z"}
        for asked, said in (
            (begun, "not_before"),
            (begun | {"queue": True, "not_before": "2030-01-01T00:00:00"}, "not_before"),
        ):
            refused = client.post("/api/v1/sessions", json=asked)
            assert refused.status_code == 422 and said in refused.json()["detail"]
        assert client.put("/api/v1/sessions/none/queue", json={}).status_code == 404
    with shared.client("read") as client:
        assert client.post("/api/v1/halt").status_code == 403
        assert client.get("/api/v1/queue").json() == []


# --- fetched and deleted ----------------------------------------------------------------------------------------------


def test_a_session_is_fetched_as_a_recording_set(shared: Running, tmp_path: Path) -> None:
    with ServiceClient(shared.url, shared.keys["calibrate"]) as client:
        session = next(client.sessions())
        archive = client.fetch_session(session.id, tmp_path / "session.zip")
        sent = client.send_recordings(archive)
        client.delete_recordings(sent.id)
    assert sent.captures == sum(shared.store.count_captures(session.id).values())
    from api.unpacking import unpack

    unpack(archive, tmp_path / "set", 1 << 28, 10_000)
    there, here = recording.read(tmp_path / "set"), shared.store.recording_set(session.id)
    for mine, theirs in zip(here.captures(), there.captures(), strict=True):
        assert (here.frame(mine) == there.frame(theirs)).all()


def test_a_session_is_deleted_with_its_files_and_its_results_stay(running: Running, client: ServiceClient) -> None:
    running.bench.delay_s = SLOW_S
    session_id = client.start_session(darks("gone", queue=False)).id
    for refused in (lambda: client.delete_session(session_id), lambda: client.fetch_session(session_id, Path("x"))):
        with pytest.raises(ServiceProblem, match=r"409: .*(connecting|running)"):
            refused()
    running.bench.delay_s = 0.0
    client.wait_session(session_id)
    running.store.add_result("fit", session_id, fitted(2.0).model_dump(mode="json"))
    (calibration,) = client.calibrations()
    client.certify(calibration.id, limits())
    with pytest.raises(ServiceProblem, match=f"409: .*certified calibration {calibration.id} rests on it"):
        client.delete_session(session_id)
    running.store.add_result("fit", session_id, fitted(2.0).model_dump(mode="json"))
    newer = next(client.calibrations())
    folder = running.store.folder(session_id)
    assert folder.exists()
    again = client.capture("fakes", quick=True, sequences=("dark",))
    running.store.add_result("fit", again.id, fitted(2.0).model_dump(mode="json"))
    client.certify(next(client.calibrations()).id, limits())  # supersedes the first
    client.delete_session(session_id)
    assert not folder.exists() and [one.id for one in client.sessions()] == [again.id]
    with pytest.raises(ServiceProblem, match="404"):
        client.delete_session(session_id)
    stay = {one.id: one.state for one in client.calibrations()}
    assert stay[calibration.id] == "superseded" and stay[newer.id] == "candidate"
    assert len(client.history(calibration.cameras["left"], "noise read_noise_e").points) == 3
