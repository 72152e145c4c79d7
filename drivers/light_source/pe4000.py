"""CoolLED pE-4000 on its USB serial port: a tunable light source, sixteen LEDs behind four channels (A to D).

Commands end CR, answers CR LF. `XMODEL` -> `XMODEL=pE-4000`; `LAMBDAS` -> a line `LAMBDA:A0=365` for each LED;
`LAMS` -> `LAM:A:365`, the LED that is loaded in each channel; `LOAD:385` loads another; `CSS?` ->
`CSSASN050BXF000CSF100DXF020`: each channel with S (selected) or X, N (on) or F, and its intensity in percent; the same
without `?` sets channels. One that isn't selected gives no light; one that is selected and off gives it while its TTL
input is high. Sources: the maker's device adapter in Micro-Manager (pE4000.cpp, 2017), and public clients written after
its Commands Manual, DOC-038. Unverified: LAMBDAS, and what LOAD is answered: LAMS is asked until it tells the LED.
"""

from __future__ import annotations

import math
import re
import time
from dataclasses import dataclass
from typing import Self

from drivers.errors import Garbled, InstrumentError, NoAnswer
from drivers.found_settings import FoundSettings
from drivers.instrument import Identity, Recorder, Setting
from drivers.light_source.base import LightSource
from drivers.transport import Transport, WireInstrument, shown

_LETTERS = "ABCD"
_STATE = re.compile(r"([A-H])([SX])([NF])(\d{3})")
#: LEDs that a channel holds.
_HELD = 4
#: Lines that may come before an answer: a greeting, and reports by itself.
_STALE_LINES = 24
_LOOK_S = 0.1


@dataclass(frozen=True)
class _Channel:
    """A channel as CSS tells it: selected or not, on or off, intensity (percent)."""

    selected: bool
    on: bool
    percent: int

    @property
    def shines(self) -> bool:
        return self.selected and self.on and self.percent > 0

    def __str__(self) -> str:
        return f"{'S' if self.selected else 'X'}{'N' if self.on else 'F'}{self.percent:03d}"

    @classmethod
    def of(cls, selected: str, on: str, percent: str) -> Self:
        return cls(selected == "S", on == "N", int(percent))


