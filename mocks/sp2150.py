"""An Acton SP2150 on a serial line: commands ended by CR, parameters first; an echo, an answer, ` ok` CR LF.

?NM          -> ?NM 0.000 nm  ok
500.00 GOTO  -> 500.00 GOTO  ok      once the grating stands
WHAT         -> WHAT  ?

A command waits until the motion before it has ended. Its slits are set by hand.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable

from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply

_UPPER_NM, _NM_PER_S, _S_PER_PLACE = 1400.0, 175.0, 0.5
_BLANK = 6
_NUMBER = r"(\d{1,5}(?:\.\d{0,4})?)"


class MockSp2150(Grammar):
    """The instrument; `light` feels its grating and its filter wheel, in which place 6 is a blank."""

    def __init__(self, light: MeasuredLight, serial_number: str = "21500427", *, echo: bool = True) -> None:
        super().__init__(light.clock)
        self._light = light
        self._serial_number = serial_number
        self._echo = echo
        self._line = bytearray()
        self._waiting: deque[str] = deque()
        self._arrive: Callable[[], None] = lambda: None
        self._moving = ""
        self._nm = 0.0
        self._filter = 1
        self._gratings = {1: "1200 g/mm BLZ=  500NM", 2: " 600 g/mm BLZ=  1.0UM"}
        self._grating = 1

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if value in (0x0D, 0x0A):
                command = " ".join(self._line.decode("latin-1").upper().split())
                self._line.clear()
                if command and len(self._waiting) < 100:
                    self._waiting.append(command)
                    out += self._run()
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def _end(self) -> list[bytes]:
        self._arrive()
        return [self._reply_to(self._moving, ""), *self._run()]

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting and self._done_at is None:
            command = self._waiting.popleft()
            text = self._answer(command) if self._failure() is None else None
            if text is not None:
                out.append(self._reply_to(command, text))
            elif self._done_at is None:
                out.append(Reply(f"{command if self._echo else ''}  ? \r\n".encode("latin-1", "replace")))
        return out

    def _reply_to(self, command: str, text: str) -> Reply:
        return Reply(f"{command if self._echo else ''} {text} ok\r\n".encode("latin-1", "replace"))

    def _answer(self, command: str) -> str | None:
        """Return the answer; None where there is none yet (a motion), or none at all."""
        known = {
            "MODEL": "SP-2-150i ",
            "SERIAL": f"{self._serial_number} ",
            "?NM": f"{self._nm:.3f} nm ",
            "?FILTER": f"{self._filter} ",
            "?GRATING": f"{self._grating} ",
            "?GRATINGS": self._grating_rows(),
        }
        if command in known:
            return known[command]
        if (match := re.fullmatch(rf"{_NUMBER} GOTO", command)) and (nm := float(match[1])) <= _UPPER_NM:
            self._go(command, 0.05 + abs(nm - self._nm) / _NM_PER_S, lambda: self._stand(nm))
        elif match := re.fullmatch(r"([1-6]) FILTER", command):
            place = int(match[1])
            self._go(command, 0.05 + _S_PER_PLACE * abs(place - self._filter), lambda: self._turn(place))
        elif match := re.fullmatch(r"([12]) GRATING", command):
            number = int(match[1])
            self._go(command, 10.0, lambda: setattr(self, "_grating", number))
        return None

    def _grating_rows(self) -> str:
        rows = "\r\n"
        for number in range(1, 10):
            mark = "\x1a" if number == self._grating else " "
            rows += f"{mark}{number} {self._gratings.get(number, 'Not Installed    ')} \r\n"
        return rows

    def _go(self, command: str, seconds: float, arrive: Callable[[], None]) -> None:
        self._moving, self._arrive = command, arrive
        self._done_at = self.clock.now() + seconds

    def _stand(self, nm: float) -> None:
        self._nm = nm
        self._light.set_wavelength(nm)

    def _turn(self, place: int) -> None:
        self._filter = place
        self._light.set_shutter(place != _BLANK)
        if place != _BLANK:
            self._light.set_filter(place)
