"""The registry's tables, and its database: SQLite in the data folder, or PostgreSQL by URL."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import sqlalchemy as sa
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from lab.capture.room import Room, why_registry_unwritable
from lab.errors import InputError


class Base(DeclarativeBase):
    """The registry's tables. A change here needs a revision in `lab/capture/migrations/versions`."""

    type_annotation_map = {dict[str, Any]: sa.JSON, list[Any]: sa.JSON, datetime: sa.DateTime(timezone=True)}


class SessionRow(Base):
    """A session. `request`: what the service was asked to start it with; `then`, `then_state`: how far that is which
    follows its end (see `api.then`)."""

    __tablename__ = "sessions"
    __table_args__ = (sa.Index("ix_sessions_created", "created", "id"),)

    id: Mapped[str] = mapped_column(sa.String(40), primary_key=True)
    name: Mapped[str] = mapped_column(sa.Text, default="")
    notes: Mapped[str] = mapped_column(sa.Text, default="")
    created: Mapped[datetime]
    closed: Mapped[datetime | None]
    state: Mapped[str] = mapped_column(sa.String(20), index=True)
    error: Mapped[str | None] = mapped_column(sa.Text)
    station: Mapped[dict[str, Any]]
    calibration: Mapped[dict[str, Any]]
    cameras: Mapped[dict[str, Any]]
    runs: Mapped[list[Any]]
    packed: Mapped[bool] = mapped_column(default=False)
    demands_certified: Mapped[bool] = mapped_column(default=False, server_default=sa.false())
    steps: Mapped[int] = mapped_column(default=0, server_default="0")
    queue_place: Mapped[int | None] = mapped_column(index=True)
    not_before: Mapped[datetime | None]
    request: Mapped[dict[str, Any] | None]
    then_state: Mapped[str | None] = mapped_column(sa.String(20), index=True)
    then: Mapped[dict[str, Any] | None]


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
    """A file of a session, immutable. `pack_index`: index of a frame in the packed session."""

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
    step: Mapped[int] = mapped_column(sa.ForeignKey("steps.id", ondelete="CASCADE"), index=True)
    file: Mapped[int] = mapped_column(sa.ForeignKey("files.id", ondelete="CASCADE"), index=True)
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


class CalibrationRow(Base):
    """A calibration: a session's fit, from candidate to superseded. `id`: of the fit's result. `rig`: its cameras, by
    side. `certified`: when; None for a candidate."""

    __tablename__ = "calibrations"

    id: Mapped[str] = mapped_column(sa.ForeignKey("results.id", ondelete="CASCADE"), primary_key=True)
    session_id: Mapped[str] = mapped_column(sa.String(40), index=True)
    created: Mapped[datetime] = mapped_column(index=True)
    rig: Mapped[str] = mapped_column(sa.Text, index=True)
    cameras: Mapped[dict[str, Any]]
    certified: Mapped[datetime | None]
    certified_by: Mapped[str | None] = mapped_column(sa.String(100))
    limits: Mapped[dict[str, Any] | None]
    judgements: Mapped[list[Any] | None]
    expires: Mapped[datetime | None]
    superseded: Mapped[datetime | None]
    superseded_by: Mapped[str | None] = mapped_column(sa.String(40))
    revoked: Mapped[datetime | None]
    revoked_by: Mapped[str | None] = mapped_column(sa.String(100))
    revoked_why: Mapped[str | None] = mapped_column(sa.Text)


