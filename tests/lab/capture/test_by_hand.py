"""What an operator's hand changed is put back after a session that was killed or given up, or told until it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from drivers.errors import Interrupted
from drivers.stage.prompt import PromptStage
from lab.capture.by_hand import left_by_hand, left_by_session, note_put_back
from lab.capture.plan import CapturePlan
from lab.capture.records import RunRecord, now
from lab.capture.recovery import Recovery
from lab.capture.session import CaptureSession
from lab.capture.station import Drivers, Station
from lab.capture.store import Store
from lab.capture_kinds.base import Setting
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.slanted_edge import EdgeSequence
from lab.capture_kinds.stopped_edge import StoppedEdgeSequence
from lab.cli.entry import app
from lab.errors import DeviceError, InputError
from tests.lab import fake_bench

STOPS = {"f/4": {"kind": "aperture", "f_number": 4.0}, "f/8": {"kind": "aperture", "f_number": 8.0}}
STOPPED = CapturePlan((StoppedEdgeSequence(frames=1, f_number=8.0, edges=("edge-1",)),))
DARKS = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=1),))
TURN_BACK = "turn the aperture ring of each lens to f/4"


def station(**changes: object) -> Station:
    """The fake station with f/4 in its data sheets, and two stops of the rings."""
    table = fake_bench.station().model_dump(mode="json")
    for camera in table["cameras"].values():
        camera["datasheet"]["f_number"] = 4.0
    return Station.model_validate(table | {"targets": table["targets"] | STOPS} | changes)


class Operator:
    """One who is asked over the stage. `leaves_at`: the question at which he goes home, once."""

    def __init__(self, leaves_at: str = "", before: Callable[[str], None] = lambda name: None) -> None:
        self.asked: list[str] = []
        self.leaves_at, self.before = leaves_at, before

    def connect(self, there: Station) -> Drivers:
        stage = PromptStage(ask=self._answer)
        stage.instruct({name: target.instruction for name, target in there.targets.items()})
        return replace(fake_bench.Bench().drivers(), stage=stage)

    def _answer(self, question: str) -> str:
        name = question.partition(":")[0]
        self.asked.append(name)
        self.before(name)
        if name == self.leaves_at:
            self.leaves_at = ""
            raise Interrupted("the operator went home")
        return ""


def given_up(store: Store, leaves_at: str = "edge-1") -> str:
    """A session that ends at a question, with the lens stopped down or about to be."""
    session = CaptureSession.start(store, station(), STOPPED, connect=Operator(leaves_at).connect)
    with pytest.raises(DeviceError, match="went home"):
        session.run()
    return session.id


def test_a_whole_session_leaves_nothing(store: Store) -> None:
    during: list[tuple[str, bool]] = []

    def look(name: str) -> None:
        (left,) = left_by_hand(store.root)
        during.extend((change.now, change.is_confirmed) for change in left.changes)

    CaptureSession.start(store, station(), STOPPED, connect=Operator(before=look).connect).run()
    # on disk before each question: f/8 asked for, f/8 stands while the edge is put there, f/4 asked for
    assert during == [("f/8", False), ("f/8", True), ("f/4", False)]
    assert left_by_hand(store.root) == ()


def test_what_is_asked_stands_in_the_progress_too(store: Store) -> None:
    """So that who follows on a page or over REST sees what the session waits for, once for each question."""
    remarks: list[str] = []
    CaptureSession.start(
        store, station(), STOPPED, connect=Operator().connect,
        on_progress=lambda told: remarks.extend(filter(None, [told.remark])),
    ).run()  # fmt: skip
    assert [line.rpartition(" ")[2] for line in remarks] == ["(f/8)", "(f/4)"]
    assert f"by hand: {TURN_BACK}" in remarks[1]


def test_a_session_that_is_given_up_says_what_is_changed_and_how_to_put_it_back(store: Store) -> None:
    id = given_up(store)
    told = store.session(id).error or ""
    assert "the lenses' aperture stands at f/8" in told and TURN_BACK in told and "\n" not in told


def test_a_question_without_an_answer_may_have_changed_it(store: Store) -> None:
    assert "may stand at f/8" in (store.session(given_up(store, "f/8")).error or "")


def test_the_next_session_has_it_put_back_before_it_captures(store: Store) -> None:
    id = given_up(store)
    operator = Operator()
    CaptureSession.start(store, station(), DARKS, connect=operator.connect).run()
    assert operator.asked == ["f/4", "cap"]
    assert left_by_session(store.root, id) is None
    operator = Operator()
    CaptureSession.start(store, station(), DARKS, connect=operator.connect).run()
    assert operator.asked == ["cap"]


def test_a_kill_while_it_is_put_back_loses_nothing(store: Store) -> None:
    id = given_up(store)
    with pytest.raises(DeviceError):
        CaptureSession.start(store, station(), DARKS, connect=Operator("f/4").connect).run()
    assert left_by_session(store.root, id) is not None
    operator = Operator()
    CaptureSession.start(store, station(), DARKS, connect=operator.connect).run()
    assert operator.asked == ["f/4", "cap"] and left_by_hand(store.root) == ()


def test_the_session_itself_goes_on_with_the_lens_as_its_steps_need_it(store: Store) -> None:
    id, operator = given_up(store), Operator()
    CaptureSession(store, id, connect=operator.connect).run()
    assert operator.asked == ["f/8", "edge-1", "f/4"] and left_by_hand(store.root) == ()


def test_other_instruments_are_left_alone(store: Store) -> None:
    given_up(store)
    table = station().model_dump(mode="json")
    elsewhere = {
        name: entry | {"address": f"{entry['address']}-2"}
        for name in ("monochromator", "spectroradiometer", "display", "stage")
        if (entry := table[name])
    }
    cameras = {side: one | {"address": f"{one['address']}-2"} for side, one in table["cameras"].items()}
    operator = Operator()
    CaptureSession.start(store, station(**elsewhere, cameras=cameras), DARKS, connect=operator.connect).run()
    assert operator.asked == ["cap"] and left_by_hand(store.root)


def test_a_station_that_cannot_ask_for_it_is_refused_before_anything_moves(store: Store) -> None:
    id, bench = given_up(store), fake_bench.Bench()
    bare = station(targets={name: one for name, one in station().model_dump(mode="json")["targets"].items()
                            if name not in STOPS})  # fmt: skip
    session = CaptureSession.start(store, bare, DARKS, connect=bench.drivers)
    with pytest.raises(InputError, match=f"put-back {id}") as refused:
        session.run()
    assert "\n" not in str(refused.value) and bench.log == []
    note_put_back(store.root, id)
    assert session.run().state == "finished"


def test_the_recovery_after_a_kill_tells_it(store: Store) -> None:
    id = given_up(store)
    store.set_state(id, "running", run=RunRecord(started=now(), instruments={}, versions={}))  # as kill -9 leaves it
    Recovery(store, fake_bench.Bench().drivers).look()
    told = store.session(id).error or ""
    assert "kill -9" in told and TURN_BACK in told


def test_the_command_lists_it_and_takes_that_it_is_put_back(store: Store) -> None:
    def told(*words: str) -> tuple[int, str]:
        found = CliRunner().invoke(app, ["put-back", *words, "--data", str(store.root)])
        return found.exit_code, " ".join(found.output.split()) or str(found.exception)

    id = given_up(store)
    assert TURN_BACK in told()[1]
    code, said = told("20200101-000000-aaaaaa")
    assert code != 0 and f"left nothing changed by hand; those are {id}" in said
    assert told(id) == (0, f"session {id}: put back")
    assert told() == (0, "nothing is left changed by hand")


def test_deleting_the_session_does_not_forget_the_lens(store: Store) -> None:
    id = given_up(store)
    store.delete_session(id)
    assert left_by_session(store.root, id) is not None


def test_a_station_without_a_stage_is_told_so_before_anything_moves(store: Store) -> None:
    bench = fake_bench.Bench()
    with pytest.raises(InputError, match=r"'f/8' is set by hand and there is no \[stage\]"):
        CaptureSession.start(store, station(stage=None), STOPPED, connect=bench.drivers)
    assert bench.log == [] and store.sessions() == []


def test_journals_of_earlier_versions_are_read() -> None:
    assert Setting.model_validate({"target": "edge-1", "aperture": "f/8"}).by_hand == ("f/8",)
    assert Setting.model_validate({"target": "edge-1", "aperture": None}).by_hand == ()
    assert EdgeSequence(edges=("edge-1",)).steps(station())[0].setting.by_hand == ()
