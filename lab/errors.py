"""Errors that reach the user: one line that says what, where and how to mend it, and the exit code that goes with
it."""

from __future__ import annotations

import errno
import socket


def one_line(error: Exception) -> str:
    """Return an exception's text on one line; its class where it has no text."""
    return " ".join(str(error).split()) or type(error).__name__


class InputError(Exception):
    """The input can't be used (exit code 2). The message is one line: what, where, remedy."""

    exit_code = 2


class DeviceError(Exception):
    """A device failed (exit code 3). The message is one line: which device, what, remedy."""

    exit_code = 3


#: What a failure of the environment is mended by, where the system's own words don't say it.
_REMEDIES = {
    errno.ENOSPC: "make room on that disk, then do it again",
    errno.EDQUOT: "make room within the quota, then do it again",
    errno.EACCES: "run it as the user to whom it belongs, or have its permissions changed",
    errno.EPERM: "run it as the user to whom it belongs, or have its permissions changed",
    errno.EROFS: "it is mounted read-only: name another place",
    errno.EIO: "look after that disk",
    errno.EMFILE: "too many files are open: raise the limit (ulimit -n)",
    errno.ENFILE: "too many files are open on this computer: end what holds them",
    errno.ECONNREFUSED: "start what listens there, or correct the address",
    errno.EHOSTUNREACH: "look after the network, or correct the address",
    errno.ENETUNREACH: "look after the network, or correct the address",
    errno.ETIMEDOUT: "look after the network, or correct the address",
}
#: What a database says of its own environment, and the remedy.
_OF_DATABASES = {
    "disk is full": _REMEDIES[errno.ENOSPC],
    "No space left": _REMEDIES[errno.ENOSPC],
    "readonly database": "run it as the user to whom the data folder belongs; reading needs that, too",
    "unable to open": "run it as the user to whom the data folder belongs, or name another folder",
    "disk I/O error": _REMEDIES[errno.EIO],
    "connect": "start the database, look after the network, or correct CALIBENCH_DATABASE_URL",
}


def failure_of_environment(error: BaseException) -> str | None:
    """Return a failure of the disk, of permissions, of the database or of the network as one line: where, what, remedy;
    None for anything else, which is a defect."""
    if isinstance(error, socket.gaierror):
        return f"{one_line(error)}: a host's name isn't known; look after the network, or correct the address"
    if isinstance(error, OSError) and error.errno in _REMEDIES:
        where = error.filename if error.filename is not None else "a file or a connection"
        return f"{where}: {error.strerror}; {_REMEDIES[error.errno]}"
    of_database = getattr(error, "orig", None)  # as SQLAlchemy wraps what a database's driver raises
    said = one_line(of_database) if isinstance(of_database, Exception) else ""
    for words, remedy in _OF_DATABASES.items():
        if words in said:
            return f"the registry: {said}; {remedy}"
    return None


class NotDetermined(Exception):
    """The recordings don't determine what a step computes: it is skipped, and `reason` says why and what would settle
    it."""

    def __init__(self, step: str, reason: str) -> None:
        super().__init__(f"{step}: {reason}")
        self.step = step
        self.reason = reason


class Cancelled(Exception):
    """Raised by a progress callback to end the work that calls it."""
