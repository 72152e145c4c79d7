"""Photo Research SpectraScan PR-655 and PR-670 in remote mode.

Nothing is answered until the characters PHOTO have come, in whatever pieces and with whatever line end, or none; Q
leaves remote mode at once. Commands end CR or LF, a pair of them counts once. Answers end CR LF and begin with a
quality code, 00000 if all is well. Data codes as in the maker's table. Before a spectrum stand two lines, or by the
manual (p. 127) one of five fields, with three-digit exponents: `dialect` chooses.
"""

from __future__ import annotations

import re

import numpy as np

from mocks.lamp import tristimulus
from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply
from sim.spectrum import PHOTON_ENERGY_J_NM, FloatArray

NOT_CONSTANT, OVERLOAD, CANNOT_SYNC, WEAK_LIGHT, SYNC, AUTO_SYNC, TIMED_OUT = -1, -2, -3, -8, -9, -10, -12
_BAD_COMMAND = -20
DIALECTS = ("two-lines", "one-line")
_OVERLOAD_CD_M2 = 1.0e5
_WEAKEST_CD_M2 = 1e-3


class PhotoResearch(Grammar):
    """The instrument; `model` is "PR-655" (4 nm) or "PR-670" (2 nm), `dialect` one of `DIALECTS`."""

    fault_code = WEAK_LIGHT

    def __init__(
        self,
        light: MeasuredLight,
        model: str = "PR-655",
        serial_number: str = "65501234",
        dialect: str = "two-lines",
    ) -> None:
        super().__init__(light.clock)
        if dialect not in DIALECTS:
            raise ValueError(f"no dialect {dialect!r}: there are {', '.join(DIALECTS)}")
        self.dialect = dialect
        self._light = light
        self._model = model
        self._serial_number = serial_number
        step_nm = 4.0 if model == "PR-655" else 2.0
        self._wavelength_nm: FloatArray = np.arange(380.0, 780.1, step_nm)
        self._remote = False
        self._echo = False
        self._line = bytearray()
        self._waiting: list[str] = []
        self._wanted = 0
        self._quality = 0
        self._spectrum: FloatArray | None = None
        self._xyz = (0.0, 0.0, 0.0)
        self._exposure_ms = 0.0
        self._sync = 0

    # --- the line ---------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if not self._remote:
                out += self._listen(value)
                continue
            if self._echo:
                out.append(bytes((value,)))
            if value in (0x0D, 0x0A):
                command = self._line.decode("latin-1").strip()
                self._line.clear()
                if command and len(self._waiting) < 100:
                    self._waiting.append(command)
                    out += self._run()
            elif value in b"Qq" and not self._line.strip():
                self._remote = self._echo = False
                self._line.clear()
                self._waiting.clear()
                self._done_at = None
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def _listen(self, value: int) -> list[bytes]:
        """Before remote mode only the five characters count."""
        self._line = self._line[-4:]
        self._line.append(value)
        if bytes(self._line).upper() != b"PHOTO":
            return []
        self._line.clear()
        self._remote = True
        return [Reply(b" REMOTE MODE\r\n")]

    def _end(self) -> list[bytes]:
        self._look()
        return [Reply(self._data(self._wanted)), *self._run()]

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting and self._done_at is None:
            answer = self._obey(self._waiting.pop(0).upper())
            if answer:
                out.append(Reply(answer))
        return out

    def _obey(self, command: str) -> bytes:
        answer = _quality(_BAD_COMMAND)
        if match := re.fullmatch(r"M(\d{1,3})", command):
            self._measure(int(match[1]))
            answer = b""
        elif match := re.fullmatch(r"D(\d{1,3})", command):
            code = self._failure()
            answer = _quality(code) if code is not None else self._data(int(match[1]))
        elif command in {"E", "C"}:
            self._echo ^= command == "E"
            self._quality *= command == "E"
            answer = b""
        elif command == "F":
            answer = b"0000,0.00 Hertz (Period = 0 milliseconds)\r\n"
        elif re.fullmatch(r"(?:I|B\d{1,3}|S[A-Z]?[-\d,.]*|L.{0,20})", command):
            if match := re.fullmatch(r"SS([013])", command):
                self._sync = int(match[1])
            answer = b"0000\r\n"
        return answer

    def _measure(self, code: int) -> None:
        """Begin a measurement that will answer with this data code. A dark source takes minutes."""
        self._quality = self._failure() or 0
        self._wanted = code
        luminance = tristimulus(self._light.radiance())[1]
        self._exposure_ms = float(np.clip(20_000.0 / max(luminance, 1e-9), 10.0, 60_000.0))
        self._done_at = self.clock.now() + 2.0 * self._exposure_ms / 1000.0 + 1.0

    # --- measuring --------------------------------------------------------------------------------------------------

    def _look(self) -> None:
        radiance = self._light.radiance()
        self._xyz = tristimulus(radiance)
        self._spectrum = radiance.at(self._wavelength_nm)
        if self._quality == 0 and self._xyz[1] > _OVERLOAD_CD_M2:
            self._quality = OVERLOAD
        elif self._quality == 0 and self._xyz[1] < _WEAKEST_CD_M2:
            self._quality = WEAK_LIGHT

    def _data(self, code: int) -> bytes:
        fixed = {110: self._serial_number, 111: self._model, 114: "1.19C", 601: self._settings()}
        fixed |= {112: "1", 115: "0", 116: "0", 117: "0", 120: "380,4,101", 200: "0", 401: "0", 602: self._settings()}
        if code in fixed:
            return f"00000,{fixed[code]}\r\n".encode("ascii")
        if code == 0:
            return _quality(self._quality)
        if self._quality or self._spectrum is None:
            return _quality(self._quality or WEAK_LIGHT)
        if code == 5:
            return self._spectral(self._spectrum)
        x, y, z = self._xyz
        total, uv = max(x + y + z, 1e-30), max(x + 15 * y + 3 * z, 1e-30)
        xy = f"{x / total:.4f},{y / total:.4f}"
        uv_1976 = f"{4 * x / uv:.4f},{9 * y / uv:.4f}"
        uv_1960 = f"{4 * x / uv:.4f},{6 * y / uv:.4f}"
        fields = {
            1: f"0,{y:.3e},{xy}",
            2: f"0,{x:.3e},{y:.3e},{z:.3e}",
            3: f"0,{y:.3e},{uv_1976}",
            4: f"0,{y:.3e},{_colour_temperature_k(x / total, y / total):.0f},0.0000",
            6: f"0,{y:.3e},{xy},{uv_1976}",
            7: f"0,{y:.3e},{uv_1960}",
            11: f"0,{y:.3e}",
            12: f"0,{y:.3e},{xy},{uv_1960}",
            13: f"Normal,{self._exposure_ms:.0f}",
            14: f"{'No Sync' if self._sync == 0 else 'Auto'},0",
        }
        return f"00000,{fields[code]}\r\n".encode("ascii") if code in fields else _quality(_BAD_COMMAND)

    def _settings(self) -> str:
        return f"0,-1,-1,-1,0,0,0,0,0,1,2,0,{self._sync},0,60.00"

    def _spectral(self, spectrum: FloatArray) -> bytes:
        peak_nm = float(self._wavelength_nm[int(np.argmax(spectrum))])
        power = float(np.trapezoid(spectrum, self._wavelength_nm))
        photons = float(np.trapezoid(spectrum * self._wavelength_nm / PHOTON_ENERGY_J_NM, self._wavelength_nm))
        if self.dialect == "one-line":
            lines = [f"00000,0,{_three_digits(0.0)},{power:.3e},{photons:.3e}"]
            lines += [f"{w:.0f},{_three_digits(v)}" for w, v in zip(self._wavelength_nm, spectrum, strict=True)]
            return ("\r\n".join(lines) + "\r\n").encode("ascii")
        lines = ["00000,0", f"{peak_nm:.0f},{power:.3e},{photons:.3e}"]
        lines += [f"{w:.0f},{v:.3e}" for w, v in zip(self._wavelength_nm, spectrum, strict=True)]
        return ("\r\n".join(lines) + "\r\n").encode("ascii")


def _three_digits(value: float) -> str:
    """Return a number of ten characters, its exponent of three digits: 1.234e-003."""
    mantissa, _, exponent = f"{value:.3e}".partition("e")
    return f"{mantissa}e{exponent[0]}{int(exponent[1:]):03d}"


def _quality(code: int) -> bytes:
    return b"%05d\r\n" % code


def _colour_temperature_k(x: float, y: float) -> float:
    """Correlated colour temperature by McCamy's cubic (Color Res. Appl. 17, 142, 1992); 0 far from the locus."""
    if abs(0.1858 - y) < 1e-6:
        return 0.0
    n = (x - 0.3320) / (0.1858 - y)
    kelvin = 449.0 * n**3 + 3525.0 * n**2 + 6823.3 * n + 5520.33
    return kelvin if 1000.0 < kelvin < 100_000.0 else 0.0
