"""JETI specbos 1211 and 1201, spectraval 1501 and 1511 on their serial line: 8N1, no flow control, commands end CR.

A setting is answered by ACK or NAK; after a NAK, `*stat:err?` tells why. A measurement (`*init`, a spectraval's
`*meas:refer`) is answered by ACK, and by BEL once it is done; ENQ in between is passed over. Without flow control a
spectrum can lose characters on its
way: it is asked for again. A spectraval takes `*para:` where a specbos takes `*conf:`, tells its error as a bare
number, chooses its integration time with `*para:tint 0`, and its spectrum on `*calc:sprad` ends with ETX
(unverified without the instrument: after the behaviour of a public client, ArgyllCMS).
"""

from __future__ import annotations

import math
import re
from contextlib import suppress

from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.instrument import Identity, Recorder
from drivers.spectroradiometer.base import RadianceMeasurement, Spectroradiometer
from drivers.transport import Transport, WireInstrument, shown
from sim.spectrum import Spectrum

ETX, ENQ, ACK, BEL, NAK = b"\x03", b"\x05", b"\x06", b"\x07", b"\x15"
ERRORS = {
    4: ("command not understood", "check that a specbos is at this address"),
    120: ("over-exposed", "dim the light or measure at a greater distance"),
    121: ("under-exposed", "give it more light or a longer `max_integration_s`"),
    123: ("no integration time fits the light", "check that the light is steady"),
    138: ("no measurement to fetch", "measure first"),
    141: ("outside the calibrated range", "ask for wavelengths within the instrument's calibration"),
}
OUT_OF_RANGE = 141
#: Ranges (nm) that are tried, each within the one before, where a unit's own isn't calibrated to its ends: the usual
#: calibrations, to 1000 nm, of visible light with its margins, and of 380 to 780 nm. Not from a manual: a unit whose
#: own range differs takes `from_nm` and `to_nm` in the station file.
NARROWER_NM = ((350, 1000), (350, 830), (380, 780))
#: A fetch that broke off is asked for again, this often in all.
FETCHES = 5
#: Silence after the last value of a fetch that says that no more comes; USB adapters hold characters back for 16 ms.
AFTER_S = 0.02
_HEADER_LINES = 2


