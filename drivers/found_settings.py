"""What an instrument was set to before it was changed, on disk until it is set so again: a process that is killed can't
do that itself.

A file for each instrument, `instruments/NAME.json` in the data folder, from the first change to the last restoration.
Whoever connects next finds it there, and restores what it says before anything else.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import ClassVar

from drivers.errors import InstrumentError, InUse
from drivers.instrument import Setting

log = logging.getLogger(__name__)
_lock = threading.Lock()
_thread = threading.local()


@contextmanager
def making_safe() -> Iterator[None]:
    """Make an instrument safe, within the block and in this thread, also where nothing can be kept on disk: what it was
    set to is kept in memory alone, for as long as its driver lives.
    """
    before = getattr(_thread, "makes_safe", False)
    _thread.makes_safe = True
    try:
        yield
    finally:
        _thread.makes_safe = before


class Hold:
    """That one driver alone, in whatever process of this computer, uses an instrument which would serve several.

    A name of the system's is taken, which is free again when the process is gone; where the system has no such names,
    nothing is held.
    """

    def __init__(self) -> None:
        self._taken: socket.socket | None = None

    def take(self, name: str, who: str) -> None:
        """Hold the instrument of that name, once. Raises `InUse`."""
        if self._taken is not None or not hasattr(socket, "AF_UNIX") or not sys.platform.startswith("linux"):
            return
        taken = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            taken.bind("\0calibench:" + hashlib.sha256(name.encode()).hexdigest())
        except OSError as error:
            taken.close()
            raise InUse(
                f"{who}: another driver on this computer uses it; close that one, or correct the address in the "
                "station file"
            ) from error
        self._taken = taken

    def let_go(self) -> None:
        """Release the hold: others may use the instrument."""
        taken, self._taken = self._taken, None
        if taken is not None:
            taken.close()


class FoundSettings:
    """The settings found on one instrument, by name, in the order in which they were changed. `who`: its name in
    messages.

    `name`: of the instrument, the same in every process that reaches it: its family and serial number, or its address.
    """

    _kept_in: ClassVar[Path | None] = None

    @classmethod
    def keep_in(cls, folder: Path | None) -> None:
        """Keep the files in this folder from now on. None: in `instruments` of the data folder that CALIBENCH_DATA
        names, or `calibench-data`."""
        cls._kept_in = folder

    def __init__(self, name: str, who: str) -> None:
        self._who = who
        folder = self._kept_in or Path(os.environ.get("CALIBENCH_DATA", "calibench-data")) / "instruments"
        self._file = folder.absolute() / f"{re.sub(r'[^A-Za-z0-9._-]+', '_', name)}.json"
        self._values: dict[str, Setting] = {}
        with suppress(FileNotFoundError, ValueError):  # torn by a full disk: nothing was changed after it
            self._values = dict(json.loads(self._file.read_text(encoding="utf-8")))

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __bool__(self) -> bool:
        return bool(self._values)

    def last_first(self) -> Iterator[tuple[str, Setting]]:
        """Yield (name, value) of each, what was changed last first."""
        return iter(list(reversed(self._values.items())))

    @property
    def values(self) -> dict[str, Setting]:
        """The value of each, in the order in which they were changed."""
        return dict(self._values)

    def get(self, name: str, otherwise: Setting) -> Setting:
        """Return what was found, or `otherwise` where it wasn't changed."""
        return self._values.get(name, otherwise)

    def note(self, name: str, value: Setting) -> None:
        """Keep a value, once, before it is changed. Raises `InstrumentError` where it can't be kept, except within
        `making_safe`."""
        if name not in self._values:
            self._values[name] = value
            try:
                self._write()
            except InstrumentError as error:
                if not getattr(_thread, "makes_safe", False):
                    raise
                log.warning("%s; its instrument is made safe all the same", error)

    def forget(self, name: str) -> None:
        """Note that a value is set as it was found. Where the file can't be changed, it stays: whoever connects next
        sets the value once more.
        """
        if self._values.pop(name, None) is not None:
            try:
                self._write()
            except InstrumentError as error:
                log.warning("%s", error)

    def _write(self) -> None:
        fresh = self._file.with_suffix(f".{os.getpid()}")
        try:
            with _lock:
                if not self._values:
                    self._file.unlink(missing_ok=True)
                    with suppress(OSError):  # other instruments' are there, too
                        self._file.parent.rmdir()
                        self._file.parent.parent.rmdir()
                    return
                self._file.parent.mkdir(parents=True, exist_ok=True)
                with fresh.open("w", encoding="utf-8") as file:
                    json.dump(self._values, file)
                    file.flush()
                    os.fsync(file.fileno())
                fresh.replace(self._file)
        except OSError as error:
            with suppress(OSError):
                fresh.unlink(missing_ok=True)
            raise InstrumentError(
                f"{self._who}: its settings can't be kept in {self._file} ({error.strerror}), to be restored later; "
                "make room, have its permissions changed, or set CALIBENCH_DATA to another folder"
            ) from error
