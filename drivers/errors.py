"""What a driver raises."""

from __future__ import annotations


class InstrumentError(Exception):
    """An instrument failed or can't be reached. The message is one line: which instrument, what happened, what to do."""
