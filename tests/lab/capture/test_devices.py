"""Blocking calls with a time-out, and the level of a frame."""

import threading
import time

import numpy as np
import pytest

from drivers.errors import InstrumentError, Interrupted, NoAnswer
from lab.capture import blocking_calls
from lab.capture.blocking_calls import Status, in_thread
from lab.capture.devices import level_of, shut
from lab.formats.recording_set import DataSheet
from tests.lab.fake_bench import Bench, FakeMonochromator


def test_a_level_is_that_of_the_brightest_channel() -> None:
    sheet = DataSheet(rows=40, cols=40, cfa="RGGB", bit_depth=12, black_level_dn=95, white_level_dn=4095)
    frame = np.full((40, 40), 95, np.uint16)
    frame[1::2, 1::2] = 2095
    assert level_of(frame, sheet) == pytest.approx(0.5)
    frame[0, 0] = 4095  # a hot pixel: 1 of 400 of its channel, above the 99.5th percentile
    assert level_of(frame, sheet) == pytest.approx(0.5)
    small = sheet.model_copy(update={"full_well_e": 5000, "conversion_gain_dn_per_e": 0.5})
    assert level_of(frame, small) == pytest.approx(2000 / 2500)


def test_a_driver_that_never_comes_back_is_given_up() -> None:
    free, done = threading.Event(), threading.Event()
    status = Status("camera left", free.wait, 0.05)
    status.add_callback(lambda _: done.set())
    assert done.wait(30)
    assert isinstance(status.exception(), NoAnswer)
    assert "camera left: no answer within 0.05 s" in str(status.exception())
    free.set()  # and its late return changes nothing
    time.sleep(0.02)
    assert not status.success


def test_a_status_tells_what_the_call_raised() -> None:
    def fails() -> None:
        raise InstrumentError("stage: stuck; free it")

    done = threading.Event()
    status = Status("stage", fails, 5.0)
    status.add_callback(lambda _: done.set())
    assert done.wait(30)
    assert (status.done, status.success) == (True, False)
    assert str(status.exception()) == "stage: stuck; free it"


def test_a_callback_added_late_is_called_at_once() -> None:
    status = Status("stage", lambda: None, 5.0)
    assert status.exception(5.0) is None
    called: list[Status] = []
    status.add_callback(called.append)
    assert called == [status]
    assert status.success


def test_a_call_that_nobody_waits_for_any_more_ends_quietly() -> None:
    """An aborted session cancels its waits. The thread goes on, and its future has to accept the late result."""
    go = threading.Event()
    future = in_thread(lambda: go.wait(10.0))
    assert not future.cancel()
    go.set()
    assert future.result(10.0)


def test_a_thread_takes_the_next_call_and_one_that_hangs_is_replaced() -> None:
    first = in_thread(threading.get_ident).result(10.0)
    hangs, go = threading.Event(), threading.Event()

    def hang() -> int:
        hangs.set()
        go.wait(30.0)
        return threading.get_ident()

    _until_idle()
    hanging = in_thread(hang)  # in the thread that was idle
    assert hangs.wait(10.0)
    others = {in_thread(threading.get_ident).result(10.0) for _ in range(3)}
    go.set()
    assert hanging.result(10.0) not in others and first not in others


def _until_idle() -> None:
    """Wait until a thread that was given work is there for the next call."""
    until = time.monotonic() + 10.0
    while not blocking_calls._threads._idle:
        assert time.monotonic() < until
        time.sleep(0.001)


def test_calls_at_the_same_time_have_threads_of_their_own() -> None:
    together = threading.Barrier(4, timeout=30.0)
    assert sorted(one.result(30.0) for one in [in_thread(together.wait) for _ in range(4)]) == [0, 1, 2, 3]


def test_a_deadline_is_kept_while_a_later_one_is_waited_for() -> None:
    free = threading.Event()
    later = Status("later", lambda: free.wait(30.0), 600.0)
    told = threading.Event()
    Status("sooner", lambda: free.wait(30.0), 0.01).add_callback(lambda _: told.set())
    assert told.wait(30.0) and not later.done
    free.set()
    assert later.exception(30.0) is None


def test_the_level_is_the_percentile_of_the_codes() -> None:
    rng = np.random.default_rng(6)
    sheet = DataSheet(rows=30, cols=44, cfa="MONO", bit_depth=12)
    for _ in range(20):
        frame = rng.poisson(rng.uniform(1.0, 3000.0), (30, 44)).astype(np.uint16)
        assert level_of(frame, sheet) == pytest.approx(np.percentile(frame, 99.5) / sheet.saturation_dn)


@pytest.mark.parametrize(("stops", "is_told"), [(0, True), (1, True), (6, True), (1, False)])
def test_a_shutter_is_asked_again_where_another_stop_ends_the_question(
    stops: int, is_told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A halt closes the shutter and ends the run at once, from two threads: each stop ends what the other waits for."""
    bench, asked = Bench(), 0
    bench.opened = True

    def shutter_is_open(self: FakeMonochromator) -> bool:
        nonlocal asked
        asked += 1
        if asked <= stops:
            raise Interrupted("stopped while waiting for 'shutter?'")
        return self.bench.opened

    monkeypatch.setattr(FakeMonochromator, "shutter_is_open", shutter_is_open)
    if is_told:
        shut(FakeMonochromator(bench))
        assert asked == stops + 1
    else:  # no time is left
        monkeypatch.setattr("lab.capture.devices.STOP_S", 0.0)
        with pytest.raises(Interrupted):
            shut(FakeMonochromator(bench))
    assert not bench.opened
