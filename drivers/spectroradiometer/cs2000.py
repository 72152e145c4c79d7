"""Konica Minolta CS-2000 and CS-2000A on USB's virtual serial port: commands and answers are lines; 380..780 nm, 1 nm.

An answer begins with `OK00`, or is an error code `ERnn`. MEAS,1 answers twice: with the seconds that the measurement
takes, and once it is done. Sources: public clients (TU Berlin's MATLAB toolbox: commands, error codes, the four pieces
of a spectrum, lines that end LF; a Python client: `MEAS,0` cancels). Unverified, as no manual was at hand: the order of
IDDR's fields, what a measurement under way answers to other commands, and the speed of the port, which counts for
nothing on a virtual one. The integration time (MEDR,0,0,1 may have it) isn't read.
"""

from __future__ import annotations

from drivers.errors import Garbled, InstrumentError, Refused
from drivers.instrument import Identity, Recorder
from drivers.quantity import read_number
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.transport import Transport, WireInstrument, shown
from sim.spectrum import Spectrum

FIRST_NM, LAST_NM = 380, 780
#: A spectrum's pieces by number, and the values in each.
PIECES = {1: 100, 2: 100, 3: 100, 4: 101}
ERRORS = {
    0: "command or its parameters not understood; check that a CS-2000 is at this address",
    2: "the measurement failed; measure again",
    5: "no user calibration; select the maker's",
    10: "too bright; dim the light, or put on the ND filter",
    17: "a parameter is wrong; set it on the instrument",
    20: "no data; measure first",
    51: "its CCD isn't cooled; let it warm up, or have it serviced",
    52: "its temperature can't be read; have it serviced",
    71: "the synchronisation is out of range; set another frequency on the instrument",
    81: "its shutter failed; have it serviced",
    82: "its ND filter failed; have it serviced",
    83: "its measuring angle isn't set right; turn the ring until it stops",
    99: "its program failed; switch it off and on",
}


class Cs2000(WireInstrument, Spectroradiometer):
    """A CS-2000. `measure_timeout_s`: longest measurement, that of a dark source."""

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 2.0,
        measure_timeout_s: float = 300.0,
        baudrate: int = 115200,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(Transport(address, "CS-2000", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder))
        self.measure_timeout_s = measure_timeout_s
        self._identity = Identity("Konica Minolta", "CS-2000")

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def measure(self) -> RadianceMeasurement:
        with self._conversation():
            seconds = self._ask("MEAS,1")
            if not seconds.strip().isdecimal():  # the late end of an earlier one has none
                raise self._strange("MEAS,1", f"OK00,{seconds}")
            if float(seconds) > self.measure_timeout_s:
                self._cancel()
                raise InstrumentError(
                    f"{self._transport.name}: this measurement takes {seconds} s, more than {self.measure_timeout_s:g} "
                    "s; give it more light, or allow it a longer measure_timeout_s"
                )
            if rest := self._check_answer("MEAS,1", self._line("MEAS,1", self.measure_timeout_s)):
                raise self._strange("MEAS,1", f"OK00,{rest}")
            values = [value for piece, count in PIECES.items() for value in self._values(f"MEDR,1,0,{piece}", count)]
            spectrum = Spectrum.of(range(FIRST_NM, LAST_NM + 1), values)
            return RadianceMeasurement(spectrum, None, self._identity.serial_number)

    def stop(self) -> None:
        """End a measurement that another thread waits for."""
        self._transport.interrupt()
        with self._lock:
            self._transport.resume()

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        self._transport.write(b"\n")  # ends half a command that an earlier host left behind
        self._cancel()
        self._ask("RMTS,1")
        answer = self._ask("IDDR")
        model, _, serial_number = (*(field.strip() for field in answer.split(",")), "", "")[:3]
        if not model.startswith("CS-"):
            raise self._strange("IDDR", f"OK00,{answer}")
        self._identity = Identity("Konica Minolta", model, serial_number)

    def _cancel(self) -> None:
        """End a measurement that may be under way; whatever it answers is discarded."""
        self._transport.write(b"MEAS,0\n")
        self._transport.drain(quiet_s=0.2)

    def _make_safe(self) -> None:
        """It emits nothing and moves nothing."""

    def _let_go(self) -> None:
        self._ask("RMTS,0")  # its own keys work again

    def _values(self, query: str, count: int) -> list[float]:
        answer = self._ask(query)
        try:
            values = [read_number(value) for value in answer.split(",")]
        except ValueError:
            raise self._strange(query, answer) from None
        if len(values) != count:
            raise self._strange(query, f"{len(values)} values, not {count} numbers")
        return values

    def _ask(self, command: str) -> str:
        self._transport.write(command.encode("ascii") + b"\n")
        return self._check_answer(command, self._line(command))

    def _line(self, asked: str, timeout_s: float | None = None) -> str:
        return self._transport.read_until(b"\n", timeout_s, asked).decode("latin-1").strip()

    def _check_answer(self, asked: str, answer: str) -> str:
        """Return what follows OK00. Raises `Refused` for ERnn."""
        code, _, rest = answer.partition(",")
        if code == "OK00":
            return rest
        if len(code) == 4 and code.startswith("ER") and code[2:].isdecimal():
            meaning = ERRORS.get(int(code[2:]), "look it up in its manual")
            raise Refused(f"{self._transport.name}: {asked!r} failed: {code}, {meaning}", int(code[2:]))
        raise self._strange(asked, answer)

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer.encode('latin-1'))}; "
            "check that a CS-2000 is at this address"
        )
