"""Spectral Products CM110 and CM112 on RS-232: 9600 8N1, commands and answers in bytes.

`27` is echoed. `56 n` asks: two bytes, the status, `24`. `16 hi lo` goes to a position in the instrument's units: the
status, `24`. A status of 128 or more refuses (its bit 5: too small, else too large); its three lowest bits are the
units: 0 um, 1 nm, 2 Angstrom. Positions are of ten Angstrom to the nm. Units are set to Angstrom, and back on closing.

It has neither shutter nor filter wheel. `dark_nm` is a wavelength at which its lamp gives no light: there the grating
is parked in place of a closed shutter, and goes to the wavelength that was asked for when the shutter is opened.

Sources: two public Python clients, which agree on the above, and on the queries 0 position, 2 lines per mm, 4 grating,
14 units, 19 serial number. Unverified, as no manual was at hand: whether the echo of 27 is followed by 24 (allowed);
whether the answer to 16 comes at once or when the grating stands (both are allowed: 27 is asked until it is echoed,
then the position; while it moves it says nothing); whether a motion can be ended (it is waited for); in which units an
instrument that says microns in its status is (its units are asked for by 56 14). Type 1 isn't asked, as no source says
what tells a CM112."""

from __future__ import annotations

import time

from drivers.errors import Garbled, InstrumentError, NoAnswer, Refused
from drivers.found_settings import FoundSettings
from drivers.instrument import Identity, Recorder, Setting
from drivers.monochromator.base import HandSlits, Monochromator, check_slit_um, check_wavelength_nm
from drivers.transport import Transport, WireInstrument, shown

_ECHO, _GOTO, _UNITS, _QUERY, _END = 27, 16, 50, 56, 24
_POSITION, _LINES_PER_MM, _GRATING, _UNIT, _SERIAL = 0, 2, 4, 14, 19
_REFUSED, _TOO_SMALL = 0x80, 0x20
_ANGSTROM = 2
#: Longest wait (s) for one echo while the grating may move.
_LOOK_S = 0.5


