"""Memory of a process that runs for days and makes each of an instrument's calls in a thread of its own."""

from __future__ import annotations

import ctypes
import sys

#: `mallopt`'s name for the number of arenas (glibc, malloc.h).
_M_ARENA_MAX = -8
ARENAS = 2


def share_arenas() -> None:
    """Let all threads of this process take their memory from the same `ARENAS` arenas; does nothing outside glibc.

    By default glibc gives threads up to eight arenas a core, and each keeps what the frames that passed through it
    left: a session of thousands of frames grew by tens of megabytes that Python knew nothing of. Call it before threads
    start."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, ARENAS)
