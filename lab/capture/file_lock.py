"""Locks between processes, on files: they end with their process. The standard library alone, as the first thing of a
start needs them."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path


class Lock:
    """A lock on a file, held by one process at a time. The system releases it when that process ends, even by kill
    -9."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: int | None = None

    def acquire(self, patience_s: float = 0.2) -> bool:
        """Take the lock, trying for `patience_s`; return whether it succeeded. It has to try, as `is_held` holds the
        lock for a moment.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:  # a full or a read-only disk: a lock that is there can be taken all the same
            if not self.path.exists():
                raise
            file = os.open(self.path, os.O_RDONLY)
        until = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() >= until:
                    os.close(file)
                    return False
                time.sleep(0.01)
            else:
                self._file = file
                return True

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def is_held(self) -> bool:
        """Return whether any process holds it, this one included."""
        if self._file is not None:
            return True
        if not self.path.exists():
            return False
        if taken := self.acquire(patience_s=0.0):
            self.release()
        return not taken
