"""The store: files on disk before their links, whole steps or none, and equal content before and after packing."""

from __future__ import annotations

import json
import pickle
import sqlite3
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from lab.capture.durable_files import npy_bytes, write_durably
from lab.capture.file_lock import Lock
from lab.capture.plan import CapturePlan
from lab.capture.records import RunRecord, now
from lab.capture.session_files import PACK
from lab.capture.settings import Settings
from lab.capture.store import Store
from lab.capture.tables import Base
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.screen import ScreenSequence
from lab.errors import InputError
from lab.formats.recording_set import read, write
from sim.spectrum import Spectrum
from tests.lab import fake_bench

STATION = fake_bench.station()
DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))


def started(store: Store, calibration: CapturePlan = DARKS, **keys: Any) -> str:
    return store.create_session(STATION, calibration.steps(STATION), patterns=calibration.patterns(STATION), **keys)


def frame(seed: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(0, 4096, (fake_bench.ROWS, fake_bench.COLS)).astype(np.uint16)


def take_all(store: Store, session: str) -> None:
    for at, entry in enumerate(store.journal(session)):
        step = entry.step
        files = [store.write_frame(session, c.frame, c.side, frame(10 * at + len(c.side))) for c in step.captures]
        captures = [c.model_copy(update={"exposure_s": 0.5, "time": now()}) for c in step.captures]
        if step.radiance:
            files.append(store.write_spectrum(session, step.radiance, Spectrum.of([400, 700], [0.1, 0.2])))
        assert store.finish_step(session, step.id, now(), {"at": at}, files, captures)


# --- the registry -----------------------------------------------------------------------------------------------------


def test_migrations_make_the_tables_that_the_code_has(store: Store) -> None:
    with store.transaction() as db:
        assert compare_metadata(MigrationContext.configure(db.connection()), Base.metadata) == []


def test_opening_twice_and_at_once_is_fine(tmp_path: Path) -> None:
    first, second = Store(tmp_path), Store(tmp_path)
    first.add_key("a", "read", "00")
    assert second.keys() == [("a", "read", "00")]
    with pytest.raises(InputError, match="exists"):
        second.add_key("a", "admin", "01")
    second.remove_key("a")
    assert first.keys() == []
    with pytest.raises(InputError, match="no API key"):
        first.remove_key("a")
    first.close()
    second.close()


def test_settings_come_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CALIBENCH_DATA", str(tmp_path / "elsewhere"))
    opened = Store.open()
    assert opened.root == tmp_path / "elsewhere"
    opened.close()
    assert Settings(database_url="postgresql://db/x").url == "postgresql://db/x"


def test_a_file_that_is_no_registry_is_refused(tmp_path: Path) -> None:
    (tmp_path / "registry.sqlite").write_text("this is no database, whatever its name says" * 100)
    with pytest.raises(InputError, match="isn't a registry"):
        Store(tmp_path)


def test_sqlite_writes_ahead_and_flushes(store: Store) -> None:
    with store.reading() as db:
        assert db.execute(sa.text("PRAGMA journal_mode")).scalar() == "wal"
        assert db.execute(sa.text("PRAGMA synchronous")).scalar() == 2  # FULL
        assert db.execute(sa.text("PRAGMA foreign_keys")).scalar() == 1


# --- files ------------------------------------------------------------------------------------------------------------


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_durably(tmp_path / "a.npy", b"old")

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fails)
    with pytest.raises(OSError, match="No space"):
        write_durably(tmp_path / "a.npy", b"new and longer")
    assert (tmp_path / "a.npy").read_bytes() == b"old"


def test_locks_exclude_and_let_go(tmp_path: Path) -> None:
    mine, other = Lock(tmp_path / "l"), Lock(tmp_path / "l")
    assert not other.is_held()
    assert mine.acquire()
    assert other.is_held()
    assert not other.acquire(patience_s=0.05)
    mine.release()
    mine.release()
    assert other.acquire()
    other.release()


# --- sessions and the journal -----------------------------------------------------------------------------------------


