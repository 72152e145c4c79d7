"""A Cornerstone 260 monochromator on RS-232, as its manual describes it.

Every character is echoed. A statement ends with LF, a CR before it is ignored; a CR alone ends one too when the host
then says nothing. A statement waits until the motion before it has ended, except ABORT. An error sets the status byte
to 20 (hex) and the error number; STB? and the handshake clear the one, ERROR? both.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply

SYSTEM, NOT_UNDERSTOOD, BAD_PARAMETER, NOT_ALLOWED, NOT_PRESENT, ALREADY_THERE, NO_HOME, LABEL_TOO_LONG = (
    *(0, 1, 2, 3),
    *(6, 7, 8, 9),
)
_UPPER_NM = 1400.0
_NM_PER_S = 175.0
_NUMBER = r"([+-]?(?:\d+\.?\d*|\.\d+)(?:E[+-]?\d+)?)"


@dataclass
class _Grating:
    lines_per_mm: int
    label: str
    factor: float = 1.0
    offset: float = 0.0
    zero: float = 0.0

    @property
    def nm_per_step(self) -> float:
        return 30.0 / self.lines_per_mm


class _Cs260Refusal(Exception):
    """An error code of the instrument."""

    def __init__(self, code: int) -> None:
        self.code = code


@dataclass(frozen=True)
class _Done:
    """What a statement amounts to: a reply, or a motion that takes `seconds` and then has its effect."""

    reply: str | None = None
    seconds: float = 0.0
    effect: Callable[[], None] | None = None


class MockCornerstone260(Grammar):
    """The instrument; `light` feels its grating, slits, filter wheel and shutter."""

    fault_code = SYSTEM
    model = "Cornerstone 260 74125"

    def __init__(self, light: MeasuredLight, serial_number: str = "0427") -> None:
        super().__init__(light.clock)
        self._light = light
        self._serial_number = serial_number
        self._line = bytearray()
        self._waiting: deque[str] = deque()
        self._busy_until: float | None = None
        self._effect: Callable[[], None] | None = None
        self._status = 0
        self._error = 0
        self._handshake = False
        self._units = "NM"
        self._steps = 0
        self._from_steps = self._to_steps = 0
        self._calibration_nm = 0.0
        self._gratings = {1: _Grating(1200, "VIS"), 2: _Grating(600, "NIR")}
        self._grating = 1
        self._filter = 1
        self._filter_labels = {place: f"FILTER{place}" for place in range(1, 7)}
        self._shutter = "C"
        self._outport = 1
        self._slits_um = {1: 3000, 2: 3000, 3: 3000}

    # --- the line ---------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            out.append(bytes((value,)))
            if value == 0x0A:
                out += self._end_line()
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def quiet(self) -> list[bytes]:
        return self._end_line() if self._line.endswith(b"\r") else []

    @property
    def wait_s(self) -> float | None:
        return None if self._busy_until is None else max(0.0, self._busy_until - self.clock.now())

    def elapse(self) -> list[bytes]:
        if self._busy_until is None or self.clock.now() < self._busy_until:
            return []
        return [*self._end_motion(arrived=True), *self._run()]

    def _end_line(self) -> list[bytes]:
        statement = self._line.decode("latin-1").strip()
        self._line.clear()
        if not statement:
            return []
        if statement.upper() == "ABORT":
            return [*self._abort(), *self._run()]
        if len(self._waiting) < 100:
            self._waiting.append(statement)
        return self._run()

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting and self._busy_until is None:
            statement = self._waiting.popleft()
            try:
                done = self._execute(" ".join(statement.upper().split()), statement)
            except _Cs260Refusal as refusal:
                self._status, self._error = 0x20, refusal.code
                out += self._answer(None)
                continue
            if done.seconds > 0:
                self._busy_until = self.clock.now() + done.seconds
                self._effect = done.effect
            else:
                if done.effect is not None:
                    done.effect()
                out += self._answer(done.reply)
        return out

    def _answer(self, reply: str | None) -> list[bytes]:
        text = "" if reply is None else f"{reply}\r\n"
        if self._handshake:
            text += f"{self._status:02X}\r\n"
            self._status = 0
        return [Reply(text.encode("latin-1"))] if text else []

    def _abort(self) -> list[bytes]:
        self._waiting.clear()
        out = self._end_motion(arrived=False) if self._busy_until is not None else []
        return [*out, *self._answer(None)]

    def _end_motion(self, arrived: bool) -> list[bytes]:
        effect, self._effect, self._busy_until = self._effect, None, None
        if arrived and effect is not None:
            effect()
        return self._answer(None)

    # --- statements -------------------------------------------------------------------------------------------------

    def _execute(self, statement: str, as_sent: str) -> _Done:
        code = None if statement in {"ERROR?", "STB?"} else self._failure()
        if code is not None:
            raise _Cs260Refusal(code)
        for pattern, action in self._grammar:
            match = re.fullmatch(pattern, statement)
            if match:
                return action(self, *match.groups())
        name = re.match(r"[A-Z]+\d?[A-Z]*", statement)
        if name and name[0] in self._known:
            raise _Cs260Refusal(BAD_PARAMETER)
        label = re.fullmatch(r"(?i)\s*FILTER([1-6])LABEL\s+(.*\S)\s*", as_sent)
        if label:
            return self._set_label(int(label[1]), label[2])
        raise _Cs260Refusal(NOT_UNDERSTOOD)

    _known = (
        *("GOWAVE", "CALIBRATE", "STEP", "UNITS", "GRAT", "FILTER", "SHUTTER", "OUTPORT", "HANDSHAKE"),
        *(f"SLIT{n}MICRONS" for n in range(10)),
        *(f"GRAT{n}{what}" for n in range(10) for what in ("LINES", "FACTOR", "OFFSET", "ZERO")),
    )

    def _nm(self, text: str) -> float:
        value = float(text)
        if not math.isfinite(value):
            raise _Cs260Refusal(BAD_PARAMETER)
        if self._units == "WN":
            if value <= 0:
                raise _Cs260Refusal(BAD_PARAMETER)
            return 1e7 / value
        return value * 1000.0 if self._units == "UM" else value

    def _position_nm(self, steps: int) -> float:
        return steps * self._gratings[self._grating].nm_per_step + self._calibration_nm

    def _go_to_steps(self, steps: int) -> _Done:
        seconds = 0.05 + abs(self._position_nm(steps) - self._position_nm(self._steps)) / _NM_PER_S

        def arrive() -> None:
            self._steps = steps
            self._light.set_wavelength(min(_UPPER_NM, max(0.0, steps * self._gratings[self._grating].nm_per_step)))

        return _Done(seconds=seconds, effect=arrive)

    def _go_wave(self, text: str) -> _Done:
        wanted = self._nm(text)
        if not 0.0 <= wanted <= _UPPER_NM:
            raise _Cs260Refusal(NOT_ALLOWED)
        return self._go_to_steps(round((wanted - self._calibration_nm) / self._gratings[self._grating].nm_per_step))

    def _wave(self) -> _Done:
        nm = self._position_nm(self._steps)
        if self._units == "WN":
            return _Done(f"{1e7 / nm if nm > 0 else 0.0:.2f}")
        if self._units == "UM":
            return _Done(_plain(nm / 1000.0, 6))
        return _Done(_plain(nm, 3))

    def _step(self, text: str) -> _Done:
        if len(text) > 9:
            raise _Cs260Refusal(BAD_PARAMETER)
        steps = self._steps + int(text)
        if not 0.0 <= self._position_nm(steps) <= _UPPER_NM:
            raise _Cs260Refusal(BAD_PARAMETER)
        return self._go_to_steps(steps)

    def _calibrate(self, text: str) -> _Done:
        wanted = self._nm(text)
        if abs(wanted - self._position_nm(self._steps)) > 50.0:
            raise _Cs260Refusal(BAD_PARAMETER)
        self._calibration_nm += wanted - self._position_nm(self._steps)
        return _Done()

    def _set_units(self, text: str) -> _Done:
        self._units = text
        return _Done()

    def _set_grating(self, text: str) -> _Done:
        number = int(text)
        if number not in self._gratings:
            raise _Cs260Refusal(NOT_PRESENT if number == 3 else BAD_PARAMETER)
        nm = self._position_nm(self._steps)

        def arrive() -> None:
            self._grating = number
            self._steps = round((nm - self._calibration_nm) / self._gratings[number].nm_per_step)

        return _Done(seconds=0.0 if number == self._grating else 10.0, effect=arrive)

    def _grating_line(self) -> _Done:
        grating = self._gratings[self._grating]
        return _Done(f"{self._grating},{grating.lines_per_mm},{grating.label}")

    def _grating_entry(self, number: str, what: str) -> _Done:
        grating = self._grating_at(number)
        if what in {"LINES", "LABEL"}:
            return _Done(str(grating.lines_per_mm) if what == "LINES" else grating.label)
        return _Done(f"{getattr(grating, what.lower()):.6f}")

    def _set_grating_entry(self, number: str, what: str, text: str) -> _Done:
        grating = self._grating_at(number)
        value = float(text)
        if not math.isfinite(value) or (what == "LINES" and not 50 <= value <= 3600):
            raise _Cs260Refusal(BAD_PARAMETER)
        if what == "LINES":
            grating.lines_per_mm = int(value)
        else:
            setattr(grating, what.lower(), value)
        return _Done()

    def _grating_at(self, number: str) -> _Grating:
        if int(number) not in self._gratings:
            raise _Cs260Refusal(NOT_PRESENT)
        return self._gratings[int(number)]

    def _set_filter(self, text: str) -> _Done:
        place = int(text)
        if not 1 <= place <= 6:
            raise _Cs260Refusal(BAD_PARAMETER)
        if place == self._filter:
            raise _Cs260Refusal(ALREADY_THERE)
        turns = min((place - self._filter) % 6, (self._filter - place) % 6)

        def arrive() -> None:
            self._filter = place
            self._light.set_filter(place)

        return _Done(seconds=0.4 * turns, effect=arrive)

    def _label(self, place: str) -> _Done:
        return _Done(self._filter_labels[int(place)])

    def _set_label(self, place: int, label: str) -> _Done:
        if len(label) > 8:
            raise _Cs260Refusal(LABEL_TOO_LONG)
        self._filter_labels[place] = label
        return _Done()

    def _set_shutter(self, text: str) -> _Done:
        def arrive() -> None:
            self._shutter = text
            self._light.set_shutter(text == "O")

        return _Done(seconds=0.05, effect=arrive)

    def _set_outport(self, text: str) -> _Done:
        port = int(text)
        if port not in (1, 2):
            raise _Cs260Refusal(BAD_PARAMETER)
        if port == self._outport:
            raise _Cs260Refusal(ALREADY_THERE)

        def arrive() -> None:
            self._outport = port

        return _Done(seconds=2.0, effect=arrive)

    def _slit(self, number: str) -> _Done:
        return _Done(str(self._slit_at(number)))

    def _set_slit(self, number: str, text: str) -> _Done:
        self._slit_at(number)
        width_um = float(text)
        if not 4.0 <= width_um <= 3000.0:
            raise _Cs260Refusal(BAD_PARAMETER)
        before = self._slits_um[int(number)]

        def arrive() -> None:
            self._slits_um[int(number)] = round(width_um)
            if number == "1":
                self._light.set_slit_um(float(round(width_um)))

        return _Done(seconds=0.05 + abs(width_um - before) / 1000.0, effect=arrive)

    def _slit_at(self, number: str) -> int:
        if int(number) not in self._slits_um:
            raise _Cs260Refusal(NOT_PRESENT)
        return self._slits_um[int(number)]

    def _set_handshake(self, text: str) -> _Done:
        def arrive() -> None:
            self._handshake = text == "1"

        return _Done(effect=arrive)

    def _read_status(self) -> _Done:
        reply, self._status = f"{self._status:02X}", 0
        return _Done(reply)

    def _read_error(self) -> _Done:
        reply, self._status, self._error = str(self._error), 0, 0
        return _Done(reply)

    _grammar: tuple[tuple[str, Callable[..., _Done]], ...] = (
        (rf"GOWAVE {_NUMBER}", _go_wave),
        (r"WAVE\?", _wave),
        (r"STEP ([+-]?\d+)", _step),
        (r"STEP\?", lambda self: _Done(str(self._steps))),
        (rf"CALIBRATE {_NUMBER}", _calibrate),
        (r"UNITS (NM|UM|WN)", _set_units),
        (r"UNITS\?", lambda self: _Done(self._units)),
        (r"GRAT (\d)", _set_grating),
        (r"GRAT\?", _grating_line),
        (r"GRAT(\d)(LINES|LABEL|FACTOR|OFFSET|ZERO)\?", _grating_entry),
        (rf"GRAT(\d)(LINES|FACTOR|OFFSET|ZERO) {_NUMBER}", _set_grating_entry),
        (r"FILTER (\d)", _set_filter),
        (r"FILTER\?", lambda self: _Done(str(self._filter))),
        (r"FILTER([1-6])LABEL\?", _label),
        (r"SHUTTER (O|C)", _set_shutter),
        (r"SHUTTER\?", lambda self: _Done(self._shutter)),
        (r"OUTPORT (\d)", _set_outport),
        (r"OUTPORT\?", lambda self: _Done(str(self._outport))),
        (r"SLIT(\d)MICRONS\?", _slit),
        (rf"SLIT(\d)MICRONS {_NUMBER}", _set_slit),
        (r"HANDSHAKE ([01])", _set_handshake),
        (r"INFO\?", lambda self: _Done(f"{self.model} SN {self._serial_number}")),
        (r"STB\?", _read_status),
        (r"ERROR\?", _read_error),
    )


def _plain(value: float, digits: int) -> str:
    """Return a number without trailing zeros: 500, 500.025."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in {"", "-0"} else text