class FigureRow(Base):
    """A figure of a calibration, in a table of its own so that a history reads no documents. `camera`: its name, or the
    rig for a figure of the pair. `temperature_c`, `doubling_c`: of a dark current, the sensor's temperature and by how
    much a rise doubles it."""

    __tablename__ = "figures"
    __table_args__ = (
        sa.Index("ix_figures_history", "camera", "name", "place"),
        sa.Index("ix_figures_once", "calibration_id", "camera", "side", "name", "place", unique=True),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    calibration_id: Mapped[str] = mapped_column(sa.ForeignKey("calibrations.id", ondelete="CASCADE"), index=True)
    camera: Mapped[str] = mapped_column(sa.Text)
    side: Mapped[str | None] = mapped_column(sa.String(10))
    name: Mapped[str] = mapped_column(sa.String(200))
    place: Mapped[str] = mapped_column(sa.String(60))
    value: Mapped[float]
    std: Mapped[float]
    temperature_c: Mapped[float | None]
    doubling_c: Mapped[float | None]
    doubling_c_std: Mapped[float | None]


class KeyRow(Base):
    """The hash of an API key (see `api.security`)."""

    __tablename__ = "api_keys"

    name: Mapped[str] = mapped_column(sa.String(100), primary_key=True)
    scope: Mapped[str] = mapped_column(sa.String(20))
    sha256: Mapped[str] = mapped_column(sa.String(64), unique=True)
    created: Mapped[datetime]


class HaltTokenRow(Base):
    """The hash of a token with which the operator's page halts, and of the key that it was made for (see
    `api.security`)."""

    __tablename__ = "halt_tokens"

    sha256: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    key_sha256: Mapped[str] = mapped_column(sa.ForeignKey("api_keys.sha256", ondelete="CASCADE"))
    expires: Mapped[datetime]


class IdempotentRow(Base):
    """A request with an idempotency key (see `api.idempotency`). `status` None: it isn't answered yet."""

    __tablename__ = "idempotent_requests"

    id: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(sa.String(64))
    created: Mapped[datetime] = mapped_column(index=True)
    status: Mapped[int | None]
    location: Mapped[str | None] = mapped_column(sa.Text)
    body: Mapped[str | None] = mapped_column(sa.Text)


#: Registries that this process uses alone.
_alone: set[Path] = set()


def use_alone(registry: Path) -> None:
    """Have this process use a registry alone, from its next opening on: SQLite needs no room on the disk then to open
    it. Other processes find it locked until this one ends."""
    _alone.add(registry.resolve())


def open_engine(url: str) -> sa.Engine:
    """Return the database at a URL, PostgreSQL through psycopg. Raises InputError where it can't be opened."""
    try:
        address = sa.make_url(url)
        if address.drivername in ("postgres", "postgresql"):
            address = address.set(drivername="postgresql+psycopg")
        if address.get_backend_name() == "sqlite" and address.database and Path(address.database) in _alone:
            address = address.set(database=f"file:{quote(address.database)}", query={"vfs": "unix-excl", "uri": "true"})
        # A connection that the server has closed, as after its restart, is replaced before it is used.
        engine = sa.create_engine(address, pool_pre_ping=address.get_backend_name() != "sqlite")
    except sa.exc.ArgumentError as error:
        raise InputError("CALIBENCH_DATABASE_URL: isn't a database's URL; give postgresql://USER@HOST/NAME") from error
    except ImportError as error:
        raise InputError(
            f"registry {address!r}: its driver isn't installed ({error}); install calibench with its extra postgresql"
        ) from error
    except sa.exc.NoSuchModuleError as error:
        raise InputError(f"registry {address!r} can't be opened ({error}); correct CALIBENCH_DATABASE_URL") from error
    if engine.dialect.name != "sqlite" or address.database is None:
        return engine
    registry = Path(unquote(address.database.removeprefix("file:")))

    @sa.event.listens_for(engine, "connect")
    def _pragmas(connection: Any, record: Any) -> None:
        connection.isolation_level = None  # `_begin` sends BEGIN
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=30000"):
            connection.execute(f"PRAGMA {pragma}").close()

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        # A transaction that reads first and then writes fails, and doesn't wait, if another process wrote in between.
        writes = connection.get_execution_options().get("writes")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    @sa.event.listens_for(engine, "handle_error")
    def _explain(context: sa.ExceptionContext) -> None:
        # Of a full disk, a read-only one and another user's folder, SQLite says no more than these.
        words = str(context.original_exception)
        if not any(
            phrase in words for phrase in ("disk is full", "disk I/O error", "unable to open", "readonly database")
        ):
            return
        why = why_registry_unwritable(registry)
        if "full" in words or "I/O" in words:
            room = Room(registry.parent)
            why = why or room.lack()
            room.give_up()  # for what comes next: that a run has ended, that a session is deleted
        if why is not None:
            raise why from context.original_exception

    return engine


#: Where a generation of a backup is staged in a data folder, and the mark that its entries are being put in place
#: (see `lab.capture.restore`).
STAGED = Path(".restore")
SWAPPING = STAGED / "complete"
