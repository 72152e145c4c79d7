"""A registry copied at one moment into a SQLite file, and back into a database: SQLite's or a server's."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from lab.capture.migrate import upgrade
from lab.capture.tables import Base, open_engine
from lab.errors import InputError

#: Rows that are copied at a time.
_ROWS = 500


def copy_registry(url: str, made: Path) -> None:
    """Write the registry at a URL into a new SQLite file, as it is at one moment. Raises InputError where the registry
    is damaged."""
    made.unlink(missing_ok=True)
    address = sa.make_url(url)
    if address.get_backend_name() == "sqlite":
        _copy_sqlite(Path(str(address.database)), made)
        return
    source, target = open_engine(url), open_engine(f"sqlite:///{made}")
    try:
        upgrade(target, made.parent)
        # One moment: a later change of another process isn't read.
        with (
            source.execution_options(isolation_level="REPEATABLE READ").begin() as read,
            target.execution_options(writes=True).begin() as written,
        ):
            _replace_rows(read, written)
        with target.execution_options(isolation_level="AUTOCOMMIT").connect() as closing:
            closing.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
    finally:
        source.dispose()
        target.dispose()


def _copy_sqlite(registry: Path, made: Path) -> None:
    try:
        with contextlib.closing(sqlite3.connect(registry, timeout=30.0)) as source:
            source.execute("VACUUM INTO ?", (str(made),))
        with contextlib.closing(sqlite3.connect(made)) as copy:
            problems = [row[0] for row in copy.execute("PRAGMA quick_check")]
            copy.execute("PRAGMA journal_mode=WAL")  # as a data folder's is, so that opening it changes no byte
    except sqlite3.DatabaseError as error:
        if "full" in str(error) or "locked" in str(error):
            raise InputError(f"{registry}: can't be copied ({error}); make room, or try again later") from error
        raise InputError(
            f"{registry}: damaged ({error}); stop the service, and bring a generation back: calibench restore"
        ) from error
    if problems != ["ok"]:
        raise InputError(
            f"{registry}: damaged ({problems[0]}); stop the service, and bring a generation back: calibench restore"
        )


def load_registry(registry: Path, url: str) -> None:
    """Replace the rows of a database by those of a SQLite file, in one transaction. Brings both to the newest
    tables."""
    source, target = open_engine(f"sqlite:///{registry}"), open_engine(url)
    try:
        upgrade(source, registry.parent)
        upgrade(target, registry.parent)
        with source.begin() as read, target.begin() as written:
            _replace_rows(read, written)
            if written.dialect.name == "postgresql":
                _continue_numbers(written)
    finally:
        source.dispose()
        target.dispose()


def count_sessions(url: str) -> int:
    """Return how many sessions a database has; 0 where it has no tables.

    url : as SQLAlchemy writes it

    >>> count_sessions("sqlite://")
    0
    """
    engine = open_engine(url)
    try:
        with engine.connect() as connection:
            if not sa.inspect(connection).has_table("sessions"):
                return 0
            return int(connection.execute(sa.text("SELECT count(*) FROM sessions")).scalar_one())
    finally:
        engine.dispose()


def _replace_rows(read: sa.Connection, written: sa.Connection) -> None:
    tables = Base.metadata.sorted_tables
    for table in reversed(tables):
        written.execute(table.delete())
    for table in tables:
        for rows in read.execution_options(stream_results=True).execute(table.select()).mappings().partitions(_ROWS):
            for names, alike in _group_rows(table, _in_utc(rows)).items():
                written.execute(table.insert(), [{name: row[name] for name in names} for row in alike])


def _group_rows(table: sa.Table, rows: Iterator[dict[str, Any]]) -> dict[tuple[str, ...], list[dict[str, Any]]]:
    """Group rows by the columns that they state: a document that is NULL would become JSON's null."""
    documents = {column.name for column in table.columns if isinstance(column.type, sa.JSON)}
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        names = tuple(name for name, value in row.items() if value is not None or name not in documents)
        groups.setdefault(names, []).append(row)
    return groups


def _in_utc(rows: Any) -> Iterator[dict[str, Any]]:
    """Yield rows with their times in UTC: SQLite keeps no zone, and a server answers in its own."""
    for row in rows:
        yield {
            name: (value.astimezone(UTC) if value.tzinfo else value.replace(tzinfo=UTC))
            if isinstance(value, datetime)
            else value
            for name, value in row.items()
        }


def _continue_numbers(written: sa.Connection) -> None:
    """Let the next row's number follow those that were copied."""
    for table in Base.metadata.sorted_tables:
        if isinstance(table.c[0].type, sa.Integer) and table.c[0].primary_key:
            column = f"{table.c[0].name}"
            written.execute(
                sa.text(
                    f"SELECT setval(pg_get_serial_sequence('{table.name}', '{column}'), "
                    f"(SELECT coalesce(max({column}), 0) + 1 FROM {table.name}), false)"
                )
            )
