"""Where captures are kept: immutable files in a folder, and a registry that says what they are.

    DATA/registry.sqlite              (or a PostgreSQL database, by URL)
    DATA/sessions/ID/frames/*.npy     one file a frame, while the session runs
                     spectra/*.csv    what the spectroradiometer measured, and the makers' curves
                     targets/*.npy    what the screen showed
                     documents.jsonl  bluesky's documents
                     session.nxs      the whole session, packed when it closes (NeXus layout, gzip and shuffle)

A file is written under a temporary name, flushed to the disk and renamed. Then one transaction links all files of a
step and marks the step done. A crash may leave a file without a link, which is removed when the session resumes; it
never leaves a link without its file. A frame's SHA-256 is checked whenever it is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray
from sqlalchemy.orm import Session, defer, sessionmaker

from drivers.found_settings import FoundSettings
from lab.capture.durable_files import npy_bytes, write_durably
from lab.capture.file_lock import Lock
from lab.capture.held_queue import hold_queue, release_held_by
from lab.capture.migrate import upgrade
from lab.capture.nexus import write_nexus
from lab.capture.records import (
    CaptureInfo,
    JournalEntry,
    ResultInfo,
    Role,
    RunRecord,
    SessionDetails,
    SessionInfo,
    SessionState,
    StoredFile,
    now,
)
from lab.capture.room import Room
from lab.capture.session_files import PACK, SessionFiles, StoredPlace
from lab.capture.settings import Settings
from lab.capture.station import Station
from lab.capture.tables import (
    CaptureRow,
    FileRow,
    HaltTokenRow,
    KeyRow,
    ResultRow,
    SessionRow,
    StepRow,
    open_engine,
)
from lab.capture_kinds.base import CAPTURES, Capture, Step
from lab.errors import CannotWrite, InputError, NoRoom, cannot_write
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.spectrum_csv import format_spectrum
from lab.plain_text import check_line, escaped
from sim.camera import Side
from sim.spectrum import Spectrum

#: How long (s) the API's keys are taken as known, where another process may change them.
KEYS_S = 0.5


class Store:
    """The data folder and its registry. Threads may share one; each process opens its own.

    Every method raises InputError where a session, capture or result that it is asked for doesn't exist.
    """

    def __init__(self, root: Path | str, database_url: str | None = None) -> None:
        self.settings = Settings(data=Path(root).resolve(), database_url=database_url)
        self.root = self.settings.data
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(self.root, error, "set CALIBENCH_DATA to another folder") from error
        self.room = Room(self.root)
        self._engine = open_engine(self.settings.url)
        self._read = sessionmaker(self._engine, expire_on_commit=False)
        self._write = sessionmaker(self._engine.execution_options(writes=True), expire_on_commit=False)
        self._keys: tuple[float, list[tuple[str, str, str]]] = (0.0, [])
        try:
            upgrade(self._engine, self.root)
        except NoRoom:  # once more, as the reserve has made way
            upgrade(self._engine, self.root)
        FoundSettings.keep_in(self.root / "instruments")

    @classmethod
    def open(cls, settings: Settings | None = None) -> Store:
        """Return the store that the settings (by default the environment) name; made if it isn't there."""
        chosen = settings or Settings()
        return cls(chosen.data, chosen.database_url)

    def close(self) -> None:
        """Close the database."""
        self._engine.dispose()

    @contextlib.contextmanager
    def reading(self) -> Iterator[Session]:
        """Open a database session that only reads."""
        with self._read() as session:
            yield session

    @contextlib.contextmanager
    def transaction(self) -> Iterator[Session]:
        """Open a database session whose changes are committed together, or not at all."""
        with self._write.begin() as session:
            yield session

    def reuse_log(self) -> None:
        """Have SQLite write its log from the beginning again, which needs no more room on a full disk. Raises
        nothing."""
        if self._engine.dialect.name != "sqlite":
            return
        with (
            contextlib.suppress(sqlite3.Error, sa.exc.SQLAlchemyError, CannotWrite),
            contextlib.closing(self._engine.raw_connection()) as taken,
        ):
            taken.cursor().execute("PRAGMA wal_checkpoint(PASSIVE)").close()

    def look_for_room(self) -> NoRoom | None:
        """Look whether the disk has room, and what is wrong where it hasn't. The reserve makes way on a full disk, and
        is made again where there is room."""
        lack = self.room.look()
        if lack is not None:
            self.reuse_log()
        return lack

    # --- sessions -----------------------------------------------------------------------------------------------------

    def folder(self, session_id: str) -> Path:
        """Return where a session's files lie."""
        return self.root / "sessions" / session_id

    def lock(self, session_id: str) -> Lock:
        """Return the lock of the process that runs a session."""
        return Lock(self.folder(session_id) / ".lock")

    def create_session(
        self,
        station: Station,
        steps: Sequence[Step],
        *,
        plan: Mapping[str, Any] | None = None,
        patterns: Mapping[str, NDArray[np.uint8]] | None = None,
        name: str = "",
        notes: str = "",
        demands_certified: bool = False,
    ) -> str:
        """Register a session with all its steps; nothing is captured yet.

        station : on which it is captured
        steps : in order
        plan : sequences and parameters of which the steps follow
        patterns : cells of the screen's patterns, by path
        name, notes : by its operator
        demands_certified : it runs only with cameras that have a certified calibration

        Returns its id. Raises NoRoom where the disk is full; then nothing of it stays.
        """
        check_line("name", name)
        check_line("notes", notes, several_lines=True)
        self.room.check()
        self.room.keep()
        created = now()
        session_id = f"{created:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        try:
            self._create(session_id, created, station, steps, plan, patterns, name, notes, demands_certified)
        except BaseException:
            shutil.rmtree(self.folder(session_id), ignore_errors=True)
            raise
        return session_id

    def _create(
        self,
        session_id: str,
        created: datetime,
        station: Station,
        steps: Sequence[Step],
        plan: Mapping[str, Any] | None,
        patterns: Mapping[str, NDArray[np.uint8]] | None,
        name: str,
        notes: str,
        demands_certified: bool,
    ) -> None:
        """Write a session's first files and its rows."""
        files: list[StoredFile] = []
        cameras: dict[str, Any] = {}
        for side, camera in station.cameras.items():
            curves = {channel: f"spectra/qe-{side}-{channel}.csv" for channel in camera.quantum_efficiency}
            for channel, path in curves.items():
                files.append(self.write_spectrum(session_id, path, camera.quantum_efficiency[channel]))
            keys: dict[str, Any] = {"quantum_efficiency": curves or None}
            if camera.datasheet.lens_file is not None:
                lens = Path(camera.datasheet.lens_file)
                keys["lens_file"] = f"lens/{lens.name}"
                write_durably(self.folder(session_id) / keys["lens_file"], lens.read_bytes())
            cameras[side] = camera.datasheet.model_dump(mode="json", exclude_unset=True) | keys
        files += [self.write_target(session_id, path, cells) for path, cells in (patterns or {}).items()]
        with self.transaction() as db:
            db.add(
                SessionRow(
                    id=session_id,
                    name=name,
                    notes=notes,
                    created=created,
                    state="created",
                    station=station.model_dump(mode="json"),
                    calibration=dict(plan or {}),
                    cameras=cameras,
                    runs=[],
                    steps=len(steps),
                    demands_certified=demands_certified,
                )
            )
            db.flush()
            db.add_all(
                StepRow(session_id=session_id, position=at, step_id=step.id, spec=step.model_dump(mode="json"))
                for at, step in enumerate(steps)
            )
            db.add_all(_file_row(session_id, file) for file in files)

    def _row(self, db: Session, session_id: str) -> SessionRow:
        row = db.get(SessionRow, session_id)
        if row is None:
            raise InputError(f"session {session_id!r} isn't in {self.root}; `calibench sessions` lists those that are")
        return row

    def _infos(self, db: Session, rows: Sequence[SessionRow]) -> list[SessionInfo]:
        """Return the sessions of these rows. Of one that is packed, all steps are done; those of the others are counted
        in one query."""
        counted = sa.select(StepRow.session_id, sa.func.count(StepRow.finished)).group_by(StepRow.session_id)
        open_ones = [row.id for row in rows if not row.packed]
        asked = db.execute(counted.where(StepRow.session_id.in_(open_ones))) if open_ones else ()
        done = {session_id: number for session_id, number in asked}  # noqa: C416  (rows, not pairs, to a type checker)
        return [
            SessionInfo(
                id=row.id,
                name=row.name,
                notes=row.notes,
                created=_aware(row.created),
                closed=row.closed and _aware(row.closed),
                state=row.state,  # type: ignore[arg-type]
                error=row.error,
                packed=row.packed,
                demands_certified=row.demands_certified,
                steps=row.steps,
                steps_done=row.steps if row.packed else done.get(row.id, 0),
            )
            for row in rows
        ]

    def _info(self, db: Session, row: SessionRow) -> SessionInfo:
        return self._infos(db, [row])[0]

    def _now(self, read: SessionInfo) -> SessionInfo:
        """Return the state as it is now.

        A session that was read as running, but whose lock is free, is read again: its process may have ended in
        between. It is "interrupted" if that process didn't record how it ended.
        """
        if read.state not in ("running", "paused") or self.lock(read.id).is_held():
            return read
        with self.reading() as db:
            again = self._info(db, self._row(db, read.id))
        if again.state not in ("running", "paused"):
            return again
        why = again.error or "its run ended and nothing could be recorded of that (killed, or a full disk); resume it"
        return again.model_copy(update={"state": "interrupted", "error": why})

    def session(self, session_id: str) -> SessionInfo:
        """Return a session. Raises InputError where there is none of that id.

        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     try:
        ...         Store(Path(folder)).session("20300101-101500-7f3ad2")
        ...     except InputError as error:
        ...         print("20300101-101500-7f3ad2" in str(error))
        True
        """
        with self.reading() as db:
            info = self._info(db, self._row(db, session_id))
        return self._now(info)

    def sessions(
        self,
        after: str | None = None,
        limit: int | None = None,
        *,
        search: str = "",
        only: Sequence[str] | None = None,
    ) -> list[SessionInfo]:
        """Return sessions, the newest first.

        after : id of the session that they follow in this order
        limit : how many at most
        search : words, each of which their id, name, notes, their station's name or what their instruments reported has
        only : ids of those that are asked for

        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     Store(Path(folder)).sessions()
        []
        """
        documents = (
            SessionRow.station,
            SessionRow.cameras,
            SessionRow.calibration,
            SessionRow.runs,
            SessionRow.request,
        )
        asked = _confine_query(sa.select(SessionRow).options(*map(defer, documents)), search, only)
        with self.reading() as db:
            if after is not None:
                last = self._row(db, after)
                asked = asked.where(sa.tuple_(SessionRow.created, SessionRow.id) < sa.tuple_(last.created, last.id))
            asked = asked.order_by(SessionRow.created.desc(), SessionRow.id.desc()).limit(limit)
            infos = self._infos(db, db.scalars(asked).all())
        return [self._now(info) for info in infos]

    def count_sessions(self, *, search: str = "", only: Sequence[str] | None = None) -> int:
        """Return how many sessions there are, of those that `sessions` answers."""
        with self.reading() as db:
            return db.scalars(_confine_query(sa.select(sa.func.count()).select_from(SessionRow), search, only)).one()

    def describe_session(self, session_id: str, name: str | None = None, notes: str | None = None) -> None:
        """Give a session another name, or other notes; None leaves them. Raises InputError for control characters."""
        check_line("name", name or "")
        check_line("notes", notes or "", several_lines=True)
        with self.transaction() as db:
            row = self._row(db, session_id)
            row.name = row.name if name is None else name
            row.notes = row.notes if notes is None else notes

    def count_states(self) -> dict[str, int]:
        """State -> how many sessions the registry has in it."""
        with self.reading() as db:
            counted = db.execute(sa.select(SessionRow.state, sa.func.count()).group_by(SessionRow.state))
            return {state: number for state, number in counted}  # noqa: C416  (rows, not pairs, to a type checker)

    def under_way(self) -> list[str]:
        """Return the ids of the sessions that are recorded as running or paused, also where their process died."""
        with self.reading() as db:
            return list(db.scalars(sa.select(SessionRow.id).where(SessionRow.state.in_(("running", "paused")))))

    def has_session(self, session_id: str) -> bool:
        """Return whether there is such a session."""
        with self.reading() as db:
            return db.get(SessionRow, session_id) is not None

    def station(self, session_id: str) -> Station:
        """Return the station of a session's last run, or that it was started on."""
        with self.reading() as db:
            return Station.model_validate(self._row(db, session_id).station)

    def details(self, session_id: str) -> SessionDetails:
        """Return one session with its provenance, in one reading."""
        with self.reading() as db:
            row = self._row(db, session_id)
            runs = tuple(RunRecord.model_validate(run) for run in row.runs)
            details = SessionDetails(self._info(db, row), str(row.station.get("name", "")), runs)
        return replace(details, info=self._now(details.info))

    def runs(self, session_id: str) -> list[RunRecord]:
        """Return the provenance: every run of a session, in order."""
        with self.reading() as db:
            return [RunRecord.model_validate(run) for run in self._row(db, session_id).runs]

    def run_before(self, session_id: str) -> tuple[str, RunRecord] | None:
        """Return the last run on the session's station so far, with its session's id: of this session, or of one that
        was registered earlier. None: there is none."""
        with self.reading() as db:
            row = self._row(db, session_id)
            station = row.station.get("name", "")
            asked = sa.select(SessionRow.id, SessionRow.station, SessionRow.runs)
            asked = asked.where(sa.tuple_(SessionRow.created, SessionRow.id) <= sa.tuple_(row.created, row.id))
            for id, station_keys, runs in db.execute(asked.order_by(SessionRow.created.desc(), SessionRow.id.desc())):
                if runs and station_keys.get("name", "") == station:
                    return id, RunRecord.model_validate(runs[-1])
        return None

    def set_state(
        self,
        session_id: str,
        state: SessionState,
        error: str | None = None,
        run: RunRecord | None = None,
        station: Station | None = None,
    ) -> None:
        """Record the state of a session and take it out of the queue. `run` is added to its provenance; `station`:
        where it runs now.

        A session that is interrupted or failed holds the queued sessions that need one of its instruments.
        """
        with self.transaction() as db:
            row = self._row(db, session_id)
            row.state, row.error = state, error
            row.queue_place = row.not_before = None
            if state in ("interrupted", "failed"):
                hold_queue(
                    db, f"session {session_id} is {state}: {error}; release it when the bench is ready", row.station
                )
            if run is not None:
                row.runs = [*row.runs, run.model_dump(mode="json")]
            if station is not None:
                row.station = station.model_dump(mode="json")

    def delete_session(self, session_id: str) -> None:
        """Delete a session for ever: its captures, its journal, its files. Results of it stay. Raises InputError while
        a process runs it."""
        lock = self.lock(session_id)
        with self.reading() as db:
            self._row(db, session_id)
        if not lock.acquire(patience_s=0.0):
            raise InputError(f"session {session_id}: a process runs it; abort it first")
        try:
            try:
                self._delete_rows(session_id)
            except NoRoom:  # its files first: they make the room that the registry needs
                shutil.rmtree(self.folder(session_id), ignore_errors=True)
                self.reuse_log()
                self._delete_rows(session_id)
        finally:
            lock.release()
        shutil.rmtree(self.folder(session_id), ignore_errors=True)

    def _delete_rows(self, session_id: str) -> None:
        with self.transaction() as db:
            for table in (CaptureRow, FileRow, StepRow):
                db.execute(sa.delete(table).where(table.session_id == session_id))
            db.execute(sa.delete(SessionRow).where(SessionRow.id == session_id))

    # --- the journal --------------------------------------------------------------------------------------------------

    def journal(self, session_id: str) -> list[JournalEntry]:
        """Return all steps of a session in order, done or to do."""
        with self.reading() as db:
            self._row(db, session_id)
            rows = db.scalars(sa.select(StepRow).where(StepRow.session_id == session_id).order_by(StepRow.position))
            return [
                JournalEntry(Step.model_validate(row.spec), row.finished and _aware(row.finished), row.result or {})
                for row in rows
            ]

    def finish_step(
        self,
        session_id: str,
        step_id: str,
        started: datetime,
        result: Mapping[str, Any],
        files: Sequence[StoredFile] = (),
        captures: Sequence[Capture] = (),
    ) -> bool:
        """Link all files and captures of a step and mark it done, in one transaction. False, and no change, if it was
        done before."""
        with self.transaction() as db:
            row = db.scalars(
                sa.select(StepRow).where(StepRow.session_id == session_id, StepRow.step_id == step_id).with_for_update()
            ).one()
            if row.finished is not None:
                return False
            row.started, row.finished, row.result = started, now(), dict(result)
            rows = {file.path: _file_row(session_id, file) for file in files}
            db.add_all(rows.values())
            db.flush()
            db.add_all(
                CaptureRow(
                    session_id=session_id,
                    step=row.id,
                    file=rows[capture.frame].id,
                    name=capture.id,
                    kind=capture.kind,
                    side=capture.side,
                    document=capture.model_dump(mode="json", exclude_unset=True),
                )
                for capture in captures
            )
        return True

    def lab_time_s(self, session_id: str) -> float:
        """Return the time that the finished steps of a session took, s, whatever lay between them."""
        asked = sa.select(StepRow.started, StepRow.finished).where(
            StepRow.session_id == session_id, StepRow.started.is_not(None), StepRow.finished.is_not(None)
        )
        with self.reading() as db:
            rows = [(started, finished) for started, finished in db.execute(asked) if started and finished]
        return float(sum((finished - started).total_seconds() for started, finished in rows))

    def sweep(self, session_id: str) -> list[str]:
        """Remove the files that no finished step links, as a crash leaves them; their paths. Needs the session's
        lock."""
        with self.reading() as db:
            linked = set(db.scalars(sa.select(FileRow.path).where(FileRow.session_id == session_id)))
        folder = self.folder(session_id)
        swept = [
            str(file.relative_to(folder))
            for part in ("frames", "spectra", "targets")
            for file in sorted((folder / part).glob("*"))
            if str(file.relative_to(folder)) not in linked
        ]
        for path in swept:
            (folder / path).unlink()
        return swept

    # --- files --------------------------------------------------------------------------------------------------------

    def _put(self, session_id: str, role: Role, path: str, content: bytes, side: Side | None = None) -> StoredFile:
        write_durably(self.folder(session_id) / path, content)
        return StoredFile(role, path, hashlib.sha256(content).hexdigest(), len(content), side)

    def write_frame(self, session_id: str, path: str, side: Side, frame: NDArray[np.uint16]) -> StoredFile:
        """Write a frame; `finish_step` links it."""
        return self._put(session_id, "frame", path, npy_bytes(np.ascontiguousarray(frame, np.uint16)), side)

    def write_spectrum(self, session_id: str, path: str, spectrum: Spectrum) -> StoredFile:
        """Write a spectrum; `finish_step` links it."""
        return self._put(session_id, "spectrum", path, format_spectrum(spectrum).encode())

    def write_target(self, session_id: str, path: str, cells: NDArray[np.uint8]) -> StoredFile:
        """Write a screen's pattern."""
        return self._put(session_id, "target", path, npy_bytes(np.ascontiguousarray(cells, np.uint8)))

    def files(self, session_id: str) -> list[StoredFile]:
        """Return the linked files of a session with their hashes, in the order in which they were linked."""
        with self.reading() as db:
            rows = db.scalars(sa.select(FileRow).where(FileRow.session_id == session_id).order_by(FileRow.id))
            return [StoredFile(row.role, row.path, row.sha256, row.bytes, row.side) for row in rows]  # type: ignore[arg-type]

    # --- captures -----------------------------------------------------------------------------------------------------

    def captures(
        self,
        session_id: str,
        *,
        kind: str | None = None,
        side: str | None = None,
        search: str = "",
        after: int | None = None,
        newest_first: bool = False,
        limit: int | None = None,
    ) -> list[CaptureInfo]:
        """Return the captures of a session in the order in which they were taken, or the newest first: of one kind and
        side, or all; those whose name has each word of `search`; `limit` at most, those that follow the capture of the
        id `after` in this order."""
        asked = _captures_of(sa.select(CaptureRow), session_id, kind, side, search)
        if after is not None:
            asked = asked.where(CaptureRow.id < after if newest_first else CaptureRow.id > after)
        asked = asked.order_by(CaptureRow.id.desc() if newest_first else CaptureRow.id).limit(limit)
        with self.reading() as db:
            self._row(db, session_id)
            return [CaptureInfo.model_validate(row) for row in db.scalars(asked)]

    def count_captures(self, session_id: str, search: str = "") -> dict[tuple[str, str], int]:
        """Count a session's captures by (kind, side), of those whose name has each word of `search`."""
        asked = sa.select(CaptureRow.kind, CaptureRow.side, sa.func.count()).group_by(CaptureRow.kind, CaptureRow.side)
        with self.reading() as db:
            return {(kind, side): n for kind, side, n in db.execute(_captures_of(asked, session_id, search=search))}

    def capture(self, capture_id: int) -> CaptureInfo:
        """Return a capture by its id in the registry."""
        with self.reading() as db:
            row = db.get(CaptureRow, capture_id)
            if row is None:
                raise InputError(f"capture {capture_id} isn't in {self.root}; list the captures of a session")
            return CaptureInfo.model_validate(row)

    def frame(self, capture_id: int) -> NDArray[np.uint16]:
        """Return the frame of a capture by its id in the registry."""
        recordings = self.recording_set(self.capture(capture_id).session_id, (capture_id,))
        return recordings.frame(recordings.captures()[0])

    def recording_set(self, session_id: str, only: Sequence[int] | None = None) -> RecordingSet:
        """Return the captures of a session so far as a recording set; `only`: those of these ids in the registry."""
        asked = sa.select(CaptureRow.document).where(CaptureRow.session_id == session_id)
        files = sa.select(FileRow.path, FileRow.sha256, FileRow.side, FileRow.pack_index)
        files = files.where(FileRow.session_id == session_id)
        if only is not None:
            asked = asked.where(CaptureRow.id.in_(only))
            theirs = sa.select(CaptureRow.file).where(CaptureRow.id.in_(only))
            files = files.where(sa.or_(FileRow.role != "frame", FileRow.id.in_(theirs)))
        with self.reading() as db:
            row = self._row(db, session_id)
            runs = [RunRecord.model_validate(run) for run in row.runs]
            statements: dict[str, Any] = {"instruments": runs[-1].instruments} if runs else {}
            if changes := tuple(line for run in runs for line in run.changes):
                statements["changes"] = changes
            cameras: Any = {side: DataSheet.model_validate(camera) for side, camera in row.cameras.items()}
            manifest = Manifest(
                name=escaped(row.name) or session_id,  # of before control characters were refused
                notes=escaped(row.notes, several_lines=True),
                **statements,
                cameras=cameras,
                captures=tuple(
                    _capture(session_id, row_of_capture) for row_of_capture in db.scalars(asked.order_by(CaptureRow.id))
                ),
            )
            where = {path: StoredPlace(sha256, side, index) for path, sha256, side, index in db.execute(files)}
        return RecordingSet(manifest, source=session_id, files=SessionFiles(self.folder(session_id), where))

    # --- closing ------------------------------------------------------------------------------------------------------

    def close_session(self, session_id: str, progress: Callable[[str, float], None] | None = None) -> Path:
        """Pack a session whose steps are all done into one NeXus-layout file, and remove the files of its frames.

        The packed frames are read back and compared by their SHA-256 before anything is removed. A second call changes
        nothing. Raises InputError while steps are still to do. What `progress` raises ends the packing, which a later
        call begins anew."""
        info = self.session(session_id)
        if info.steps_done < info.steps:
            raise InputError(
                f"session {session_id}: {info.steps - info.steps_done} of {info.steps} steps are to do; resume it first"
            )
        folder = self.folder(session_id)
        pack = folder / PACK
        if not info.packed:
            recordings = self.recording_set(session_id)
            recordings.cache_bytes = 0  # each frame is read once
            files = self.files(session_id)
            frames = [file for file in files if file.role == "frame"]
            partial = pack.with_name(f".{PACK}.partial")
            partial.unlink(missing_ok=True)
            try:
                index = write_nexus(partial, recordings, info, self.runs(session_id), files, progress)
                packed = SessionFiles(
                    folder,
                    {file.path: StoredPlace(file.sha256, file.side, index[file.path]) for file in frames},
                    pack=partial,
                )
                for number, file in enumerate(frames):
                    packed.frame(file.path, recordings.manifest.cameras["left"])
                    if progress:
                        progress("checking the packed session", number / len(frames))
                with partial.open("rb") as written:
                    os.fsync(written.fileno())
                partial.rename(pack)
            except BaseException:  # on a full disk, what is unfinished takes the room that others wait for
                partial.unlink(missing_ok=True)
                raise
            with self.transaction() as db:
                for path, at in index.items():
                    db.execute(
                        sa.update(FileRow)
                        .where(FileRow.session_id == session_id, FileRow.path == path)
                        .values(pack_index=at)
                    )
                row = self._row(db, session_id)
                row.packed, row.closed, row.state, row.error = True, now(), "finished", None
                row.queue_place = row.not_before = None
                release_held_by(db, session_id)
        shutil.rmtree(folder / "frames", ignore_errors=True)
        return pack

    # --- results ------------------------------------------------------------------------------------------------------

    def add_result(self, kind: str, source: str, document: Mapping[str, Any], job_id: str | None = None) -> str:
        """Store a result; returns its id."""
        result_id = secrets.token_hex(8)
        with self.transaction() as db:
            db.add(
                ResultRow(id=result_id, job_id=job_id, source=source, kind=kind, created=now(), document=dict(document))
            )
        return result_id

    def result(self, result_id: str) -> ResultInfo:
        """Return a result by its own id or by the id of the job that made it."""
        with self.reading() as db:
            row = db.get(ResultRow, result_id)
            row = row or db.scalars(sa.select(ResultRow).where(ResultRow.job_id == result_id)).first()
            if row is None:
                raise InputError(f"result {result_id!r} isn't in {self.root}; list the results of a session")
            return ResultInfo.model_validate(row)

    def newest_results(self, source: str) -> dict[str, str]:
        """Return the id of the newest result of each kind, of one session (or recording set's folder)."""
        asked = sa.select(ResultRow.kind, ResultRow.id).where(ResultRow.source == source).order_by(ResultRow.created)
        with self.reading() as db:
            return {row.kind: row.id for row in db.execute(asked)}

    def results(self, source: str | None = None, kind: str | None = None) -> list[ResultInfo]:
        """Return results, the newest first; of one session (or recording set's folder) and one kind, or all."""
        asked = sa.select(ResultRow).order_by(ResultRow.created.desc())
        if source is not None:
            asked = asked.where(ResultRow.source == source)
        if kind is not None:
            asked = asked.where(ResultRow.kind == kind)
        with self.reading() as db:
            return [ResultInfo.model_validate(row) for row in db.scalars(asked)]

    # --- keys ---------------------------------------------------------------------------------------------------------

    def keys(self, anew: bool = True) -> list[tuple[str, str, str]]:
        """Return (name, scope, SHA-256) of every API key; unless `anew`, as another process may have left them `KEYS_S`
        ago. Where the registry can't be read, as they were read last.
        """
        if anew or not self.knows_keys():
            try:
                with self.reading() as db:
                    rows = db.scalars(sa.select(KeyRow).order_by(KeyRow.name))
                    keys = [(row.name, row.scope, row.sha256) for row in rows]
            except (CannotWrite, sa.exc.SQLAlchemyError):  # a registry that can't be read doesn't stop a halt
                if not self._keys[1]:
                    raise
                keys = self._keys[1]
            self._keys = (time.monotonic() + KEYS_S, keys)
        return self._keys[1]

    def knows_keys(self) -> bool:
        """Return whether `keys(anew=False)` asks nothing of the registry now."""
        return time.monotonic() < self._keys[0]

    def add_key(self, name: str, scope: str, sha256: str) -> None:
        """Register an API key by its hash. Raises InputError if the name is taken."""
        try:
            with self.transaction() as db:
                db.add(KeyRow(name=name, scope=scope, sha256=sha256, created=now()))
        except sa.exc.IntegrityError as error:
            raise InputError(f"an API key called {name!r} exists; choose another name or remove it") from error
        self._keys = (0.0, [])

    def remove_key(self, name: str) -> None:
        """Remove an API key."""
        with self.transaction() as db:
            row = db.get(KeyRow, name)
            if row is None:
                raise InputError(f"no API key is called {name!r}; list them for their names")
            db.delete(row)
        self._keys = (0.0, [])

    def add_halt_token(self, sha256: str, key_sha256: str, expires: datetime) -> None:
        """Register a halt token by its hash, for the key of that hash, and remove those that have expired."""
        with self.transaction() as db:
            db.execute(sa.delete(HaltTokenRow).where(HaltTokenRow.expires < now()))
            db.add(HaltTokenRow(sha256=sha256, key_sha256=key_sha256, expires=expires))

    def key_of_halt_token(self, sha256: str) -> tuple[str, str, str] | None:
        """Return (name, scope, SHA-256) of the key that a halt token was made for; None where the token is unknown or
        expired, or its key removed."""
        asked = sa.select(KeyRow).join(HaltTokenRow, HaltTokenRow.key_sha256 == KeyRow.sha256)
        asked = asked.where(HaltTokenRow.sha256 == sha256, HaltTokenRow.expires > now())
        with self.reading() as db:
            row = db.scalars(asked).first()
            return None if row is None else (row.name, row.scope, row.sha256)

    def remove_halt_token(self, sha256: str) -> None:
        """Remove a halt token, where there is one."""
        with self.transaction() as db:
            db.execute(sa.delete(HaltTokenRow).where(HaltTokenRow.sha256 == sha256))