class Pe4000(WireInstrument, LightSource):
    """A CoolLED pE-4000; its channels are its LEDs, by their wavelength (nm).

    Of four LEDs that share a channel one can be lit at a time: to light another is refused until the first is dark.
    `load_timeout_s`: longest time until an LED is loaded.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 2.0,
        load_timeout_s: float = 10.0,
        baudrate: int = 57600,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(Transport(address, "pE-4000", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder))
        self.load_timeout_s = load_timeout_s
        self._identity = Identity("CoolLED", "pE-4000")
        self._leds: dict[str, str] = {}  # the channel's letter by the LED's wavelength
        self._found = FoundSettings(f"light_source-{address}", self._transport.name)

    # --- the abstraction ----------------------------------------------------------------------------------------------

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def channels(self) -> tuple[str, ...]:
        with self._conversation():
            return tuple(self._leds)

    def level(self, channel: str | None = None) -> float:
        with self._conversation():
            led, letter = self._led(channel)
            state = self._states()[letter]
            return state.percent / 100.0 if state.shines and self._read_loaded()[letter] == led else 0.0

    def set_level(self, level: float, channel: str | None = None) -> None:
        if not (math.isfinite(level) and 0.0 <= level <= 1.0):
            raise InstrumentError(
                f"{self._transport.name}: a level of {level} is outside 0..1; ask for a share of its brightest"
            )
        with self._conversation():
            led, letter = self._led(channel)
            percent, state, loaded = round(100.0 * level), self._states()[letter], self._read_loaded()[letter]
            if loaded != led:
                if percent == 0:
                    return
                if state.shines:
                    raise InstrumentError(
                        f"{self._transport.name}: {led} nm shares channel {letter} with {loaded} nm, which is lit at "
                        f"{state.percent} %; set that to 0 first"
                    )
            self._note(letter, loaded, state)
            if loaded != led:
                self._load(letter, led)
            self._set({letter: _Channel(percent > 0, percent > 0, percent)})

    def settings(self) -> dict[str, Setting]:
        with self._conversation():
            states, loaded = self._states(), self._read_loaded()
            return {
                f"level_{led}_nm": states[letter].percent / 100.0 if states[letter].shines else 0.0
                for letter, led in loaded.items()
            }

    # --- the wire -----------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        self._transport.write(b"\r")  # ends half a command that an earlier host left behind
        self._transport.drain(quiet_s=0.05)  # it greets whoever opens the port
        model = self._ask("XMODEL", "XMODEL")[0].partition("=")[2].strip()
        if "pE-4000" not in model:
            raise self._strange("XMODEL", model)
        self._identity = Identity("CoolLED", model)
        self._leds = {}
        for line in self._ask("LAMBDAS", "LAMBDA:", _HELD * len(_LETTERS)):
            match = re.fullmatch(r"LAMBDA:([A-D])\d=(\d*)", line)
            if match is None:
                raise self._strange("LAMBDAS", line)
            if match[2]:
                self._leds[match[2]] = match[1]
        if not self._leds:
            raise InstrumentError(f"{self._transport.name}: it tells no LED; look whether any is fitted")
        self._restore()  # what a process that was killed, or an unplugged lamp, left changed

    def _make_safe(self) -> None:
        """Dark, whatever its TTL inputs say."""
        states = self._states()
        lit = {letter: state for letter, state in states.items() if state.selected}
        if lit:
            loaded = self._read_loaded()
            for letter, state in lit.items():
                self._note(letter, loaded[letter], state)
            self._set({letter: _Channel(False, False, state.percent) for letter, state in lit.items()})

    def _make_safe_for_good(self) -> InstrumentError | None:
        """Leave it as it was found: where another lit it, it shines on."""
        self._transport.interrupt()
        with self._lock:
            self._transport.resume()
            if not self._found:
                return None
            try:
                with self._conversation():
                    self._restore()
            except InstrumentError as error:
                return InstrumentError(f"{error}; it may be lit still: switch it off by hand")
        return None

    def _note(self, letter: str, loaded: str, state: _Channel) -> None:
        self._found.note(letter, f"{loaded} {state}")

    def _restore(self) -> None:
        for letter, kept in self._found.last_first():
            led, _, state = str(kept).partition(" ")
            if self._read_loaded()[letter] != led:
                self._set({letter: _Channel(False, False, 0)})
                self._load(letter, led)
            self._set({letter: _Channel.of(state[0], state[1], state[2:])})
            self._found.forget(letter)

    def _led(self, channel: str | None) -> tuple[str, str]:
        """Return an LED's wavelength and its channel's letter; None: the first LED."""
        led = next(iter(self._leds)) if channel is None else channel
        if led not in self._leds:
            raise InstrumentError(f"{self._transport.name}: no channel {led!r}; it has {', '.join(self._leds)}")
        return led, self._leds[led]

    def _states(self) -> dict[str, _Channel]:
        (answer,) = self._ask("CSS?", "CSS")
        states = {match[1]: _Channel.of(match[2], match[3], match[4]) for match in _STATE.finditer(answer[3:])}
        if not set(_LETTERS) <= set(states) or len(answer) != 3 + 6 * len(states):
            raise self._strange("CSS?", answer)
        return {letter: states[letter] for letter in _LETTERS}

    def _read_loaded(self) -> dict[str, str]:
        """Return the LED that is loaded in each channel, by its wavelength (nm)."""
        loaded: dict[str, str] = {}
        for line in self._ask("LAMS", "LAM:", len(_LETTERS)):
            match = re.fullmatch(r"LAM:([A-D]):(\d+)", line)
            if match is None:
                raise self._strange("LAMS", line)
            loaded[match[1]] = match[2]
        if len(loaded) != len(_LETTERS):
            raise self._strange("LAMS", str(loaded))
        return loaded

    def _set(self, wanted: dict[str, _Channel]) -> None:
        """Set channels and read them back."""
        command = "CSS" + "".join(f"{letter}{state}" for letter, state in wanted.items())
        self._ask(command, "CSS")
        states = self._states()
        for letter, state in wanted.items():
            if states[letter] != state:
                raise InstrumentError(
                    f"{self._transport.name}: channel {letter} was set to {letter}{state} and reads {states[letter]}; "
                    "check the lamp"
                )

    def _load(self, letter: str, led: str) -> None:
        self._ask(f"LOAD:{led}", "LOAD")
        until = time.monotonic() + self.load_timeout_s
        while self._read_loaded()[letter] != led:
            if time.monotonic() > until:
                raise NoAnswer(
                    f"{self._transport.name}: {led} nm isn't loaded within {self.load_timeout_s:g} s; listen whether "
                    "it moves, or state load_timeout_s"
                )
            self._transport.pause(_LOOK_S, f"LOAD:{led}")

    def _ask(self, command: str, begins: str, lines: int = 1) -> list[str]:
        """Return the lines of an answer, which begin with a word; what else comes before them is no answer."""
        self._transport.write(command.encode("ascii") + b"\r")
        answers: list[str] = []
        for _ in range(_STALE_LINES + lines):
            line = self._transport.read_until(b"\r\n", asked=command).decode("latin-1").strip()
            if line.startswith(begins):
                answers.append(line)
            if len(answers) == lines:
                return answers
        raise self._strange(command, line)

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer.encode('latin-1'))}; check that a pE-4000 "
            "is at this address and nothing else talks to it"
        )
