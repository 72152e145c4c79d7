"""Where captures are kept: immutable files in a folder, and a registry that says what they are.

    DATA/registry.sqlite              (or a PostgreSQL database, by URL)
    DATA/sessions/ID/frames/*.npy     one file a frame, while the session runs
                     spectra/*.csv    what the spectroradiometer measured, and the makers' curves
                     targets/*.npy    what the screen showed
                     documents.jsonl  bluesky's documents
                     session.nxs      the whole session, packed when it closes (NeXus layout, gzip and shuffle)

A file is written under a temporary name, flushed to the disk and renamed; only then one transaction links everything that a
step took and marks the step done. So a file without a link may be left after a crash (it is swept away when the session
resumes), and a link without its file never. A frame's SHA-256 is checked whenever it is read.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import json
import os
import secrets
import shutil
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, sessionmaker

from lab.capture.sequences.steps import Step
from lab.capture.station import Station
from lab.errors import InputError
from lab.formats.recording_set import (
    AnyCapture,
    Camera,
    Manifest,
    RecordingSet,
    format_spectrum,
    manifest_json,
    parse_spectrum,
)
from sim.camera import Side
from sim.parameters import Frozen
from sim.spectrum import Spectrum

SessionState = Literal["created", "running", "paused", "interrupted", "failed", "finished"]
JobState = Literal["queued", "running", "done", "failed", "cancelled"]
Role = Literal["frame", "spectrum", "target"]
_CAPTURE: TypeAdapter[AnyCapture] = TypeAdapter(AnyCapture)
PACK = "session.nxs"
_GZIP_LEVEL = 1  # of frames that are mostly noise, level 6 saves 2 % more and takes three times as long
_PACKERS = 2


class Settings(BaseSettings):
    """Where data are kept and where work is done; from the environment, `CALIBENCH_DATA` and so on."""

    model_config = SettingsConfigDict(env_prefix="CALIBENCH_")

    data: Path = Path("calibench-data")
    database_url: str | None = None  # None: SQLite in the data folder
    scheduler: str | None = None  # address of a Dask scheduler; None: in this process

    @property
    def url(self) -> str:
        """The registry's SQLAlchemy URL."""
        return self.database_url or f"sqlite:///{(self.data / 'registry.sqlite').resolve()}"


# --- the registry's tables ---------------------------------------------------------------------------------------------


class Base(DeclarativeBase):
    """The registry's tables. A change here needs a revision in `lab/capture/migrations/versions`."""

    type_annotation_map = {dict[str, Any]: sa.JSON, list[Any]: sa.JSON, datetime: sa.DateTime(timezone=True)}


class SessionRow(Base):
    __tablename__ = "sessions"

    id: Mapped[str] = mapped_column(sa.String(40), primary_key=True)
    name: Mapped[str] = mapped_column(sa.Text, default="")
    notes: Mapped[str] = mapped_column(sa.Text, default="")
    created: Mapped[datetime]
    closed: Mapped[datetime | None]
    state: Mapped[str] = mapped_column(sa.String(20))
    error: Mapped[str | None] = mapped_column(sa.Text)
    station: Mapped[dict[str, Any]]
    calibration: Mapped[dict[str, Any]]
    cameras: Mapped[dict[str, Any]]
    runs: Mapped[list[Any]]
    packed: Mapped[bool] = mapped_column(default=False)


