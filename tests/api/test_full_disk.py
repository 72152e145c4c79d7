"""A full disk stops no halt and no deletion; a session waits for room."""

from __future__ import annotations

import errno
import logging
from pathlib import Path
from typing import Any

import httpx
import pytest

from drivers.errors import InstrumentError
from drivers.found_settings import FoundSettings
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.errors import NoRoom
from tests.api.conftest import Running, served, serving, until, until_state
from tests.lab import fake_bench
from tests.small_disk import fill, small_disk

#: HDF5 flushes where an object of a file is dropped, which can't raise; the next call of the file does.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Exception ignored in. 'h5py._objects.ObjectID.__dealloc__':pytest.PytestUnraisableExceptionWarning"
)

DARKS = {"station": "fakes", "quick": True, "sequences": ["dark"]}


def test_a_session_waits_for_room_and_the_service_answers_what_to_do(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (
        small_disk(tmp_path / "disk", 8 << 10) as disk,
        serving(disk / "data", delay_s=0.02) as running,
        running.client() as client,
    ):
        old = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        until_state(client, old, "finished")
        session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
        until(client, f"/api/v1/sessions/{session}", lambda now: now["steps_done"] >= 2)
        filling = fill(disk)
        paused = until_state(client, session, "paused")
        assert "its disk is full" in paused["error"] and "delete sessions" in paused["error"]
        assert not running.bench.opened
        folders = set((running.store.root / "sessions").iterdir())
        for refused in (
            client.post("/api/v1/sessions", json=DARKS),
            client.post("/api/v1/sessions", json=DARKS | {"queue": True}),
            client.patch(f"/api/v1/sessions/{old}", json={"name": "other"}),
            client.post(f"/api/v1/sessions/{old}/jobs", json={"kind": "fit"}),
        ):
            assert refused.status_code == 507, refused.text
            assert "the data folder: can't be written, its disk is full" in refused.json()["detail"]
        assert set((running.store.root / "sessions").iterdir()) == folders
        assert client.get("/healthz").status_code == 503 and "full" in client.get("/healthz").json()["detail"]
        assert client.get("/health").status_code == 200
        states = {client.get(f"/api/v1/sessions/{session}").json()["state"] for _ in range(20)}
        assert states == {"paused"}
        assert client.delete(f"/api/v1/sessions/{old}").status_code == 204
        assert client.get(f"/api/v1/sessions/{old}").status_code == 404
        filling.unlink()
        finished = until_state(client, session, "finished")
        assert finished["error"] is None
        until(client, "/healthz", lambda now: now.get("status") == "ok")
    assert not [one.getMessage() for one in caplog.records if one.levelno >= logging.ERROR]


def test_a_halt_on_a_full_disk_is_confirmed_and_holds_the_queue_as_soon_as_that_can_be_written(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the registry nor what an instrument was set to can be written."""
    service = running.app.state.service
    with running.client("operate") as client:
        waits = client.post(
            "/api/v1/sessions", json=DARKS | {"queue": True, "not_before": "2999-01-01T00:00:00Z"}
        ).json()["id"]
        connect = fake_bench.FakeMonochromator.connect

        def changes_units(self: fake_bench.FakeMonochromator) -> None:
            FoundSettings("monochromator-fake", "monochromator").note("UNITS", 1)
            connect(self)

        def full(*_: object, **__: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        def full_registry(self: Store) -> Any:
            raise NoRoom("the data folder: its disk is full")

        with monkeypatch.context() as patched:
            patched.setattr(fake_bench.FakeMonochromator, "connect", changes_units)
            patched.setattr("drivers.found_settings.os.fsync", full)
            patched.setattr(Store, "transaction", full_registry)
            running.bench.opened = True
            found = client.post("/api/v1/halt").json()["stations"]
            assert [(one["name"], one["safety"]["state"]) for one in found] == [("fakes", "safe")]
            assert not running.bench.opened and service.waiting._holds
            with pytest.raises(InstrumentError, match="can't be kept"):  # a run would be refused
                FoundSettings("monochromator-fake", "monochromator").note("UNITS", 1)
        held = until(client, f"/api/v1/sessions/{waits}", lambda now: now["error"] is not None)
        assert held["error"].startswith("held: halted by the key 'operate' at ")


def test_serve_starts_on_a_full_disk_and_halts_and_deletes(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 8 << 10) as disk:
        with serving(disk / "data") as running, running.client() as client:
            session = client.post("/api/v1/sessions", json=DARKS).json()["id"]
            until_state(client, session, "finished")
            key = {"Authorization": f"Bearer {running.keys['admin']}"}
        fill(disk)
        log = disk.with_name("serve")
        with served(disk / "data", log=log) as (url, _, output), httpx.Client(base_url=url, headers=key) as client:
            assert "its disk is full" in output.read_text()
            assert client.post("/api/v1/halt").status_code == 200
            assert client.get("/healthz").status_code == 503
            assert client.post("/api/v1/sessions", json=DARKS).status_code == 507
            assert client.post("/login", json={"key": running.keys["admin"]}).status_code == 200
            assert client.delete(f"/api/v1/sessions/{session}").status_code == 204
            assert "Traceback" not in output.read_text()


def test_a_refused_session_leaves_no_folder(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = running.store.root / "sessions"
    with running.client() as client, monkeypatch.context() as patched:
        patched.setattr(Store, "transaction", full)
        refused = client.post("/api/v1/sessions", json=DARKS)
        assert refused.status_code == 507 and not (folder.exists() and list(folder.iterdir()))


def test_a_deletion_makes_the_room_that_the_registry_needs(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 40 << 10) as disk:
        store, bench = Store(disk / "data"), fake_bench.Bench()
        session = CaptureSession.start(store, fake_bench.station(), quick=True, connect=bench.drivers)
        session.run()
        store.room.give_up()
        fill(disk)
        with pytest.raises(NoRoom, match="its disk is full"):
            store.describe_session(session.id, notes="more" * (2 << 20))
        store.delete_session(session.id)
        assert store.sessions() == [] and not store.folder(session.id).exists()
        store.close()


def test_a_step_whose_frame_was_not_taken_is_taken_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every step's files are there once, whatever the disk did in between."""
    write, refused = Store.write_frame, []

    def full_at_first(self: Store, session_id: str, path: str, side: Any, frame: Any) -> Any:
        if "dark" in path and len(refused) < 2:
            refused.append(path)
            raise OSError(errno.ENOSPC, "No space left on device", str(self.root / path))
        return write(self, session_id, path, side, frame)

    monkeypatch.setattr(Store, "write_frame", full_at_first)
    store, bench, states = Store(tmp_path), fake_bench.Bench(), []
    session = CaptureSession.start(
        store,
        fake_bench.station(),
        quick=True,
        connect=bench.drivers,
        on_progress=lambda now: states.append((now.state, now.remark)),
    )
    assert session.run().state == "finished"
    paused = [remark for state, remark in states if state == "paused"]
    assert len(refused) == 2 and paused and all("make room" in remark for remark in paused)
    assert len({file.path for file in store.files(session.id)}) == len(store.files(session.id))
    store.close()