def test_a_session_starts_with_all_its_steps_to_do(store: Store) -> None:
    session = started(store, name="first", notes="cold room")
    info = store.session(session)
    assert (info.name, info.notes, info.state) == ("first", "cold room", "created")
    assert (info.steps, info.steps_done) == (4, 0)
    assert [e.step for e in store.journal(session)] == list(DARKS.steps(STATION))
    assert store.station(session) == STATION
    assert store.sessions() == [info]
    assert store.has_session(session)
    for ask in (store.session, store.journal, store.recording_set, store.captures, store.station):
        with pytest.raises(InputError, match="isn't in"):
            ask("none")


def test_a_step_is_finished_once(store: Store) -> None:
    session = started(store)
    step = store.journal(session)[0].step
    files = [store.write_frame(session, c.frame, c.side, frame(1)) for c in step.captures]
    assert store.finish_step(session, step.id, now(), {}, files, step.captures)
    assert not store.finish_step(session, step.id, now(), {"other": 1}, files, step.captures)
    assert len(store.captures(session)) == 2
    assert store.session(session).steps_done == 1
    assert store.journal(session)[0].result == {}


def test_a_step_that_cannot_be_linked_whole_is_not_linked_at_all(store: Store) -> None:
    session = started(store)
    first, second = (entry.step for entry in store.journal(session)[:2])
    files = [store.write_frame(session, c.frame, c.side, frame(1)) for c in first.captures]
    assert store.finish_step(session, first.id, now(), {}, files, first.captures)
    other = [store.write_frame(session, c.frame, c.side, frame(2)) for c in second.captures]
    with pytest.raises(sa.exc.IntegrityError):  # the second of these captures has a name that is taken
        store.finish_step(
            session,
            second.id,
            now(),
            {},
            other,
            [second.captures[0], second.captures[1].model_copy(update={"id": first.captures[0].id})],
        )
    assert store.session(session).steps_done == 1
    assert len(store.captures(session)) == len(store.files(session)) - 6 == 2  # and six curves


def test_files_that_nothing_links_are_swept(store: Store) -> None:
    session = started(store)
    step = store.journal(session)[0].step
    files = [store.write_frame(session, c.frame, c.side, frame(1)) for c in step.captures]
    store.finish_step(session, step.id, now(), {}, files, step.captures)
    store.write_frame(session, "frames/lost-left.npy", "left", frame(2))
    (store.folder(session) / "frames" / ".half.npy.partial").write_bytes(b"\x93NUM")
    assert store.sweep(session) == ["frames/.half.npy.partial", "frames/lost-left.npy"]
    assert store.sweep(session) == []
    assert store.recording_set(session).frame(store.recording_set(session).captures("dark")[0]).shape == (24, 32)


def test_provenance_grows_run_by_run(store: Store) -> None:
    session = started(store)
    for number in range(2):
        run = RunRecord(started=now(), instruments={"stage": {"model": f"m{number}"}}, versions={"python": "3"})
        store.set_state(session, "running", run=run)
    assert [run.instruments["stage"].model for run in store.runs(session)] == ["m0", "m1"]


def test_a_session_without_a_process_is_interrupted(store: Store) -> None:
    session = started(store)
    store.set_state(session, "running")
    assert store.session(session).state == "interrupted"
    lock = store.lock(session)
    assert lock.acquire()
    assert store.session(session).state == "running"
    lock.release()


