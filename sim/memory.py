"""Memory of a process that runs for days and makes each of an instrument's calls in a thread of its own, or that waits
after it has computed."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

#: `mallopt`'s name for the number of arenas (glibc, malloc.h).
_M_ARENA_MAX = -8
ARENAS = 2


def share_arenas() -> None:
    """Let all threads of this process take their memory from the same `ARENAS` arenas; does nothing outside glibc.

    By default glibc gives threads up to eight arenas a core, and each keeps what the frames that passed through it
    left: a session of thousands of frames grew by tens of megabytes that Python knew nothing of. Call it before threads
    start."""
    mallopt = _glibc("mallopt")
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, ARENAS)


def return_freed_memory() -> None:
    """Give the system back what was freed; does nothing outside glibc. Takes some milliseconds.

    By itself glibc returns only what lies at the end of an arena. Call it where much was freed and the process goes on
    to wait, or to something else."""
    trim = _glibc("malloc_trim")
    if trim is not None:
        trim(0)


def _glibc(name: str) -> Any:
    """Return a function of the C library; None where it has none of this name."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
