"""Colorimetry Research CR-300 (and CR-250): case-sensitive commands ended by CR or LF, answers ended CR LF.

M            -> OK:0:M:No errors
RM Spectrum  -> OK:0:RM Spectrum:380.0,780.0,2.0,201   and one value a line
what         -> ER:-500:Invalid command:what
"""

from __future__ import annotations

import re

import numpy as np

from mocks.lamp import tristimulus
from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply
from sim.spectrum import FloatArray

INVALID_COMMAND, INVALID_VALUE, TOO_LOW, TOO_HIGH, NOTHING_MEASURED = -500, -519, -304, -306, -305
_MEANING = {
    INVALID_COMMAND: "Invalid command",
    INVALID_VALUE: "Invalid exposure value",
    TOO_LOW: "MeasuredLight intensity too low",
    TOO_HIGH: "MeasuredLight intensity too high",
    NOTHING_MEASURED: "MeasuredLight intensity unmeasurable",
}
_SPEEDS = ("slow", "normal", "fast", "2x fast")


class ColorimetryResearch(Grammar):
    """The instrument; `model` is "CR-300" or "CR-250", `step_nm` 2 or 4, by default that of the model."""

    fault_code = TOO_LOW

    def __init__(
        self,
        light: MeasuredLight,
        model: str = "CR-300",
        serial_number: str = "A00427",
        step_nm: float | None = None,
    ) -> None:
        super().__init__(light.clock)
        self._light = light
        self._model = model
        self._serial_number = serial_number
        self._step_nm = step_nm or (2.0 if model == "CR-300" else 4.0)
        self._wavelength_nm: FloatArray = np.arange(380.0, 780.1, self._step_nm)
        self._echo = False
        self._line = bytearray()
        self._waiting: list[str] = []
        self._failing: int | None = None
        self._spectrum: FloatArray | None = None
        self._xyz = (0.0, 0.0, 0.0)
        self._exposure_ms = 100.0
        self._settings = {"Speed": 1, "ExposureMode": 0, "ExposureX": 1, "Exposure": 100, "SyncMode": 0, "SyncFreq": 60}

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for value in data:
            if self._echo:
                out.append(bytes((value,)))
            if value in (0x0D, 0x0A):
                command = self._line.decode("latin-1").strip()
                self._line.clear()
                if command and len(self._waiting) < 100:
                    self._waiting.append(command)
                    out += self._run()
            elif len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def _end(self) -> list[bytes]:
        code = self._failing
        if code is None:
            radiance = self._light.radiance()
            self._xyz = tristimulus(radiance)
            self._spectrum = radiance.at(self._wavelength_nm)
            code = TOO_HIGH if self._xyz[1] > 5e4 else TOO_LOW if self._xyz[1] < 1e-3 else None
        answer = _error(code, "M") if code is not None else _ok("M", "No errors")
        return [answer, *self._run()]

    def _run(self) -> list[bytes]:
        out: list[bytes] = []
        while self._waiting and self._done_at is None:
            answer = self._obey(self._waiting.pop(0))
            if answer:
                out.append(answer)
        return out

    def _obey(self, command: str) -> Reply | None:
        code = self._failure()
        if command == "M":
            self._failing = code
            luminance = tristimulus(self._light.radiance())[1]
            self._exposure_ms = float(np.clip(1e4 / max(luminance, 1e-9), 5.0, 30_000.0))
            self._done_at = self.clock.now() + 2 * self._settings["ExposureX"] * self._exposure_ms / 1000.0
            return None
        if code is not None:
            return _error(code, command)
        if command == "E":
            self._echo = not self._echo
            return None
        if match := re.fullmatch(r"SM (\w+) (-?\d{1,7})", command):
            return self._set(command, match[1], int(match[2]))
        if match := re.fullmatch(r"R[CSM] \w+", command):
            return self._get(command)
        return _error(INVALID_COMMAND, command)

    def _set(self, command: str, name: str, value: int) -> Reply:
        if name not in self._settings:
            return _error(INVALID_COMMAND, command)
        if value < 0 or (name == "Speed" and value >= len(_SPEEDS)) or (name == "ExposureX" and not 1 <= value <= 50):
            return _error(INVALID_VALUE, command)
        self._settings[name] = value
        return _ok(f"SM {name}", "No errors")

    def _get(self, command: str) -> Reply:
        answers = {
            "RC ID": self._serial_number,
            "RC Model": self._model,
            "RC Firmware": "1.23",
            "RC InstrumentType": "2",
            "RS Speed": _SPEEDS[self._settings["Speed"]],
            "RS Aperture": "2 deg",
            **{f"RS {name}": str(value) for name, value in self._settings.items() if name != "Speed"},
            "RS Exposure": f"{self._settings['Exposure']} msec",
            "RS SyncFreq": f"{self._settings['SyncFreq']:.2f} Hz",
            "RM Warnings": "0",
        }
        if command in answers:
            return _ok(command, answers[command])
        if command not in {
            "RM Spectrum",
            "RM XYZ",
            "RM Y",
            "RM xy",
            "RM Exposure",
            "RM Radiometric",
            "RM X",
            "RM XYZ10",
        }:
            return _error(INVALID_COMMAND, command)
        if self._spectrum is None:
            return _error(NOTHING_MEASURED, command)
        x, y, z = self._xyz
        total = max(x + y + z, 1e-30)
        if command == "RM Spectrum":
            values = "".join(f"\r\n{value:.3e}" for value in self._spectrum)
            first_nm, last_nm = self._wavelength_nm[0], self._wavelength_nm[-1]
            return _ok(command, f"{first_nm:.1f},{last_nm:.1f},{self._step_nm:.1f},{len(self._spectrum)}{values}")
        measured = {
            "RM XYZ": f"{x:.4e},{y:.4e},{z:.4e}",
            "RM XYZ10": f"{x:.4e},{y:.4e},{z:.4e}",  # close enough for a mock: it knows the 2 degree functions alone
            "RM X": f"{x:.4e}",
            "RM Y": f"{y:.4e}",
            "RM xy": f"{x / total:.4f},{y / total:.4f}",
            "RM Exposure": f"{self._exposure_ms:.3f} msec",
            "RM Radiometric": f"{float(np.trapezoid(self._spectrum, self._wavelength_nm)):.3e}",
        }
        return _ok(command, measured[command])


def _ok(command: str, text: str) -> Reply:
    return Reply(f"OK:0:{command}:{text}\r\n".encode("latin-1"))


def _error(code: int, command: str) -> Reply:
    return Reply(f"ER:{code}:{_MEANING.get(code, 'Error')}:{command}\r\n".encode("latin-1"))
