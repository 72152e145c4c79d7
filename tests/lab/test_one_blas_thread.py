"""Threads and memory of one process."""

from __future__ import annotations

import platform
import subprocess
import sys
import threading

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from lab.observables.edges import profile
from lab.observables.edges.mtf import edge_mtf
from lab.one_blas_thread import one_blas_thread
from tests.lab.observables.edges.drawn_edges import edge


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    """The default of a user's environment: BLAS with two threads."""
    with threadpool_limits(2, user_api="blas"):
        for library in (
            ThreadpoolController().select(internal_api="openblas").lib_controllers
        ):  # as if no thread had set it
            library.clear_controlling_thread(force=True)
        if blas_threads() != {2}:
            pytest.skip("this BLAS has no second thread")
        yield


def test_inside_there_is_one_and_outside_what_there_was():
    @one_blas_thread
    def inner() -> set[int]:
        return blas_threads()

    @one_blas_thread
    def outer() -> tuple[set[int], set[int]]:
        return inner(), blas_threads()

    assert outer() == ({1}, {1})
    assert blas_threads() == {2}


def test_a_failure_gives_the_threads_back():
    @one_blas_thread
    def fails() -> None:
        raise ValueError

    with pytest.raises(ValueError):
        fails()
    assert blas_threads() == {2}


def test_the_last_to_leave_gives_them_back():
    """Two threads that overlap: the first to come leaves first and lives on, and what it set mustn't stay."""
    first_inside, second_inside, first_left, second_left = (threading.Event() for _ in range(4))
    seen: list[set[int]] = []

    @one_blas_thread
    def first() -> None:
        first_inside.set()
        assert second_inside.wait(30.0)

    @one_blas_thread
    def second() -> None:
        second_inside.set()
        assert first_left.wait(30.0)
        seen.append(blas_threads())

    def first_and_later() -> None:
        first()
        first_left.set()
        assert second_left.wait(30.0)

    one, two = threading.Thread(target=first_and_later), threading.Thread(target=second)
    one.start()
    assert first_inside.wait(30.0)
    two.start()
    two.join(30.0)
    left = blas_threads()
    second_left.set()
    one.join(30.0)
    assert (seen, left) == ([{1}], {2})


def test_an_edge_is_measured_with_one(monkeypatch: pytest.MonkeyPatch):
    seen: list[set[int]] = []
    fitted = profile.posterior
    monkeypatch.setattr(profile, "posterior", lambda *arguments: (seen.append(blas_threads()), fitted(*arguments))[1])
    edge_mtf(np.asarray(edge(64, 5.0, 0.5)))
    assert seen == [{1}, {1}]  # in the last two passes


# --- Threads share their arenas of memory -----------------------------------------------------------------------------


#: Threads that all hold memory at the same time, and then the number of arenas as glibc itself tells it.
PROGRAM = """
import ctypes, sys, threading
from sim.memory import share_arenas
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


#: 2000 arrays of 64 kB, below the size from which glibc maps each by itself. Every second one is held, so that
#: nothing is free at the end of the arena. What the process has in memory (pages) before, when the others are freed,
#: and when they are given back.
FREED = """
import os
import numpy as np
from sim.memory import return_freed_memory
def resident():
    return int(open("/proc/self/statm").read().split()[1])
held = [np.ones(8192) for _ in range(2000)]
held = held[::2]
before = resident()
return_freed_memory()
print(before, resident(), os.sysconf("SC_PAGE_SIZE"))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="returning memory is glibc's")
def test_freed_memory_is_returned() -> None:
    """1000 arrays of 64 kB lie free between others; a page at each end of one is shared with its neighbours."""
    before, after, page = map(int, subprocess.check_output([sys.executable, "-c", FREED], text=True).split())
    assert (before - after) * page > 1000 * (65536 - 2 * page)
