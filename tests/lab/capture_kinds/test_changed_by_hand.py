"""Captures for which a hand turns the knife edges or brings the sensors to another temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.stage.prompt import PromptStage
from lab.capture.by_hand import left_by_hand
from lab.capture.catalogue import StepTimes, estimate
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.session import CaptureSession
from lab.capture.station import Station
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkCapture, DarkSequence
from lab.capture_kinds.slanted_edge import EdgeLayout, EdgeSequence, SlantedEdgeCapture, turn_layout
from lab.errors import InputError
from tests.lab import fake_bench
from tests.lab.fake_bench import COLS, ROWS

TURNS = {f"turn {deg}": {"kind": "turn", "angle_deg": deg} for deg in (0, 90)}
TEMPERATURES = {
    "usual": {"kind": "sensor_temperature"},
    "30 C": {"kind": "sensor_temperature", "sensor_c": 30.0},
    "40 C": {"kind": "sensor_temperature", "sensor_c": 40.0},
}
WARM = CapturePlan(
    tuple(DarkSequence(exposures_s=(0.001, 1.0), frames=1, sensor_c=sensor_c) for sensor_c in (None, 30.0, 40.0))
)
TURNED = CapturePlan((EdgeSequence(frames=1, edges=("edge-1",), turn_deg=90.0),))


def station(**targets: object) -> Station:
    """The fake station, whose first knife edge stays in the frame when it is turned."""
    table = fake_bench.station().model_dump(mode="json")
    for side in ("left", "right"):
        for region in table["targets"]["edge-1"][side]["regions"]:
            region |= {"region": [ROWS // 2 - 4, COLS // 2 - 4, ROWS // 2 + 4, COLS // 2 + 4], "field_mm": [0.0, 0.0]}
    return Station.model_validate(table | {"targets": table["targets"] | targets})


def taken(store: Store, there: Station, plan: CapturePlan) -> tuple[str, list[str]]:
    """The session in which an operator does all that he is asked, and what he was asked."""
    asked: list[str] = []
    stage = PromptStage(ask=lambda question: asked.append(question) or "")  # type: ignore[func-returns-value]
    stage.instruct({name: target.instruction for name, target in there.targets.items()})
    drivers = replace(fake_bench.Bench().drivers(), stage=stage)
    found = CaptureSession.start(store, there, plan, connect=lambda _: drivers).run()
    assert found.state == "finished" and left_by_hand(store.root) == ()
    return found.id, asked


def test_an_edge_that_is_turned_is_where_a_turn_of_the_frame_has_it() -> None:
    """Against `numpy.rot90`, which turns a picture by 90 degrees: its top to the left, so three times for the right.

    Of a frame of 101 x 101, the middle pixel of a region is followed; the region is the pixel with one around it."""
    for row, col in ((20, 50), (50, 80), (30, 70)):
        frame = np.zeros((101, 101))
        frame[row, col] = 1.0
        region = EdgeLayout(
            name="one", region=(row - 1, col - 1, row + 2, col + 2), angle_deg=5.0, field_mm=(row - 50.0, col - 50.0)
        )
        turned = turn_layout(region, 90.0, 101, 101)
        assert turned is not None
        (there,) = np.argwhere(np.rot90(frame, 3))
        assert tuple(there) == (turned.region[0] + 1, turned.region[1] + 1)
        assert turned.field_mm == pytest.approx((there[0] - 50.0, there[1] - 50.0))
        assert turned.angle_deg == 95.0
        back = turn_layout(turned, -90.0, 101, 101)
        assert back == region


def test_an_edge_that_leaves_the_frame_is_left_out() -> None:
    region = EdgeLayout(name="corner", region=(80, 160, 100, 180), angle_deg=5.0, field_mm=(0.4, 0.7))
    assert turn_layout(region, 90.0, 100, 200) is None
    assert turn_layout(region, 180.0, 100, 200) is not None


def test_the_operator_turns_the_edges_and_turns_them_back(store: Store) -> None:
    session, asked = taken(store, station(**TURNS), TURNED)
    assert [question.partition(":")[0] for question in asked] == ["turn 90", "edge-1", "turn 0"]
    assert "by 90 degrees from its usual place, its top to the right" in asked[0] and "back to its" in asked[2]
    straight = EdgeSequence(frames=1, edges=("edge-1",)).steps(station())[1].captures
    turned = store.recording_set(session).captures(SlantedEdgeCapture)
    assert turned and {c.angle_deg for c in turned} == {(c.angle_deg or 0.0) + 90.0 for c in straight}  # type: ignore[attr-defined]
    assert {c.id for c in turned}.isdisjoint(c.id for c in straight)


def test_sensors_are_warmed_step_by_step_and_cooled_once(store: Store) -> None:
    """Between two temperatures nobody is asked for the usual one."""
    session, asked = taken(store, station(**TEMPERATURES), WARM)
    assert [question.partition(":")[0] for question in asked] == ["cap", "30 C", "40 C", "usual"]
    assert len(store.recording_set(session).captures(DarkCapture)) == 3 * 2 * 2


def test_where_the_camera_says_no_temperature_that_of_the_operator_is_kept() -> None:
    warm = DarkSequence(exposures_s=(1.0,), frames=1, sensor_c=30.0).steps(station(**TEMPERATURES))
    assert {capture.temperature_c for step in warm for capture in step.captures} == {30.0}
    usual = DarkSequence(exposures_s=(1.0,), frames=1).steps(station(**TEMPERATURES))
    assert {capture.temperature_c for step in usual for capture in step.captures} == {None}


@pytest.mark.parametrize(
    ("plan", "targets", "said"),
    [
        (TURNED, {}, "kind 'turn' with angle_deg = 90; it has none; add"),
        (TURNED, {"turn 90": TURNS["turn 90"]}, "no target of kind 'turn' is the usual state"),
        (WARM, {"usual": TEMPERATURES["usual"]}, "sensor_c = 30; it has none; add"),
        (WARM, {"30 C": TEMPERATURES["30 C"]}, "no target of kind 'sensor_temperature' is the usual state"),
    ],
)
def test_a_station_that_lacks_what_a_hand_needs_says_so_before_anything_moves(
    plan: CapturePlan, targets: dict[str, object], said: str, store: Store
) -> None:
    bench = fake_bench.Bench()
    with pytest.raises(InputError, match=said) as refused:
        CaptureSession.start(store, station(**targets), plan, connect=bench.drivers)
    assert "\n" not in str(refused.value) and bench.log == [] and store.sessions() == []


def test_a_full_session_asks_for_none_of_it() -> None:
    steps = full_plan(station(**TURNS, **TEMPERATURES)).steps(station(**TURNS, **TEMPERATURES))
    assert not any(step.setting.by_hand for step in steps)


def test_the_hand_has_its_time() -> None:
    """Half a minute for each question where the station has shown nothing: to turn the edges, and back."""
    there, times = station(**TURNS), StepTimes({})
    straight = CapturePlan((EdgeSequence(frames=1, edges=("edge-1",)),))
    slower = estimate(TURNED, there, times).estimated_s - estimate(straight, there, times).estimated_s
    assert slower == pytest.approx(60.0)
