"""A data folder that an older calibench wrote: everything in it is there after the upgrade, and what was interrupted
goes on. `make_older_data.py` says how it was made."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from lab.calibration import life
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture.tables import Base, KeyRow
from lab.formats.results import FitResult
from tests.lab.fake_bench import BLACK, COLS, ROWS, Bench

OLDER = Path(__file__).with_name("data-of-revision-0007.tar.gz")


@pytest.fixture
def upgraded(tmp_path: Path) -> Iterator[Store]:
    """The older folder, opened by this version."""
    with tarfile.open(OLDER) as packed:
        packed.extractall(tmp_path, filter="data")
    with sa.create_engine(f"sqlite:///{tmp_path}/registry.sqlite").connect() as db:
        assert db.execute(sa.text("SELECT version_num FROM alembic_version")).scalar_one() == "0007"
    store = Store(tmp_path)
    yield store
    store.close()


def test_the_registry_has_the_tables_of_this_version_and_all_rows(upgraded: Store) -> None:
    with upgraded.transaction() as db:
        assert compare_metadata(MigrationContext.configure(db.connection()), Base.metadata) == []
        assert db.execute(sa.select(KeyRow.name, KeyRow.scope)).all() == [("ada", "operate")]
    done, half = sorted(upgraded.sessions(), key=lambda one: one.created)
    assert (done.name, done.state, done.packed) == ("before the upgrade", "finished", True)
    assert (half.name, half.packed) == ("interrupted", False) and 0 < half.steps_done < half.steps
    (calibration,) = life.calibrations(upgraded)
    assert calibration.id == upgraded.results(done.id, "fit")[0].id


def test_every_frame_and_the_fit_are_read(upgraded: Store) -> None:
    done = min(upgraded.sessions(), key=lambda one: one.created)
    recordings = upgraded.recording_set(done.id)
    assert {capture.kind for capture in recordings.captures()} == {"dark", "flat"}
    for capture in recordings.captures():
        frame = recordings.frame(capture)
        assert frame.shape == (ROWS, COLS) and frame.dtype == np.uint16
        assert (frame.mean() > BLACK + 1) == (capture.kind == "flat")
    kept = FitResult.model_validate(upgraded.results(done.id, "fit")[0].document)
    assert set(kept.cameras) == {"left", "right"} and kept.source == done.id


def test_the_interrupted_session_goes_on_where_it_was(upgraded: Store) -> None:
    half = max(upgraded.sessions(), key=lambda one: one.created)
    there = {capture.id for capture in upgraded.captures(half.id)}
    bench = Bench()
    assert CaptureSession(upgraded, half.id, connect=bench.drivers).run().state == "finished"
    found = upgraded.captures(half.id)
    assert there < {capture.id for capture in found}
    assert len({(capture.name, capture.side) for capture in found}) == len(found)  # none twice
    recordings = upgraded.recording_set(half.id)
    assert len(recordings.captures()) == len(found)
    assert all(recordings.frame(capture).shape == (ROWS, COLS) for capture in recordings.captures())
