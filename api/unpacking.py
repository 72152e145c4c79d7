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
from lab.plain_text import complaint_of, escaped

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
#: Compressions of a .zip that aren't read.
_METHODS = {9: "deflate64", zipfile.ZIP_BZIP2: "bzip2", zipfile.ZIP_LZMA: "lzma", 93: "zstd", 95: "xz", 98: "ppmd"}
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
    """Return a member's name as a path in the folder.

    Raises InputError for a path that leads out of it, and for a name that some system couldn't keep.

    >>> inside("frames/dark-1.npy")
    PurePosixPath('frames/dark-1.npy')
    """
    path = PurePosixPath(name)
    parts = path.parts
    causes = {
        "it has no name": not parts,
        "it is absolute": path.is_absolute() or any(":" in part for part in parts[:1]),
        "it leads out of the archive's folder": ".." in parts,
        "it has a backslash": "\\" in name,
        "it has a colon": any(":" in part for part in parts),
        "it has a control character": complaint_of(name) is not None,
        "a name of it is longer than 200 bytes": any(len(part.encode(errors="replace")) > 200 for part in parts),
        "it lies more than 10 folders deep": len(parts) > 10,
    }
    for cause, holds in causes.items():
        if holds:
            words = f"'{escaped(name)[:80]}' isn't a path inside it ({cause})"
            raise InputError(f"archive: {words}; pack the files, or their folder, by themselves")
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

    @property
    def separator(self) -> str:
        """What parts the names of folders."""
        return "/"

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
        separator = self.separator
        for entry in self._packed.infolist():
            if stat.S_IFMT(entry.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise _no_plain_file(entry.filename)
            # Another compression could take any amount of memory to undo.
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                method = _METHODS.get(entry.compress_type, f"method {entry.compress_type}")
                raise InputError(
                    f"archive: {entry.filename[:80]!r} is compressed by {method}, neither stored nor deflated; pack it "
                    "again with the ordinary compression of .zip (deflate)"
                )
            name = entry.filename.replace(separator, "/")
            yield _Member(name, entry.file_size, name.endswith("/"), entry)

    @property
    def separator(self) -> str:
        """What parts the names of folders: a backslash in an archive of Windows that has no slash at all, against the
        format."""
        names = [entry.filename for entry in self._packed.infolist()]
        windows = any("\\" in name for name in names) and not any("/" in name for name in names)
        return "\\" if windows else "/"

    def open(self, member: _Member) -> IO[bytes]:
        return self._packed.open(member.entry)


class _Tar(_Archive):
    """A tar has no list: its headers are read one by one, before anything is written."""

    def __init__(self, packed: tarfile.TarFile) -> None:
        self._packed = packed

    def members(self) -> Iterator[_Member]:
        while (entry := self._packed.next()) is not None:
            # A negative size would lead back to this header for ever. A sparse file states what it doesn't hold.
            if entry.size < 0 or entry.issparse() or not (entry.isreg() or entry.isdir()):
                raise _no_plain_file(entry.name)
            if entry.isdir() and entry.name in ("", ".", "./"):
                continue
            yield _Member(entry.name, entry.size, entry.isdir(), entry)

    def open(self, member: _Member) -> IO[bytes]:
        content = self._packed.extractfile(member.entry)
        assert content is not None  # a plain file, as `members` found
        return content


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
def _open(archive: Path, limit_bytes: int, limit_files: int) -> Iterator[_Archive]:
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


def unpack(archive: Path, folder: Path, limit_bytes: int, limit_files: int) -> tuple[str, ...]:
    """Unpack a .zip, .tar or .tar.gz into `folder`, which must not exist; returns remarks on what isn't taken as it is
    in the archive. Raises InputError, and TooMuch beyond a limit."""
    try:
        with _open(archive, limit_bytes, limit_files) as opened:
            members, remarks = _check_members(opened, folder.parent, limit_bytes, limit_files)
            check_ratio(archive, sum(member.size_bytes for member, _ in members))
            _write(opened, members, folder, limit_bytes)
            return remarks
    except _BROKEN as error:
        raise InputError(f"archive: {_why_broken(archive, error, folder)}") from error


def most_bytes(archive: Path) -> int:
    """Return the bytes that an archive of this size may hold."""
    return MOST_RATIO * archive.stat().st_size + FREE_BYTES


def check_ratio(archive: Path, stated_bytes: int) -> None:
    """Raise TooMuch where an archive states to hold far more than recordings can be packed into it."""
    if stated_bytes > (most := most_bytes(archive)):
        raise TooMuch(
            f"archive: {stated_bytes} bytes unpacked from {archive.stat().st_size} packed ones, {most} at most; "
            "pack the recordings without compression"
        )


#: First bytes of archives that aren't read, and their names.
_OTHERS = {
    b"7z\xbc\xaf": "a 7-Zip archive",
    b"Rar!": "a RAR archive",
    b"\xfd7zX": "compressed by xz",
    b"BZh": "compressed by bzip2",
    b"\x28\xb5\x2f\xfd": "compressed by zstd",
}


def _why_broken(archive: Path, error: Exception, folder: Path) -> str:
    """Return why an archive can't be unpacked, and the remedy, without the words of Python's readers."""
    with archive.open("rb") as file:
        begin = file.read(4)
    for first, name in _OTHERS.items():
        if begin.startswith(first):
            return f"it is {name}; send a .zip, .tar or .tar.gz"
    if isinstance(error, FileExistsError | NotADirectoryError | IsADirectoryError):
        place = Path(str(error.filename)).relative_to(folder) if error.filename else ""
        text = f"{place} is there twice, or as a file and as a folder"[-120:]
        return f"can't be unpacked ({text}); pack each file once"
    plain = re.sub(r"<ZipInfo filename='(.*?)'.*?>", r"'\1'", str(error))
    text = " ".join(plain.replace(str(folder), "").split())[:120]
    if begin[:2] == b"PK" and text == "File is not a zip file":
        return "it is cut off: the list of files at the end of the .zip is missing; copy it anew and send it again"
    if isinstance(error, EOFError) or "unexpected end of data" in text:
        return "it is cut off before its end; copy it anew and send it again"
    return f"can't be unpacked ({text}); send a .zip, .tar or .tar.gz with each file once, without a password"


def _is_of_the_system(path: PurePosixPath) -> bool:
    """Return whether a file is one that macOS or Windows adds: resource forks, views of folders."""
    return "__MACOSX" in path.parts or path.name.startswith("._") or path.name in _OF_SYSTEMS


_OF_SYSTEMS = frozenset((".DS_Store", "Thumbs.db", "desktop.ini"))


def _check_members(
    opened: _Archive, room: Path, limit_bytes: int, limit_files: int
) -> tuple[list[tuple[_Member, PurePosixPath]], tuple[str, ...]]:
    """Return the archive's members and their paths, all checked by what the archive states of them, and remarks."""
    checked: list[tuple[_Member, PurePosixPath]] = []
    added: list[PurePosixPath] = []
    for member in opened.members():
        path = inside(member.name)
        if _is_of_the_system(path):
            added.append(path)
        else:
            checked.append((member, path))
        if max(len(checked), len(added)) > limit_files:
            raise TooMuch(f"archive: more files than it may hold, {limit_files} at most; pack less")
    stated = sum(member.size_bytes for member, _ in checked)
    if stated > limit_bytes:
        raise TooMuch(f"archive: {stated} bytes unpacked, {limit_bytes} at most; pack less")
    check_room(room, stated)
    remarks = []
    if opened.separator != "/":
        remarks.append("archive: its names have backslashes, which are taken as separators of folders")
    if added:
        remarks.append(f"archive: {len(added)} files that an operating system added are left out, such as {added[0]}")
    return checked, tuple(remarks)


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