class Specbos1211(WireInstrument, Spectroradiometer):
    """A specbos or spectraval. Rates in `baudrates` are tried in turn; a TCP connection has none.

    `from_nm`, `to_nm`: range asked for, in steps of 1 nm; None: as far as the unit is calibrated, by its own word, or
    less where it then refuses to measure that (error 141). `max_integration_s`: longest integration time that the
    instrument may choose; one measurement ends within 5 times that and 10 s.
    """

    def __init__(
        self,
        address: str,
        *,
        from_nm: int | None = None,
        to_nm: int | None = None,
        max_integration_s: float = 3.0,
        timeout_s: float = 2.0,
        fetch_timeout_s: float = 6.0,
        measure_timeout_s: float | None = None,
        baudrates: tuple[int, ...] = (921600, 115200, 38400),
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(
            Transport(address, "specbos 1211", baudrate=baudrates[0], timeout_s=timeout_s, recorder=recorder)
        )
        self._wanted_nm = (from_nm, to_nm)
        if from_nm is not None and to_nm is not None and not from_nm < to_nm:
            raise InstrumentError(f"specbos 1211: {from_nm}..{to_nm} nm is no range; give from_nm below to_nm")
        self.from_nm, self.to_nm = 0, 0  # what the unit measures, known once it is connected
        self._spectraval = self._has_measured = False
        self.max_integration_s = max_integration_s
        self.fetch_timeout_s = fetch_timeout_s
        self.measure_timeout_s = 5 * max_integration_s + 10 if measure_timeout_s is None else measure_timeout_s
        self.baudrates = tuple(baudrates)
        self._identity = Identity("JETI", "specbos 1211")

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def measure(self) -> RadianceMeasurement:
        with self._conversation():
            while True:
                try:
                    spectrum = self._read_measured()
                except Refused as error:
                    # Later the spectra of a session would cover different ranges.
                    if error.code != OUT_OF_RANGE or self._has_measured or not self._narrow():
                        raise
                else:
                    self._has_measured = True
                    return RadianceMeasurement(spectrum, self._integration_time_s(), self._identity.serial_number)

    def _read_measured(self) -> Spectrum:
        begin = "*init"
        if self._spectraval:
            self._set("*para:form 0")  # the spectrum is asked for once it is measured
            begin = "*meas:refer"
        self._set(begin)
        done = self._byte(begin, self.measure_timeout_s)
        if done == NAK:
            raise self._refusal(begin)
        if done != BEL:
            raise self._strange(begin, done)
        if self._spectraval:
            self._set("*para:form 2")  # as text
        return self._fetch_spectrum()

    def stop(self) -> None:
        """End a measurement that another thread waits for; there is nothing to bring into a safe state."""
        self._transport.interrupt()
        with self._lock:
            self._transport.resume()

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        line = self._transport
        model = self._find()
        serial_number = re.sub(r"\D+", "", self._ask("*para:spnum?"))
        firmware = ""
        with suppress(Refused):
            firmware = self._ask("*vers?")
        self._identity = Identity("JETI", model, serial_number, firmware)
        self._transport.device = self._identity.model
        self._spectraval = model.startswith("spectraval")
        if self._spectraval:
            if self._ask("*conf:dispen?").strip() == "1":  # one with a display is under its own keys' control
                self._identity = Identity("JETI", "spectraval 1511", serial_number, firmware)
                self._transport.device = self._identity.model
                with suppress(Refused):  # newer firmware doesn't know it
                    self._set("*REMOTE 1")
            settings = [
                "*para:calibn 0",
                "*para:tint 0",
                "*para:aver 1",
                f"*para:maxtint {round(self.max_integration_s * 1000)}",
            ]
        else:
            settings = ["*conf:default", "*para:calibn 0", "*para:expo 1"]
            settings += [f"*conf:maxtin {round(self.max_integration_s * 1000)}"]
            settings += ["*conf:func 6", "*conf:form 4", "*conf:aver 1"]
        for setting in settings:
            try:
                self._set(setting)
            except Refused:
                # Firmware of the 1201 up to 1.8.3 doesn't know it, and chooses among its own times.
                if not (model == "specbos 1201" and "maxtin" in setting):
                    raise
        self._choose_range()
        line.drain(quiet_s=0.02)

    def _choose_range(self) -> None:
        """The range asked for if the unit is calibrated there, or all that it is. Raises `InstrumentError`."""
        if self._spectraval:
            limits = re.findall(r"\d+(?:\.\d+)?", self._ask("*para:wran?"))[:2]
        else:
            limits = [re.sub(r"^.*:\s*", "", self._ask(f"*para:{end}?")) for end in ("wavbeg", "wavend")]
        try:
            first, last = (float(text.split()[0]) for text in limits)
        except (ValueError, IndexError):
            raise self._strange("*para:wavbeg?", " ".join(limits).encode("latin-1")) from None
        low, high = math.ceil(first), math.floor(last)
        wanted = [low if self._wanted_nm[0] is None else self._wanted_nm[0]]
        wanted += [high if self._wanted_nm[1] is None else self._wanted_nm[1]]
        if not low <= wanted[0] < wanted[1] <= high:
            raise InstrumentError(
                f"{self._transport.name}: {wanted[0]}..{wanted[1]} nm isn't within the {low}..{high} nm for which it "
                "is calibrated; "
                "correct from_nm and to_nm in the station file, or leave them out"
            )
        self.from_nm, self.to_nm = int(wanted[0]), int(wanted[1])
        self._has_measured = False
        self._set_range()

    def _set_range(self) -> None:
        """Send the range; a narrower one where that is refused as not calibrated."""
        try:
            self._set(f"*{'para' if self._spectraval else 'conf'}:wran {self.from_nm} {self.to_nm} 1")
        except Refused as error:
            if error.code != OUT_OF_RANGE or not self._narrow():
                raise

    def _narrow(self) -> bool:
        """Take the next narrower range; whether there is one, and the station file left it to the unit."""
        if self._wanted_nm != (None, None):
            return False
        for low, high in NARROWER_NM:
            narrower = max(low, self.from_nm), min(high, self.to_nm)
            if narrower[0] < narrower[1] and narrower != (self.from_nm, self.to_nm):
                self.from_nm, self.to_nm = narrower
                self._set_range()
                return True
        return False

    def _find(self) -> str:
        """Model that answers `*idn?`, at the first rate at which one does."""
        line = self._transport
        failure: InstrumentError | None = None
        for baudrate in self.baudrates if "://" not in line.address else self.baudrates[:1]:
            if line.baudrate != baudrate:
                line.baudrate = baudrate
                line.open()
            line.write(b"\r")  # ends whatever half a command an earlier host left behind
            line.drain(quiet_s=0.05)
            try:
                answer = self._ask("*idn?")
            except (Disconnected, Interrupted):
                raise
            except InstrumentError as error:
                failure = failure or error
                continue
            if match := re.fullmatch(r"JETI_SB(\d+)", answer):
                return f"specbos {match[1]}"
            if answer.startswith("SB05"):
                return "specbos 1201"
            if match := re.match(r"JETI_SDCM3|DCM3_JETI|S?PECFIRM_JETI_(15\d1)", answer):
                return f"spectraval {match[1] or 1501}"
            failure = self._strange("*idn?", answer.encode("latin-1"))
        line.baudrate = self.baudrates[0]
        assert failure is not None
        raise failure

    def _make_safe(self) -> None:
        """Nothing to do: it emits nothing and moves nothing."""

    def _set(self, command: str) -> None:
        """A setting: ACK, or NAK and the reason."""
        self._transport.write(command.encode("ascii") + b"\r")
        answer = self._byte(command)
        if answer == NAK:
            raise self._refusal(command)
        if answer != ACK:
            raise self._strange(command, answer)

    def _ask(self, query: str) -> str:
        """Return a query: one line, or NAK and the reason."""
        line = self._transport
        line.write(query.encode("ascii") + b"\r")
        first = self._byte(query)
        if first == NAK:
            raise self._refusal(query)
        rest = b"" if first == b"\r" else line.read_until(b"\r", asked=query)
        return (first + rest).replace(ENQ, b"").decode("latin-1").strip()

    def _byte(self, asked: str, timeout_s: float | None = None) -> bytes:
        """Return the next byte that isn't ENQ."""
        while (byte := self._transport.read(1, timeout_s, asked)) == ENQ:
            pass
        return byte

    def _refusal(self, command: str) -> InstrumentError:
        self._transport.write(b"*stat:err?\r")
        answer = self._transport.read_until(b"\r", asked="*stat:err?").decode("latin-1")
        match = re.search(r"(\d+)\s*$", answer.strip())
        if not match:
            return self._strange("*stat:err?", answer.encode("latin-1"))
        code = int(match[1])
        meaning, remedy = ERRORS.get(code, ("an error of its own", "look it up in its manual"))
        return Refused(f"{self._transport.name}: {command!r} failed: error {code}, {meaning}; {remedy}", code)

    def _fetch_spectrum(self) -> Spectrum:
        """Return the last measured spectrum; requested again while it arrives incomplete."""
        failure: InstrumentError | None = None
        for _ in range(FETCHES):
            try:
                return self._fetch_once()
            except (NoAnswer, Garbled) as error:
                failure = error
                self._transport.drain(quiet_s=0.1)
        assert failure is not None
        raise Garbled(f"{failure} (asked {FETCHES} times)")

    def _fetch_once(self) -> Spectrum:
        line = self._transport
        # A specbos says two lines, then a value a line; a spectraval a wavelength and its value a line, and ETX.
        query, header = ("*calc:sprad", 0) if self._spectraval else ("*fetch:sprad", _HEADER_LINES)
        wavelengths = range(self.from_nm, self.to_nm + 1)
        line.write(query.encode("ascii") + b"\r")
        first = self._byte(query, self.fetch_timeout_s)
        if first == NAK:
            raise self._refusal(query)
        if self._spectraval:
            text = (first + line.read_until(ETX, self.fetch_timeout_s, query)).removesuffix(ETX).replace(ENQ, b"")
            pieces = [piece for piece in text.split(b"\r") if piece.strip()]
            if len(pieces) != len(wavelengths):
                raise Garbled(f"{line.name}: sent {len(pieces)} values where {len(wavelengths)} were asked for")
        else:
            began = first if first == b"\r" else first + line.read_until(b"\r", self.fetch_timeout_s, query)
            # Within a reply characters follow each other: a pause of a second is where it broke off.
            pause_s = min(1.0, self.fetch_timeout_s)
            rest_of_it = (line.read_until(b"\r", pause_s, query) for _ in range(header + len(wavelengths) - 1))
            pieces = [piece.replace(ENQ, b"").strip() for piece in (began, *rest_of_it)]
        values = [self._value(query, nm, text) for nm, text in zip(wavelengths, pieces[header:], strict=True)]
        rest = line.drain(quiet_s=AFTER_S)
        if rest.strip():
            raise Garbled(
                f"{line.name}: sent {shown(rest.strip())} after {len(values)} values; check that nothing else talks "
                "to it"
            )
        return Spectrum.of(wavelengths, values)

    def _value(self, query: str, wavelength_nm: int, text: bytes) -> float:
        try:
            *others, value = (float(word) for word in text.split())
        except ValueError:
            raise self._strange(query, text) from None
        if not math.isfinite(value) or others != ([float(wavelength_nm)] if self._spectraval else []):
            raise self._strange(query, text)
        return value

    def _integration_time_s(self) -> float | None:
        """Integration time of the last measurement; None where the firmware doesn't report it."""
        try:
            match = re.search(r"(\d+(?:\.\d+)?)\s*(?:ms)?\s*$", self._ask("*fetch:tint"))
        except Refused:
            return None
        return float(match[1]) / 1000.0 if match else None

    def _strange(self, asked: str, answer: bytes) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer)}; "
            "check that a specbos is at this address and nothing else talks to it"
        )