class StepRow(Base):
    """The journal: a step is done when `finished` is set."""

    __tablename__ = "steps"
    __table_args__ = (sa.UniqueConstraint("session_id", "step_id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[str] = mapped_column(sa.ForeignKey("sessions.id", ondelete="CASCADE"), index=True)
    position: Mapped[int]
    step_id: Mapped[str] = mapped_column(sa.String(120))
    spec: Mapped[dict[str, Any]]
    started: Mapped[datetime | None]
    finished: Mapped[datetime | None]
    result: Mapped[dict[str, Any] | None]


class FileRow(Base):
    """A file of a session, immutable. `pack_index`: where a frame lies in the packed session."""

    __tablename__ = "files"
    __table_args__ = (sa.UniqueConstraint("session_id", "path"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[str] = mapped_column(sa.ForeignKey("sessions.id", ondelete="CASCADE"), index=True)
    role: Mapped[str] = mapped_column(sa.String(20))
    path: Mapped[str] = mapped_column(sa.String(300))
    sha256: Mapped[str] = mapped_column(sa.String(64))
    bytes: Mapped[int]
    side: Mapped[str | None] = mapped_column(sa.String(10))
    pack_index: Mapped[int | None]


class CaptureRow(Base):
    __tablename__ = "captures"
    __table_args__ = (sa.UniqueConstraint("session_id", "name"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[str] = mapped_column(sa.ForeignKey("sessions.id", ondelete="CASCADE"), index=True)
    step: Mapped[int] = mapped_column(sa.ForeignKey("steps.id", ondelete="CASCADE"))
    file: Mapped[int] = mapped_column(sa.ForeignKey("files.id", ondelete="CASCADE"))
    name: Mapped[str] = mapped_column(sa.String(160))
    kind: Mapped[str] = mapped_column(sa.String(20))
    side: Mapped[str] = mapped_column(sa.String(10))
    document: Mapped[dict[str, Any]]


class JobRow(Base):
    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(sa.String(40), primary_key=True)
    kind: Mapped[str] = mapped_column(sa.String(20))
    source: Mapped[str] = mapped_column(sa.Text)
    state: Mapped[str] = mapped_column(sa.String(20), index=True)
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(sa.Text, default="")
    error: Mapped[str | None] = mapped_column(sa.Text)
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    runner: Mapped[str] = mapped_column(sa.String(40))
    created: Mapped[datetime]
    started: Mapped[datetime | None]
    finished: Mapped[datetime | None]


class ResultRow(Base):
    __tablename__ = "results"

    id: Mapped[str] = mapped_column(sa.String(40), primary_key=True)
    job_id: Mapped[str | None] = mapped_column(sa.ForeignKey("jobs.id", ondelete="SET NULL"), index=True)
    source: Mapped[str] = mapped_column(sa.Text, index=True)
    kind: Mapped[str] = mapped_column(sa.String(20))
    created: Mapped[datetime]
    document: Mapped[dict[str, Any]]


class KeyRow(Base):
    """An API key: only its hash (see `api.security`)."""

    __tablename__ = "api_keys"

    name: Mapped[str] = mapped_column(sa.String(100), primary_key=True)
    scope: Mapped[str] = mapped_column(sa.String(20))
    sha256: Mapped[str] = mapped_column(sa.String(64), unique=True)
    created: Mapped[datetime]


# --- what the store tells ----------------------------------------------------------------------------------------------


class _Row(Frozen):
    model_config = ConfigDict(frozen=True, extra="forbid", from_attributes=True)


class SessionInfo(_Row):
    """A session as the registry has it."""

    id: str
    name: str
    notes: str
    created: datetime
    closed: datetime | None
    state: SessionState
    error: str | None
    packed: bool
    steps: int
    steps_done: int


class CaptureInfo(_Row):
    """A capture as the registry has it; `document` is its entry in a manifest."""

    id: int
    session_id: str
    name: str
    kind: str
    side: str
    document: dict[str, Any]


class ResultInfo(_Row):
    """A stored result; `document` as `spec/results.md` has it."""

    id: str
    job_id: str | None
    source: str
    kind: str
    created: datetime
    document: dict[str, Any]


class Run(Frozen):
    """Provenance of one run of a session: when, with which instruments and which versions."""

    started: datetime
    instruments: dict[str, dict[str, str]]
    versions: dict[str, str]


@dataclass(frozen=True)
class StoredFile:
    """A file that is on the disk and not linked yet."""

    role: Role
    path: str
    sha256: str
    bytes: int
    side: Side | None = None


@dataclass(frozen=True)
class JournalEntry:
    """A step of the journal with what came of it; `finished` None: still to do."""

    step: Step
    finished: datetime | None
    result: dict[str, Any]


def now() -> datetime:
    """The time, UTC."""
    return datetime.now(UTC)


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An array as the bytes of its .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def write_durably(path: Path, content: bytes) -> None:
    """Write a file completely or not at all, and see it onto the disk: temporary name, fsync, rename, fsync of the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    partial.rename(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class Lock:
    """Held by one process at a time, and let go of by the system when that process ends, however it ends."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: int | None = None

    def acquire(self, patience_s: float = 0.2) -> bool:
        """Whether the lock is ours now; tries for `patience_s`, for a mere look at a lock holds it for a moment."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o600)
        until = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() >= until:
                    os.close(file)
                    return False
                time.sleep(0.01)
            else:
                self._file = file
                return True

    def release(self) -> None:
        """Let go; doing it twice is fine."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def is_held(self) -> bool:
        """Whether anyone holds it, us included."""
        if self._file is not None:
            return True
        if not self.path.exists():
            return False
        if taken := self.acquire(patience_s=0.0):
            self.release()
        return not taken


class Store:
    """The data folder and its registry. May be shared by threads; other processes open their own.

    Every method raises InputError where a session, capture or result that it is asked for doesn't exist.
    """

    def __init__(self, root: Path | str, database_url: str | None = None) -> None:
        self.settings = Settings(data=Path(root).resolve(), database_url=database_url)
        self.root = self.settings.data
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.root}: can't be made ({error.strerror}); set CALIBENCH_DATA to a folder of yours"
            ) from error
        self._engine = _engine(self.settings.url)
        self._read = sessionmaker(self._engine, expire_on_commit=False)
        self._write = sessionmaker(self._engine.execution_options(writes=True), expire_on_commit=False)
        self._upgrade()

    @classmethod
    def open(cls, settings: Settings | None = None) -> Store:
        """The store that the settings (by default the environment) name; made if it isn't there."""
        chosen = settings or Settings()
        return cls(chosen.data, chosen.database_url)

    def close(self) -> None:
        """Let go of the database."""
        self._engine.dispose()

    def _upgrade(self) -> None:
        """Bring the registry to the newest revision."""
        config = Config()
        config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
        newest = ScriptDirectory.from_config(config).get_current_head()
        lock = Lock(self.root / ".migration.lock")
        if not lock.acquire(patience_s=60.0):
            raise InputError(
                f"{self.root}: its registry is being migrated by another process; try again when it is done"
            )
        try:
            with self._engine.execution_options(writes=True).connect() as connection:
                if MigrationContext.configure(connection).get_current_revision() == newest:
                    return
                config.attributes["connection"] = connection
                command.upgrade(config, "head")
                connection.commit()
        except sa.exc.DatabaseError as error:
            raise InputError(
                f"{self.settings.url}: isn't a registry ({str(error.orig or error).splitlines()[0]}); "
                "set CALIBENCH_DATA to another folder"
            ) from error
        finally:
            lock.release()

    @contextlib.contextmanager
    def reading(self) -> Iterator[Session]:
        """A database session that only reads."""
        with self._read() as session:
            yield session

    @contextlib.contextmanager
    def transaction(self) -> Iterator[Session]:
        """A database session whose changes are kept together, or not at all."""
        with self._write.begin() as session:
            yield session

    # --- sessions --------------------------------------------------------------------------------------------------------

    def folder(self, session_id: str) -> Path:
        """Where a session's files lie."""
        return self.root / "sessions" / session_id

    def lock(self, session_id: str) -> Lock:
        """Held by whoever runs a session."""
        return Lock(self.folder(session_id) / ".lock")

    def create_session(
        self,
        station: Station,
        steps: Sequence[Step],
        *,
        calibration: Mapping[str, Any] | None = None,
        patterns: Mapping[str, NDArray[np.uint8]] | None = None,
        name: str = "",
        notes: str = "",
    ) -> str:
        """Register a session with all its steps; nothing is taken yet. The id is returned."""
        created = now()
        session_id = f"{created:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
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
                    calibration=dict(calibration or {}),
                    cameras=cameras,
                    runs=[],
                )
            )
            db.flush()
            db.add_all(
                StepRow(session_id=session_id, position=at, step_id=step.id, spec=step.model_dump(mode="json"))
                for at, step in enumerate(steps)
            )
            db.add_all(_file_row(session_id, file) for file in files)
        return session_id

    def _row(self, db: Session, session_id: str) -> SessionRow:
        row = db.get(SessionRow, session_id)
        if row is None:
            raise InputError(f"session {session_id!r} isn't in {self.root}; `calibench sessions` lists those that are")
        return row

    def _info(self, db: Session, row: SessionRow) -> SessionInfo:
        steps, done = db.execute(
            sa.select(sa.func.count(), sa.func.count(StepRow.finished)).where(StepRow.session_id == row.id)
        ).one()
        return SessionInfo(
            id=row.id,
            name=row.name,
            notes=row.notes,
            created=_aware(row.created),
            closed=row.closed and _aware(row.closed),
            state=row.state,  # type: ignore[arg-type]
            error=row.error,
            packed=row.packed,
            steps=steps,
            steps_done=done,
        )

    def _now(self, read: SessionInfo) -> SessionInfo:
        """What was read, unless it says that the session runs and no process holds its lock: then it is read again, because
        the process may have said how it ended in between, and is "interrupted" if it ended without a word."""
        if read.state not in ("running", "paused") or self.lock(read.id).is_held():
            return read
        with self.reading() as db:
            again = self._info(db, self._row(db, read.id))
        return again.model_copy(update={"state": "interrupted"}) if again.state in ("running", "paused") else again

    def session(self, session_id: str) -> SessionInfo:
        """One session."""
        with self.reading() as db:
            found = self._info(db, self._row(db, session_id))
        return self._now(found)

    def sessions(self) -> list[SessionInfo]:
        """All sessions, the newest first."""
        with self.reading() as db:
            rows = db.scalars(sa.select(SessionRow).order_by(SessionRow.created.desc(), SessionRow.id.desc()))
            found = [self._info(db, row) for row in rows]
        return [self._now(one) for one in found]

    def has_session(self, session_id: str) -> bool:
        """Whether there is such a session."""
        with self.reading() as db:
            return db.get(SessionRow, session_id) is not None

    def station(self, session_id: str) -> Station:
        """The station that a session was started on."""
        with self.reading() as db:
            return Station.model_validate(self._row(db, session_id).station)

    def runs(self, session_id: str) -> list[Run]:
        """Provenance: every run of a session, in order."""
        with self.reading() as db:
            return [Run.model_validate(run) for run in self._row(db, session_id).runs]

    def set_state(self, session_id: str, state: SessionState, error: str | None = None, run: Run | None = None) -> None:
        """Say where a session stands; `run` is added to its provenance."""
        with self.transaction() as db:
            row = self._row(db, session_id)
            row.state, row.error = state, error
            if run is not None:
                row.runs = [*row.runs, run.model_dump(mode="json")]

    # --- the journal -----------------------------------------------------------------------------------------------------

    def journal(self, session_id: str) -> list[JournalEntry]:
        """All steps of a session in order, done or to do."""
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
        captures: Sequence[AnyCapture] = (),
    ) -> bool:
        """Link everything a step took and mark it done, in one transaction. False if it was done before: nothing changes."""
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

    def sweep(self, session_id: str) -> list[str]:
        """Remove the files of a session that no finished step links: what a crash left. Only under the session's lock."""
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

    # --- files -----------------------------------------------------------------------------------------------------------

    def _put(self, session_id: str, role: Role, path: str, content: bytes, side: Side | None = None) -> StoredFile:
        write_durably(self.folder(session_id) / path, content)
        return StoredFile(role, path, hashlib.sha256(content).hexdigest(), len(content), side)

    def write_frame(self, session_id: str, path: str, side: Side, frame: NDArray[np.uint16]) -> StoredFile:
        """A frame onto the disk; link it with `finish_step`."""
        return self._put(session_id, "frame", path, npy_bytes(np.ascontiguousarray(frame, np.uint16)), side)

    def write_spectrum(self, session_id: str, path: str, spectrum: Spectrum) -> StoredFile:
        """A spectrum onto the disk; link it with `finish_step`."""
        return self._put(session_id, "spectrum", path, format_spectrum(spectrum).encode())

    def write_target(self, session_id: str, path: str, cells: NDArray[np.uint8]) -> StoredFile:
        """A pattern onto the disk."""
        return self._put(session_id, "target", path, npy_bytes(np.ascontiguousarray(cells, np.uint8)))

    def files(self, session_id: str) -> list[StoredFile]:
        """The linked files of a session with their hashes, in the order in which they were linked."""
        with self.reading() as db:
            rows = db.scalars(sa.select(FileRow).where(FileRow.session_id == session_id).order_by(FileRow.id))
            return [StoredFile(row.role, row.path, row.sha256, row.bytes, row.side) for row in rows]  # type: ignore[arg-type]

    # --- captures --------------------------------------------------------------------------------------------------------

    def captures(self, session_id: str) -> list[CaptureInfo]:
        """The captures of a session in the order in which they were taken."""
        with self.reading() as db:
            self._row(db, session_id)
            rows = db.scalars(sa.select(CaptureRow).where(CaptureRow.session_id == session_id).order_by(CaptureRow.id))
            return [CaptureInfo.model_validate(row) for row in rows]

    def capture(self, capture_id: int) -> CaptureInfo:
        """One capture by its id in the registry."""
        with self.reading() as db:
            row = db.get(CaptureRow, capture_id)
            if row is None:
                raise InputError(f"capture {capture_id} isn't in {self.root}; list the captures of a session")
            return CaptureInfo.model_validate(row)

    def frame(self, capture_id: int) -> NDArray[np.uint16]:
        """The frame of a capture by its id in the registry."""
        capture = self.capture(capture_id)
        return self.recording_set(capture.session_id).frame(_CAPTURE.validate_python(capture.document))

    def recording_set(self, session_id: str) -> RecordingSet:
        """A session as a recording set: what was taken so far, or all of it."""
        with self.reading() as db:
            row = self._row(db, session_id)
            documents = db.scalars(
                sa.select(CaptureRow.document).where(CaptureRow.session_id == session_id).order_by(CaptureRow.id)
            )
            manifest = Manifest(
                name=row.name or session_id,
                notes=row.notes,
                cameras={side: Camera.model_validate(camera) for side, camera in row.cameras.items()},  # type: ignore[misc]
                captures=tuple(_CAPTURE.validate_python(document) for document in documents),
            )
            files = db.execute(
                sa.select(FileRow.path, FileRow.sha256, FileRow.side, FileRow.pack_index).where(
                    FileRow.session_id == session_id
                )
            )
            where = {path: _Place(sha256, side, index) for path, sha256, side, index in files}
        return RecordingSet(manifest, source=session_id, store=_SessionFiles(self.folder(session_id), where))

    # --- closing ---------------------------------------------------------------------------------------------------------

    def close_session(self, session_id: str, progress: Callable[[str, float], None] | None = None) -> Path:
        """Pack a session whose steps are all done into one NeXus-layout file, and take away the files of its frames.

        The packed frames are read back and compared by their SHA-256 before anything is removed. Doing it twice is fine.
        Raises InputError while steps are to do.
        """
        info = self.session(session_id)
        if info.steps_done < info.steps:
            raise InputError(
                f"session {session_id}: {info.steps - info.steps_done} of {info.steps} steps are to do; resume it first"
            )
        folder = self.folder(session_id)
        pack = folder / PACK
        if not info.packed:
            recordings = self.recording_set(session_id)
            files = self.files(session_id)
            frames = [file for file in files if file.role == "frame"]
            partial = pack.with_name(f".{PACK}.partial")
            partial.unlink(missing_ok=True)
            index = _pack(partial, recordings, info, self.runs(session_id), files, progress)
            packed = _SessionFiles(
                folder, {file.path: _Place(file.sha256, file.side, index[file.path]) for file in frames}, pack=partial
            )
            for file in frames:
                packed.frame(file.path, recordings.manifest.cameras["left"])
            with partial.open("rb") as written:
                os.fsync(written.fileno())
            partial.rename(pack)
            with self.transaction() as db:
                for path, at in index.items():
                    db.execute(
                        sa.update(FileRow)
                        .where(FileRow.session_id == session_id, FileRow.path == path)
                        .values(pack_index=at)
                    )
                row = self._row(db, session_id)
                row.packed, row.closed, row.state, row.error = True, now(), "finished", None
        shutil.rmtree(folder / "frames", ignore_errors=True)
        return pack

    # --- results ---------------------------------------------------------------------------------------------------------

    def add_result(self, kind: str, source: str, document: Mapping[str, Any], job_id: str | None = None) -> str:
        """Keep a result; its id is returned."""
        result_id = secrets.token_hex(8)
        with self.transaction() as db:
            db.add(
                ResultRow(id=result_id, job_id=job_id, source=source, kind=kind, created=now(), document=dict(document))
            )
        return result_id

    def result(self, result_id: str) -> ResultInfo:
        """One result by its own id or by the id of the job that made it."""
        with self.reading() as db:
            row = db.get(ResultRow, result_id)
            row = row or db.scalars(sa.select(ResultRow).where(ResultRow.job_id == result_id)).first()
            if row is None:
                raise InputError(f"result {result_id!r} isn't in {self.root}; list the results of a session")
            return ResultInfo.model_validate(row)

    def results(self, source: str | None = None, kind: str | None = None) -> list[ResultInfo]:
        """Results, the newest first; of one session (or recording set's folder) and one kind, or all."""
        asked = sa.select(ResultRow).order_by(ResultRow.created.desc())
        if source is not None:
            asked = asked.where(ResultRow.source == source)
        if kind is not None:
            asked = asked.where(ResultRow.kind == kind)
        with self.reading() as db:
            return [ResultInfo.model_validate(row) for row in db.scalars(asked)]

    # --- keys ------------------------------------------------------------------------------------------------------------

    def keys(self) -> list[tuple[str, str, str]]:
        """(name, scope, SHA-256) of every API key."""
        with self.reading() as db:
            return [(row.name, row.scope, row.sha256) for row in db.scalars(sa.select(KeyRow).order_by(KeyRow.name))]

    def add_key(self, name: str, scope: str, sha256: str) -> None:
        """Register an API key by its hash. Raises InputError if the name is taken."""
        try:
            with self.transaction() as db:
                db.add(KeyRow(name=name, scope=scope, sha256=sha256, created=now()))
        except sa.exc.IntegrityError as error:
            raise InputError(f"an API key called {name!r} exists; choose another name or remove it") from error

    def remove_key(self, name: str) -> None:
        """Take an API key away."""
        with self.transaction() as db:
            row = db.get(KeyRow, name)
            if row is None:
                raise InputError(f"no API key is called {name!r}; list them for their names")
            db.delete(row)


# --- the engine --------------------------------------------------------------------------------------------------------


def _engine(url: str) -> sa.Engine:
    try:
        engine = sa.create_engine(url)
    except (sa.exc.ArgumentError, sa.exc.NoSuchModuleError, ImportError) as error:
        raise InputError(f"registry {url!r} can't be opened ({error}); correct CALIBENCH_DATABASE_URL") from error
    if engine.dialect.name != "sqlite":
        return engine

    @sa.event.listens_for(engine, "connect")
    def _pragmas(connection: Any, record: Any) -> None:
        connection.isolation_level = None  # BEGIN is ours, below
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=30000"):
            connection.execute(f"PRAGMA {pragma}").close()

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        # A writer that began by reading would fail, not wait, where another wrote in between.
        writes = connection.get_execution_options().get("writes")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def _file_row(session_id: str, file: StoredFile) -> FileRow:
    return FileRow(
        session_id=session_id, role=file.role, path=file.path, sha256=file.sha256, bytes=file.bytes, side=file.side
    )


def _aware(at: datetime) -> datetime:
    """SQLite forgets the time zone; ours is always UTC."""
    return at if at.tzinfo is not None else at.replace(tzinfo=UTC)


# --- a session's files as a recording set's ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Place:
    sha256: str
    side: str | None
    pack_index: int | None


class _SessionFiles:
    """Frames, spectra and targets of a session, packed or not; each checked against the registry's SHA-256.

    Knows paths only, so that it can be sent to another process.
    """

    def __init__(self, folder: Path, places: Mapping[str, _Place], pack: Path | None = None) -> None:
        self.folder, self.places = folder, dict(places)
        self.pack = pack or folder / PACK

    def _place(self, path: str) -> _Place:
        if path not in self.places:
            raise InputError("isn't linked in the registry; resume the session, which takes it again")
        return self.places[path]

    def _bytes(self, path: str) -> bytes:
        place = self._place(path)
        try:
            content = (self.folder / path).read_bytes()
        except OSError as error:
            raise InputError(f"can't be read ({error.strerror}); restore it from a backup") from error
        return _intact(content, place)

    def file(self, path: str) -> Path | None:
        if path.startswith("lens/"):
            return self.folder / path
        return None if self._place(path).pack_index is not None else self.folder / path

    def frame(self, path: str, camera: Camera) -> NDArray[np.uint16]:
        place = self._place(path)
        if place.pack_index is None:
            return np.load(io.BytesIO(self._bytes(path)), allow_pickle=False)
        try:
            with h5py.File(self.pack, "r") as file:
                frame = np.asarray(file[f"entry/instrument/{place.side}/data"][place.pack_index], np.uint16)
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"can't be read from {self.pack} ({error}); restore it from a backup") from error
        _intact(npy_bytes(frame), place)
        return frame

    def spectrum(self, path: str) -> Spectrum:
        return parse_spectrum(self._bytes(path).decode())

    def target(self, path: str) -> NDArray[np.uint8]:
        return np.load(io.BytesIO(self._bytes(path)), allow_pickle=False)

    def where(self, path: str) -> str:
        place = self.places.get(path)
        if place is not None and place.pack_index is not None:
            return f"{self.pack}:/entry/instrument/{place.side}/data[{place.pack_index}]"
        return str(self.folder / path)


