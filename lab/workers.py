"""Where independent pieces of work are done: in this process, in processes of this computer, or on a Dask cluster.

The cluster is the one of the service's jobs (`lab.jobs`), reached by its scheduler's address. Its workers are processes
that have calibench installed and see the folders that the work names under the same paths. They do best with one thread
each (`dask worker ADDRESS --nthreads 1`): Python computes in one at a time, and CPU time and memory are measured by the
process.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, TypeVar

from lab.errors import InputError

R = TypeVar("R")

CONNECT_TIMEOUT_S = 10.0


def dask_client(scheduler: str, timeout_s: float) -> Any:
    """Return a client of the Dask scheduler at an address (tcp://HOST:PORT). Raises InputError where none answers."""
    from distributed import Client

    try:
        return Client(scheduler, timeout=timeout_s, set_as_default=False)
    except (OSError, ValueError) as error:  # ValueError: the address isn't one
        raise InputError(
            f"Dask scheduler {scheduler}: not reached ({error}); start it, or leave --scheduler and "
            "CALIBENCH_SCHEDULER out"
        ) from error


@contextlib.contextmanager
def _cluster(scheduler: str) -> Iterator[Any]:
    """Connect to a scheduler and yield the client. Raises InputError where none answers, or it has no workers."""
    with dask_client(scheduler, CONNECT_TIMEOUT_S) as client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise InputError(f"Dask scheduler {scheduler}: has no workers; start some with `dask worker {scheduler}`")
        yield client


@dataclass(frozen=True)
class Workers:
    """`jobs` processes of this computer, 1: this one; or with `scheduler` the workers of a Dask cluster, however many
    those are."""

    jobs: int = 1
    scheduler: str | None = None

    def done(self, work: Callable[..., R], items: Sequence[Any], *shared: Any) -> Iterator[tuple[int, R]]:
        """Number and result of `work(item, *shared)` of every item, as they get ready.

        `shared` goes to each worker of a cluster once. An exception of the work ends the rest of it. Raises InputError
        where no scheduler answers."""
        if self.scheduler is not None and items:
            yield from self._on_cluster(self.scheduler, work, items, shared)
        elif self.jobs == 1 or len(items) < 2:
            for number, item in enumerate(items):
                yield number, work(item, *shared)
        else:
            yield from self._here(work, items, shared)

    def check(self) -> None:
        """Raise InputError where the cluster's scheduler doesn't answer or has no workers: before the work."""
        if self.scheduler is not None:
            with _cluster(self.scheduler):
                pass

    def in_order(self, work: Callable[..., R], items: Sequence[Any], *shared: Any) -> list[R]:
        """Return the results of `done`, in the order of the items."""
        found = dict(self.done(work, items, *shared))
        return [found[number] for number in range(len(items))]

    def _here(self, work: Callable[..., R], items: Sequence[Any], shared: Sequence[Any]) -> Iterator[tuple[int, R]]:
        with ProcessPoolExecutor(min(self.jobs, len(items)), mp_context=get_context("spawn")) as pool:
            running = {pool.submit(work, item, *shared): number for number, item in enumerate(items)}
            left = set(running)
            try:
                while left:
                    ready, left = wait(left, return_when=FIRST_COMPLETED)
                    for one in ready:
                        yield running[one], one.result()
            except BaseException:  # nobody waits for the rest
                for process in list(pool._processes.values()):  # Python 3.14 has `kill_workers`
                    process.kill()
                raise
            finally:
                for future in left:
                    future.cancel()

    @staticmethod
    def _on_cluster(
        scheduler: str, work: Callable[..., R], items: Sequence[Any], shared: Sequence[Any]
    ) -> Iterator[tuple[int, R]]:
        from distributed import as_completed as as_completed_there

        with _cluster(scheduler) as client:
            there = [client.scatter(part, broadcast=True, hash=False) for part in shared]
            running = {client.submit(work, item, *there, pure=False): number for number, item in enumerate(items)}
            for ready in as_completed_there(running, loop=client.loop):
                yield running[ready], ready.result()
