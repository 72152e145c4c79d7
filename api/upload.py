"""Recording sets that are sent in: streamed to the disk and unpacked, both with upper limits, into a folder of their own.

Nothing that an archive states is trusted. Its list of files is read under a cap. Every name, kind, compression and stated size, the
sum of all sizes and the room on the disk are checked before the first byte is written; sizes are counted again while they are
written. Names that lead out of the folder, links and devices are refused. The reader of recording sets then checks the content.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import secrets
import shutil
import stat
import time
import zipfile
import zlib
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.importers.import_options import ImportOptions
from lab.formats.recording_set import FolderFiles, RecordingSet

_CHUNK = 1 << 20
_ID = re.compile(r"[0-9a-f]{16}")
_MANIFEST = "manifest.json"
#: Bytes of an archive's list of files, per file that is allowed: a name of 200 and what `zip` writes beside it.
_LISTED_BYTES = 400
#: Bytes of the disk that uploads leave free: captures come first.
RESERVE_BYTES = 1 << 30
#: A folder of an upload that a crash left behind is removed when it is older than this (s).
_STALE_S = 86400.0


class TooMuch(InputError):
    """More than the upper limit."""


class NoRoom(Exception):
    """The data folder's disk hasn't the room."""


def check_room(folder: Path, wanted_bytes: int) -> None:
    """Raises NoRoom where `wanted_bytes` more would leave less than the reserve on the disk of `folder`."""
    free = shutil.disk_usage(folder).free
    if free - wanted_bytes < RESERVE_BYTES:
        raise NoRoom(
            f"the data folder has {free} bytes free, {wanted_bytes} are needed and {RESERVE_BYTES} are kept for captures; make room"
        )


def check_size(size_bytes: int, limit_bytes: int) -> None:
    """Raises TooMuch for an archive, stated or received, beyond the limit."""
    if size_bytes > limit_bytes:
        raise TooMuch(f"the archive is larger than {limit_bytes} bytes; send fewer captures, or use the command line")


async def receive(body: AsyncIterator[bytes], file: BinaryIO, limit_bytes: int) -> int:
    """Write a body to `file` while it arrives; returns its size. Raises TooMuch beyond `limit_bytes`."""
    taken = 0
    async for chunk in body:
        taken += len(chunk)
        check_size(taken, limit_bytes)
        file.write(chunk)
    return taken


def _inside(name: str) -> PurePosixPath:
    """A member's name as a path in the folder. Raises InputError for a path that leads out of it."""
    path = PurePosixPath(name)
    parts = path.parts
    if (
        not parts
        or path.is_absolute()
        or ".." in parts
        or "\\" in name
        or any(":" in part or any(ord(letter) < 32 for letter in part) or len(part.encode()) > 200 for part in parts)
        or len(parts) > 10
    ):
        raise InputError(f"archive: {name[:80]!r} isn't a path inside it; pack the recording set's folder itself")
    return path


