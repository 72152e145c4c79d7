"""Errors that reach the user: one line that says what, where and how to mend it, and the exit code that goes with it."""

from __future__ import annotations


def one_line(error: Exception) -> str:
    """An exception's text on one line; its class where it has no text."""
    return " ".join(str(error).split()) or type(error).__name__


class InputError(Exception):
    """The input can't be used (exit code 2). The message is one line: what, where, remedy."""

    exit_code = 2


class DeviceError(Exception):
    """A device failed (exit code 3). The message is one line: which device, what, remedy."""

    exit_code = 3


class NotDetermined(Exception):
    """The recordings don't determine what a step computes: it is skipped, and `reason` says why and what would settle it."""

    def __init__(self, step: str, reason: str) -> None:
        super().__init__(f"{step}: {reason}")
        self.step = step
        self.reason = reason


class Cancelled(Exception):
    """Raised by a progress callback to end the work that calls it."""
