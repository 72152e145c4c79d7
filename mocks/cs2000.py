"""Konica Minolta CS-2000: commands ended by CR or LF, answers ended CR LF.

MEAS,1      -> OK00,2      and once it is done   OK00
MEDR,1,0,1  -> OK00,1.234e-03,...   100 values; the fourth piece has 101
what        -> ER00

Outside remote mode nothing but RMTS and IDDR is heard. A measurement under way hears MEAS,0 alone and answers ER00 to
all else. Values have nine characters, by the length of the lines that a public client reads.
"""

from __future__ import annotations

import re

import numpy as np

from mocks.lamp import tristimulus
from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply

INVALID, OVER_RANGE, NO_DATA = 0, 10, 20


class MockCs2000(Grammar):
    """The instrument; it looks at `light` when a measurement ends."""

    fault_code = OVER_RANGE

    def __init__(self, light: MeasuredLight, serial_number: str = "10004711") -> None:
        super().__init__(light.clock)
        self._light = light
        self._serial_number = serial_number
        self._line = bytearray()
        self._remote = False
        self._failing: int | None = None
        self._values: list[str] = []

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if value in (0x0D, 0x0A):
                command = self._line.decode("latin-1").strip()
                self._line.clear()
                if command:
                    out.append(self._obey(command))
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def _end(self) -> list[bytes]:
        radiance = self._light.radiance()
        code = self._failing
        if code is None and tristimulus(radiance)[1] > 5e5:
            code = OVER_RANGE
        if code is not None:
            return [_error(code)]
        self._values = [f"{value:.3e}" for value in radiance.at(np.arange(380.0, 780.5))]
        return [_ok()]

    def _obey(self, command: str) -> Reply:
        code = self._failure()
        if command in {"MEAS,0", "MEAS,1"} and self._remote:
            return self._measure(command == "MEAS,1", code)
        if code is None and self._done_at is not None:
            code = INVALID
        return self._tell(command) if code is None else _error(code)

    def _measure(self, begin: bool, code: int | None) -> Reply:
        if not begin:
            self._done_at = None
            return _ok()
        if self._done_at is not None:
            return _error(INVALID)
        self._failing, self._values = code, []
        luminance = tristimulus(self._light.radiance())[1]
        seconds = round(float(np.clip(40.0 / max(luminance, 1e-9), 2.0, 240.0)))
        self._done_at = self.clock.now() + seconds
        return _ok(str(seconds))

    def _tell(self, command: str) -> Reply:
        if command == "IDDR":
            return _ok("CS-2000", "0", self._serial_number)
        if match := re.fullmatch(r"RMTS,([01])", command):
            self._remote = match[1] == "1"
            return _ok()
        if (match := re.fullmatch(r"MEDR,1,0,0?([1-4])", command)) and self._remote:
            first = 100 * (int(match[1]) - 1)
            piece = self._values[first : first + (101 if first == 300 else 100)]
            return _ok(*piece) if piece else _error(NO_DATA)
        return _error(INVALID)


def _ok(*fields: str) -> Reply:
    return Reply(",".join(("OK00", *fields)).encode("latin-1") + b"\r\n")


def _error(code: int) -> Reply:
    return Reply(b"ER%02d\r\n" % code)
