"""Oriel/Newport Cornerstone 260 on RS-232, and a CS260B / CS130B on its RS-232 port: 9600 8N1, replies end CR LF.

The driver works in handshake mode, in which every statement is answered by the status byte: `00`, or `20` (hex) for an
error whose number `ERROR?` tells. A Cornerstone 260 sends it when the motion is done, and echoes every character. A
CS260B sends it on receipt: the driver asks `IDLE?` until nothing moves; its echo may be off. On closing, handshake and
units are as they were found, by a process that was killed, too: the next program that talks to it expects its own.
Sources: the manual's appendix on low level commands (p. 50-51); the MCS260B manual."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress

from drivers.errors import Garbled, InstrumentError, NoAnswer, Refused
from drivers.found_settings import FoundSettings
from drivers.instrument import Identity, Recorder
from drivers.monochromator.base import (
    DISPERSION_NM,
    NO_SLIT,
    HandSlits,
    Monochromator,
    check_slit_um,
    check_wavelength_nm,
    filter_place,
    lines_per_mm,
    order_sorting_filters,
)
from drivers.quantity import read_number
from drivers.transport import Transport, WireInstrument, shown

ERRORS = {
    0: "system error",
    1: "statement not understood",
    2: "bad parameter",
    3: "wavelength not allowed for this grating",
    6: "accessory not present",
    7: "accessory already in position",
    8: "wavelength drive can't find home",
    9: "label too long",
    10: "system error",
}
_ALREADY_THERE = 7
_DONE = {"00", "0"}
_FAILED = {"20", "32"}
_NOT_UNDERSTOOD = 1
#: Seconds between two looks at whether a motion has ended, where the instrument doesn't say so by itself.
_LOOK_S = 0.1
#: Lines that a slow instrument still sends after the statements of the first contact, echoes and status bytes, and the
#: most of them.
_LATE, _LATE_LINES = {"", "ABORT", *_DONE}, 6
#: Most lines, echoes and status bytes among them, before an answer that tells where the instrument stands.
_STALE_LINES = 24
#: How often the shutter is asked before the first contact: a late answer to an earlier program is at most one of the
#: answers.
_ASKED = 2
#: Longest time (s) that the status byte of HANDSHAKE itself is waited for.
_HANDSHAKE_S = 1.0


class Cornerstone260(WireInstrument, Monochromator):
    """A Cornerstone 260.

    `filters`: the order-sorting filters (rows of `place`, `from_nm`, `to_nm`; None: the default table; an empty list:
    no wheel). `grating`: which one to use, None: the one that stands. `dispersion_nm_per_mm`: None: by the lines of the
    grating in use. `slit_um`: the width of slits that are set by hand. `move_timeout_s`: longest motion.
    """

    def __init__(
        self,
        address: str,
        *,
        filters: Sequence[object] | None = None,
        grating: int | None = None,
        dispersion_nm_per_mm: float | None = None,
        slit_um: float | None = None,
        upper_nm: float = 1400.0,
        tolerance_nm: float = 0.5,
        timeout_s: float = 2.0,
        move_timeout_s: float = 60.0,
        baudrate: int = 9600,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(
            Transport(address, "Cornerstone 260", baudrate=baudrate, timeout_s=timeout_s, recorder=recorder)
        )
        self.filters = order_sorting_filters(filters)
        self.grating = grating
        self.dispersion_nm_per_mm = dispersion_nm_per_mm
        self._slits = HandSlits(None if slit_um is None else check_slit_um(slit_um))
        self._by_hand = slit_um is not None
        self.upper_nm = upper_nm
        self.tolerance_nm = tolerance_nm
        self.move_timeout_s = move_timeout_s
        self._identity = Identity("Newport", "Cornerstone 260")
        self._echoes = True
        self._tells_idle = False
        self._found: FoundSettings | None = None
        self._info = ""  # the reply to INFO?, which is nothing else's

    # --- the abstraction --------------------------------------------------------------------------------------------

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def check_nm(self, wavelength_nm: float) -> None:
        filter_place(self.filters, check_wavelength_nm(wavelength_nm, self.upper_nm))

    def check_slit_um(self, width_um: float) -> None:
        check_slit_um(width_um)
        if self._by_hand:
            self._slits.set(width_um, self._transport.name)

    def departures(self) -> tuple[str, ...]:
        with self._conversation():
            self._slit_um()
            return self._slits.departures(self._transport.name) if self._by_hand else ()

    def shut_at_once(self) -> bool:
        with self._lock:
            self._live = False
            self._transport.open()
            self._transport.write(b"\r\nABORT\r\nSHUTTER C\r\n" + _ASKED * b"SHUTTER?\r\n")
            try:
                closed = 0
                for _ in range(_STALE_LINES):
                    closed += self._line("SHUTTER?") == "C"
                    if closed == _ASKED:
                        return True
            except (NoAnswer, Garbled):
                return False
        return False

    def move_nm(self, wavelength_nm: float) -> None:
        wanted = check_wavelength_nm(wavelength_nm, self.upper_nm)
        with self._conversation():
            if self.filters:
                self.select_filter(filter_place(self.filters, wanted))
            self._do(f"GOWAVE {round(wanted, 3):.12g}")
            reached = self._number("WAVE?")
            if abs(reached - wanted) > self.tolerance_nm:
                raise Garbled(
                    f"{self._transport.name}: stands at {reached:g} nm after a move to {wanted:g} nm; "
                    "check its units and its wavelength calibration"
                )

    def wavelength_nm(self) -> float:
        with self._conversation():
            return self._number("WAVE?")

    def open_shutter(self) -> None:
        with self._conversation():
            self._may_shine = True
            self._move_shutter("O")

    def close_shutter(self) -> None:
        with self._conversation():
            self._move_shutter("C")

    def shutter_is_open(self) -> bool:
        with self._conversation():
            answer = self._ask("SHUTTER?")
            if answer not in {"O", "C"}:
                raise self._strange("SHUTTER?", answer)
            return answer == "O"

    def select_filter(self, place: int) -> None:
        with self._conversation():
            if self.selected_filter() != place:
                self._do(f"FILTER {place}")

    def selected_filter(self) -> int:
        with self._conversation():
            return round(self._number("FILTER?"))

    def slit_um(self) -> float:
        width_um = self._slit_um()
        if width_um is None:
            raise InstrumentError("; ".join(self._slits.departures(self._transport.name)))
        return width_um

    def _slit_um(self) -> float | None:
        """Width of the entrance slit, or what is stated of one that is set by hand."""
        with self._conversation():
            if not self._by_hand:
                try:
                    return self._number("SLIT1MICRONS?")
                except Refused as refusal:
                    if refusal.code not in NO_SLIT:
                        raise
                    self._by_hand = True
            return self._slits.stated_um

    def set_slit_um(self, width_um: float) -> None:
        wanted = check_slit_um(width_um)
        with self._conversation():
            if self._slit_um() is None or self._by_hand:
                self._slits.set(wanted, self._transport.name)
                return
            for slit in (1, 2):
                self._do(f"SLIT{slit}MICRONS {round(wanted)}")

    def bandwidth_nm(self) -> float:
        with self._conversation():
            width_um = self._slit_um()
            if width_um is None:
                return 0.0
            dispersion = self.dispersion_nm_per_mm
            if dispersion is None:
                dispersion = DISPERSION_NM / lines_per_mm(self._ask("GRAT?"), self._transport.name)
            return width_um * 1e-3 * dispersion

    # --- the wire ---------------------------------------------------------------------------------------------------

    def _establish(self) -> None:
        line = self._transport
        # An empty statement ends whatever half a statement an earlier host left behind; ABORT, a motion under way.
        line.write(b"\r\n")
        line.write(b"ABORT\r\n")
        line.drain(quiet_s=0.3)  # an instrument that moves is slow to echo
        self._info, handshake = self._first_answer()
        model, _, serial_number = self._info.partition(" SN ")
        self._identity = Identity("Newport", model.strip() or "Cornerstone 260", serial_number.strip())
        self._found = FoundSettings(f"monochromator-{serial_number.strip() or line.address}", line.name)
        if not handshake:
            self._found.note("HANDSHAKE", 0)
        self._say("HANDSHAKE 1")
        with suppress(NoAnswer):  # its own status byte: waited for, as a busy computer hands it over late
            self._line("HANDSHAKE 1", _HANDSHAKE_S)
        line.drain(quiet_s=0.1)  # an error that stood from before
        self._ask("ERROR?")
        self._tells_idle = self._knows("IDLE?")
        if (units := self._ask("UNITS?").strip().upper()) != "NM":
            self._found.note("UNITS", units)
        self._do("UNITS NM")
        if self.grating is not None and self._ask("GRAT?").partition(",")[0].strip() != str(self.grating):
            self._do(f"GRAT {self.grating}")

    def _first_answer(self) -> tuple[str, bool]:
        """Return the reply to INFO?, and whether handshake mode is on; by what comes with it also whether the
        instrument echoes.

        Late answers to what was sent before are skipped.
        """
        line = self._transport
        line.write(b"INFO?\r\n")
        first = self._line("INFO?")
        for _ in range(_LATE_LINES):
            if first.upper() in _LATE:
                first = self._line("INFO?")
        self._echoes = first.upper() == "INFO?"
        reply = self._line("INFO?") if self._echoes else first
        more = line.drain(quiet_s=0.1).decode("latin-1").split()
        complains = "INFO?" in reply.upper() or reply.upper().startswith(("ER:", "ERROR"))  # another instrument does
        if complains or reply in _FAILED or len(more) > 1 or any(len(word) > 2 for word in more):
            raise self._strange("INFO?", " ".join([first, reply, *more]))
        return reply, bool(more)

    def _knows(self, query: str) -> bool:
        try:
            self._ask(query)
        except Refused as refusal:
            if refusal.code != _NOT_UNDERSTOOD:
                raise
            return False
        return True

    def _let_go(self) -> None:
        kept = self._found
        if kept is None:
            return
        if (units := str(kept.get("UNITS", ""))) in {"UM", "WN"}:
            self._do(f"UNITS {units}")
        kept.forget("UNITS")
        if "HANDSHAKE" in kept:
            self._transport.write(b"HANDSHAKE 0\r\n")
            self._transport.drain(quiet_s=0.1)
            kept.forget("HANDSHAKE")

    def _make_safe(self) -> None:
        self._move_shutter("C")

    def _gets_in_step(self) -> bool:
        """End the motion and ask INFO?: answers come in the order of the statements, so what comes before its reply is
        stale."""
        self._transport.write(b"\r\nABORT\r\nINFO?\r\n")
        for _ in range(_STALE_LINES):
            if self._line("INFO?") == self._info:
                return self._line("INFO?") in _DONE
        return False

    def _make_safe_for_good(self) -> InstrumentError | None:
        return self._shut_for_good()

    def _is_shut(self, again: bool) -> bool:
        if not again:
            return super()._is_shut(again)
        if not self.shut_at_once():  # to meet it anew takes longer than the time-out that is left
            return False
        with suppress(InstrumentError):
            self.connect()  # it answers: it can be left as it was found
        return True

    def _move_shutter(self, to: str) -> None:
        """Open (O) or close (C) the shutter, which takes no longer than a query: a lost answer isn't waited for as that
        of a grating is."""
        self._do(f"SHUTTER {to}", self._transport.timeout_s)

    def _do(self, statement: str, timeout_s: float | None = None) -> None:
        """Do a command: its echo, its status byte within `timeout_s` (None: that of motions), the end of its motion."""
        self._say(statement)
        status = self._line(statement, self.move_timeout_s if timeout_s is None else timeout_s)
        if self._tells_idle and status in _DONE:
            self._await_idle(statement)
        if status in _FAILED:
            code = self._error_number()
            if code != _ALREADY_THERE:
                raise self._describe_refusal(statement, code)
        elif status not in _DONE:
            raise self._strange(statement, status)

    def _await_idle(self, statement: str) -> None:
        until = time.monotonic() + self.move_timeout_s
        while self._ask("IDLE?").strip() != "1":
            if time.monotonic() > until:
                raise NoAnswer(
                    f"{self._transport.name}: still moving {self.move_timeout_s:g} s after {statement!r}; "
                    "listen whether its motors run, and allow it a longer move_timeout_s"
                )
            self._transport.pause(_LOOK_S, statement)

    def _ask(self, query: str) -> str:
        """Return a query: its echo, its reply, its status byte. A refused query has the status byte alone."""
        self._say(query)
        reply = self._line(query)
        if reply in _FAILED:
            # A status byte of 20, or the number 20 with its status byte to follow.
            try:
                status = self._line(query, 0.3)
            except NoAnswer:
                raise self._describe_refusal(query, self._error_number()) from None
        else:
            status = self._line(query)
        if status in _FAILED:
            raise self._describe_refusal(query, self._error_number())
        if status not in _DONE:
            raise self._strange(query, status)
        return reply

    def _number(self, query: str) -> float:
        reply = self._ask(query)
        try:
            return read_number(reply)
        except ValueError:
            raise self._strange(query, reply) from None

    def _error_number(self) -> int:
        self._say("ERROR?")
        reply = self._line("ERROR?")
        self._line("ERROR?")
        return int(reply) if reply.isdigit() else 0

    def _say(self, statement: str) -> None:
        self._transport.write(statement.encode("ascii") + b"\r\n")
        if self._echoes:
            self._echo(statement)

    def _echo(self, statement: str) -> None:
        echo = self._transport.read_until(b"\n", asked=statement)
        if echo.strip() != statement.encode("ascii"):
            raise Garbled(
                f"{self._transport.name}: {shown(echo)} instead of the echo of {statement!r}; "
                "check that a Cornerstone 260 is at this address and nothing else talks to it"
            )

    def _line(self, asked: str, timeout_s: float | None = None) -> str:
        return self._transport.read_until(b"\r\n", timeout_s, asked).decode("latin-1").strip()

    def _describe_refusal(self, statement: str, code: int) -> InstrumentError:
        meaning = ERRORS.get(code, "unknown error")
        return Refused(
            f"{self._transport.name}: refused {statement!r}: error {code}, {meaning}; check the value against the "
            "instrument",
            code,
        )

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._transport.name}: answered {asked!r} with {shown(answer.encode('latin-1'))}; "
            "check that a Cornerstone 260 is at this address and nothing else talks to it"
        )
