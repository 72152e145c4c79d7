"""Archives that are sent in, unpacked under caps: .zip, .tar and .tar.gz.

Nothing that an archive states is trusted. All its names, kinds and stated sizes, their sum and the room on the disk are
checked before the first byte is written; sizes are counted again while they are written. Names that lead out of the
folder, links and devices are refused."""

from __future__ import annotations

import contextlib
import gzip
import io
import re
import shutil
import stat
import tarfile
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

from lab.errors import InputError, NoRoom

CHUNK = 1 << 20
#: Bytes of an archive's list of files, per file that is allowed: a name of 200 and what `zip` or `tar` writes beside
#: it.
_LISTED_BYTES = 400
#: Bytes of the disk that uploads leave free: captures come first.
RESERVE_BYTES = 1 << 30
#: Most bytes that a byte of an archive may stand for, beyond what unpacks within a second anyway: frames, even dark
#: ones, pack less.
MOST_RATIO, FREE_BYTES = 100, 64 << 20
_GZIP = b"\x1f\x8b"
_ZIP = (b"PK\x03\x04", b"PK\x05\x06")


class TooMuch(InputError):
    """More than the upper limit."""


def check_room(folder: Path, wanted_bytes: int) -> None:
    """Raises NoRoom where `wanted_bytes` more would leave less than the reserve on the disk of `folder`."""
    free = shutil.disk_usage(folder).free
    if free - wanted_bytes < RESERVE_BYTES:
        raise NoRoom(
            f"the data folder has {free} bytes free, {wanted_bytes} are needed and {RESERVE_BYTES} are kept for "
            "captures; make room"
        )


def inside(name: str) -> PurePosixPath:
    """Return a member's name as a path in the folder. Raises InputError for a path that leads out of it."""
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
        raise InputError(
            f"archive: {name[:80]!r} isn't a path inside it; pack the files, or their folder, by themselves"
        )
    return path


def _no_plain_file(name: str) -> InputError:
    return InputError(f"archive: {name[:80]!r} is a link or a device; pack plain files only")


@dataclass(frozen=True)
class _Member:
    """A file or a folder of an archive, as the archive states it."""

    name: str
    size_bytes: int
    is_folder: bool
    entry: Any


class _Archive(ABC):
    """An archive that is open. `members` raises InputError for what may not be in it."""

    @abstractmethod
    def members(self) -> Iterator[_Member]:
        """Yield what it states to hold."""

    @abstractmethod
    def open(self, member: _Member) -> IO[bytes]:
        """Return a file's content."""


