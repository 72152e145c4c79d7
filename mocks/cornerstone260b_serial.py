"""A Cornerstone 260B on its RS-232 port, which differs from a Cornerstone 260 in what its clients trip over.

The handshake byte comes on receipt, not on arrival; motions overlap, and queries are answered while they last; `IDLE?`
tells whether one does; the echo may be off; a line ends with CR LF, an LF alone doesn't end it; no error 7. Source:
Newport, MCS260B manual, p. 43-46, 62."""

from __future__ import annotations

from collections.abc import Callable

from mocks.cornerstone260 import ALREADY_THERE, MockCornerstone260, _Cs260Refusal, _Done
from mocks.wire import LONGEST_LINE, MeasuredLight


class MockCornerstone260BSerial(MockCornerstone260):
    """The instrument; `echo` as its switch stands."""

    fault_code = 10
    model = "CS260B 74125"

    def __init__(self, light: MeasuredLight, serial_number: str = "CB-260B-02", echo: bool = False) -> None:
        super().__init__(light, serial_number)
        self.echo = echo
        self._motions: list[tuple[float, Callable[[], None] | None]] = []

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if self.echo:
                out.append(bytes((value,)))
            ended = value == 0x0A and self._line.endswith(b"\r")
            if ended:
                out += self._end_line()
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
            else:  # so that the end of too long a line is seen
                self._line[-1] = value
        return out

    def quiet(self) -> list[bytes]:
        return []

    @property
    def wait_s(self) -> float | None:
        if not self._motions:
            return None
        return max(0.0, min(end for end, _ in self._motions) - self.clock.now())

    def elapse(self) -> list[bytes]:
        now = self.clock.now()
        done = [motion for motion in self._motions if motion[0] <= now]
        self._motions = [motion for motion in self._motions if motion[0] > now]
        for _, effect in done:
            if effect is not None:
                effect()
        return []

    def _abort(self) -> list[bytes]:
        self._motions.clear()
        return self._answer(None)

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting:
            statement = self._waiting.popleft()
            upper = " ".join(statement.upper().split())
            try:
                done = _Done("0" if self._motions else "1") if upper == "IDLE?" else self._execute(upper, statement)
            except _Cs260Refusal as refusal:
                if refusal.code != ALREADY_THERE:
                    self._status, self._error = 0x20, refusal.code
                out += self._answer(None)
                continue
            if done.seconds > 0:
                self._motions.append((self.clock.now() + done.seconds, done.effect))
            elif done.effect is not None:
                done.effect()
            out += self._answer(done.reply)
        return out
