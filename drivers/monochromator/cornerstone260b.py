"""Newport Cornerstone 260B and 130B on USB: USBTMC, SCPI-like commands. Motions overlap; `idle?` says when all have
ended.

After each command the driver asks `system:error?`: the instrument reports no failed command by itself. Source:
Newport, MCS260B manual, p. 43-46, 62.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence

import usb.core

from drivers.errors import Garbled, InstrumentError, Interrupted, NoAnswer, Refused
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
from drivers.transport import shown
from drivers.usbip import open_device
from drivers.usbtmc import UsbTmc

VENDOR, MODELS = 0x1FDE, {0x0014: "CS260B", 0x0006: "CS130B"}
_LOOK_S = 0.05


class Cornerstone260B(Monochromator):
    """A CS260B or CS130B at `usb://SERIAL` or `usbip://HOST:PORT/SERIAL` (or an already found pyusb `device`).

    `filters`, `grating`, `dispersion_nm_per_mm`, `slit_um`, `upper_nm`, `tolerance_nm`: as of `cornerstone260`.
    `move_timeout_s`: longest motion; a change of the grating takes 29 s.
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
        device: usb.core.Device | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.address, self._given = address, device
        self.filters = order_sorting_filters(filters)
        self.grating = grating
        self.dispersion_nm_per_mm, self.upper_nm, self.tolerance_nm = dispersion_nm_per_mm, upper_nm, tolerance_nm
        self._slits = HandSlits(None if slit_um is None else check_slit_um(slit_um))
        self._by_hand = slit_um is not None
        self.timeout_s, self.move_timeout_s = timeout_s, move_timeout_s
        self._recorder = recorder
        self._who = f"Cornerstone 260B at {address}"
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._stopping = threading.Lock()  # a stop ends what others wait for, but no stop
        self._open: UsbTmc | None = None
        self._met = False
        self._found: FoundSettings | None = None
        self._identity = Identity("Newport", "CS260B")

    # --- the abstraction --------------------------------------------------------------------------------------------

    def connect(self) -> None:
        with self._conversation():
            pass

    def identity(self) -> Identity:
        with self._conversation():
            return self._identity

    def check_nm(self, wavelength_nm: float) -> None:
        filter_place(self.filters, check_wavelength_nm(wavelength_nm, self.upper_nm))

    def check_slit_um(self, width_um: float) -> None:
        check_slit_um(width_um)
        if self._by_hand:
            self._slits.set(width_um, self._who)

    def departures(self) -> tuple[str, ...]:
        self._slit_um()
        return self._slits.departures(self._who) if self._by_hand else ()

    def move_nm(self, wavelength_nm: float) -> None:
        wanted = check_wavelength_nm(wavelength_nm, self.upper_nm)
        with self._conversation() as wire:
            if self.filters:
                self.select_filter(filter_place(self.filters, wanted))
            self._do(f"gowave {wanted:.3f}")
            reached = self._number(wire, "wave?")
            if abs(reached - wanted) > self.tolerance_nm:
                raise Garbled(
                    f"{self._who}: stands at {reached:g} nm after a move to {wanted:g} nm; check its units and its "
                    "calibration"
                )

    def wavelength_nm(self) -> float:
        with self._conversation() as wire:
            return self._number(wire, "wave?")

    def open_shutter(self) -> None:
        self._may_shine = True
        self._do("shutter 1")

    def close_shutter(self) -> None:
        self._do("shutter 0")

    def shutter_is_open(self) -> bool:
        with self._conversation() as wire:
            answer = wire.ask("shutter?").upper()
            if answer not in {"0", "1", "O", "C"}:
                raise self._strange("shutter?", answer)
            return answer in {"1", "O"}

    def select_filter(self, place: int) -> None:
        with self._conversation():
            if self.selected_filter() != place:
                self._do(f"filter {place}")

    def selected_filter(self) -> int:
        with self._conversation() as wire:
            return round(self._number(wire, "filter?"))

    def slit_um(self) -> float:
        width_um = self._slit_um()
        if width_um is None:
            raise InstrumentError("; ".join(self._slits.departures(self._who)))
        return width_um

    def _slit_um(self) -> float | None:
        """Width of the entrance slit, or what is stated of one that is set by hand: it doesn't answer the question
        then, and has an error."""
        with self._conversation() as wire:
            if not self._by_hand:
                try:
                    return self._number(wire, "slit1microns?")
                except NoAnswer:
                    wire.clear()
                    error = self._error()
                    if error is None or error[0] not in NO_SLIT:
                        raise
                    self._by_hand = True
            return self._slits.stated_um

    def set_slit_um(self, width_um: float) -> None:
        wanted = check_slit_um(width_um)
        with self._conversation():
            if self._slit_um() is None or self._by_hand:
                self._slits.set(wanted, self._who)
                return
            for slit in (1, 2):
                self._do(f"slit{slit}microns {round(wanted)}")

    def bandwidth_nm(self) -> float:
        with self._conversation() as wire:
            width_um = self._slit_um()
            if width_um is None:
                return 0.0
            dispersion = self.dispersion_nm_per_mm
            if dispersion is None:
                dispersion = DISPERSION_NM / lines_per_mm(wire.ask("grat?"), self._who)
            return width_um * 1e-3 * dispersion

    def stop(self) -> None:
        if not self._met:
            return
        with self._stopping:
            self._stopped.set()
            with self._lock:
                self._stopped.clear()
                with self._conversation() as wire:
                    wire.write("abort")
                    self._do("shutter 0")

    def close(self) -> None:
        unsafe = self._shut_for_good() if self._met else None
        with self._lock:
            if self._open is not None and self._found is not None and self._found:
                with contextlib.suppress(InstrumentError):
                    self._open.write(f"units {str(self._found.get('UNITS', 'NM')).lower()}")
                    self._found.forget("UNITS")
            self._met = False
            self._drop()
        if unsafe is not None:
            raise unsafe

    # --- the wire ---------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _conversation(self) -> Iterator[UsbTmc]:
        """The connection, opened anew after any failure but a refusal or a stop."""
        with self._lock:
            if self._open is None:
                self._establish()
            assert self._open is not None
            try:
                yield self._open
            except (Refused, Interrupted):
                raise
            except InstrumentError:
                self._drop()
                raise

    def _establish(self) -> None:
        device = self._given if self._given is not None else open_device(self.address)
        if device.idVendor != VENDOR or device.idProduct not in MODELS:
            raise InstrumentError(
                f"{self._who}: USB device {device.idVendor:04x}:{device.idProduct:04x} is neither CS260B (1fde:0014) "
                "nor CS130B "
                "(1fde:0006): correct the address in the station file"
            )
        self._open = UsbTmc(device, self._who, timeout_s=self.timeout_s, recorder=self._recorder)
        try:
            wire = self._open
            wire.write("abort")  # a motion that a host before left under way
            maker, model, serial_number, firmware = (*wire.ask("*idn?").split(","), "", "", "", "")[:4]
            self._identity = Identity(maker.strip(), model.strip(), serial_number.strip(), firmware.strip())
            for _ in range(32):  # errors that stood from before
                if self._error() is None:
                    break
            self._found = FoundSettings(f"monochromator-{self._identity.serial_number or self.address}", self._who)
            if (units := wire.ask("units?").upper()) in {"UM", "WN"}:
                self._found.note("UNITS", units)
            self._do("units nm")
            if self.grating is not None and round(self._number(wire, "grating?")) != self.grating:
                self._do(f"grating {self.grating}")
        except InstrumentError:
            self._drop()
            raise
        self._met = True

    def _do(self, command: str) -> None:
        """A command, and the end of every motion. Raises `Refused` with the instrument's error."""
        with self._conversation() as wire:
            wire.write(command)
            until = time.monotonic() + self.move_timeout_s
            while not self._idle(wire):
                if self._stopped.wait(_LOOK_S):
                    wire.write("abort")
                    raise Interrupted(f"{self._who}: stopped while waiting for {command!r}; start again")
                if time.monotonic() > until:
                    raise NoAnswer(
                        f"{self._who}: still moving {self.move_timeout_s:g} s after {command!r}; listen whether its "
                        "motors run"
                    )
            if (error := self._error()) is not None:
                code, text = error
                raise Refused(
                    f"{self._who}: refused {command!r}: error {code}, {text}; check the value against the instrument",
                    code,
                )

    def _idle(self, wire: UsbTmc) -> bool:
        answer = wire.ask("idle?")
        if answer not in {"0", "1"}:
            raise self._strange("idle?", answer)
        return answer == "1"

    def _error(self) -> tuple[int, str] | None:
        assert self._open is not None
        answer = self._open.ask("system:error?")
        code, _, text = answer.partition(",")
        try:
            number = int(code)
        except ValueError:
            raise self._strange("system:error?", answer) from None
        return None if number == 0 else (number, text.strip().strip('"'))

    def _number(self, wire: UsbTmc, query: str) -> float:
        answer = wire.ask(query)
        try:
            return read_number(answer)
        except ValueError:
            raise self._strange(query, answer) from None

    def _strange(self, asked: str, answer: str) -> Garbled:
        return Garbled(
            f"{self._who}: answered {asked!r} with {shown(answer.encode('latin-1'))}; check that a CS260B is at this "
            "address"
        )

    def _drop(self) -> None:
        opened, self._open = self._open, None
        if opened is not None:
            opened.close()