def _plain_file(member: zipfile.ZipInfo) -> None:
    """Raises InputError for a link or a device, and for a compression that could take any amount of memory to undo."""
    if stat.S_IFMT(member.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise InputError(f"archive: {member.filename[:80]!r} is a link or a device; pack plain files only")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError(f"archive: {member.filename[:80]!r} is neither stored nor deflated; pack it so")


class _ListedArchive(io.FileIO):
    """An archive whose list of files is read at once only up to `limit_bytes`: `zipfile` reads as much as the archive states."""

    def __init__(self, file: Path, limit_bytes: int) -> None:
        super().__init__(file)
        self._limit_bytes = limit_bytes

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes. Raises TooMuch where more are asked for than the limit."""
        if size is None or size < 0:
            at = self.tell()
            size = self.seek(0, io.SEEK_END) - at
            self.seek(at)
        if size > self._limit_bytes:
            raise TooMuch("archive: its list of files is too long; pack fewer captures")
        return super().read(size) or b""


def _checked(
    packed: zipfile.ZipFile, room: Path, limit_bytes: int, limit_files: int
) -> list[tuple[zipfile.ZipInfo, PurePosixPath]]:
    """The archive's members and their paths, all checked by what the archive states of them."""
    members = packed.infolist()
    if len(members) > limit_files:
        raise TooMuch(f"archive: {len(members)} files, {limit_files} at most; pack fewer captures")
    checked = [(member, _inside(member.filename)) for member in members]
    for member in members:
        _plain_file(member)
    stated = sum(member.file_size for member in members)
    if stated > limit_bytes:
        raise TooMuch(f"archive: {stated} bytes unpacked, {limit_bytes} at most; pack fewer captures")
    check_room(room, stated)
    return checked


def _write_members(packed: zipfile.ZipFile, folder: Path, limit_bytes: int, limit_files: int) -> None:
    members = _checked(packed, folder.parent, limit_bytes, limit_files)
    folder.mkdir(parents=True)
    left = limit_bytes
    for member, inside in members:
        path = folder / inside
        if member.is_dir():
            path.mkdir(parents=True, exist_ok=True)
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        with packed.open(member) as source, path.open("xb") as made:
            while chunk := source.read(_CHUNK):
                left -= len(chunk)
                if left < 0:
                    raise TooMuch(f"archive: more than {limit_bytes} bytes unpacked; pack fewer captures")
                made.write(chunk)


#: What `zipfile` raises for a damaged archive.
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    RuntimeError,  # a password, NotImplementedError for an unknown compression
    EOFError,
    ValueError,
    FileExistsError,
    NotADirectoryError,
    IsADirectoryError,
)


def unpack(archive: Path, folder: Path, limit_bytes: int, limit_files: int) -> None:
    """Unpack a .zip into `folder`, which must not exist. Raises InputError, and TooMuch beyond a limit."""
    try:
        listed_bytes = max(_CHUNK, limit_files * _LISTED_BYTES)
        with _ListedArchive(archive, listed_bytes) as file, zipfile.ZipFile(file) as packed:
            _write_members(packed, folder, limit_bytes, limit_files)
    except _BROKEN as error:
        said = " ".join(str(error).replace(str(folder), "").split())[:120]
        raise InputError(
            f"archive: can't be unpacked ({said}); send a .zip with each file once, deflated, without a password"
        ) from error


@dataclass(frozen=True)
class Foreign:
    """What an archive holds that isn't a recording set: the format, which file or folder of it, and what the format doesn't say.

    The files that `statements` name (`camera`, `light`, `white_patch`) are in the archive.
    """

    format: str
    path: str
    statements: ImportOptions

    def read(self, folder: Path) -> RecordingSet:
        """The recordings below `folder`. Raises InputError."""
        from lab.formats.importers import KINDS, read_foreign

        of_a_file = self.format in KINDS and KINDS[self.format].of_a_file
        if of_a_file and not self.path:
            raise InputError(f"path: a recording of the format {self.format} is one file; name it as in the archive")
        stated = self.statements
        there = replace(
            stated,
            camera=stated.camera and self._located(folder, "camera", str(stated.camera)),
            light=stated.light and self._located(folder, "light", str(stated.light)),
            white_patch=stated.white_patch and self._located(folder, "white_patch", str(stated.white_patch)),
        )
        at = self._located(folder, "path", self.path, a_file=of_a_file) if self.path else folder
        return read_foreign(self.format, at, there)

    @staticmethod
    def _located(folder: Path, name: str, path: str, a_file: bool = True) -> Path:
        """A file or folder of the archive. Raises InputError where it isn't in it."""
        found = folder / _inside(path)
        if not (found.is_file() or (found.is_dir() and not a_file)):
            raise InputError(f"{name} {path[:80]!r}: isn't in the archive; name it as in the archive")
        return found


