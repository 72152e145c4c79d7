"""Photo Research PR-655 and PR-670 on the serial line: remote mode, commands end CR, answers end CR LF and begin with a
quality code.

Sources: PR-655 manual, p. 127; what public clients expect where it leaves room. A spectrum has one or two lines before
its values (both are documented), the wavelengths stand beside the values, so their step is the instrument's own.
"""

from __future__ import annotations

from drivers.errors import Garbled, NoAnswer, Refused
from drivers.instrument import Identity, Recorder
from drivers.quantity import read_number
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.transport import Transport, WireInstrument, shown
from sim.spectrum import Spectrum

FIRST_NM, LAST_NM = 380.0, 780.0
ERRORS = {
    -1: ("the light isn't constant", "wait until the source has settled"),
    -2: ("over-exposed", "dim the light or measure at a greater distance"),
    -3: ("can't synchronise with the light", "set its sync mode to none"),
    -8: ("under-exposed", "give it more light"),
    -9: ("sync error", "set its sync mode to none"),
    -10: ("no frequency found to synchronise with", "set its sync mode to none"),
    -12: ("it took too long", "give it more light"),
}
#: A PR-655 loses characters of PHOTO that come in one piece.
_BETWEEN_CHARACTERS_S = 0.01
#: Lines that may come before its greeting: late answers to what was asked before the connection was opened anew.
_MOST_LATE = 3


class Pr655(WireInstrument, Spectroradiometer):
    """A PR-655 or PR-670. One measurement of a dark source takes minutes: `measure_timeout_s`."""

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 2.0,
        measure_timeout_s: float = 300.0,
        baudrate: int = 9600,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(Transport(address, "PR-655", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder))
        self.measure_timeout_s = measure_timeout_s
        self._identity = Identity("Photo Research", "PR-655")

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def measure(self) -> RadianceMeasurement:
        with self._conversation() as line:
            line.write(b"M5\r")
            spectrum = self._read_spectrum()
            return RadianceMeasurement(spectrum, self._integration_time_s(), self._identity.serial_number)

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        line = self._transport
        line.write(b"\rQ")  # ends half a command, and remote mode if an earlier host left it on
        line.drain(quiet_s=0.05)
        for at, character in enumerate((b"P", b"H", b"O", b"T", b"O")):
            if at:
                line.pause(_BETWEEN_CHARACTERS_S, "PHOTO")
            line.write(character)
        heard = [line.read_until(b"\r\n", asked="PHOTO")]
        try:
            while b"REMOTE MODE" not in heard[-1] and len(heard) <= _MOST_LATE:
                heard.append(line.read_until(b"\r\n", asked="PHOTO"))
        except NoAnswer:
            raise self._strange("PHOTO", heard[0]) from None
        if b"REMOTE MODE" not in heard[-1]:
            raise self._strange("PHOTO", heard[0])
        line.drain(quiet_s=0.05)  # a second greeting, to a PHOTO that wasn't heard in time
        model = self._ask("D111")
        if not model.startswith(("PR-655", "PR-670")):
            raise self._strange("D111", model.encode("latin-1"))
        self._identity = Identity("Photo Research", model, self._ask("D110"), self._ask("D114"))
        self._transport.device = self._identity.model

    def _make_safe(self) -> None:
        """It emits nothing and moves nothing."""

    def stop(self) -> None:
        """End a measurement that another thread waits for."""
        self._transport.interrupt()
        with self._lock:
            self._transport.resume()

    def _let_go(self) -> None:
        self._transport.write(b"Q")

    def _read_spectrum(self) -> Spectrum:
        self._check_answer("M5", self._line("M5", self.measure_timeout_s))  # the header's first line
        pairs = self._pair(self._line("M5"), may_be_a_header=True) or self._pair(self._line("M5"))
        while max(pairs) < LAST_NM:
            pairs |= self._pair(self._line("M5"))
        wavelengths = list(pairs)
        if wavelengths != sorted(wavelengths) or wavelengths[0] != FIRST_NM:
            raise self._strange("M5", f"{wavelengths[:8]}".encode())
        return Spectrum.of(wavelengths, list(pairs.values()))

    def _pair(self, line: str, may_be_a_header: bool = False) -> dict[float, float]:
        """Wavelength and value of a line; nothing for a line of the header."""
        fields = line.split(",")
        try:
            if len(fields) == 2 and FIRST_NM <= read_number(fields[0]) <= LAST_NM:
                return {read_number(fields[0]): read_number(fields[1])}
        except ValueError:
            pass
        if may_be_a_header:
            return {}
        raise self._strange("M5", line.encode("latin-1"))

    def _integration_time_s(self) -> float | None:
        try:
            return float(self._ask("D13").rpartition(",")[2]) / 1000.0
        except (Refused, ValueError):
            return None

    def _ask(self, command: str) -> str:
        """Return what follows the quality code of an answer of one line."""
        self._transport.write(command.encode("ascii") + b"\r")
        return self._check_answer(command, self._line(command))

    def _line(self, asked: str, timeout_s: float | None = None) -> str:
        return self._transport.read_until(b"\r\n", timeout_s, asked).decode("latin-1").strip()

    def _check_answer(self, asked: str, answer: str) -> str:
        """`answer` without its quality code. Raises `Refused` for any other than 0."""
        code, _, rest = answer.partition(",")
        try:
            quality = int(code)
        except ValueError:
            raise self._strange(asked, answer.encode("latin-1")) from None
        if quality:
            meaning, remedy = ERRORS.get(quality, ("an error of its own", "look it up in its manual"))
            raise Refused(f"{self._transport.name}: {asked!r} failed: {quality}, {meaning}; {remedy}", quality)
        return rest

    def _strange(self, asked: str, answer: bytes) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer)}; check that a PR-655 or PR-670 is at "
            "this address"
        )
