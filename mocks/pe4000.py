"""A CoolLED pE-4000 on its USB serial port: commands end CR, answers CR LF.

CSS?         -> CSSASN050BXF000CXF100DXF020
CSSASN050    -> the same line, as it is then
LAMS         -> LAM:A:365, and a line for each other channel
LOAD:385     -> LOAD:385     the LED stands two seconds later; the channel is dark meanwhile
PORT:P=OFF   -> PORT:P=OFF   its pod is locked

A channel that isn't selected can't be on. What it doesn't know it doesn't answer.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply

_LOAD_S = 2.0
LEDS = {
    "A": (365, 385, 405, 435),
    "B": (460, 470, 490, 500),
    "C": (525, 550, 580, 595),
    "D": (635, 660, 740, 770),
}
_GROUP = re.compile(r"([A-D])([SX])([NF])(\d{3})")


class MockPe4000(Grammar):
    """The instrument. `state`: each channel's S or X, N or F, and percent; `loaded`: its LED (nm)."""

    def __init__(self, light: MeasuredLight) -> None:
        super().__init__(light.clock)
        self._light = light
        self._line = bytearray()
        self._arriving = 0
        self.state = {"A": ("X", "F", 50), "B": ("X", "F", 0), "C": ("X", "F", 100), "D": ("X", "F", 20)}
        self.loaded = {letter: leds[0] for letter, leds in LEDS.items()}

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if value in (0x0D, 0x0A):
                command = self._line.decode("latin-1").strip()
                self._line.clear()
                if command and self._failure() is None:
                    out += (
                        [Reply("\r\n".join([*lines, ""]).encode("ascii"))] if (lines := self._answer(command)) else []
                    )
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def _end(self) -> list[bytes]:
        self.loaded[self._channel_of(self._arriving)] = self._arriving
        self._shine()
        return []

    def _shine(self) -> None:
        """Let the light path have the light that is there now."""
        self._light.set_leds({nm: self.shines(nm) for leds in LEDS.values() for nm in leds})

    def shines(self, nm: int) -> float:
        """Return the share 0..1 at which an LED gives light now."""
        letter = self._channel_of(nm)
        selected, on, percent = self.state[letter]
        moves = self._done_at is not None and self._channel_of(self._arriving) == letter
        return percent / 100.0 if (selected, on, self.loaded[letter], moves) == ("S", "N", nm, False) else 0.0

    @staticmethod
    def _channel_of(nm: int) -> str:
        return next(letter for letter, leds in LEDS.items() if nm in leds)

    def _answer(self, command: str) -> list[str]:
        """Return the lines of an answer; none to what it doesn't know."""
        known: dict[str, Callable[[], list[str]]] = {
            "XMODEL": lambda: ["XMODEL=pE-4000"],
            "LAMBDAS": lambda: [
                f"LAMBDA:{letter}{at}={nm}" for letter, leds in LEDS.items() for at, nm in enumerate(leds)
            ],
            "LAMS": lambda: [f"LAM:{letter}:{nm}" for letter, nm in self.loaded.items()],
            "PORT:P=ON": lambda: [command],
            "PORT:P=OFF": lambda: [command],
            "CSS?": lambda: [self._css()],
        }
        if command in known:
            return known[command]()
        if command.startswith("CSS"):
            return self._set(command[3:])
        if (match := re.fullmatch(r"LOAD:(\d{3})", command)) and any(int(match[1]) in leds for leds in LEDS.values()):
            if self._done_at is not None:
                self._end()
            self._arriving, self._done_at = int(match[1]), self.clock.now() + _LOAD_S
            self._shine()
            return [command]
        return []

    def _set(self, groups: str) -> list[str]:
        if not groups or _GROUP.sub("", groups) or any(int(percent) > 100 for *_, percent in _GROUP.findall(groups)):
            return []
        for letter, selected, on, percent in _GROUP.findall(groups):
            self.state[letter] = (selected, on if selected == "S" else "F", int(percent))
        self._shine()
        return [self._css()]

    def _css(self) -> str:
        states = (f"{letter}{selected}{on}{percent:03d}" for letter, (selected, on, percent) in self.state.items())
        return f"CSS{''.join(states)}"
