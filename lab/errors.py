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


class CannotWrite(Exception):
    """What calibench keeps can't be written (exit code 2): no permission, a read-only disk, a disk that failed. The
    message is one line: where, why, remedy."""

    exit_code = 2


class NoRoom(CannotWrite):
    """A disk is full."""


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command as Ctrl-C does."""


#: What a failure of the environment is mended by, where the system's own words don't say it.
_REMEDIES = {
    errno.ENOSPC: "make room on that disk, then do it again",
    errno.EDQUOT: "make room within the quota, then do it again",
    errno.EACCES: "run it as the user to whom it belongs, or have its permissions changed",
    errno.EPERM: "run it as the user to whom it belongs, or have its permissions changed",
    errno.EROFS: "it is mounted read-only: mount it writable, or name another place",
    errno.EIO: "look after that disk",
    errno.EMFILE: "too many files are open: raise the limit (ulimit -n)",
    errno.ENFILE: "too many files are open on this computer: end what holds them",
    errno.ECONNREFUSED: "start what listens there, or correct the address",
    errno.EHOSTUNREACH: "look after the network, or correct the address",
    errno.ENETUNREACH: "look after the network, or correct the address",
    errno.ETIMEDOUT: "look after the network, or correct the address",
}
#: Errors of a full disk.
FULL = (errno.ENOSPC, errno.EDQUOT)
#: Errors of the disk, not of the network.
_OF_DISKS = (*FULL, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO)
#: What a database says of its own environment, and the remedy. Of a registry in the data folder, `lab.capture.room`
#: says more.
_OF_DATABASES = {
    "disk is full": _REMEDIES[errno.ENOSPC],
    "No space left": _REMEDIES[errno.ENOSPC],
    "readonly database": "run it as the user to whom the data folder belongs; reading needs that, too",
    "unable to open": "run it as the user to whom the data folder belongs, or name another folder",
    "disk I/O error": _REMEDIES[errno.EIO],
    "connect": "start the database, look after the network, or correct CALIBENCH_DATABASE_URL",
}


def lacks_room(error: BaseException | None) -> bool:
    """Return whether an error, or what it came from, is that of a full disk."""
    while error is not None:
        if isinstance(error, NoRoom) or (isinstance(error, OSError) and error.errno in FULL):
            return True
        if any(words in str(error) for words in ("No space left on device", "disk is full")):  # of HDF5, of databases
            return True
        error = error.__cause__ or error.__context__
    return False


def cannot_write(place: object, error: OSError, otherwise: str) -> CannotWrite | InputError:
    """Return that a place can't be written, with the remedy that the system's error has; `otherwise`: the remedy where
    it is no failure of the disk or of permissions."""
    remedy = _REMEDIES[error.errno] if error.errno in _OF_DISKS else otherwise
    text = f"{place}: can't be written ({error.strerror}); {remedy}"
    if error.errno in FULL:
        return NoRoom(text)
    return CannotWrite(text) if error.errno in _OF_DISKS else InputError(text)


def failure_of_environment(error: BaseException) -> CannotWrite | DeviceError | None:
    """Return a failure of the disk, of permissions, of the database or of the network as an error whose text is one
    line: where, what, remedy; None for anything else, which is a defect."""
    if isinstance(error, CannotWrite):
        return error
    if isinstance(error, socket.gaierror):
        return DeviceError(
            f"{one_line(error)}: a host's name isn't known; look after the network, or correct the address"
        )
    if isinstance(error, OSError) and error.errno in _REMEDIES:
        where = error.filename if error.filename is not None else "a file or a connection"
        text = f"{where}: {error.strerror}; {_REMEDIES[error.errno]}"
        return NoRoom(text) if error.errno in FULL else (CannotWrite if error.errno in _OF_DISKS else DeviceError)(text)
    of_database = getattr(error, "orig", None)  # as SQLAlchemy wraps what a database's driver raises
    said = one_line(of_database) if isinstance(of_database, Exception) else ""
    for words, remedy in _OF_DATABASES.items():
        if words in said:
            return (NoRoom if remedy == _REMEDIES[errno.ENOSPC] else CannotWrite)(f"the registry: {said}; {remedy}")
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
