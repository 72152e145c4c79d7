"""A JETI specbos 1211 on its serial line.

Commands end CR; letter case doesn't matter, an LF is passed over. A setting is answered by ACK or NAK, a query by one
line, `*init` by ACK and later BEL, or NAK if the measurement failed; after a NAK `*stat:err?` tells the number. What it
doesn't understand, probes for other instruments included, it answers by NAK.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable

import numpy as np

from mocks.lamp import tristimulus
from mocks.wire import LONGEST_LINE, Grammar, MeasuredLight, Reply
from sim.spectrum import Spectrum

ETX, ACK, BEL, NAK, ESCAPE = b"\x03", b"\x06", b"\x07", b"\x15", 0x1B
COMMAND, PARAMETER, CONFIGURATION, CONTROL, FETCH, MEASURE = 4, 20, 21, 22, 24, 25
OVER_EXPOSED, UNDER_EXPOSED, NOTHING_MEASURED, OUT_OF_RANGE, BROKEN_OFF = 120, 121, 138, 141, 147
#: Radiance x integration time (W s sr^-1 m^-2 nm^-1) at which the detector is full.
_FULL = 6e-4
_SHORTEST_MS = 1.0
#: Settings and what they may be: lower end, upper end, value after `*conf:default`.
_SETTINGS: dict[str, tuple[float, float, float]] = {
    "calibn": (0, 3, 0),
    "expo": (0, 2, 1),
    "adap": (0, 2, 2),
    "maxtin": (1, 65000, 60000),
    "tint": (0, 65000, 100),
    "func": (0, 15, 6),
    "form": (0, 12, 4),
    "aver": (1, 1000, 1),
    "cycmod": (0, 1, 0),
    "cyctim": (0, 1e9, 0),
    "splitt": (0, 65000, 1000),
    "maxaver": (2, 1000, 2),
    "syncmod": (0, 1, 0),
    "syncfreq": (0, 1e4, 0),
}


class _SpecbosRefusal(Exception):
    """An error code of the instrument."""

    def __init__(self, code: int) -> None:
        self.code = code


class MockSpecbos1211(Grammar):
    """The instrument; it looks at `light` when a measurement ends."""

    line_end = b"\r"
    fault_code = OVER_EXPOSED

    def __init__(
        self,
        light: MeasuredLight,
        serial_number: str = "1211427",
        model: str = "specbos 1211",
        calibrated_nm: tuple[float, float] = (350.0, 1000.0),
        told_nm: tuple[float, float] | None = None,
    ) -> None:
        """`told_nm`: the range that it says it measures, where that isn't the one for which it is calibrated."""
        super().__init__(light.clock)
        self._model = model
        self._is_spectraval = model.startswith("spectraval")
        self._calibrated_nm = calibrated_nm
        self._told_nm = told_nm or calibrated_nm
        self._light = light
        self._serial_number = serial_number
        self._line = bytearray()
        self._later = bytearray()
        self._error = 0
        self._laser = 0
        self._settings: dict[str, float] = {}
        self._range_nm = self._whole_range()
        self._default()
        self._planned_failure: int | None = None
        self._measured: Spectrum | None = None
        self._measured_tint_ms = 0.0

    # --- the line ---------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        todo = deque(data)
        while todo:
            value = todo.popleft()
            if self._done_at is not None:
                if value == ESCAPE:
                    self._done_at = None
                    self._error = BROKEN_OFF
                    out.append(Reply(NAK))
                    todo.extendleft(reversed(self._take_later()))
                elif len(self._later) < 8 * LONGEST_LINE:
                    self._later.append(value)
                continue
            if value == 0x0D:
                command = self._line.decode("latin-1").strip()
                self._line.clear()
                if command:
                    out += self._obey(command)
            elif value not in (0x0A, ESCAPE) and len(self._line) < LONGEST_LINE:
                self._line.append(value)
        return out

    def _end(self) -> list[bytes]:
        try:
            self._look()
            answer = Reply(BEL)
        except _SpecbosRefusal as refusal:
            self._error = refusal.code
            answer = Reply(NAK)
        return [answer, *self.receive(bytes(self._take_later()))]

    def _take_later(self) -> bytearray:
        later, self._later = self._later, bytearray()
        return later

    def _obey(self, command: str) -> list[bytes]:
        words = " ".join(command.lower().split())
        try:
            for pattern, action in self._grammar:
                match = re.fullmatch(pattern, words)
                if match:
                    return [Reply(self._answer(words, action, match.groups()))]
        except _SpecbosRefusal as refusal:
            self._error = refusal.code
            return [Reply(NAK)]
        self._error = COMMAND
        return [Reply(NAK)]

    def _answer(self, words: str, action: Callable[..., bytes], arguments: tuple[str | None, ...]) -> bytes:
        if words != "*stat:err?" and not words.startswith(("*init", "*meas")):
            code = self._failure()
            if code is not None:
                raise _SpecbosRefusal(code)
        return action(self, *arguments)

    # --- commands ---------------------------------------------------------------------------------------------------

    def _identify(self) -> bytes:
        return {
            "specbos 1211": b"JETI_SB1211\r",
            "specbos 1201": b"SB05\r",
            "spectraval 1501": b"JETI_SDCM3 1501427\r",
            "spectraval 1511": b"JETI_SDCM3 1511427\r",
        }[self._model]

    def _version(self) -> bytes:
        return b"1.8.3\r" if self._model == "specbos 1201" else b"V2.1.4\r"

    def _last_error(self) -> bytes:
        code, self._error = self._error, 0
        return self._label_answer("Error Code: ", f"{code}")

    def _label_answer(self, label: str, value: str) -> bytes:
        """Return an answer: a spectraval tells the value alone."""
        return f"{'' if self._is_spectraval else label}{value}\r".encode("ascii")

    def _default(self) -> bytes:
        self._settings = {name: default for name, (_, _, default) in _SETTINGS.items()}
        self._range_nm = self._whole_range()
        return ACK

    def _whole_range(self) -> tuple[float, float, float]:
        """Return a specbos begins with the visible, a spectraval with all that it measures."""
        return (*self._calibrated_nm, 1.0) if self._is_spectraval else (380.0, 780.0, 1.0)

    def _save(self) -> bytes:
        return ACK

    def _set(self, tree: str, name: str, text: str) -> bytes:
        wrong = PARAMETER if tree.startswith("para") else CONFIGURATION
        if name == "wran":
            numbers = [_number(word, wrong) for word in text.split()]
            if len(numbers) != 3 or not 0 < numbers[0] < numbers[1] or not 0.5 <= numbers[2] <= 100:
                raise _SpecbosRefusal(wrong)
            self._range_nm = (numbers[0], numbers[1], numbers[2])
            return ACK
        if name == "maxtint" and self._is_spectraval:
            name = "maxtin"
        # Firmware of the 1201 up to 1.8.3 doesn't know maxtin; a spectraval has its settings under para alone.
        if name not in _SETTINGS or (name == "maxtin" and self._model == "specbos 1201"):
            raise _SpecbosRefusal(COMMAND)
        if self._is_spectraval and tree.startswith("conf"):
            raise _SpecbosRefusal(COMMAND)
        lower, upper, _ = _SETTINGS[name]
        value = _number(text, wrong)
        if not lower <= value <= upper:
            raise _SpecbosRefusal(wrong)
        self._settings[name] = value
        return ACK

    def _get(self, tree: str, name: str) -> bytes:
        first_nm, last_nm, step_nm = self._range_nm
        if self._is_spectraval and tree.startswith("conf"):  # of its hardware: a display, Bluetooth
            if name not in ("dispen", "bten"):
                raise _SpecbosRefusal(COMMAND)
            return b"%d\r" % (name == "dispen" and self._model == "spectraval 1511")
        if name == "wavbeg":
            return b"Predefined start wave: %.1f\r" % self._told_nm[0]
        if name == "wavend":
            return b"Predefined end wave: %.1f\r" % self._told_nm[1]
        if name == "spnum":
            return self._label_answer("spectrometer number: ", self._serial_number)
        if name == "wran":
            return self._label_answer("wran: ", f"{first_nm:.0f} {last_nm:.0f} {step_nm:.0f}")
        if name in _SETTINGS:
            return self._label_answer(f"{name}: ", f"{self._settings[name]:g}")
        raise _SpecbosRefusal(COMMAND)

    def _head(self) -> bytes:
        return b"mhead: 0\r"

    def _laser_state(self) -> bytes:
        return self._label_answer("laser: ", f"{self._laser}")

    def _set_laser(self, text: str) -> bytes:
        self._laser = int(text)
        return ACK

    def _cycle_time(self) -> bytes:
        return b"cyctim[ms]: 0.000\r"  # the light is steady

    def _init(self) -> bytes:
        self._planned_failure = self._failure()
        seconds = int(self._settings["aver"]) * 2.0 * self._integration_ms() / 1000.0 + 0.5
        self._done_at = self.clock.now() + seconds
        return ACK

    def _adapts(self) -> bool:
        """Return whether it chooses its integration time: a spectraval does where it is set to 0."""
        return self._settings["tint"] == 0 if self._is_spectraval else self._settings["expo"] == 1

    def _integration_ms(self) -> float:
        if not self._adapts():
            return max(_SHORTEST_MS, self._settings["tint"])
        peak = max(self._light.radiance().value)
        longest_ms = self._settings["maxtin"]
        best_ms = 0.8e3 * _FULL / peak if peak > 0 else math.inf
        return max(_SHORTEST_MS, min(longest_ms, best_ms))

    def _look(self) -> None:
        if self._planned_failure is not None:
            raise _SpecbosRefusal(self._planned_failure)
        first_nm, last_nm, step_nm = self._range_nm
        if first_nm < self._calibrated_nm[0] or last_nm > self._calibrated_nm[1]:
            raise _SpecbosRefusal(OUT_OF_RANGE)
        tint_ms = self._integration_ms()
        radiance = self._light.radiance()
        filled = max(radiance.value) * tint_ms * 1e-3 / _FULL
        if filled > 1.0:
            raise _SpecbosRefusal(OVER_EXPOSED)
        if not self._adapts() and filled < 1e-4:
            raise _SpecbosRefusal(UNDER_EXPOSED)
        wavelength_nm = np.arange(first_nm, last_nm + step_nm / 1000.0, step_nm)
        self._measured = Spectrum.of(wavelength_nm, radiance.at(wavelength_nm))
        # A later measurement without adaptation integrates as long as this one.
        self._measured_tint_ms = tint_ms
        if not self._is_spectraval:
            self._settings["tint"] = tint_ms

    def _spectrum(self) -> Spectrum:
        if self._measured is None:
            raise _SpecbosRefusal(NOTHING_MEASURED)
        return self._measured

    def _calculate_spectrum(self) -> bytes:
        """Return a spectraval's: wavelength and value a line, if it was set to text.

        Argyll's spotread takes 8000 bytes of 350..830 nm in steps of 1 nm, and asks again for what is longer.
        """
        spectrum = self._spectrum()
        if not self._is_spectraval or self._settings["form"] != 2:
            raise _SpecbosRefusal(COMMAND)
        lines = [f"{w:g} {v:.5e}" for w, v in zip(spectrum.wavelength_nm, spectrum.value, strict=True)]
        return "\r".join([*lines, ""]).encode("ascii") + ETX

    def _calculate(self, what: str) -> bytes:
        """Return a spectraval's luminance, or its chromaticity."""
        if not self._is_spectraval:
            raise _SpecbosRefusal(COMMAND)
        x, y, z = tristimulus(self._spectrum())
        if what.startswith("photo"):
            return f"{y:.5e}\r".encode("ascii")
        total = x + y + z
        return f"{x / total:.4f} {y / total:.4f}\r".encode("ascii") if total > 0 else b"0.0000 0.0000\r"

    def _remote(self) -> bytes:
        if not self._is_spectraval:
            raise _SpecbosRefusal(COMMAND)
        return ACK

    def _fetch_spectrum(self, form: str | None) -> bytes:
        spectrum = self._spectrum()
        if self._is_spectraval:
            raise _SpecbosRefusal(COMMAND)
        number = int(form) if form else int(self._settings["form"])
        if number in (7, 10):  # for a terminal: wavelength and value, blocks ended by an empty line
            lines = [f"{w:.0f}\t{v:.6e}" for w, v in zip(spectrum.wavelength_nm, spectrum.value, strict=True)]
            return "\r".join(["Spectral Radiance [W/(sr*m^2*nm)]", "", *lines, "", ""]).encode("ascii")
        header = ["Spectral Radiance", "W/(sr*m^2*nm)"]
        return "\r".join([*header, *(f"{v:.6e}" for v in spectrum.value), "", ""]).encode("ascii")

    def _fetch(self, form: str | None) -> bytes:
        if self._is_spectraval:
            raise _SpecbosRefusal(COMMAND)
        return self._fetch_spectrum(form)

    def _fetch_xyz(self) -> bytes:
        if self._is_spectraval:
            raise _SpecbosRefusal(COMMAND)
        x, y, z = tristimulus(self._spectrum())
        return f"X: {x:.6e}\rY: {y:.6e}\rZ: {z:.6e}\r".encode("ascii")

    def _fetch_luminance(self, form: str | None) -> bytes:
        return f"Luminance[cd/m^2]:{_gap(form)}{tristimulus(self._spectrum())[1]:.5e}\r".encode("ascii")

    def _fetch_chromaticity(self, form: str | None) -> bytes:
        x, y, z = tristimulus(self._spectrum())
        total = x + y + z
        a, b = (x / total, y / total) if total > 0 else (0.0, 0.0)
        return _pair("Chrom_x", a, "Chrom_y", b, form)

    def _fetch_uv(self, form: str | None) -> bytes:
        x, y, z = tristimulus(self._spectrum())
        total = x + 15 * y + 3 * z
        a, b = (4 * x / total, 9 * y / total) if total > 0 else (0.0, 0.0)
        return _pair("Chrom_u'", a, "Chrom_v'", b, form)

    def _fetch_integration_time(self) -> bytes:
        self._spectrum()
        return f"tint[ms]: {self._measured_tint_ms:.3f}\r".encode("ascii")

    _grammar: tuple[tuple[str, Callable[..., bytes]], ...] = (
        (r"\*idn\?", _identify),
        (r"\*vers(?:ion)?\?", _version),
        (r"\*stat(?:us)?:err(?:or)?\?", _last_error),
        (r"\*conf(?:igure)?:default", _default),
        (r"\*para(?:meter)?:default", _default),
        (r"\*(?:para(?:meter)?|conf(?:igure)?):save", _save),
        (r"\*(para|conf)(?:meter|igure)?:([a-z]+)\?", _get),
        (r"\*(para|conf)(?:meter|igure)?:([a-z]+) (.+)", _set),
        (r"\*contr(?:ol)?:mhead\?", _head),
        (r"\*contr(?:ol)?:laser\?", _laser_state),
        (r"\*contr(?:ol)?:laser ([01])", _set_laser),
        (r"\*contr(?:ol)?:cyctim(?: \d+){0,2}", _cycle_time),
        (r"\*init(?:iate)?|\*meas(?:ure)?:refer", _init),
        (r"\*fetch:sprad(?: (\d{1,2}))?", _fetch_spectrum),
        (r"\*calc:sprad", _calculate_spectrum),
        (r"\*calc:(photo(?:metric)?|chromxy)", _calculate),
        (r"\*remote [01]", _remote),
        (r"\*fetch(?: (\d{1,2}))?", _fetch),
        (r"\*fetch:xyz(?: \d{1,2})?", _fetch_xyz),
        (r"\*fetch:photo(?:metric)?(?: (\d{1,2}))?", _fetch_luminance),
        (r"\*fetch:chromxy(?: (\d{1,2}))?", _fetch_chromaticity),
        (r"\*fetch:chromuv(?: (\d{1,2}))?", _fetch_uv),
        (r"\*fetch:tint", _fetch_integration_time),
    )


def _number(text: str, code: int) -> float:
    try:
        value = float(text)
    except ValueError:
        raise _SpecbosRefusal(code) from None
    if not math.isfinite(value):
        raise _SpecbosRefusal(code)
    return value


def _gap(form: str | None) -> str:
    return "\t" if form == "7" else " "


def _pair(first: str, a: float, second: str, b: float, form: str | None) -> bytes:
    between = "\r" if form == "7" else " "
    return f"{first}:{_gap(form)}{a:.4f}{between}{second}:{_gap(form)}{b:.4f}\r".encode("ascii")