class _Zip(_Archive):
    def __init__(self, packed: zipfile.ZipFile) -> None:
        self._packed = packed

    def members(self) -> Iterator[_Member]:
        for one in self._packed.infolist():
            if stat.S_IFMT(one.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise _no_plain_file(one.filename)
            # Another compression could take any amount of memory to undo.
            if one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(f"archive: {one.filename[:80]!r} is neither stored nor deflated; pack it so")
            yield _Member(one.filename, one.file_size, one.is_dir(), one)

    def open(self, member: _Member) -> IO[bytes]:
        return self._packed.open(member.entry)


class _Tar(_Archive):
    """A tar has no list: its headers are read one by one, before anything is written."""

    def __init__(self, packed: tarfile.TarFile) -> None:
        self._packed = packed

    def members(self) -> Iterator[_Member]:
        while (one := self._packed.next()) is not None:
            # A negative size would lead back to this header for ever. A sparse file states what it doesn't hold.
            if one.size < 0 or one.issparse() or not (one.isreg() or one.isdir()):
                raise _no_plain_file(one.name)
            if one.isdir() and one.name in ("", ".", "./"):
                continue
            yield _Member(one.name, one.size, one.isdir(), one)

    def open(self, member: _Member) -> IO[bytes]:
        found = self._packed.extractfile(member.entry)
        assert found is not None  # a plain file, as `members` found
        return found


class _Bounded(io.RawIOBase):
    """A file of which at most `at_once` bytes are read at a time, and whose end lies below `limit_bytes`: the readers
    of archives read as much as an archive states, and a compressed one has no end that is known."""

    def __init__(self, file: IO[bytes], at_once: int, limit_bytes: int) -> None:
        self._file, self._at_once, self._limit_bytes = file, at_once, limit_bytes

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence == io.SEEK_SET and offset > self._limit_bytes:
            raise TooMuch(f"archive: more than {self._limit_bytes} bytes unpacked; pack less")
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes. Raises TooMuch where more are asked for than the limit."""
        if size is None or size < 0:
            at = self.tell()
            size = self.seek(0, io.SEEK_END) - at
            self.seek(at)
        if size > self._at_once:
            raise TooMuch("archive: its list of files is too long; pack less")
        return self._file.read(size) or b""


#: What the readers of archives raise for a damaged one.
_BROKEN = (
    zipfile.BadZipFile,
    tarfile.TarError,
    gzip.BadGzipFile,
    zlib.error,
    RuntimeError,  # a password, NotImplementedError for an unknown compression
    EOFError,
    ValueError,
    FileExistsError,
    NotADirectoryError,
    IsADirectoryError,
)


@contextlib.contextmanager
def _opened(archive: Path, limit_bytes: int, limit_files: int) -> Iterator[_Archive]:
    """The archive, by its first bytes."""
    listed_bytes = max(CHUNK, limit_files * _LISTED_BYTES)
    with archive.open("rb") as file:
        begin = file.read(4)
        file.seek(0)
        if begin in _ZIP:
            with zipfile.ZipFile(_Bounded(file, listed_bytes, archive.stat().st_size)) as zipped:
                yield _Zip(zipped)
            return
        # Headers, and what fills the last block of each file.
        most = min(limit_bytes, most_bytes(archive)) + 4 * 512 * (limit_files + 20)
        with contextlib.ExitStack() as stack:
            content: IO[bytes] = file
            if begin[:2] == _GZIP:
                # A step back beyond the buffer would unpack all of it from the beginning again.
                content = io.BufferedReader(stack.enter_context(gzip.GzipFile(fileobj=file)), CHUNK)
            yield _Tar(stack.enter_context(tarfile.open(fileobj=_Bounded(content, CHUNK, most), mode="r:")))


def unpack(archive: Path, folder: Path, limit_bytes: int, limit_files: int) -> None:
    """Unpack a .zip, .tar or .tar.gz into `folder`, which must not exist. Raises InputError, and TooMuch beyond a
    limit."""
    try:
        with _opened(archive, limit_bytes, limit_files) as opened:
            members = _checked(opened, folder.parent, limit_bytes, limit_files)
            check_ratio(archive, sum(member.size_bytes for member, _ in members))
            _write(opened, members, folder, limit_bytes)
    except _BROKEN as error:
        said = _said(error, folder)
        raise InputError(
            f"archive: can't be unpacked ({said}); send a .zip, .tar or .tar.gz with each file once, without a password"
        ) from error


def most_bytes(archive: Path) -> int:
    """Bytes that an archive of this size may hold."""
    return MOST_RATIO * archive.stat().st_size + FREE_BYTES


def check_ratio(archive: Path, stated_bytes: int) -> None:
    """Raise TooMuch where an archive states to hold far more than recordings can be packed into it."""
    if stated_bytes > (most := most_bytes(archive)):
        raise TooMuch(
            f"archive: {stated_bytes} bytes unpacked from {archive.stat().st_size} packed ones, {most} at most; "
            "pack the recordings without compression"
        )


def _said(error: Exception, folder: Path) -> str:
    """Return what is wrong with an archive, in one line without the words of Python's readers."""
    if isinstance(error, FileExistsError | NotADirectoryError | IsADirectoryError):
        name = Path(str(error.filename)).relative_to(folder) if error.filename else ""
        return f"{name} is there twice, or as a file and as a folder"[-120:]
    text = re.sub(r"<ZipInfo filename='(.*?)'.*?>", r"'\1'", str(error))
    return " ".join(text.replace(str(folder), "").split())[:120]


def _checked(opened: _Archive, room: Path, limit_bytes: int, limit_files: int) -> list[tuple[_Member, PurePosixPath]]:
    """Return the archive's members and their paths, all checked by what the archive states of them."""
    checked: list[tuple[_Member, PurePosixPath]] = []
    for member in opened.members():
        if len(checked) == limit_files:
            raise TooMuch(f"archive: more files than it may hold, {limit_files} at most; pack less")
        checked.append((member, inside(member.name)))
    stated = sum(member.size_bytes for member, _ in checked)
    if stated > limit_bytes:
        raise TooMuch(f"archive: {stated} bytes unpacked, {limit_bytes} at most; pack less")
    check_room(room, stated)
    return checked


def _write(opened: _Archive, members: list[tuple[_Member, PurePosixPath]], folder: Path, limit_bytes: int) -> None:
    folder.mkdir(parents=True)
    left = limit_bytes
    for member, place in members:
        path = folder / place
        if member.is_folder:
            path.mkdir(parents=True, exist_ok=True)
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        with opened.open(member) as source, path.open("xb") as made:
            while chunk := source.read(CHUNK):
                left -= len(chunk)
                if left < 0:
                    raise TooMuch(f"archive: more than {limit_bytes} bytes unpacked; pack less")
                made.write(chunk)
