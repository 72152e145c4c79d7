"""Linear algebra in one thread while the numerics run.

Matrices here are small, a few hundred rows: more threads wait for each other longer than they compute (an estimated
kernel takes 2.4 times as long with two), and both cameras are fitted at the same time. The number of threads belongs to
the process, so that what else computes in it meanwhile has one thread, too; afterwards it is what it was. Within a
`threadpool_limits` of another thread, that one's number holds."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401  (the controller knows the libraries that are loaded when it is made)
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


class _ThreadLimit:
    """Reentrant context: BLAS uses one thread from the first entry until the last exit, whatever threads enter and in
    which order they leave."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0

    @functools.cached_property
    def _libraries(self) -> ThreadpoolController:
        return ThreadpoolController()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._limiter = self._libraries.limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                for library in self._libraries.lib_controllers:
                    # Of OpenBLAS, only the thread that set the limit may lift it, unless it lets go: here that may be
                    # another one
                    if (let_go := getattr(library, "clear_controlling_thread", None)) is not None:
                        let_go(force=True)
                self._limiter.restore_original_limits()


_LIMIT = _ThreadLimit()


def one_blas_thread(work: Callable[P, R]) -> Callable[P, R]:
    """`work`, in which linear algebra (BLAS, LAPACK) has one thread. For the entries of the numerics; they may call
    each other."""

    @functools.wraps(work)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _LIMIT:
            return work(*args, **kwargs)

    return limited
