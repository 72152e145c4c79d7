"""Acton / Princeton Instruments SP2150 (SP-2150i) on RS-232 or its USB port: 9600 8N1, commands end CR, numbers first.

The instrument echoes a command, and ends its answer with ` ok` CR LF once it is done: `500.00 GOTO` when the grating
stands, `?NM` after ` 500.000 nm `. It has no shutter: a blank in its filter wheel stands for one. `dark_place` says
where, as no command does. Sources: a public script for an SP-2150i (commands, a blank at place 6) and public drivers of
its sister SP-2300i, which take over the manual's list of commands and the answer to `?GRATINGS`. Unverified, as no
manual was at hand: the answer to a command that it doesn't know, taken to end with `?` CR LF; whether its echo can be
off, which the driver allows; and whether GOTO can be ended (MONO-STOP ends `>NM`): a motion is waited for. Its slits
are taken to be set by hand."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from drivers.errors import Garbled, InstrumentError, Refused
from drivers.instrument import Identity, Recorder, Setting
from drivers.monochromator.base import (
    HandSlits,
    Monochromator,
    check_slit_um,
    check_wavelength_nm,
    filter_place,
    order_sorting_filters,
)
from drivers.transport import Transport, WireInstrument, shown

#: Reciprocal linear dispersion (nm/mm), times the grating's lines per mm, of a focal length of 150 mm and half an angle
#: of 12.4 deg between its arms (unverified): 1e6 nm/mm x cos(12.4 deg) / 150 mm.
DISPERSION_150_MM_NM = 1e6 / 150.0 * math.cos(math.radians(12.4))
_NUMBER = re.compile(r"[+-]?\d+(?:\.\d*)?")
#: Most lines of one answer: nine gratings, and what is around them.
_MOST_LINES = 16


class Sp2150(WireInstrument, Monochromator):
    """An SP2150.

    `filters`: the order-sorting filters (rows of `place`, `from_nm`, `to_nm`; None: the default table). `dark_place`:
    the blank in the wheel; None: there is none, and nothing can keep its light in. `dispersion_nm_per_mm`: None: by the
    lines of the grating in use. `slit_um`: the width at which the slits are set. `move_timeout_s`: longest motion.
    """

    def __init__(
        self,
        address: str,
        *,
        filters: Sequence[object] | None = None,
        dark_place: int | None = None,
        dispersion_nm_per_mm: float | None = None,
        slit_um: float | None = None,
        upper_nm: float = 1400.0,
        tolerance_nm: float = 0.5,
        timeout_s: float = 2.0,
        move_timeout_s: float = 60.0,
        baudrate: int = 9600,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(Transport(address, "SP2150", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder))
        self.filters = order_sorting_filters(filters)
        self.dark_place = dark_place
        if dark_place in {row.place for row in self.filters}:
            raise InstrumentError(
                f"monochromator: dark_place {dark_place} is an order-sorting filter's place, too; correct one of them"
            )
        self.dispersion_nm_per_mm = dispersion_nm_per_mm
        self._slits = HandSlits(None if slit_um is None else check_slit_um(slit_um))
        self.upper_nm = upper_nm
        self.tolerance_nm = tolerance_nm
        self.move_timeout_s = move_timeout_s
        self._identity = Identity("Princeton Instruments", "SP2150")

    # --- the abstraction --------------------------------------------------------------------------------------------

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def settings(self) -> dict[str, Setting]:
        return {**super().settings(), "grating": self._grating()[0]}

    def departures(self) -> tuple[str, ...]:
        return self._slits.departures(self._transport.name)

    def check_nm(self, wavelength_nm: float) -> None:
        filter_place(self.filters, check_wavelength_nm(wavelength_nm, self.upper_nm))

    def check_slit_um(self, width_um: float) -> None:
        self._slits.set(check_slit_um(width_um), self._transport.name)

    def move_nm(self, wavelength_nm: float) -> None:
        wanted = check_wavelength_nm(wavelength_nm, self.upper_nm)
        place = filter_place(self.filters, wanted)
        with self._conversation():
            if self.selected_filter() != self.dark_place:  # else the blank stays until light may get out
                self.select_filter(place)
            self._ask(f"{wanted:.2f} GOTO", self.move_timeout_s)
            reached = self.wavelength_nm()
            if abs(reached - wanted) > self.tolerance_nm:
                raise Garbled(
                    f"{self._transport.name}: stands at {reached:g} nm after a move to {wanted:g} nm; "
                    "check its grating and its wavelength calibration"
                )

    def wavelength_nm(self) -> float:
        return self._number("?NM")

    def open_shutter(self) -> None:
        with self._conversation():
            self._may_shine = True
            self.select_filter(filter_place(self.filters, max(0.0, self.wavelength_nm())))

    def close_shutter(self) -> None:
        with self._conversation():
            if self.dark_place is None:
                raise InstrumentError(
                    f"{self._transport.name}: has no shutter; put a blank in its filter wheel and state its dark_place "
                    "in the station file"
                )
            self.select_filter(self.dark_place)

    def shutter_is_open(self) -> bool:
        return self.selected_filter() != self.dark_place

    def select_filter(self, place: int) -> None:
        with self._conversation():
            if self.selected_filter() != place:
                self._ask(f"{place} FILTER", self.move_timeout_s)
                if (at_place := self.selected_filter()) != place:
                    raise Garbled(
                        f"{self._transport.name}: its filter wheel stands at {at_place} after a move to {place}; "
                        "check that nothing blocks it"
                    )

    def selected_filter(self) -> int:
        return round(self._number("?FILTER"))

    def slit_um(self) -> float:
        if self._slits.stated_um is None:
            raise InstrumentError("; ".join(self.departures()))
        return self._slits.stated_um

    def set_slit_um(self, width_um: float) -> None:
        self.check_slit_um(width_um)

    def bandwidth_nm(self) -> float:
        if self._slits.stated_um is None:
            return 0.0
        dispersion = self.dispersion_nm_per_mm
        return (
            self._slits.stated_um
            * 1e-3
            * (DISPERSION_150_MM_NM / self._grating()[1] if dispersion is None else dispersion)
        )

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        self._transport.write(b"\r")  # ends half a command that an earlier host left behind
        self._transport.drain(quiet_s=0.2)
        model = self._ask("MODEL")
        if not model.upper().startswith("SP"):
            raise self._strange("MODEL", model)
        self._identity = Identity("Princeton Instruments", model, self._ask("SERIAL"))

    def _make_safe(self) -> None:
        self.close_shutter()

    def _gets_in_step(self) -> bool:
        """Wait for the end of the motion: its ` ok` is all that is outstanding."""
        self._answer("GOTO", self.move_timeout_s)
        return not self._transport.drain(quiet_s=0.1)

    def _make_safe_for_good(self) -> InstrumentError | None:
        return self._shut_for_good()

    def _grating(self) -> tuple[int, float]:
        """Return the number and the lines per mm of the grating in use: the answer marks its row with 1A (hex)."""
        with self._conversation():
            answer = self._ask("?GRATINGS")
            match = re.search(r"\x1a\s*(\d+)\s+(\d+) *g/mm", answer)
            if match is None:
                raise self._strange("?GRATINGS", answer)
            return int(match[1]), float(match[2])

    def _number(self, query: str) -> float:
        with self._conversation():
            answer = self._ask(query)
            match = _NUMBER.match(answer)
            if match is None:
                raise self._strange(query, answer)
            return float(match[0])

    def _ask(self, command: str, timeout_s: float | None = None) -> str:
        """Return what is between the echo of a command and ` ok`. Raises `Refused` where `?` ends it."""
        self._transport.write(command.encode("ascii") + b"\r")
        return self._answer(command, timeout_s)

    def _answer(self, command: str, timeout_s: float | None = None) -> str:
        text = ""
        for _ in range(_MOST_LINES):
            text += self._transport.read_until(b"\n", timeout_s, command).decode("latin-1")
            reply = text.strip().removeprefix(command).strip(" \r\n")
            if reply == "ok" or reply.endswith((" ok", "\nok")):
                return reply.removesuffix("ok").strip(" \r\n")
            if reply.endswith("?"):
                raise Refused(f"{self._transport.name}: doesn't know {command!r}; check that it has this accessory", 0)
        raise self._strange(command, text)

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer.encode('latin-1'))}; "
            "check that an SP2150 is at this address and nothing else talks to it"
        )
