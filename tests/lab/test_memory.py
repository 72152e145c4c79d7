"""Threads share their arenas of memory."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

#: Threads that all hold memory at the same time, and then the number of arenas as glibc itself tells it.
PROGRAM = """
import ctypes, sys, threading
from lab.memory import share_arenas
if sys.argv[1] == "shared":
    share_arenas()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.free.argtypes = [ctypes.c_void_p]
all_there = threading.Barrier(8)
def work():
    held = libc.malloc(1000)
    all_there.wait(30)
    libc.free(held)
threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are glibc's")
def test_threads_share_two_arenas() -> None:
    arenas = {
        how: subprocess.run(
            [sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, check=True, timeout=60
        ).stdout.count("<heap nr=")
        for how in ("shared", "own")
    }
    assert arenas["shared"] <= 2 < arenas["own"]