def test_a_process_that_ends_while_it_is_looked_at_is_believed(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process records its end and releases its lock after its row was read and before its lock is checked."""
    session = started(store)
    store.set_state(session, "running")

    class EndsNow(Lock):
        def is_held(self) -> bool:
            store.set_state(session, "interrupted", error="aborted by the operator")
            return False

    monkeypatch.setattr(store, "lock", lambda id: EndsNow(store.folder(id) / ".lock"))
    found = store.session(session)
    assert (found.state, found.error) == ("interrupted", "aborted by the operator")


# --- as a recording set -----------------------------------------------------------------------------------------------

SCREEN = CapturePlan(
    (
        DarkSequence(exposures_s=(0.001,), frames=2),
        ScreenSequence(frames=2),
    )
)


def test_a_session_is_a_recording_set_loose_and_packed(store: Store, tmp_path: Path) -> None:
    session = started(store, SCREEN, name="whole")
    take_all(store, session)
    loose = store.recording_set(session)
    before = {capture.id: loose.frame(capture).copy() for capture in loose.captures()}
    pack = store.close_session(session)
    assert store.close_session(session) == pack  # a second call changes nothing
    assert not (store.folder(session) / "frames").exists()
    info = store.session(session)
    assert (info.state, info.packed) == ("finished", True)

    packed = store.recording_set(session)
    assert packed.manifest == loose.manifest
    assert packed.source == session
    assert [c.side for c in packed.captures("white")] == ["left", "right"] * 2
    for capture in pickle.loads(pickle.dumps(packed)).captures():
        assert np.array_equal(packed.frame(capture), before[capture.id])
    assert packed.camera("left").quantum_efficiency == {c: f"spectra/qe-left-{c}.csv" for c in "RGB"}
    assert packed.target("targets/bernoulli.npy").shape == packed.target("targets/checkerboard.npy").shape

    exported = read(write(packed, tmp_path / "out"))
    assert exported.manifest.captures == packed.manifest.captures
    assert all(np.array_equal(exported.frame(c), before[c.id]) for c in exported.captures())


def test_the_packed_file_has_the_nexus_layout(store: Store) -> None:
    session = started(store, SCREEN)
    take_all(store, session)
    with h5py.File(store.close_session(session)) as file:
        entry = file[file.attrs["default"]]
        assert entry.attrs["NX_class"] == "NXentry"
        detector = entry["instrument/left"]
        assert detector.attrs["NX_class"] == "NXdetector"
        data = detector["data"]
        assert data.shape == (2 + 2 * len(ScreenSequence.kinds()), fake_bench.ROWS, fake_bench.COLS)
        assert (data.compression, data.shuffle, data.chunks) == ("gzip", True, (1, fake_bench.ROWS, fake_bench.COLS))
        assert list(detector["count_time"][:]) == [0.5] * data.shape[0]
        assert json.loads(entry["manifest"][()])["format"] == "calibench-recording"
        assert entry["spectra/screen-exposure"].attrs["signal"] == "value"


def test_a_session_with_steps_to_do_is_not_packed(store: Store) -> None:
    with pytest.raises(InputError, match="4 of 4 steps are to do"):
        store.close_session(started(store))


def test_a_damaged_frame_is_named_with_its_hash(store: Store) -> None:
    session = started(store)
    take_all(store, session)
    recordings = store.recording_set(session)
    capture = recordings.captures("dark")[0]
    (store.folder(session) / capture.frame).write_bytes(npy_bytes(frame(999)))
    with pytest.raises(InputError, match=r"dark-0.001s-1-left\.npy .*damaged: its SHA-256 is"):
        recordings.frame(capture)
    with pytest.raises(InputError, match="damaged"):  # nor is it packed
        store.close_session(session)
    assert (store.folder(session) / "frames").exists()
    assert not (store.folder(session) / PACK).exists()


def test_captures_are_served_by_id(store: Store) -> None:
    session = started(store)
    take_all(store, session)
    listed = store.captures(session)
    assert store.capture(listed[3].id) == listed[3]
    recordings = store.recording_set(session)
    assert np.array_equal(store.frame(listed[3].id), recordings.frame(recordings.capture(listed[3].name)))
    with pytest.raises(InputError, match="capture 12345"):
        store.capture(12345)


def test_results_are_kept_newest_first(store: Store) -> None:
    first = store.add_result("fit", "s", {"n": 1})
    second = store.add_result("fit", "s", {"n": 2})
    store.add_result("validate", "s", {"n": 3})
    assert [r.id for r in store.results("s", "fit")] == [second, first]
    assert store.result(first).document == {"n": 1}
    assert len(store.results()) == 3
    with pytest.raises(InputError, match="result 'x'"):
        store.result("x")


def test_writers_wait_for_one_another(store: Store, tmp_path: Path) -> None:
    session = started(store)
    other = sqlite3.connect(store.root / "registry.sqlite", timeout=0)
    with store.transaction() as db:
        assert db.execute(sa.text("SELECT count(*) FROM steps")).scalar() == 4
        with pytest.raises(
            sqlite3.OperationalError, match="locked"
        ):  # the transaction read first and now writes: it holds the lock
            other.execute("BEGIN IMMEDIATE")
    other.execute("BEGIN IMMEDIATE")
    other.rollback()
    other.close()
    assert store.session(session).steps == 4
