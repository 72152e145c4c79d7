"""What a driver raises: one kind of error for the caller, with what happened told apart for the driver's own recovery."""

from __future__ import annotations


class InstrumentError(Exception):
    """An instrument failed or can't be reached. The message is one line: which instrument, what happened, what to do."""


class NoAnswer(InstrumentError):
    """Nothing, or not all of an answer, came within the time-out."""


class Disconnected(InstrumentError):
    """The line is gone: unplugged, refused, or closed by the other side."""


class Garbled(InstrumentError):
    """Something came that isn't an answer to what was asked."""


class Interrupted(InstrumentError):
    """A wait was ended by `stop` from another thread."""


class Refused(InstrumentError):
    """The instrument answered with an error code of its own, kept in `code`."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code
