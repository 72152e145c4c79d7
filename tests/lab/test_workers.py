"""The same work in this process, in processes of this computer and on a Dask cluster of worker processes: the same
results."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from distributed import LocalCluster

from evaluation.__main__ import main
from evaluation.blind import BlindProof
from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.make import make
from evaluation.truth import FIRST_FRESH_SEED
from lab.diagnose.inference.bootstrap import healthy_draws
from lab.diagnose.inference.side_model import measurement_model
from lab.errors import InputError
from lab.formats import recording_set
from lab.workers import Workers
from sim.optics.traced_table import TableSettings, lens_table
from sim.optics.zmx import read_zmx

DOUBLET = Path(__file__).parents[1] / "sim" / "optics" / "lenses" / "doublet.zmx"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Workers]:
    """Two worker processes, which share nothing with this one but the files."""
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as running:
        yield Workers(scheduler=running.scheduler_address)


@pytest.mark.parametrize("where", ["here", "processes", "cluster"])
def test_every_item_has_its_result(where: str, cluster: Workers) -> None:
    workers = {"here": Workers(), "processes": Workers(jobs=2), "cluster": cluster}[where]
    assert workers.in_order(math.hypot, [3.0, 5.0, 8.0], 4.0) == [math.hypot(x, 4.0) for x in (3.0, 5.0, 8.0)]
    assert dict(workers.done(operator.neg, [1, 2])) == {0: -1, 1: -2}
    assert workers.in_order(operator.neg, []) == []
    with pytest.raises(ZeroDivisionError):
        workers.in_order(operator.truediv, [1.0, 2.0], 0.0)


def test_the_work_is_done_elsewhere(cluster: Workers) -> None:
    """`/proc/self` names the process that runs the work."""
    others = {Path(found).name for _, found in cluster.done(os.path.realpath, ["/proc/self"] * 8)}
    assert str(os.getpid()) not in others
    assert 1 <= len(others) <= 2


def test_a_scheduler_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lab.workers.CONNECT_TIMEOUT_S", 0.3)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        with pytest.raises(InputError, match="not reached"):
            Workers(scheduler=address).in_order(operator.neg, [1])


def test_a_scheduler_without_workers_is_said() -> None:
    with (
        LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as running,
        pytest.raises(InputError, match="has no workers"),
    ):
        Workers(scheduler=running.scheduler_address).in_order(operator.neg, [1])


@pytest.mark.slow
def test_sealed_cases_are_made_and_diagnosed_on_the_cluster(
    cluster: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same recordings as in this process, to the byte; and what a worker says of a set that can't be read."""
    seed, address = FIRST_FRESH_SEED + 5, str(cluster.scheduler)
    monkeypatch.chdir(tmp_path)
    words = ["--cases", "1", "--seed", str(seed), "--size", "small", "--cfa", "MONO"]
    assert main(["make", "--out", "there", "--scheduler", address, *words]) == 0
    assert "1 cases" in capsys.readouterr().out
    here = make(tmp_path / "here", 1, seed, tmp_path / "here.json", "small", Workers(), cfa="MONO")
    there = make(tmp_path / "there", 1, seed, tmp_path / "there.truths.json", "small", Workers(), cfa="MONO")
    assert there.truths["case-0001"].truth == here.truths["case-0001"].truth
    (tmp_path / "there" / "case-0002").mkdir()
    runs = BlindProof(Path("there"), ("case-0002",)).run(Path("there"), workers=cluster)
    assert "manifest.json" in str(runs["case-0002"].error)


def test_what_a_worker_says_of_a_set_that_is_not_there(cluster: Workers, tmp_path: Path) -> None:
    """A diagnosis on the cluster that fails is this case's result, as one here is."""
    there, here = (
        BlindProof(tmp_path / str(k), ("case-0001",)).run(tmp_path / str(k), workers=workers)
        for k, workers in enumerate((cluster, Workers()))
    )
    for runs in (there, here):
        assert "no such folder" in str(runs["case-0001"].error)


@pytest.mark.slow
def test_lens_tables_are_the_same(cluster: Workers) -> None:
    settings = TableSettings(wavelength_nm=(500.0, 600.0), fields=4, samples=16)
    here, there = (lens_table(read_zmx(DOUBLET), settings, each=each) for each in (None, cluster.done))
    assert here.warnings == there.warnings
    for name in ("chief_mm", "relative_illumination", "psf", "window_um", "centroid_um"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))


@pytest.mark.slow
def test_drawn_healthy_cameras_are_the_same(cluster: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has a generator of its own, so that neither the order nor the place matters."""
    camera = ConcealedCamera(9, cfa="MONO", rows=64, cols=96)
    recording_set.write(recordings_of(camera, Plan(kinds=("dark", "flat"))), tmp_path / "set")
    monkeypatch.chdir(tmp_path)  # not the workers' directory
    recordings = recording_set.read("set")
    model, _ = measurement_model(recordings, "left")
    assert model is not None
    here, there = (
        healthy_draws(recordings, "left", model, 3, np.random.default_rng(1), workers=workers)
        for workers in (None, cluster)
    )
    assert len(here) == 3
    assert len({draw.top_score for draw in here}) == 3
    assert there == here
