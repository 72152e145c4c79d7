"""A calibrated photodiode on a picoammeter, electrometer or multimeter that speaks SCPI, through PyVISA.

    E = (I - I_dark) / (R(wavelength) x A)
    sd(E)^2 = (s^2 / n + s_dark^2 / n_dark) / (R A)^2 + (u_R E)^2

I: mean of n readings (A), s their standard deviation; R: responsivity (A/W) from the calibration file; A: area (m2)
that the calibration holds for; u_R: its relative standard uncertainty. Source: EMVA 1288 release 4.0, section 6.1;
Keithley 6485 and Keysight 34465A manuals for the commands.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from drivers.calibration_file import read_calibration
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.instrument import Identity, Recorder
from drivers.photodiode.base import IrradianceMeasurement, Photodiode
from drivers.quantity import read_quantity
from drivers.transport import shown

COLUMNS = ["wavelength_nm", "responsivity_a_per_w"]
#: Bytes that are read at once.
_PIECE = 4096
#: A reading or the number of an error: no identity begins so, a late answer to what was asked before does.
_NUMBER = re.compile(r"\s*[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\s*[^\W\d]{0,5}\s*(?:,|$)")
_MOST_LATE = 3
#: How long (s) a meter is silent after its identity, unless it repeats it to an earlier connection.
_QUIET_S = 0.1
#: What sets a meter to direct current, by what its identity holds; the last one is every other meter's.
_SETUP: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("MODEL 648", ("*RST", "SYST:ZCH OFF", "RANG:AUTO ON")),  # picoammeters begin with their input shorted
    ("MODEL 6517", ("*RST", "FUNC 'CURR'", "CURR:RANG:AUTO ON", "SYST:ZCH OFF")),
    ("", ("*RST", "CONF:CURR:DC AUTO")),
)


class ScpiPhotodiode(Photodiode):
    """A photodiode whose meter has the VISA address `address` (`TCPIP0::host::5025::SOCKET`, `ASRL/dev/ttyUSB0::INSTR`,
    `USB0::...`).

    `calibration`: CSV file of the columns `wavelength_nm,responsivity_a_per_w`. `area_mm2`: area that it holds for.
    `calibration_sd_percent`: its relative standard uncertainty (half of the expanded one on the certificate).
    `readings`: of one measurement, two at least, for their scatter is its uncertainty. `setup`: commands that set the
    meter to direct current, None: by its identity. `visa_library`: PyVISA's name of the library, `@py` for the one in
    Python.
    """

    def __init__(
        self,
        address: str,
        *,
        calibration: str,
        area_mm2: float,
        calibration_sd_percent: float,
        readings: int = 10,
        setup: Sequence[str] | None = None,
        timeout_s: float = 5.0,
        visa_library: str = "@py",
        recorder: Recorder | None = None,
    ) -> None:
        for name, value, least in (
            ("area_mm2", area_mm2, 0.0),
            ("calibration_sd_percent", calibration_sd_percent, 0.0),
            ("readings", readings, 1),
        ):
            if not (math.isfinite(value) and value > least):
                raise InstrumentError(
                    f"photodiode: {name} = {value} isn't above {least}; take it from the calibration's certificate"
                )
        self.address = address
        self.area_m2, self.calibration_sd = area_mm2 * 1e-6, calibration_sd_percent / 100.0
        self.readings, self.setup, self.timeout_s = int(readings), setup, timeout_s
        self._responsivity = read_calibration(calibration, COLUMNS, "photodiode")
        self._library, self._record = visa_library, recorder or (lambda direction, data: None)
        self._who = f"photodiode's meter at {address}"
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._open: Any = None
        self._tried = False
        self._identity = Identity("", "")
        self._dark_a, self._var_dark = 0.0, 0.0

    def connect(self) -> None:
        with self._conversation():
            pass

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def measure_dark(self) -> float:
        with self._conversation():
            currents = self._currents()
            self._dark_a, self._var_dark = float(np.mean(currents)), _variance_of_mean(currents)
            return self._dark_a

    def check_nm(self, wavelength_nm: float) -> None:
        low, high = self._responsivity.wavelength_nm[0], self._responsivity.wavelength_nm[-1]
        if not low <= wavelength_nm <= high:
            raise InstrumentError(
                f"photodiode: {wavelength_nm} nm is outside its calibration's {low:g}..{high:g} nm; ask for a "
                "wavelength in it"
            )

    def measure(self, wavelength_nm: float) -> IrradianceMeasurement:
        self.check_nm(wavelength_nm)
        with self._conversation():
            currents = self._currents()
            current_a = float(np.mean(currents)) - self._dark_a
            watts_per_amp_m2 = 1.0 / (float(self._responsivity.at(np.array([wavelength_nm]))[0]) * self.area_m2)
            irradiance = current_a * watts_per_amp_m2
            var = (_variance_of_mean(currents) + self._var_dark) * watts_per_amp_m2**2 + (
                self.calibration_sd * irradiance
            ) ** 2
            return IrradianceMeasurement(
                irradiance, math.sqrt(var), wavelength_nm, current_a, self.readings, self.calibration_sd
            )

    def stop(self) -> None:
        """End a measurement after the reading under way; the meter emits nothing and moves nothing."""
        self._stopped.set()

    def close(self) -> None:
        with self._lock:
            self._drop()

    # --- the wire ---------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _conversation(self) -> Iterator[None]:
        with self._lock:
            self._stopped.clear()
            if self._open is None:
                self._meet()
            try:
                yield
            except (Refused, Interrupted):
                raise
            except InstrumentError:
                self._drop()
                raise

    def _meet(self) -> None:
        """Open the connection; twice if it was tried before, as a late answer to what was asked then may still
        arrive."""
        again, self._tried = self._tried, True
        try:
            self._establish()
        except (NoAnswer, Garbled):
            if not again:
                raise
            self._establish()

    def _establish(self) -> None:
        try:
            import pyvisa
        except ImportError as error:
            raise InstrumentError(
                "photodiode: PyVISA isn't installed; install calibench with its extra visa"
            ) from error
        try:
            self._open = pyvisa.ResourceManager(self._library).open_resource(self.address)
            self._open.timeout = self.timeout_s * 1000.0
            self._open.read_termination = self._open.write_termination = "\n"
        except Exception as error:  # PyVISA's backends raise what their libraries raise
            self._drop()
            reason = " ".join(str(error).split())
            raise Disconnected(
                f"{self._who}: can't be opened ({reason}); check the cable, the power and the address"
            ) from error
        try:
            answer = self._first_answer()
            maker, model, serial_number, firmware = (*(part.strip() for part in answer.split(",")), "", "", "", "")[:4]
            self._identity = Identity(maker, model, serial_number, firmware)
            commands = self.setup
            if commands is None:
                commands = next(setup for mark, setup in _SETUP if mark in answer.upper())
            for command in ("*CLS", *commands):
                self._say(command)
            code, _, text = self._ask("SYST:ERR?").partition(",")
            if not re.fullmatch(r"[+-]?\d+", code.strip()):
                raise self._strange("SYST:ERR?", code)
            if int(code):
                raise Refused(
                    f"{self._who}: its setup failed: error {code.strip()}, {text.strip()}; correct `setup`", int(code)
                )
        except InstrumentError:
            self._drop()
            raise

    def _first_answer(self) -> str:
        """Return its identity, and leave nothing behind of what was asked before. PyVISA opens a TCP address without
        looking whether anyone is there."""
        try:
            answer = self._ask("*IDN?")
            for _ in range(_MOST_LATE):
                if not _NUMBER.match(answer):
                    break
                answer = self._heard("*IDN?")
            self._drain()
        except Disconnected as error:
            reason = str(error.__cause__).partition(":")[0] if error.__cause__ is not None else str(error)
            raise Disconnected(
                f"{self._who}: can't be reached ({reason}); check the cable, the power and the address"
            ) from error
        return answer

    def _currents(self) -> list[float]:
        return [self._current() for _ in range(self.readings)]

    def _current(self) -> float:
        if self._stopped.is_set():
            raise Interrupted(f"{self._who}: the measurement was stopped; start again")
        answer = self._ask("READ?")
        try:
            current_a = read_quantity(answer, "A")
        except ValueError as reason:
            raise Garbled(
                f"{self._who}: answered 'READ?' with {shown(answer.encode('latin-1', 'replace'))}: {reason}; check "
                "that a SCPI meter is at this address, and that `setup` has it measure a direct current"
            ) from reason
        if not math.isfinite(current_a):
            raise Refused(f"{self._who}: the current is beyond its range; dim the light or let it choose its range", 1)
        return current_a

    def _say(self, command: str) -> None:
        self._record("sent", command.encode() + b"\n")
        self._do(command, lambda: self._open.write(command))

    def _ask(self, query: str) -> str:
        self._say(query)
        return self._heard(query)

    def _drain(self) -> None:
        """Discard what comes until the meter is silent."""
        self._open.timeout = _QUIET_S * 1000.0
        with contextlib.suppress(NoAnswer):
            for _ in range(_MOST_LATE):
                self._heard("*IDN?")
        self._open.timeout = self.timeout_s * 1000.0

    def _heard(self, query: str) -> str:
        answer: bytes = self._do(query, self._answer)
        self._record("received", answer)
        return answer.decode("latin-1").strip()

    def _answer(self) -> bytes:
        """Return the next line. The library reads on as long as anything comes: here it ends with the time-out,
        whatever comes."""
        from pyvisa.constants import StatusCode

        until, line = time.monotonic() + self.timeout_s, bytearray()
        while True:
            with self._open.ignore_warning(StatusCode.success_max_count_read):
                piece, status = self._open.visalib.read(self._open.session, _PIECE)
            line += piece
            if b"\n" in line or status != StatusCode.success_max_count_read:
                return bytes(line)
            if time.monotonic() > until:
                raise Garbled(
                    f"{self._who}: sends without end, {shown(bytes(line[:24]))} ...; check that a SCPI meter is at "
                    "this address"
                )

    def _do(self, command: str, action: Any) -> Any:
        from pyvisa.constants import StatusCode
        from pyvisa.errors import VisaIOError

        try:
            return action()
        except VisaIOError as error:
            if error.error_code == StatusCode.error_timeout:
                raise NoAnswer(
                    f"{self._who}: no answer within {self.timeout_s:g} s to {command!r}; check the power and the cable"
                ) from error
            raise self._gone(error) from error
        except (OSError, ValueError, AttributeError) as error:
            raise self._gone(error) from error

    def _gone(self, error: Exception) -> Disconnected:
        reason = " ".join(str(error).split())
        return Disconnected(f"{self._who}: the line broke ({reason}); plug it in again, the next call reconnects")

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._who}: answered {asked!r} with {shown(answer.encode('latin-1', 'replace'))}; check that a SCPI "
            "meter is at this address"
        )

    def _drop(self) -> None:
        opened, self._open = self._open, None
        if opened is not None:
            with contextlib.suppress(Exception):  # PyVISA's backends raise what their libraries raise
                opened.close()


def _variance_of_mean(values: Sequence[float]) -> float:
    return float(np.var(values, ddof=1)) / len(values) if len(values) > 1 else 0.0