def _confine_query(asked: Any, search: str, only: Sequence[str] | None) -> Any:
    """Return a query of sessions, confined to those that have all words of a text, and to some ids."""
    for word in search.split():
        places = (SessionRow.id, SessionRow.name, SessionRow.notes, SessionRow.station["name"].as_string())
        reported = sa.cast(SessionRow.runs, sa.Text)
        asked = asked.where(sa.or_(*(place.icontains(word, autoescape=True) for place in (*places, reported))))
    return asked if only is None else asked.where(SessionRow.id.in_(only))


def _captures_of(
    asked: Any, session_id: str, kind: str | None = None, side: str | None = None, search: str = ""
) -> Any:
    """Return a query of captures, confined to a session, a kind, a side and the words of a search."""
    for word in search.split():
        asked = asked.where(CaptureRow.name.icontains(word, autoescape=True))
    for column, wanted in ((CaptureRow.session_id, session_id), (CaptureRow.kind, kind), (CaptureRow.side, side)):
        if wanted is not None:
            asked = asked.where(column == wanted)
    return asked


def _file_row(session_id: str, file: StoredFile) -> FileRow:
    return FileRow(
        session_id=session_id, role=file.role, path=file.path, sha256=file.sha256, bytes=file.bytes, side=file.side
    )


def _aware(at: datetime) -> datetime:
    """Return the time with its zone, UTC, which SQLite doesn't keep."""
    return at if at.tzinfo is not None else at.replace(tzinfo=UTC)


def _capture(session_id: str, document: dict[str, Any]) -> Capture:
    """Return a capture of the registry. Raises InputError for a kind that this installation doesn't have."""
    if document["kind"] not in CAPTURES.models:
        raise InputError(
            f"session {session_id}: it has captures of the kind {document['kind']!r}, which this version doesn't know; "
            "read it with the version that took it"
        )
    return CAPTURES.parse(document)
