"""What a halt asks of a Cornerstone 260: the shutter's answer on the connection that is there, from several threads."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from drivers.errors import InstrumentError, Interrupted
from drivers.monochromator.cornerstone260 import Cornerstone260
from drivers.transport import Transport
from lab.capture.devices import shut
from mocks.bench import Bench, Clock
from mocks.cornerstone260 import MockCornerstone260
from mocks.cornerstone260b_serial import MockCornerstone260BSerial
from mocks.wire import Grammar, Pty


@pytest.mark.parametrize("kind", [MockCornerstone260, MockCornerstone260BSerial])
def test_a_stop_under_way_of_a_motion_keeps_the_connection(
    served: Callable[..., str], kind: type[Grammar], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Meeting the instrument anew takes quiet periods, which add up with every stop of a halt."""
    bench, opened, moves = Bench(), [], threading.Event()
    bench.clock = Clock(real_time_factor=1.0)
    open_port = Transport.open
    monkeypatch.setattr(Transport, "open", lambda self: (opened.append(1), open_port(self))[1])
    mono = Cornerstone260(
        served(kind(bench), Pty()),  # type: ignore[call-arg, arg-type]
        recorder=lambda direction, data: moves.set() if data.startswith(b"GOWAVE") else None,
    )
    mono.open_shutter()
    told: list[InstrumentError] = []

    def move() -> None:
        try:
            mono.move_nm(1000)  # 5.8 s
        except InstrumentError as error:
            told.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    assert moves.wait(30.0)
    halting = [threading.Thread(target=shut, args=(mono,)) for _ in range(4)]
    for one in halting:
        one.start()
    for one in (*halting, mover):
        one.join(30.0)
    assert [type(error) for error in told] == [Interrupted]
    assert not bench.light.shutter_open and not mono.shutter_is_open()
    assert len(opened) == 1
    mono.close()


@pytest.mark.parametrize("left", [b"", b"HANDSHAKE 1\nGOWAVE 700\n"], ids=["idle", "moving"])
def test_a_shutter_answers_before_the_first_contact(
    served: Callable[..., str], left: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench()
    mock = MockCornerstone260(bench)
    mock.receive(b"SHUTTER O\n" + left)
    mono = Cornerstone260(served(mock, Pty()))
    monkeypatch.setattr(Transport, "drain", lambda *_, **__: pytest.fail("it waited for silence"))
    assert mono.shut_at_once() and not bench.light.shutter_open
    monkeypatch.undo()
    mono.close()


def test_a_late_answer_to_an_earlier_program_is_not_the_shutters(served: Callable[..., str]) -> None:
    """One that says `C` comes first; the shutter itself is stuck, and never says it."""

    class Stuck(MockCornerstone260):
        def receive(self, data: bytes) -> list[bytes]:
            late, self.late = self.late, []
            return [*late, *super().receive(data.replace(b"SHUTTER C", b"SHUTTER O"))]

        late: list[bytes] = [b"C\r\n00\r\n"]

    mono = Cornerstone260(served(Stuck(Bench()), Pty()), timeout_s=0.3)
    assert not mono.shut_at_once()
