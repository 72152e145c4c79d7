"""Colorimetry Research CR-250 and CR-300 on the serial line: 115200 8N1, case-sensitive commands, answers end CR LF.

An answer is `OK:0:COMMAND:TEXT` or `ER:CODE:MEANING:COMMAND`. A spectrum's step and number of values stand in its first
line: a CR-300's is 1 nm for one public client and 2 nm for another, so no table of ours says it.
"""

from __future__ import annotations

import math

from drivers.errors import Garbled, Refused
from drivers.instrument import Identity, Recorder
from drivers.quantity import read_number, read_quantity
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.transport import Transport, WireInstrument, shown
from sim.spectrum import Spectrum

REMEDIES = {
    -304: "give it more light",
    -305: "measure first",
    -306: "dim the light or measure at a greater distance",
}
#: After RM Spectrum the instrument gathers its values: who reads at once loses some.
_GATHERING_S = 0.2
_MOST_VALUES = 4096


class Cr300(WireInstrument, Spectroradiometer):
    """A CR-250 or CR-300. `measure_timeout_s`: longest measurement, that of a dark source."""

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 2.0,
        measure_timeout_s: float = 120.0,
        baudrate: int = 115200,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(Transport(address, "CR-300", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder))
        self.measure_timeout_s = measure_timeout_s
        self._identity = Identity("Colorimetry Research", "CR-300")

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def measure(self) -> RadianceMeasurement:
        with self._conversation():
            self._ask("M", self.measure_timeout_s)
            self._say("RM Spectrum")
            self._transport.pause(_GATHERING_S, "RM Spectrum")
            spectrum = self._read_spectrum(self._check_answer("RM Spectrum", self._line("RM Spectrum")))
            return RadianceMeasurement(spectrum, self._integration_time_s(), self._identity.serial_number)

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        line = self._transport
        line.write(b"\n")  # ends half a command that an earlier host left behind
        line.drain(quiet_s=0.05)
        self._say("RC ID")
        first = self._line("RC ID")
        if first.startswith("RC ID"):  # it echoes: E is a switch, and its own echo comes before it acts
            first = first.removeprefix("RC ID").strip() or self._line("RC ID")
            self._say("E")
            line.drain(quiet_s=0.1)
        serial_number = self._check_answer("RC ID", first)
        self._identity = Identity(
            "Colorimetry Research", self._ask("RC Model"), serial_number, self._ask("RC Firmware")
        )
        self._transport.device = self._identity.model

    def _make_safe(self) -> None:
        """It emits nothing and moves nothing."""

    def stop(self) -> None:
        """End a measurement that another thread waits for."""
        self._transport.interrupt()
        with self._lock:
            self._transport.resume()

    def _read_spectrum(self, header: str) -> Spectrum:
        try:
            first_nm, last_nm, step_nm, count = (read_number(field) for field in header.split(","))
        except ValueError:
            raise self._strange("RM Spectrum", header) from None
        if not (2 <= count <= _MOST_VALUES and step_nm > 0 and math.isclose(first_nm + (count - 1) * step_nm, last_nm)):
            raise self._strange("RM Spectrum", header)
        values: list[float] = []
        for _ in range(int(count)):
            text = self._line("RM Spectrum")
            try:
                values.append(read_number(text))
            except ValueError:
                raise self._strange("RM Spectrum", text) from None
        return Spectrum.of([first_nm + k * step_nm for k in range(int(count))], values)

    def _integration_time_s(self) -> float | None:
        """`12.345 msec`; None where the unit is another, or none."""
        try:
            answer = self._ask("RM Exposure")
            return read_quantity(answer, "s") if " " in answer.strip() else None
        except (Refused, ValueError):
            return None

    def _ask(self, command: str, timeout_s: float | None = None) -> str:
        self._say(command)
        return self._check_answer(command, self._line(command, timeout_s))

    def _say(self, command: str) -> None:
        self._transport.write(command.encode("ascii") + b"\n")

    def _line(self, asked: str, timeout_s: float | None = None) -> str:
        return self._transport.read_until(b"\r\n", timeout_s, asked).decode("latin-1").strip()

    def _check_answer(self, asked: str, answer: str) -> str:
        """Return the text of an answer. Raises `Refused` with the instrument's code."""
        kind, _, rest = answer.partition(":")
        code, _, rest = rest.partition(":")
        if kind == "OK" and rest.startswith(f"{asked}:"):
            return rest.removeprefix(f"{asked}:").strip()
        if kind == "ER" and code.lstrip("-").isdecimal():
            remedy = REMEDIES.get(int(code), "look it up in its manual")
            meaning = rest.partition(":")[0]
            raise Refused(f"{self._transport.name}: {asked!r} failed: error {code}, {meaning}; {remedy}", int(code))
        raise self._strange(asked, answer)

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer.encode('latin-1'))}; "
            "check that a CR-250 or CR-300 is at this address"
        )
