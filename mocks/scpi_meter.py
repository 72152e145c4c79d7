"""A picoammeter after Keithley's 6485 with a photodiode in the light: SCPI, commands and answers end LF.

It begins with its input shorted (zero check): who doesn't switch that off reads nothing of the photodiode.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply
from sim.spectrum import FloatArray

#: Area of the diode (m2), solid angle (sr) under which it sees the light's surface, and its dark current (A).
AREA_M2, SOLID_ANGLE_SR, DARK_A = 1e-4, 0.1, 2e-12
NOISE_A = 1e-11
_RANGE_A = 0.02


def responsivity_a_per_w(wavelength_nm: FloatArray) -> FloatArray:
    """Return the responsivity (A/W) of a silicon photodiode, whose quantum efficiency falls off towards 300 nm and 1100
    nm.

    wavelength_nm : (m,)

    >>> responsivity_a_per_w(np.array([700.0])).round(2).tolist()
    [0.48]
    """
    efficiency = 0.85 / (1.0 + np.exp((wavelength_nm - 1050.0) / 25.0)) / (1.0 + np.exp((330.0 - wavelength_nm) / 20.0))
    return np.asarray(efficiency * wavelength_nm / 1239.84)


def calibration_csv(departure_percent: float = 0.8) -> str:
    """Return the calibration that came with the diode, as its driver reads it.

    departure_percent : by how much it is off, as real ones are

    >>> calibration_csv().splitlines()[0]
    'wavelength_nm,responsivity_a_per_w'
    """
    at = np.arange(300.0, 1101.0, 10.0)
    certified = responsivity_a_per_w(at) * (1.0 + departure_percent / 100.0 * np.sin(at / 180.0))
    return (
        "\n".join(
            ["wavelength_nm,responsivity_a_per_w", *(f"{w:.0f},{r:.6f}" for w, r in zip(at, certified, strict=True))]
        )
        + "\n"
    )


#: Long forms of the words that it knows.
_SHORT = {
    "SYSTEM": "SYST",
    "ZCHECK": "ZCH",
    "ERROR": "ERR",
    "CURRENT": "CURR",
    "RANGE": "RANG",
    "MEASURE": "MEAS",
    "CONFIGURE": "CONF",
    "FORMAT": "FORM",
    "ELEMENTS": "ELEM",
}
#: Bits of the standard event register (IEEE 488.2), and of the status byte: error queue, summary of the events.
_OPERATION_COMPLETE, _DEVICE_ERROR, _COMMAND_ERROR, _POWER_ON = 0x01, 0x08, 0x20, 0x80
_ERRORS_THERE, _EVENTS_THERE = 0x04, 0x20


def _short(command: str) -> str:
    """Return a command without its leading colon and the optional SENSE, each word in its short form."""
    head, space, argument = command.removeprefix(":").partition(" ")
    asks = "?" if head.endswith("?") else ""
    words = [_SHORT.get(word, word) for word in head.removesuffix("?").split(":")]
    if words[0] in ("SENS", "SENSE") and len(words) > 1:
        words = words[1:]
    return ":".join(words) + asks + space + argument


class MockScpiMeter(Grammar):
    """The meter; `light` is what the diode sees, `seed` that of its noise."""

    line_end = b"\n"
    fault_code = -310

    def __init__(self, light: MeasuredLight, serial_number: str = "1234567", seed: int = 6485) -> None:
        super().__init__(light.clock)
        self._light = light
        self._serial_number = serial_number
        self._rng = np.random.default_rng(seed)
        self._line = bytearray()
        self._errors: deque[str] = deque()
        self._events, self._events_enabled = _POWER_ON, 0
        self._zero_check = True
        self._waiting: deque[str] = deque()

    def receive(self, data: bytes) -> list[bytes]:
        for value in data:
            if value == 0x0A:
                command = self._line.decode("latin-1").strip().upper()
                self._line.clear()
                self._waiting.extend(filter(None, (part.strip() for part in command.split(";"))))
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return self._run()

    def _end(self) -> list[bytes]:
        return [Reply(self._reading()), *self._run()]

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting and self._done_at is None:
            answer = self._obey(self._waiting.popleft())
            if answer:
                out.append(Reply(answer))
        return out

    def _obey(self, command: str) -> bytes:
        command = _short(command)
        if command in ("SYST:ERR?", "SYST:ERR:NEXT?"):
            return (self._errors.popleft() if self._errors else '0,"No error"').encode() + b"\n"
        if (code := self._failure()) is not None:
            self._errors.append(f'{code},"System error"')
            self._events |= _DEVICE_ERROR
            return b""
        if command.startswith("*") and (answer := self._common(command)) is not None:
            return answer
        if command == "SYST:ZCH?":
            return b"%d\n" % self._zero_check
        if command.startswith("SYST:ZCH "):
            self._zero_check = command.endswith(("ON", "1"))
        elif command in ("READ?", "MEAS?", "MEAS:CURR?", "MEAS:CURR:DC?"):
            self._done_at = self.clock.now() + 0.1  # five cycles of the mains
        elif command not in (
            "RANG:AUTO ON",
            "CURR:RANG:AUTO ON",
            "CONF:CURR",
            "CONF:CURR:DC",
            "FORM:ELEM READ",
        ):
            self._errors.append('-113,"Undefined header"')
            self._events |= _COMMAND_ERROR
        return b""

    def _common(self, command: str) -> bytes | None:
        """Return the answer to a command that IEEE 488.2 asks of every instrument; None: it isn't one that is known."""
        events = self._events
        status = (_ERRORS_THERE if self._errors else 0) | (_EVENTS_THERE if events & self._events_enabled else 0)
        answers = {
            "*IDN?": f"KEITHLEY INSTRUMENTS INC.,MODEL 6485,{self._serial_number},B03",
            "*OPC?": "1",  # a reading is waited for before the next command is obeyed
            "*STB?": str(status),
            "*ESR?": str(events),
            "*ESE?": str(self._events_enabled),
            "*TST?": "0",
        }
        if command == "*CLS":
            self._errors.clear()
            self._events = 0
        elif command == "*ESR?":
            self._events = 0
        elif command == "*RST":
            self._zero_check = True
        elif command == "*OPC":
            self._events |= _OPERATION_COMPLETE
        elif command.startswith("*ESE ") and command[5:].strip().isdigit():
            self._events_enabled = int(command[5:]) & 0xFF
        elif command not in answers and command != "*WAI" and not command.startswith("*SRE "):
            return None
        return answers[command].encode() + b"\n" if command in answers else b""

    def _reading(self) -> bytes:
        current_a = 0.0 if self._zero_check else DARK_A + self._photocurrent()
        current_a += NOISE_A * float(self._rng.standard_normal())
        reading = current_a if abs(current_a) <= _RANGE_A else 9.9e37
        return f"{reading:+.6E}A,{self.clock.now() % 1e5:+.6E},{0:+.6E}\n".encode()

    def _photocurrent(self) -> float:
        """Area x solid angle x the integral of radiance x responsivity."""
        wavelength_nm = np.arange(340.0, 1100.5, 1.0)
        current_spectrum = self._light.radiance().at(wavelength_nm) * responsivity_a_per_w(wavelength_nm)
        return AREA_M2 * SOLID_ANGLE_SR * float(np.sum(current_spectrum))
