"""Sessions whose process died: the station is made safe, the reason recorded, and the session resumed where that is
allowed."""

from __future__ import annotations

import time

import pytest

from drivers.instrument import Instrument
from drivers.monochromator.base import Monochromator
from lab.capture import instruments
from lab.capture.instruments import made_safe
from lab.capture.plan import CapturePlan
from lab.capture.records import RunRecord, now
from lab.capture.recovery import Recovery, make_station_safe
from lab.capture.store import Store
from lab.capture.tables import SessionRow
from lab.capture_kinds.dark import DarkSequence
from tests.lab.fake_bench import Bench, station

FEW = CapturePlan((DarkSequence(exposures_s=(0.001, 1.0), frames=1),))


def left_behind(store: Store, runs: int = 1, **changes: object) -> str:
    """A session as `kill -9` leaves it: recorded as running, its lock free."""
    where = station(**changes)
    session_id = store.create_session(where, FEW.steps(where))
    for _ in range(runs):
        store.set_state(session_id, "running", run=RunRecord(started=now(), instruments={}, versions={}))
    return session_id


def test_the_station_is_made_safe_the_reason_told_and_nothing_resumed_unasked(store: Store) -> None:
    bench, resumed = Bench(), []
    session_id = left_behind(store)
    recovery = Recovery(store, bench.drivers)
    recovery.resume_with(resumed.append)
    recovery.look()
    assert not bench.opened and not bench.lit
    assert {"close monochromator", "close camera left"} <= set(bench.log)
    info = store.session(session_id)
    assert info.state == "interrupted"
    assert (
        info.error is not None and "kill -9" in info.error and "made safe" in info.error and "resume it" in info.error
    )
    assert resumed == [] and store.under_way() == []


def test_a_session_goes_on_by_itself_where_its_station_says_so(store: Store) -> None:
    resumed: list[str] = []
    session_id = left_behind(store, resume_automatically=True)
    recovery = Recovery(store, Bench().drivers)
    recovery.look()
    assert resumed == []  # there is no service yet
    recovery.resume_with(resumed.append)
    recovery.look()
    assert resumed == [session_id]
    stuck = left_behind(store, runs=2, resume_automatically=True)
    recovery.look()
    assert resumed == [session_id]  # no endless loop of a run that ends its process
    assert "finished no step" in (store.session(stuck).error or "")


def test_an_instrument_that_does_not_answer_is_named_and_tried_again(store: Store) -> None:
    bench, at_s = Bench(), 0.0
    bench.unplugged = {"monochromator"}
    session_id = left_behind(store)
    recovery = Recovery(store, bench.drivers, clock=lambda: at_s)
    recovery.look()
    info = store.session(session_id)
    assert info.state == "interrupted" and "not brought into a safe state: monochromator" in (info.error or "")
    assert bench.opened and not bench.lit  # the others were made safe
    bench.unplugged = set()
    recovery.look()
    assert bench.opened  # not at once: an instrument that is gone would be asked without end
    at_s += 60.0
    recovery.look()
    assert not bench.opened and "made safe" in (store.session(session_id).error or "")


def test_a_session_whose_process_lives_is_left_alone(store: Store) -> None:
    bench = Bench()
    session_id = left_behind(store)
    lock = store.lock(session_id)
    assert lock.acquire()
    Recovery(store, bench.drivers).look()
    lock.release()
    assert bench.opened and bench.log == []
    with store.reading() as db:
        assert db.get_one(SessionRow, session_id).error is None  # nothing was recorded


def test_the_shutter_answers_before_the_others_are_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instruments, "HEAD_START_S", 30.0)
    reached: list[str] = []

    def reach(driver: Instrument) -> None:
        if isinstance(driver, Monochromator):
            time.sleep(0.1)  # it takes its time
        reached.append(type(driver).__name__)

    found = made_safe(Bench().drivers(), reach, lambda: reached.append("shut"))
    assert found.complaints == () and found.shutter == "closed"
    assert reached[:2] == ["FakeMonochromator", "shut"] and len(reached) > 3


def test_a_station_whose_drivers_cannot_be_made_is_a_complaint() -> None:
    found = make_station_safe(station())  # the driver "fake" isn't registered
    (said,) = found.complaints
    assert "fake" in said and "\n" not in said and found.shutter == "unknown"
