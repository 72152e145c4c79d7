"""Recording sets that are sent in: streamed to the disk and unpacked, both with upper limits, into a folder of their own.

Nothing that an archive states is trusted. Sizes are counted while they are written, not read from its headers. Names that lead
out of the folder, links and devices are refused. The reader of recording sets then checks the content.
"""

from __future__ import annotations

import contextlib
import lzma
import re
import secrets
import shutil
import stat
import zipfile
import zlib
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from lab.errors import InputError
from lab.formats import recording_set as recording
from lab.formats.recording_set import Manifest, RecordingSet

_CHUNK = 1 << 20
_ID = re.compile(r"[0-9a-f]{16}")
_MANIFEST = "manifest.json"


class TooMuch(InputError):
    """More than the upper limit."""


async def receive(body: AsyncIterator[bytes], file: BinaryIO, limit_bytes: int) -> int:
    """Write a body to `file` while it arrives; returns its size. Raises TooMuch beyond `limit_bytes`."""
    taken = 0
    async for chunk in body:
        taken += len(chunk)
        if taken > limit_bytes:
            raise TooMuch(
                f"the archive is larger than {limit_bytes} bytes; send fewer captures, or use the command line"
            )
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
    """Raises InputError for a link or a device."""
    if stat.S_IFMT(member.external_attr >> 16) not in (0, stat.S_IFREG):
        raise InputError(f"archive: {member.filename[:80]!r} is a link or a device; pack plain files only")


def _write_members(packed: zipfile.ZipFile, folder: Path, limit_bytes: int, limit_files: int) -> None:
    members = packed.infolist()
    if len(members) > limit_files:
        raise TooMuch(f"archive: {len(members)} files, {limit_files} at most; pack fewer captures")
    folder.mkdir(parents=True)
    left = limit_bytes
    for member in members:
        path = folder / _inside(member.filename)
        if member.is_dir():
            path.mkdir(parents=True, exist_ok=True)
            continue
        _plain_file(member)
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
    lzma.LZMAError,
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
        with zipfile.ZipFile(archive) as packed:
            _write_members(packed, folder, limit_bytes, limit_files)
    except _BROKEN as error:
        said = " ".join(str(error).replace(str(folder), "").split())[:120]
        raise InputError(
            f"archive: can't be unpacked ({said}); send a .zip with each file once, deflated, without a password"
        ) from error


@dataclass(frozen=True)
class Inbox:
    """The recording sets that were sent in: `DATA/recordings/ID/`."""

    root: Path

    def ids(self) -> list[str]:
        """Ids of all, in order."""
        return sorted(entry.name for entry in self.root.glob("*") if _ID.fullmatch(entry.name) and entry.is_dir())

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
        place = self.root / f".incoming-{secrets.token_hex(8)}"
        place.mkdir(mode=0o700)
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def take_in(self, place: Path, archive: Path, limit_bytes: int, limit_files: int) -> tuple[str, RecordingSet]:
        """Unpack a recording set, check it completely, and keep it. Raises InputError with all problems; nothing is kept then."""
        unpacked = place / "set"
        unpack(archive, unpacked, limit_bytes, limit_files)
        top = _top(unpacked)
        try:
            recordings = recording.read(top)
        except InputError as error:
            raise InputError(str(error).replace(f"{top}/", "").replace(str(top), "archive")) from None
        id = secrets.token_hex(8)
        unpacked.rename(self.root / id)
        return id, recordings

    def manifest(self, id: str) -> Manifest:
        """The manifest of kept recordings, which were checked when they were sent in."""
        file = self.folder(id) / _MANIFEST
        return recording.parse_manifest(file.read_text(encoding="utf-8-sig"), _MANIFEST)[0]


def _top(folder: Path) -> Path:
    """The folder that holds the manifest: `folder`, or the only folder in it."""
    inner = [entry for entry in folder.iterdir() if entry.is_dir() and entry.name != "__MACOSX"]
    return inner[0] if not (folder / _MANIFEST).exists() and len(inner) == 1 else folder
