"""A Spectral Products CM110 on RS-232: commands and answers in bytes, without ends of lines.

27        -> 27
56 n      -> two bytes, the status, 24
16 hi lo  -> the status, 24; then it moves, and hears what was sent meanwhile when it stands

The status is the units (0 um, 1 nm, 2 Angstrom), with 128 where it refuses, and 32 where the value was too small. What
its sources leave open is chosen by arguments: `late_status` answers 16 when the grating stands, `ended_echo` sends 24
after 27, too.
"""

from __future__ import annotations

from mocks.wire import Grammar, MeasuredLight, Reply

ECHO, GOTO, UNITS, QUERY, END = 27, 16, 50, 56, 24
REFUSED, TOO_SMALL = 0x80, 0x20
_UPPER_NM, _NM_PER_S = 1400.0, 175.0
#: Units of each code in one nm.
_PER_NM = {0: 1e-3, 1: 1.0, 2: 10.0}
#: Bytes after each command that has any.
_PARAMETERS = {GOTO: 2, UNITS: 1, QUERY: 1, 18: 2, 13: 2, 12: 4, 26: 1, 51: 1, 52: 1, 55: 1, 255: 2}
_LONGEST_WAIT = 4096


class MockCm110(Grammar):
    """The instrument; `light` feels its grating."""

    line_end = bytes((END,))
    fault_code = REFUSED

    def __init__(
        self,
        light: MeasuredLight,
        serial_number: int = 11042,
        *,
        late_status: bool = False,
        ended_echo: bool = False,
        units: int = 1,
    ) -> None:
        super().__init__(light.clock)
        self._light = light
        self._serial_number = serial_number
        self._late_status, self._ended_echo = late_status, ended_echo
        self._heard = bytearray()
        self._nm = self._wanted_nm = 0.0
        self.units = units

    def receive(self, data: bytes) -> list[bytes]:
        self._heard += data[: _LONGEST_WAIT - len(self._heard)]
        return self._run()

    def _end(self) -> list[bytes]:
        self._nm = self._wanted_nm
        self._light.set_wavelength(self._nm)
        return [*([self._status()] if self._late_status else []), *self._run()]

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._heard and self._done_at is None:
            length = 1 + _PARAMETERS.get(self._heard[0], 0)
            if len(self._heard) < length:
                break
            command = bytes(self._heard[:length])
            del self._heard[:length]
            out += self._obey(command)
        return out

    def _obey(self, command: bytes) -> list[bytes]:
        code = self._failure()
        if command[0] == ECHO:
            return [Reply(bytes((ECHO, END) if self._ended_echo else (ECHO,)))]
        if code is not None:
            return [self._status(code)]
        if command[0] == QUERY:
            return self._tell(command[1])
        if command[0] == UNITS and command[1] in _PER_NM:
            self.units = command[1]
            return [self._status()]
        if command[0] == GOTO:
            return self._go(int.from_bytes(command[1:], "big") / _PER_NM[self.units])
        return [self._status(REFUSED)]

    def _go(self, nm: float) -> list[bytes]:
        if nm > _UPPER_NM:
            return [self._status(REFUSED)]
        self._wanted_nm = nm
        self._done_at = self.clock.now() + 0.05 + abs(nm - self._nm) / _NM_PER_S
        return [] if self._late_status else [self._status()]

    def _tell(self, what: int) -> list[bytes]:
        known = {
            0: round(self._nm * _PER_NM[self.units]),
            2: 1200,
            3: 500,
            4: 1,
            13: 2,
            14: self.units,
            19: self._serial_number,
        }
        if what not in known:
            return [self._status(REFUSED)]
        return [Reply(known[what].to_bytes(2, "big") + self._status())]

    def _status(self, more: int = 0) -> Reply:
        return Reply(bytes(((more | self.units) & 0xFF, END)))