class Cm110(WireInstrument, Monochromator):
    """A CM110 or CM112.

    `dark_nm`: where its lamp gives no light; None: nothing can keep its light in. `dispersion_nm_per_mm`: reciprocal
    linear dispersion of the grating in use, from its data sheet; None: not known, and no bandwidth either. `slit_um`:
    the width of the slits put in. `move_timeout_s`: longest motion.
    """

    def __init__(
        self,
        address: str,
        *,
        dark_nm: float | None = None,
        dispersion_nm_per_mm: float | None = None,
        slit_um: float | None = None,
        upper_nm: float = 1400.0,
        tolerance_nm: float = 0.5,
        timeout_s: float = 2.0,
        move_timeout_s: float = 30.0,
        baudrate: int = 9600,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(Transport(address, "CM110", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder))
        self.dark_nm = None if dark_nm is None else check_wavelength_nm(dark_nm, upper_nm)
        self.dispersion_nm_per_mm = dispersion_nm_per_mm
        self._slits = HandSlits(None if slit_um is None else check_slit_um(slit_um))
        self.upper_nm = upper_nm
        self.tolerance_nm = tolerance_nm
        self.move_timeout_s = move_timeout_s
        self._identity = Identity("Spectral Products", "CM110")
        self._next_nm: float | None = None  # where it goes once it is opened
        self._found: FoundSettings | None = None

    # --- the abstraction --------------------------------------------------------------------------------------------

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def settings(self) -> dict[str, Setting]:
        with self._conversation():
            return {
                "bandwidth_nm": self.bandwidth_nm(),
                "grating": self._ask(_GRATING),
                "lines_per_mm": self._ask(_LINES_PER_MM),
            }

    def departures(self) -> tuple[str, ...]:
        who = self._transport.name
        unknown = self._slits.departures(who)
        if not unknown and self.dispersion_nm_per_mm is None:
            unknown = (f"{who}: no dispersion_nm_per_mm is stated: the bandwidth of its light isn't known",)
        return (
            f"{who}: has no order-sorting filters: light of half the wavelength passes where the lamp has any",
            f"{who}: has no shutter: parked at {self.dark_nm} nm, its stray light still gets out",
            *unknown,
        )

    def check_nm(self, wavelength_nm: float) -> None:
        wanted = check_wavelength_nm(wavelength_nm, self.upper_nm)
        if self.dark_nm is not None and abs(wanted - self.dark_nm) <= self.tolerance_nm:
            raise InstrumentError(
                f"monochromator: {wanted:g} nm is where it is parked in place of a shutter; ask for another "
                "wavelength, or state another dark_nm"
            )

    def check_slit_um(self, width_um: float) -> None:
        self._slits.set(check_slit_um(width_um), self._transport.name)

    def move_nm(self, wavelength_nm: float) -> None:
        """Go there; or, while it is parked, keep the wavelength for when it is opened."""
        self.check_nm(wavelength_nm)
        with self._conversation():
            self._next_nm = wavelength_nm
            if self.shutter_is_open():
                self._go(wavelength_nm)

    def wavelength_nm(self) -> float:
        with self._conversation():
            return self._ask(_POSITION) / 10.0

    def open_shutter(self) -> None:
        with self._conversation():
            if self._next_nm is None:
                raise InstrumentError(f"{self._transport.name}: no wavelength was set yet; set one before it is opened")
            self._may_shine = True
            self._go(self._next_nm)

    def close_shutter(self) -> None:
        with self._conversation():
            if self.dark_nm is None:
                raise InstrumentError(
                    f"{self._transport.name}: has no shutter; state in the station file a dark_nm at which its lamp "
                    "gives no light"
                )
            if self.shutter_is_open():
                self._go(self.dark_nm)

    def shutter_is_open(self) -> bool:
        return self.dark_nm is None or abs(self.wavelength_nm() - self.dark_nm) > self.tolerance_nm

    def select_filter(self, place: int) -> None:
        raise InstrumentError(f"{self._transport.name}: has no filter wheel; leave place {place} out")

    def selected_filter(self) -> int:
        raise InstrumentError(f"{self._transport.name}: has no filter wheel; don't ask for its place")

    def slit_um(self) -> float:
        if self._slits.stated_um is None:
            raise InstrumentError("; ".join(self._slits.departures(self._transport.name)))
        return self._slits.stated_um

    def set_slit_um(self, width_um: float) -> None:
        self.check_slit_um(width_um)

    def bandwidth_nm(self) -> float:
        return (self._slits.stated_um or 0.0) * 1e-3 * (self.dispersion_nm_per_mm or 0.0)

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        self._transport.drain(quiet_s=0.05)
        if not self._echoes(self._transport.timeout_s):
            raise self._silent(self._transport.timeout_s)
        serial_number = str(self._ask(_SERIAL))
        self._identity = Identity("Spectral Products", "CM110", serial_number)
        self._found = FoundSettings(f"monochromator-cm110-{serial_number}", self._transport.name)
        if (units := self._ask(_UNIT)) != _ANGSTROM:
            self._found.note("UNITS", units)
            self._say(_UNITS, _ANGSTROM)
        if self._ask(_UNIT) != _ANGSTROM:
            raise Garbled(f"{self._transport.name}: its units stay {self._ask(_UNIT)}, not 2; check that it is a CM110")

    def _let_go(self) -> None:
        if self._found is not None and "UNITS" in self._found:
            self._say(_UNITS, int(self._found.get("UNITS", _ANGSTROM)))
            self._found.forget("UNITS")

    def _make_safe(self) -> None:
        self.close_shutter()

    def _make_safe_for_good(self) -> InstrumentError | None:
        return self._shut_for_good()

    def _gets_in_step(self) -> bool:
        """Wait for the end of the motion: then it echoes."""
        self._await_echo(self.move_timeout_s)
        return True

    def _go(self, wanted_nm: float) -> None:
        """Go to a wavelength (nm), and return when the grating stands there."""
        until = time.monotonic() + self.move_timeout_s
        position = round(10.0 * wanted_nm)
        self._say(_GOTO, position >> 8, position & 0xFF, timeout_s=self.move_timeout_s)
        self._await_echo(until - time.monotonic())
        if abs((reached := self.wavelength_nm()) - wanted_nm) > self.tolerance_nm:
            raise Garbled(
                f"{self._transport.name}: stands at {reached:g} nm after a move to {wanted_nm:g} nm; "
                "check its grating and its wavelength calibration"
            )

    def _await_echo(self, within_s: float) -> None:
        until = time.monotonic() + within_s
        while not self._echoes(min(_LOOK_S, max(0.0, until - time.monotonic()))):
            if time.monotonic() > until:
                raise self._silent(within_s)

    def _echoes(self, timeout_s: float) -> bool:
        """Ask for one echo. What comes with it is discarded: the end of a motion, and other echoes."""
        self._transport.write(bytes((_ECHO,)))
        try:
            first = self._transport.read(1, timeout_s, "27")
        except NoAnswer:
            return False
        heard = first + self._transport.drain(quiet_s=0.1)
        if _ECHO not in heard:
            raise self._strange("27", heard)
        return True

    def _ask(self, what: int) -> int:
        high, low = self._say(_QUERY, what, more=2)
        return 256 * high + low

    def _say(self, *command: int, more: int = 0, timeout_s: float | None = None) -> bytes:
        """Send a command. Returns the bytes before its status. Raises `Refused` where the status refuses."""
        asked = " ".join(map(str, command))
        self._transport.write(bytes(command))
        answer = self._transport.read(more + 2, timeout_s, asked)
        status = answer[-2]
        if answer[-1] != _END or status & 7 > _ANGSTROM:  # no such units
            raise self._strange(asked, answer)
        if status & _REFUSED:
            why = "too small" if status & _TOO_SMALL else "too large"
            raise Refused(
                f"{self._transport.name}: refused {asked!r}: status {status}, {why}; check the value with its grating",
                status,
            )
        return answer[:more]

    def _silent(self, within_s: float) -> NoAnswer:
        return NoAnswer(
            f"{self._transport.name}: no answer within {within_s:g} s to '27'; check the power, the cable, the "
            "address, and that it doesn't move still"
        )

    def _strange(self, asked: str, answer: bytes) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer)}; check that a CM110 is at this address "
            "and nothing else talks to it"
        )
