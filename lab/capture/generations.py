"""A backup as a folder of generations: each is a data folder of its own, with a record of the SHA-256 of every file.

    BACKUP/.backup-of                 the data folder whose backup it is
           latest                     a link to the newest generation
           20300101-023000-000000/    a generation: registry.sqlite, sessions/, stations/, ...
               .generation.json       its record: versions, and SHA-256 and size of every file

A file that is the same in two generations is one file of the disk (a hard link), so that a generation costs what
changed. A generation gets its name when all of it is written and flushed to the disk: what a crash leaves behind begins
with a point.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pwd
import shutil
import sqlite3
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from lab.capture.file_lock import Lock
from lab.errors import InputError
from sim.parameters import Frozen

REGISTRY = "registry.sqlite"
MARK, RECORD, LATEST = ".backup-of", ".generation.json", "latest"
#: Generations that are kept unless another number is asked for: a week of nights.
KEPT = 7
_CHUNK_BYTES = 1 << 20


class FileSum(Frozen):
    """SHA-256 and size of a file."""

    sha256: str
    bytes: int


class GenerationRecord(Frozen):
    """What a generation holds. `calibench`: the version that wrote it, "" where it isn't known; `revision`: of the
    registry's tables; `sessions`: how many the registry has. `files`: by path relative to the generation."""

    format: Literal["calibench-backup"] = "calibench-backup"
    version: Literal[1] = 1
    data_folder: str
    made: datetime
    calibench: str
    revision: str
    sessions: int
    files: dict[str, FileSum]


@dataclass(frozen=True)
class Generation:
    """A complete generation of a backup."""

    folder: Path

    @property
    def name(self) -> str:
        """Its time, UTC, as the name of its folder."""
        return self.folder.name

    @cached_property
    def record(self) -> GenerationRecord:
        """Read its record. Raises InputError where that is damaged."""
        file = self.folder / RECORD
        try:
            return GenerationRecord.model_validate_json(file.read_bytes())
        except (OSError, ValidationError) as error:
            why = error.strerror if isinstance(error, OSError) else "damaged, or of another version of calibench"
            raise InputError(f"{file}: can't be read ({why}); take another generation of this backup") from error

    def sum_of(self, path: str) -> FileSum | None:
        """Return the recorded sum of a file; None where the generation doesn't hold it, or its record is damaged."""
        with contextlib.suppress(InputError):
            return self.record.files.get(path)
        return None

    def damage(self, path: str) -> str | None:
        """Read a file; return what is wrong with it, None where it has the recorded SHA-256."""
        recorded = self.record.files[path]
        try:
            actual = sha256_of(self.folder / path)
        except OSError as error:
            return f"can't be read ({error.strerror})"
        if actual == recorded.sha256 or (path == REGISTRY and is_intact_registry(self.folder / path)):
            return None
        return f"damaged: its SHA-256 is {actual[:12]}, recorded is {recorded.sha256[:12]}"


def generations_of(backup: Path) -> list[Generation]:
    """Return the generations of a backup, the newest first.

    backup : its folder

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     generations_of(Path(folder))
    []
    """
    folders = [record_file.parent for record_file in backup.glob(f"[0-9]*/{RECORD}")]
    return [Generation(folder) for folder in sorted(folders, key=lambda folder: folder.name, reverse=True)]


def lock_of(backup: Path) -> Lock:
    """Return the lock of the process that writes into a backup."""
    return Lock(backup / ".lock")


def sha256_of(file: Path) -> str:
    """Return a file's SHA-256, in hexadecimal digits.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "empty"
    ...     file.touch()
    ...     sha256_of(file)[:8]
    'e3b0c442'
    """
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def copy_hashed(source: Path, made: Path) -> FileSum:
    """Copy a file with its time and its permissions, flushed to the disk.

    source : no link is followed
    made : where the copy is made

    Returns the sum of what was copied. Its time is that of before the reading, so that a file which was written
    meanwhile counts as changed.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     (Path(folder) / "dark-1.npy").touch()
    ...     _ = copy_hashed(Path(folder) / "dark-1.npy", Path(folder) / "copy")
    ...     (Path(folder) / "copy").is_file()
    True
    """
    made.parent.mkdir(parents=True, exist_ok=True)
    digest, size = hashlib.sha256(), 0
    with os.fdopen(os.open(source, os.O_RDONLY | os.O_NOFOLLOW), "rb") as read:
        there = os.fstat(read.fileno())
        try:
            with made.open("wb") as written:
                while chunk := read.read(_CHUNK_BYTES):
                    digest.update(chunk)
                    size += written.write(chunk)
                written.flush()
                os.fchmod(written.fileno(), there.st_mode & 0o777)
                os.fsync(written.fileno())
        except OSError as error:  # of a full disk, the system names no file
            made.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, error.filename or str(made)) from error
    os.utime(made, ns=(there.st_atime_ns, there.st_mtime_ns))
    return FileSum(sha256=digest.hexdigest(), bytes=size)


