"""The catalogue of sequences says what is declared, and a plan's estimate is what its steps and the station's own
sessions give."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from lab.capture.catalogue import (
    TYPICAL_S,
    StepTimes,
    catalogue,
    describe_sequence,
    estimate,
    parse_parameters,
    step_times,
)
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.session import CaptureSession
from lab.capture.store import Store
from lab.capture.tables import StepRow
from lab.capture_kinds.base import SEQUENCES
from lab.capture_kinds.dark import DarkSequence
from lab.errors import InputError
from sim.parameters import read_quantities
from tests.lab import fake_bench

STATION = fake_bench.station()
DARKS = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))


def test_every_sequence_is_listed_with_what_it_declares() -> None:
    for told, kind in zip(catalogue(), SEQUENCES.values(), strict=True):
        assert told == describe_sequence(kind.name) and told.purpose and told.capture_kinds
        assert [one.name for one in told.parameters] == list(read_quantities(kind))
        for one in told.parameters:
            quantity = read_quantities(kind)[one.name]
            assert (one.unit, one.lower, one.upper) == (quantity.unit, quantity.lower, quantity.upper)
    assert {one.name for told in catalogue() for one in told.parameters if one.several} == {
        "exposures_s",
        "gains_db",
        "levels",
    }
    with pytest.raises(InputError, match="no sequence 'magic'; there are dark"):
        describe_sequence("magic")


def test_parameters_replace_those_of_a_full_session() -> None:
    plan = full_plan(STATION, True, ("dark", "narrowband"), {"narrowband": {"step_nm": 5.0}, "dark": {"frames": 2.0}})
    dark, narrowband = plan.sequences
    assert isinstance(dark, DarkSequence) and dark.frames == 2
    assert dark.exposures_s == next(iter(full_plan(STATION, True, ("dark",)).sequences)).exposures_s  # type: ignore[attr-defined]
    assert len(narrowband.wavelengths_nm) == (720 - 400) / 5 + 1  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (
            {"dark": {"exposures_s": [0.1, 0.1]}},
            "the step dark/0.1s/1 is there 2 times; take each sequence once, and give every value once",
        ),
        ({"dark": {"exposures_s": [0.1, 1e9]}}, r"dark\.exposures_s: .* is above the upper limit 3600"),
        ({"dark": {"exposures_s": []}}, r"dark\.exposures_s: .* at least 1 item"),
        ({"dark": {"frames": 2.5}}, r"dark\.frames: .* valid integer"),
        ({"narrowband": {"step_nm": 0.0}}, r"narrowband\.step_nm: .* below the lower limit 0\.1 nm"),
        ({"narrowband": {"step_nm": float("nan")}}, r"narrowband\.step_nm: .*finite"),
        ({"narrowband": {"from_nm": 800.0}}, "to_nm: 720 nm is below from_nm, 800 nm"),
        ({"dark": {"frames": 20_000}}, "100000 steps are more than the limit of 50000"),
        ({"narrowband": {"pose": 1.0}}, r"narrowband\.pose: isn't a parameter; narrowband has from_nm"),
        ({"magic": {}}, "parameters: magic isn't taken; name some of dark"),
    ],
)
def test_a_parameter_out_of_its_bounds_is_refused(parameters: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        full_plan(STATION, parameters=parameters).steps(STATION)


def test_parameters_are_read_from_texts() -> None:
    read = parse_parameters(
        ["narrowband.step_nm=5", "narrowband.passes=1", "dark.exposures_s=0.1", "flat.levels=0.1,0.5"]
    )
    assert read == {
        "narrowband": {"step_nm": 5.0, "passes": 1.0},
        "dark": {"exposures_s": [0.1]},
        "flat": {"levels": [0.1, 0.5]},
    }
    for wrong in ("narrowband", "narrowband=5", "magic.x=1", "dark.frames=", "dark.frames=few"):
        with pytest.raises(InputError, match="give"):
            parse_parameters([wrong])


def test_an_estimate_counts_what_the_plan_takes() -> None:
    plan = full_plan(STATION)
    found = estimate(plan, STATION, StepTimes({}))
    steps = plan.steps(STATION)
    assert found.steps == len(steps) and found.captures == sum(len(step.captures) for step in steps)
    assert [one.name for one in found.sequences] == list(plan.names) and not any(one.learned for one in found.sequences)
    dark = found.sequences[0]
    # 5 exposures of 4 frames each, their sum 7.5505 s, and a frame's typical time; told to 0.1 s
    assert dark.estimated_s == pytest.approx(4 * (7.5505 + 5 * TYPICAL_S["frame"]), abs=0.05)


def test_times_are_learned_as_a_constant_and_a_slope() -> None:
    steps = DarkSequence(exposures_s=(0.5, 2.0, 5.0), frames=2).steps(STATION)
    others = full_plan(STATION, only=("flat",)).steps(STATION)
    seen = [(step, 0.3 + 1.1 * float(step.id.split("/")[1][:-1])) for step in steps] + [(step, 2.0) for step in others]
    times = StepTimes.learn(seen)
    assert times.per_exposure == pytest.approx(1.1)
    longer = DarkSequence(exposures_s=(10.0,), frames=1).steps(STATION)[0]
    assert times.seconds(longer) == (pytest.approx(0.3 + 11.0), True)
    for step in others:
        assert times.seconds(step) == (pytest.approx(2.0), True)
    assert times.seconds(full_plan(STATION, only=("chart",)).steps(STATION)[0])[1] is False


def test_a_station_learns_from_its_own_finished_sessions(tmp_path: Path) -> None:
    store = Store(tmp_path)
    session = CaptureSession.start(store, STATION, DARKS, connect=fake_bench.Bench().drivers)
    assert step_times(store, STATION).mean_s == {}
    session.run()
    with store.transaction() as db:
        for row in db.scalars(sa.select(StepRow)):
            assert row.started is not None
            row.finished = row.started + timedelta(seconds=3 + (7 if "0.1s" in row.step_id else 0))
    found = estimate(DARKS, STATION, step_times(store, STATION)).sequences[0]
    assert found.learned and found.estimated_s == pytest.approx(2 * 3 + 2 * 10)
    moved = STATION.model_copy(update={"stage": STATION.stage.model_copy(update={"address": "elsewhere"})})  # type: ignore[union-attr]
    assert step_times(store, moved).mean_s == {}
    store.close()
