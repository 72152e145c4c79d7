"""The mock target stage: an operator at the end of a TCP line, one request a line.

    PLACE edge-1   -> OK edge-1
    PLACED?        -> edge-1
    LIST?          -> cap,sphere,...
    anything else  -> ERROR and why

Lines end LF or CR LF, answers CR LF. Placing a target takes a moment.
"""

from __future__ import annotations

from typing import Protocol

from mocks.wire import LONGEST_LINE, Grammar, MockClock, Reply


class Targets(Protocol):
    """Where targets stand: `mocks.bench.Bench`, or `mocks.lamp.Lamp` alone."""

    @property
    def clock(self) -> MockClock: ...
    @property
    def placed(self) -> str: ...
    @property
    def targets(self) -> tuple[str, ...]: ...
    def place(self, name: str) -> None: ...


class MockStage(Grammar):
    """The operator; `targets` is where things are put."""

    fault_code = 1

    def __init__(self, targets: Targets, seconds_to_place: float = 5.0) -> None:
        super().__init__(targets.clock)
        self._targets = targets
        self._seconds_to_place = seconds_to_place
        self._line = bytearray()
        self._waiting: list[str] = []
        self._placing = ""

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if value != 0x0A:
                if len(self._line) < LONGEST_LINE:
                    self._line.append(value)
                continue
            request = self._line.decode("utf-8", "replace").strip()
            self._line.clear()
            if request and len(self._waiting) < 100:
                self._waiting.append(request)
            out += self._run()
        return out

    def _end(self) -> list[bytes]:
        self._targets.place(self._placing)
        return [_line(f"OK {self._placing}"), *self._run()]

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting and self._done_at is None:
            out += self._answer(self._waiting.pop(0))
        return out

    def _answer(self, request: str) -> list[bytes]:
        if self._failure() is not None:
            return [_line("ERROR the operator is away")]
        word, _, name = request.partition(" ")
        if request.upper() == "PLACED?":
            return [_line(self._targets.placed)]
        if request.upper() == "LIST?":
            return [_line(",".join(self._targets.targets))]
        if word.upper() != "PLACE" or not name.strip():
            return [_line("ERROR not understood; say PLACE name, PLACED? or LIST?")]
        if name.strip() not in self._targets.targets:
            return [_line(f"ERROR no target {name.strip()!a}; LIST? names them")]
        self._placing = name.strip()
        self._done_at = self.clock.now() + self._seconds_to_place
        return []


def _line(text: str) -> Reply:
    return Reply(text.encode("utf-8") + b"\r\n")