@dataclass(frozen=True)
class Inbox:
    """The recording sets that were sent in: `DATA/recordings/ID/`."""

    root: Path

    def ids(self) -> list[str]:
        """Ids of all, the newest first."""
        entries = [entry for entry in self.root.glob("*") if _ID.fullmatch(entry.name) and entry.is_dir()]
        return [entry.name for entry in sorted(entries, key=lambda one: (-one.stat().st_mtime_ns, one.name))]

    def folder(self, id: str) -> Path:
        """The recording set's folder. Raises InputError where there is none of that id."""
        if not _ID.fullmatch(id) or not (self.root / id).is_dir():
            raise InputError(f"no recordings {id[:60]!r}; list those that were sent in")
        return _top(self.root / id)

    def id_of(self, folder: str) -> str | None:
        """The id of the recordings whose folder this is, or None."""
        with contextlib.suppress(ValueError):
            return Path(folder).relative_to(self.root).parts[0]
        return None

    @contextlib.contextmanager
    def receiving(self) -> Iterator[Path]:
        """A temporary folder for an archive while it arrives."""
        self.root.mkdir(parents=True, exist_ok=True)
        for left in self.root.glob(".*-*"):  # what a crash left
            if left.lstat().st_mtime < time.time() - _STALE_S:
                shutil.rmtree(left, ignore_errors=True)
        place = self.root / f".incoming-{secrets.token_hex(8)}"
        place.mkdir(mode=0o700)
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def take_in(
        self, place: Path, archive: Path, limit_bytes: int, limit_files: int, foreign: Foreign | None = None
    ) -> tuple[str, RecordingSet]:
        """Unpack a recording set, or what `foreign` says, check it completely, and keep it as a recording set. Raises InputError with all
        problems; nothing is kept then."""
        unpacked = place / "set"
        sent = unpacked if foreign is None else place / "sent"
        unpack(archive, sent, limit_bytes, limit_files)
        try:
            if foreign is None:
                recordings = recording.read(_top(sent))
            else:
                recordings = foreign.read(_top(sent, None))
                recording.write(recordings, unpacked)
        except InputError as error:
            raise InputError(as_in_archive(str(error), place)) from None
        id = secrets.token_hex(8)
        unpacked.rename(self.root / id)
        os.utime(self.root / id)  # by which they are listed
        return id, recordings

    def remove(self, id: str) -> None:
        """Take recordings away. Raises InputError where there are none of that id."""
        self.folder(id)
        away = self.root / f".removed-{id}"
        (self.root / id).rename(away)  # gone at once
        shutil.rmtree(away)

    def manifest(self, id: str) -> dict[str, Any]:
        """The manifest of kept recordings as it is written: it was checked when they were sent in."""
        found: dict[str, Any] = json.loads((self.folder(id) / _MANIFEST).read_text(encoding="utf-8-sig"))
        return found

    def recordings(self, id: str) -> RecordingSet:
        """Kept recordings, whose frames are checked when they are read."""
        folder = self.folder(id)
        manifest, _ = recording.parse_manifest((folder / _MANIFEST).read_text(encoding="utf-8-sig"), _MANIFEST)
        return RecordingSet(manifest, source=id, files=FolderFiles(folder))


def _top(folder: Path, holds: str | None = _MANIFEST) -> Path:
    """The folder that holds the file `holds`: `folder`, or the only folder in it. None: the only folder where no file is beside it."""
    entries = [entry for entry in folder.iterdir() if entry.name != "__MACOSX"]
    inner = [entry for entry in entries if entry.is_dir()]
    here = (folder / holds).exists() if holds is not None else len(entries) > 1
    return inner[0] if not here and len(inner) == 1 else folder


def as_in_archive(text: str, place: Path) -> str:
    """A message with the archive's files named as in the archive."""
    for part in ("set", "sent"):
        for top in place.glob(f"{part}/*"):
            if top.is_dir() and len(list((place / part).iterdir())) == 1:
                text = text.replace(f"{top}/", "").replace(str(top), "the archive")
        text = text.replace(f"{place / part}/", "").replace(str(place / part), "the archive")
    return text