def _intact(content: bytes, place: _Place) -> bytes:
    found = hashlib.sha256(content).hexdigest()
    if found != place.sha256:
        raise InputError(
            f"damaged: its SHA-256 is {found[:12]}, the registry has {place.sha256[:12]}; restore it from a backup"
        )
    return content


def _group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group


def _chunk(frame: NDArray[np.uint16]) -> bytes:
    """A frame as HDF5's shuffle and gzip filters would leave it; zlib lets other threads run, HDF5's own filters don't."""
    shuffled = np.ascontiguousarray(frame.astype("<u2").view(np.uint8).reshape(-1, 2).T)
    return zlib.compress(shuffled.tobytes(), _GZIP_LEVEL)


def _pack(
    path: Path,
    recordings: RecordingSet,
    info: SessionInfo,
    runs: Sequence[Run],
    files: Sequence[StoredFile],
    progress: Callable[[str, float], None] | None,
) -> dict[str, int]:
    """Write the NeXus-layout file; the place of every frame in its side's stack is returned.

    `/entry/instrument/SIDE` is an NXdetector whose `data` stacks that side's frames in the order in which they were taken;
    `/entry/spectra` and `/entry/targets` hold the rest, `/entry/manifest` the manifest as JSON.
    """
    first = {capture.frame: capture for capture in reversed(recordings.manifest.captures)}
    frames = [stored for stored in files if stored.role == "frame"]
    index: dict[str, int] = {}
    with h5py.File(path, "w") as file:
        file.attrs["NX_class"] = "NXroot"
        file.attrs["default"] = "entry"
        entry = _group(file, "entry", "NXentry")
        entry["title"] = info.name or info.id
        entry["entry_identifier"] = info.id
        entry["start_time"] = info.created.isoformat()
        entry["program_name"] = "calibench"
        entry["manifest"] = manifest_json(recordings.manifest)
        entry["provenance"] = json.dumps([run.model_dump(mode="json") for run in runs])
        instrument = _group(entry, "instrument", "NXinstrument")
        done = 0
        for side in recordings.sides:
            camera = recordings.manifest.cameras[side]
            mine = [stored for stored in frames if stored.side == side]
            detector = _group(instrument, side, "NXdetector")
            data = detector.create_dataset(
                "data",
                shape=(len(mine), camera.rows, camera.cols),
                dtype=np.dtype("<u2"),
                chunks=(1, camera.rows, camera.cols) if mine else None,
                compression="gzip" if mine else None,
                compression_opts=_GZIP_LEVEL if mine else None,
                shuffle=bool(mine),
            )
            data.attrs["units"] = "DN"
            with ThreadPoolExecutor(_PACKERS, thread_name_prefix="pack") as pool:
                chunks = pool.map(lambda stored: _chunk(recordings.frame(first[stored.path])), mine)
                for at, (stored, chunk) in enumerate(zip(mine, chunks, strict=True)):
                    data.id.write_direct_chunk((at, 0, 0), chunk)
                    index[stored.path] = at
                    done += 1
                    if progress:
                        progress("packing the session", done / len(frames))
            detector["frame_name"] = [stored.path for stored in mine]
            detector["count_time"] = [first[stored.path].exposure_s for stored in mine]
            detector["count_time"].attrs["units"] = "s"
            detector["bit_depth_readout"] = camera.bit_depth
            if camera.pixel_pitch_um is not None:
                for axis in ("x_pixel_size", "y_pixel_size"):
                    detector[axis] = camera.pixel_pitch_um
                    detector[axis].attrs["units"] = "um"
        spectra = _group(entry, "spectra", "NXcollection")
        targets = _group(entry, "targets", "NXcollection")
        for stored in files:
            name = Path(stored.path).stem
            if stored.role == "spectrum":
                spectrum = recordings.spectrum(stored.path)
                group = _group(spectra, name, "NXdata")
                group.attrs["signal"], group.attrs["axes"] = "value", "wavelength"
                group["value"] = spectrum.value
                group["wavelength"] = spectrum.wavelength_nm
                group["wavelength"].attrs["units"] = "nm"
            elif stored.role == "target":
                targets.create_dataset(name, data=recordings.target(stored.path), compression="gzip")
    return index
