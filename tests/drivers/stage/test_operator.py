"""The stage at the end of a TCP line."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from drivers.stage.operator import OperatorStage
from mocks.bench import Bench
from mocks.stage import MockStage as Mock
from mocks.wire import Reply, Tcp


def test_targets_are_placed_on_the_bench(served: Callable[..., str]) -> None:
    bench = Bench()
    before_s = bench.clock.now()
    with OperatorStage(served(Mock(bench), Tcp("127.0.0.1", 0))) as stage:
        assert stage.targets() == bench.targets
        for target in ("sphere", "edge-1", "charuco-12"):
            stage.place(target)
            assert stage.placed() == bench.placed == target
        with pytest.raises(Refused, match="no target 'moon'"):
            stage.place("moon")
        assert stage.placed() == "charuco-12"
    assert bench.clock.now() - before_s == pytest.approx(15.0)


@pytest.mark.parametrize("name", ["", "a\nPLACE b", " cap", "cap\r"])
def test_a_name_that_would_be_two_requests_is_refused(name: str) -> None:
    with pytest.raises(InstrumentError, match="is no name of a target"):
        OperatorStage("socket://127.0.0.1:9").place(name)


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("never@2", NoAnswer, "no answer within 1 s to 'PLACE sphere'"),
        ("half@2", NoAnswer, "only 'OK sp' within"),
        ("wrong@2", Garbled, "answered 'PLACE sphere' with"),
        ("error@2", Refused, "the operator is away"),
        ("late=1.5@2", NoAnswer, "no answer within"),
        ("unplug=0.2@2", Disconnected, "the line broke"),
    ],
)
def test_every_fault_is_one_error_and_then_it_works_again(
    served: Callable[..., str], fault: str, error: type[Exception], message: str
) -> None:
    stage = OperatorStage(served(Mock(Bench()), Tcp("127.0.0.1", 0), fault), timeout_s=1.0, place_timeout_s=1.0)
    stage.connect()
    with pytest.raises(error, match=message):
        stage.place("sphere")
    end = time.monotonic() + 30
    placed = ""
    while placed != "edge-2" and time.monotonic() < end:
        try:
            stage.place("edge-2")
            placed = stage.placed()
        except InstrumentError:
            time.sleep(0.05)
    assert placed == "edge-2"
    stage.close()


class _Behind(Mock):
    """One that answers what an earlier connection asked before it answers the first question."""

    behind = True

    def receive(self, data: bytes) -> list[bytes]:
        answers = super().receive(data)
        late, self.behind = self.behind and bool(answers), self.behind and not answers
        return [Reply(b"cap\r\n"), *answers] if late else answers


def test_late_answers_to_an_earlier_connection_are_left_out(served: Callable[..., str]) -> None:
    bench = Bench()
    with OperatorStage(served(_Behind(bench), Tcp("127.0.0.1", 0))) as stage:
        stage.place("sphere")
        assert stage.placed() == "sphere"
        assert stage.targets() == bench.targets
