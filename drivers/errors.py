"""Errors that drivers raise: one base class for the caller, subclasses for the driver's own recovery."""

from __future__ import annotations

#: What mends a refused permission for a port or a USB device.
PERMISSION_REMEDY = (
    "install deploy/70-calibench.rules as /etc/udev/rules.d/70-calibench.rules, join the group calibench and log in "
    "again (docs/how-to/install-in-a-lab.md)"
)


class InstrumentError(Exception):
    """An instrument failed or can't be reached. The message is one line: which instrument, what happened, what to
    do."""


class NoAnswer(InstrumentError):
    """No answer, or an incomplete one, within the time-out."""


class Disconnected(InstrumentError):
    """The connection is gone: unplugged, refused, or closed by the other side."""


class InUse(Disconnected):
    """Another program, or another driver of this one, holds the port."""


class Garbled(InstrumentError):
    """Something was received that isn't an answer to the request."""


class Repeated(Garbled):
    """A camera's frame came once more: its number is that of the frame before. No trigger is spent on it."""


class Interrupted(InstrumentError):
    """`stop`, called from another thread, ended a wait."""


class Refused(InstrumentError):
    """The instrument answered with an error code of its own, kept in `code`."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code
