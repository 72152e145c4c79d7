"""Knife edges on a station: in light of one wavelength, one by one, and at another f-number, which an operator sets."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drivers.stage.prompt import PromptStage
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.session import CaptureSession
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture_kinds.slanted_edge import EdgeSequence
from lab.capture_kinds.stopped_edge import StoppedEdgeCapture, StoppedEdgeSequence
from lab.errors import InputError
from tests.lab import fake_bench

STOPS = {"f/4": {"kind": "aperture", "f_number": 4.0}, "f/8": {"kind": "aperture", "f_number": 8.0}}


def station(**targets: object) -> Station:
    """The fake station with f/4 in its data sheets, and more targets."""
    table = fake_bench.station().model_dump(mode="json")
    for camera in table["cameras"].values():
        camera["datasheet"]["f_number"] = 4.0
    return Station.model_validate(table | {"targets": table["targets"] | targets})


def test_one_edge_in_light_of_one_wavelength() -> None:
    steps = EdgeSequence(frames=2, wavelength_nm=450.0, edges=("edge-3",)).steps(station())
    assert [step.id for step in steps] == [f"edge/450nm/edge-3/{k}" for k in ("exposure", 1, 2)]
    assert {(step.setting.target, step.setting.wavelength_nm) for step in steps} == {("edge-3", 450.0)}
    both = CapturePlan((EdgeSequence(frames=2), EdgeSequence(frames=2, wavelength_nm=450.0))).steps(station())
    ids = [capture.id for step in both for capture in step.captures]
    assert len(set(ids)) == len(ids)


def test_an_edge_that_is_not_there_is_one_line() -> None:
    with pytest.raises(InputError, match="no knife edge 'edge-9'; it has edge-1, edge-2"):
        EdgeSequence(edges=("edge-9",)).steps(station())


def test_a_full_session_leaves_the_lens_alone() -> None:
    assert "stopped_edge" not in full_plan(station(**STOPS)).names


@pytest.mark.parametrize(
    ("targets", "said"), [({}, "it has none"), ({"f/4": STOPS["f/4"]}, "with f_number = 8; it has f/4; add")]
)
def test_a_station_without_the_stop_says_so_before_anything_moves(
    targets: dict[str, object], said: str, store: Store
) -> None:
    bench = fake_bench.Bench()
    plan = CapturePlan((StoppedEdgeSequence(f_number=8.0),))
    with pytest.raises(InputError, match=said) as refused:
        CaptureSession.start(store, station(**targets), plan, connect=bench.drivers)
    assert "\n" not in str(refused.value)
    assert store.sessions() == [] and bench.log == []


def test_the_operator_is_asked_to_set_the_stop_and_to_set_it_back(store: Store) -> None:
    """Over the prompt of the stage, as for any target."""
    asked: list[str] = []
    bench = fake_bench.Bench()

    def answer(question: str) -> str:
        asked.append(question)
        return ""

    there = station(**STOPS)
    stage = PromptStage(ask=answer)
    stage.instruct({name: target.instruction for name, target in there.targets.items()})
    drivers = replace(bench.drivers(), stage=stage)
    plan = CapturePlan((StoppedEdgeSequence(frames=2, f_number=8.0, edges=("edge-1", "edge-2")),))
    found = CaptureSession.start(store, there, plan, connect=lambda _: drivers).run()
    assert found.state == "finished"
    assert [question.partition(":")[0] for question in asked] == ["f/8", "edge-1", "edge-2", "f/4"]
    assert "turn the aperture ring of each lens to f/8" in asked[0]
    taken = store.recording_set(found.id).captures(StoppedEdgeCapture)
    assert len(taken) == 2 * 2 * 2 * 3  # edges, frames, sides, regions
    assert {capture.f_number for capture in taken} == {8.0}
