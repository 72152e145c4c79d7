"""A backup of a data folder while it is in use: a folder that is itself a data folder.

Files of sessions never change once they are linked, so a backup copies only those that it hasn't yet. The registry is
copied at one moment, by SQLite itself, before the files. A session that is packed meanwhile moves its frames into one
file: the copy is then checked against the registry's copy, and both are taken again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lab.capture.session_files import PACK
from lab.capture.store import Store
from lab.errors import InputError

REGISTRY = "registry.sqlite"
#: Most attempts at copies of registry and files that agree.
TRIES = 5
_COMPARED_BYTES = 1 << 20


@dataclass(frozen=True)
class BackupCount:
    """Sessions and files that a backup holds; files and bytes that this call copied."""

    sessions: int
    files: int
    copied: int
    copied_bytes: int


def back_up(store: Store, folder: Path) -> BackupCount:
    """Bring the backup in `folder` up to date, or make it.

    Files that were deleted from the data folder stay in the backup, except frames that were packed. Raises InputError
    where the registry isn't SQLite, where `folder` lies in the data folder or holds anything but a backup of it, where
    files can't be written, and where files that the registry names are missing or damaged.
    """
    target = folder.resolve()
    if store.count_sessions() == 0 and any((store.root / "sessions").glob("*/*")):
        raise InputError(
            f"{store.root}: its registry names no session, and there are folders of sessions; where the registry is a "
            "database server's, set "
            "CALIBENCH_DATABASE_URL as the service has it, and dump it by its own means (pg_dump)"
        )
    if store.settings.database_url is not None:
        raise InputError(
            "backup: the registry is a database server's; dump it by its own means (pg_dump), then copy the data folder"
        )
    if target == store.root or target.is_relative_to(store.root) or store.root.is_relative_to(target):
        raise InputError(f"{folder}: is the data folder or lies in it; name a folder on another disk")
    try:
        target.mkdir(parents=True, exist_ok=True)
        _same_store(store.root, target)
        return _taken(store, target)
    except OSError as error:
        raise InputError(
            f"{error.filename or folder}: can't be copied ({error.strerror}); make room, or name another folder"
        ) from error


def _same_store(root: Path, target: Path) -> None:
    """Mark an empty folder as this data folder's backup. Raises InputError for a folder that holds anything else."""
    mark = target / ".backup-of"
    if not mark.exists():
        if any(target.iterdir()):
            raise InputError(f"{target}: isn't empty and no backup; name a folder of its own")
        mark.write_text(f"{root}\n")
    elif mark.read_text().strip() != str(root):
        raise InputError(f"{target}: is the backup of another data folder; name a folder of its own")


def _taken(store: Store, target: Path) -> BackupCount:
    partial = target / f".{REGISTRY}.partial"
    copied = copied_bytes = 0
    lacking: list[str] = []
    for _ in range(TRIES):
        partial.unlink(missing_ok=True)
        with contextlib.closing(sqlite3.connect(store.root / REGISTRY, timeout=30.0)) as source:
            source.execute("VACUUM INTO ?", (str(partial),))
        for file in _files(store.root):
            size = _copied(store.root / file, target / file)
            copied, copied_bytes = copied + (size is not None), copied_bytes + (size or 0)
        sessions, number, lacking = _checked(partial, target)
        if not lacking:
            with partial.open("rb") as written:
                os.fsync(written.fileno())
            partial.rename(target / REGISTRY)
            _drop_packed(store.root, target)
            return BackupCount(sessions, number, copied, copied_bytes)
    raise InputError(
        f"backup: {len(lacking)} files that the registry names are missing or damaged in the data folder, such as "
        f"{lacking[0]}; the backup "
        "of before is kept"
    )


def _files(root: Path) -> Iterator[Path]:
    """Files to copy, relative to `root`: without registry, unfinished files, locks and links."""
    for folder, folders, names in os.walk(root):
        folders[:] = [
            name for name in folders if not name.startswith(".") and (Path(folder) != root or name != "runners")
        ]
        for name in names:
            file = Path(folder) / name
            if not (
                name.startswith(".")
                or name.endswith((".lock", ".partial"))
                or file.is_symlink()
                or name.startswith(REGISTRY)
            ):
                yield file.relative_to(root)


def _copied(source: Path, made: Path) -> int | None:
    """Copy a file, unless the backup has one of the same size and time. Returns the bytes copied; None if nothing was,
    also where the file vanished meanwhile (deleted or packed)."""
    try:
        there = source.stat()
        if made.exists() and (made.stat().st_size, made.stat().st_mtime_ns) == (there.st_size, there.st_mtime_ns):
            return None
        made.parent.mkdir(parents=True, exist_ok=True)
        partial = made.with_name(f".{made.name}.partial")
        shutil.copy2(source, partial)
    except FileNotFoundError:
        return None
    partial.rename(made)
    return there.st_size


def _checked(registry: Path, target: Path) -> tuple[int, int, list[str]]:
    """Number of sessions and of linked files in a copied registry, and the files that the backup lacks.

    A file must exist with the registered size, one of at most `_COMPARED_BYTES` also with the registered SHA-256. Of
    packed frames only the pack must exist: their SHA-256 is checked whenever one is read.
    """
    asked = "SELECT session_id, path, sha256, bytes, pack_index FROM files"
    with contextlib.closing(sqlite3.connect(registry)) as copy:
        rows = copy.execute(asked).fetchall()
        (sessions,) = copy.execute("SELECT count(*) FROM sessions").fetchone()
    lacking = []
    for session_id, path, sha256, size, pack_index in rows:
        folder = target / "sessions" / session_id
        if pack_index is not None:
            if not (folder / PACK).exists():
                lacking.append(f"sessions/{session_id}/{PACK}")
            continue
        file = folder / path
        if (
            not file.exists()
            or file.stat().st_size != size
            or (size <= _COMPARED_BYTES and hashlib.sha256(file.read_bytes()).hexdigest() != sha256)
        ):
            lacking.append(f"sessions/{session_id}/{path}")
    return sessions, len(rows), list(dict.fromkeys(lacking))


def _drop_packed(root: Path, target: Path) -> None:
    """Remove from the backup the frames of sessions that are packed: they are in one file now."""
    for session in (target / "sessions").glob("*"):
        if (session / PACK).exists() and not (root / "sessions" / session.name / "frames").exists():
            shutil.rmtree(session / "frames", ignore_errors=True)
