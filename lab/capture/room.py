"""Room on the disk of the data folder, and why the folder can't be written.

A reserve lies in the data folder, `.reserve`, which is given up when the disk is full. With it the registry can still
be opened, a run's end be recorded and a session be deleted. Captures and new sessions need more than the reserve, so
they don't use it up.
"""

from __future__ import annotations

import contextlib
import os
import pwd
from pathlib import Path

from lab.errors import CannotWrite, NoRoom

#: Size of the reserve, bytes. A change of a session's state writes some 20 kB into the registry's log, and SQLite needs
#: 32 kB to open it: enough for the ends of all sessions that run, and for deleting one.
RESERVE_BYTES = 2 << 20
#: Below this, bytes, a disk takes nothing more: one page of the registry and of its log, and its index.
FULL_BYTES = 64 << 10


#: What makes room on the disk of a data folder.
_DELETE = (
    "delete sessions that are no longer needed (their view on the page, DELETE /api/v1/sessions/ID), or make room on "
    "that disk otherwise"
)


def why_unwritable(
    folder: Path, files: tuple[Path, ...] = (), make_room: str = "make room there"
) -> CannotWrite | None:
    """Return why nothing can be written into a folder and into files in it; None where it can, as far as is known.

    folder, files : that are going to be written
    make_room : what makes room on its disk, for the message

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     why_unwritable(Path(folder)) is None
    True
    """
    try:
        free_bytes = _free_bytes(folder)
        is_read_only = bool(os.statvfs(folder).f_flag & os.ST_RDONLY)
    except OSError as error:
        return CannotWrite(f"{folder}: can't be written ({error.strerror}); look after its disk")
    if is_read_only:
        return CannotWrite(
            f"{folder}: can't be written, its disk is mounted read-only; mount it writable, or name another folder"
        )
    for place in (folder, *(file for file in files if file.exists())):
        if not os.access(place, os.W_OK | (os.X_OK if place == folder else 0)):
            return CannotWrite(
                f"{place}: can't be written by the user {_name(os.geteuid())}, it belongs to {_owner(place)}; run it "
                f"as {_owner(place)}, have its permissions changed, or name another folder"
            )
    return NoRoom(_full(folder, free_bytes, FULL_BYTES, make_room)) if free_bytes < FULL_BYTES else None


def why_registry_unwritable(registry: Path) -> CannotWrite | None:
    """Return why a registry in a data folder can't be written, or read, which needs a file beside it; None: it can, as
    far as is known."""
    return why_unwritable(registry.parent, (registry,), _DELETE)


def _full(folder: Path, free_bytes: int, wanted_bytes: int, make_room: str) -> str:
    return (
        f"{folder}: can't be written, its disk is full: {free_bytes / 1e6:.1f} MB are free and "
        f"{wanted_bytes / 1e6:.1f} MB are needed; {make_room}"
    )


def _free_bytes(folder: Path) -> int:
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    disk = os.statvfs(existing)
    return disk.f_frsize * (disk.f_bfree if os.geteuid() == 0 else disk.f_bavail)


def _owner(place: Path) -> str:
    return _name(place.stat().st_uid)


def _name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


class Room:
    """The room of one data folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._reserve = folder / ".reserve"

    def lack(self, wanted_bytes: int = 0) -> NoRoom | None:
        """Return what is wrong where the disk doesn't take `wanted_bytes` beside the reserve; None: it does. While the
        reserve has made way, that is room for it twice, so that it can be made again."""
        wanted_bytes += 0 if self._reserve.exists() else 2 * RESERVE_BYTES
        try:
            free_bytes = _free_bytes(self.folder)
        except OSError as error:
            return NoRoom(f"{self.folder}: can't be written ({error.strerror}); look after its disk")
        needed_bytes = max(wanted_bytes, FULL_BYTES)
        return NoRoom(_full(self.folder, free_bytes, needed_bytes, _DELETE)) if free_bytes < needed_bytes else None

    def check(self, wanted_bytes: int = 0) -> None:
        """Raise NoRoom where the disk doesn't take `wanted_bytes` beside the reserve."""
        if (lack := self.lack(wanted_bytes)) is not None:
            raise lack

    def keep(self) -> None:
        """Make the reserve, where there is none and the disk has room for it twice. Raises nothing."""
        with contextlib.suppress(OSError):
            if not self._reserve.exists() and _free_bytes(self.folder) >= 2 * RESERVE_BYTES:
                partial = self._reserve.with_name(f".reserve.{os.getpid()}.partial")
                try:
                    partial.write_bytes(bytes(RESERVE_BYTES))
                    partial.rename(self._reserve)
                finally:
                    partial.unlink(missing_ok=True)

    def give_up(self) -> bool:
        """Give the reserve up for what has to be written now; whether there was one. Raises nothing."""
        try:
            self._reserve.unlink()
        except OSError:
            return False
        return True

    def look(self) -> NoRoom | None:
        """Give the reserve up where the disk is full, make it again where there is room. Returns what `lack`
        returns."""
        lack = self.lack()
        if lack is None:
            self.keep()
        elif _is_full(self.folder):
            self.give_up()
        return lack


def _is_full(folder: Path) -> bool:
    try:
        return _free_bytes(folder) < FULL_BYTES
    except OSError:
        return False