def link_or_copy(source: Path, made: Path) -> None:
    """Make a second name of a file; a copy on disks that have no hard links, or where the file has too many.

    source : the file
    made : its second name

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     (Path(folder) / "dark-1.npy").touch()
    ...     link_or_copy(Path(folder) / "dark-1.npy", Path(folder) / "second")
    ...     (Path(folder) / "second").is_file()
    True
    """
    made.parent.mkdir(parents=True, exist_ok=True)
    made.unlink(missing_ok=True)
    try:
        os.link(source, made, follow_symlinks=False)
    except OSError:
        copy_hashed(source, made)


def sync_folders(folder: Path) -> None:
    """Flush the entries of a folder and of all folders in it to the disk."""
    for path, _, _ in os.walk(folder):
        sync_folder(Path(path))


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def can_be_parsed(file: Path, name: Path) -> bool:
    """Return whether a file with a name of .toml or .json is one; true for other files.

    file : whose content is read
    name : that it has in the data folder

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "copy"
    ...     _ = file.write_text("valid_days = ")
    ...     can_be_parsed(file, Path("limits.toml"))
    False
    """
    parse = {".toml": tomllib.loads, ".json": json.loads}.get(name.suffix)
    try:
        if parse is not None:
            parse(file.read_text(encoding="utf-8-sig"))
    except ValueError:
        return False
    return True


def is_intact_registry(file: Path) -> bool:
    """Return whether a registry whose bytes differ from the recorded ones is whole: a generation that was opened by a
    newer calibench has its tables brought to newer ones."""
    try:
        with contextlib.closing(sqlite3.connect(f"file:{file}?mode=ro&immutable=1", uri=True)) as opened:
            return [row[0] for row in opened.execute("PRAGMA integrity_check")] == ["ok"]
    except sqlite3.Error:
        return False


def remove_tree(folder: Path) -> None:
    """Remove a folder, under a name that begins with a point first, so that a half removed one is no generation.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     (Path(folder) / "20300101" / "frames").mkdir(parents=True)
    ...     remove_tree(Path(folder) / "20300101")
    ...     list(Path(folder).iterdir())
    []
    """
    away = folder if folder.name.startswith(".") else folder.with_name(f".removed-{folder.name}")
    if folder.exists():
        folder.rename(away)
    shutil.rmtree(away, ignore_errors=True)


@contextlib.contextmanager
def acting_as_owner(owned: Path, made: Path | None = None) -> Iterator[None]:
    """Let root act, within the block, as the user to whom the folder `owned` belongs, so that what is written belongs
    to that user, and a link of that user leads nowhere that the user may not go. Other users, and root with folders of
    its own, act as themselves.

    `made`: a folder that root makes for that user before. Raises InputError where it belongs to another user.
    """
    if os.geteuid() != 0 or not owned.exists() or (owner := owned.stat()).st_uid == 0:
        yield
        return
    try:
        name = pwd.getpwuid(owner.st_uid).pw_name
    except KeyError:
        name = str(owner.st_uid)
    if made is not None:
        if not made.exists() and made.parent.is_dir():
            made.mkdir(mode=0o750)
            os.chown(made, owner.st_uid, owner.st_gid, follow_symlinks=False)
        elif made.exists() and made.stat().st_uid != owner.st_uid:
            raise InputError(
                f"{made}: belongs to another user than {owned}, which is {name}'s; chown --recursive {name} it, or "
                "name another folder"
            )
    groups = os.getgroups()
    os.setgroups([owner.st_gid])
    os.setegid(owner.st_gid)
    os.seteuid(owner.st_uid)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(0)
        os.setgroups(groups)
