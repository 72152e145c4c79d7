"""A Dask cluster of worker processes on this computer: how much faster than one worker, beside the ideal.

The ideal is the number of workers, or of cores where those are fewer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from distributed import LocalCluster

from benchmarks.table import Row, show
from evaluation.draw import kind_of
from evaluation.make import make
from lab.workers import Workers
from sim.optics.traced_table import TableSettings, lens_table
from sim.optics.zmx import read_zmx

WORKERS = 4
LENS = Path(__file__).parents[1] / "tests" / "sim" / "optics" / "lenses" / "doublet.zmx"
CASES = 6
#: Tuning cases of healthy cameras alone: all take about as long.
SEED = next(s for s in range(100000) if all(kind_of(s, i) == "healthy" for i in range(1, CASES + 1)))
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def test_four_workers_beside_one(tmp_path: Path) -> None:
    prescription = read_zmx(LENS)

    def tables(workers: Workers, fields: int) -> None:
        lens_table(prescription, TableSettings(fields=fields), each=workers.done)

    def cases(workers: Workers, count: int) -> None:
        place = tmp_path / f"{time.monotonic_ns()}"
        make(place, count, SEED, place.with_suffix(".json"), "small", workers)

    rows = []
    for name, work, few, many in (
        ("lens table, 33 wavelengths, 32 field points", tables, 8, 32),
        (f"{CASES} cases of the blind proof", cases, 4, CASES),
    ):
        taken = [wall_s(count, work, few, many) for count in (1, WORKERS)]
        rows.append(Row(f"{name}: speed-up", taken[0] / taken[1], min(WORKERS, os.cpu_count() or 1), "", "ideal"))
        rows.append(Row(f"{name}: one worker", taken[0], None, "s"))
    show(f"{WORKERS} worker processes, {os.cpu_count()} cores", rows)


def wall_s(workers: int, work: Callable[[Workers, int], None], few: int, many: int) -> float:
    """Wall time of `many` pieces, after `few` have loaded the libraries in every worker."""
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
    ) as running:
        there = Workers(scheduler=running.scheduler_address)
        work(there, few)
        start = time.perf_counter()
        work(there, many)
        return time.perf_counter() - start
