"""The registry on a real PostgreSQL: sessions, jobs and keys as on SQLite, writers at the same time, and what can't be
reached."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

import lab.jobs
from lab.calibration.life import drift_board
from lab.calibration.overview import overviews
from lab.capture.backup import back_up
from lab.capture.plan import CapturePlan
from lab.capture.restore import restore
from lab.capture.session import CaptureSession
from lab.capture.settings import Settings
from lab.capture.store import Store
from lab.capture.tables import Base
from lab.capture_kinds.dark import DarkSequence
from lab.errors import InputError
from lab.jobs import JobRunner
from lab.pipeline import PipelineRequest, Tell
from tests.lab import fake_bench
from tests.lab.calibration.test_life import calibrated
from tests.postgresql import database, postgresql

pytestmark = pytest.mark.extra  # starts a PostgreSQL server

DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with postgresql() as url:
        yield url


@pytest.fixture
def url(server: str, request: pytest.FixtureRequest) -> Iterator[str]:
    with database(server, request.node.name[:60]) as found:
        yield found


def test_migrations_make_the_tables_that_the_code_has(url: str, tmp_path: Path) -> None:
    store = Store(tmp_path, url)
    with store.transaction() as db:
        assert db.connection().dialect.name == "postgresql"
        assert compare_metadata(MigrationContext.configure(db.connection()), Base.metadata) == []
    assert not (tmp_path / "registry.sqlite").exists()
    store.close()


def test_a_session_is_captured_packed_and_fitted(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path, url)
    bench = fake_bench.Bench()
    session = CaptureSession.start(store, fake_bench.station(), DARKS, connect=bench.drivers)
    session.abort("at once")
    assert session.run().state == "interrupted"
    info = CaptureSession(store, session.id, connect=bench.drivers).run()
    assert (info.state, info.packed, info.steps_done) == ("finished", True, info.steps)
    assert info.created.utcoffset() is not None
    recordings = store.recording_set(session.id)
    assert len(recordings.captures()) == 8
    assert recordings.frame(recordings.captures()[0]).shape == (fake_bench.ROWS, fake_bench.COLS)

    def pipeline(request: PipelineRequest, tell: Tell, *, store: Store, capturer: object) -> None:
        store.add_result(request.goal, request.source, {"of": "PostgreSQL"}, request.job_id)

    monkeypatch.setattr(lab.jobs, "run_pipeline", pipeline)
    with JobRunner(store) as runner:
        job = runner.wait(runner.submit("fit", session.id), 30.0)
    assert (job.state, job.error) == ("done", None)
    assert store.result(job.id).document == {"of": "PostgreSQL"}
    store.close()


def test_writers_at_the_same_time_lose_nothing(url: str, tmp_path: Path) -> None:
    stores = [Store(tmp_path, url) for _ in range(4)]
    session = CaptureSession.start(stores[0], fake_bench.station(), DARKS).id
    step = stores[0].journal(session)[0].step.id
    began = stores[0].session(session).created
    finished: list[bool] = []

    def write(store: Store, number: int) -> None:
        store.add_key(f"key {number}", "read", f"{number:064d}")
        finished.append(store.finish_step(session, step, began, {"by": number}))

    threads = [threading.Thread(target=write, args=(store, number)) for number, store in enumerate(stores)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30.0)
    assert len(stores[0].keys()) == 4
    assert sorted(finished) == [False, False, False, True]  # a step is linked once
    with pytest.raises(InputError, match="exists"):
        stores[1].add_key("key 1", "admin", "f" * 64)
    for store in stores:
        store.close()


def test_a_server_that_is_not_there_is_said_in_one_line_without_the_password(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can't be reached") as caught:
        Store(tmp_path, f"postgresql://ada:secret@/lab?host={tmp_path}")
    assert "\n" not in str(caught.value) and "secret" not in str(caught.value)
    assert "CALIBENCH_DATABASE_URL" in str(caught.value)


def test_both_names_of_the_protocol_use_the_driver_that_is_installed() -> None:
    from lab.capture.tables import open_engine

    for name in ("postgres", "postgresql", "postgresql+psycopg"):
        engine = open_engine(f"{name}://db/x")
        assert isinstance(engine, sa.Engine) and engine.driver == "psycopg"
        engine.dispose()


def test_sessions_are_searched_and_looked_over(url: str, tmp_path: Path) -> None:
    store = Store(tmp_path, url)
    calibration = calibrated(store, 2.0)
    session = store.result(calibration).source
    store.describe_session(session, notes="50% #night")
    store.add_result("diagnose", session, {"verdict": "explained"})
    assert [one.id for one in store.sessions(search="#night m c 50%")] == [session]
    assert store.count_sessions(search="L1") == 1 and store.sessions(search="elsewhere") == []
    found = overviews(store, [session])[session]
    assert found.calibration_id == calibration and found.verdict == "explained"
    assert found.mtf50_cy_per_px == {"left": 0.25} and found.read_noise_e == {"left": 2.0, "right": 2.0}
    assert len(drift_board(store, "m c L1").columns) == 1
    store.close()


def test_a_backup_has_the_rows_and_a_restore_brings_them_back(url: str, server: str, tmp_path: Path) -> None:
    """Into another empty database, and with --replace into the one that changed since; the next rows follow on."""
    store = Store(tmp_path / "data", url)
    calibration = calibrated(store, 2.0)
    session = store.result(calibration).source
    store.add_key("ada", "read", "a" * 64)
    times = store.session(session)
    backup = tmp_path / "backup"
    made = back_up(store, backup)
    assert made.sessions == 1 and not back_up(store, backup).is_new
    with Store(made.generation.folder).reading():  # a data folder with a registry of its own
        assert Store(made.generation.folder).session(session) == times

    with database(server, "elsewhere") as other:
        restore(backup, Settings(data=tmp_path / "again", database_url=other))
        assert not (tmp_path / "again" / "registry.sqlite").exists()
        again = Store(tmp_path / "again", other)
        assert again.session(session) == times and again.keys() == store.keys()
        assert again.result(calibration) == store.result(calibration)
        CaptureSession.start(again, fake_bench.station(), DARKS)  # its rows' numbers are new
        again.close()
        with pytest.raises(InputError, match="has 2 sessions; give --replace"):
            restore(backup, Settings(data=tmp_path / "third", database_url=other))

    store.delete_session(session)
    store.add_key("eve", "admin", "e" * 64)
    store.close()
    done = restore(backup, store.settings, replace=True)
    restored = Store(store.root, url)
    keys = restored.keys()
    assert restored.has_session(session) and [name for name, *_ in keys] == ["ada"]
    assert done.before is not None
    restored.close()
