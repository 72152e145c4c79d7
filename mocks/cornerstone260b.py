"""A Cornerstone 260B monochromator on USB: a USBTMC (USB488) device that takes SCPI-like commands.

Each motion is done by a thread of its own: motions overlap, and commands don't wait for them; `*wai` and `*opc?` do. A
host that asks where the grating stands without waiting reads where it stood. Wordings beyond those in the manual's
examples follow SCPI-99.

Source: USB-IF, USBTMC 1.0 and USB488; Newport, MCS260B manual, p. 43-46, 62.
"""

from __future__ import annotations

import re
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from mocks.usb_device import Cancelled, Stalled, UsbDevice, UsbEndpoint, UsbIdentity, UsbInterface
from mocks.wire import MeasuredLight

BULK_OUT, BULK_IN = 0x02, 0x82
DEV_DEP_MSG_OUT, REQUEST_DEV_DEP_MSG_IN = 1, 2
_HEADER = struct.Struct("<BBBxIB3x")  # message, tag, its complement, size, attributes
_END_OF_MESSAGE = 1
_UPPER_NM, _NM_PER_S = 1400.0, 175.0
_LONGEST_MESSAGE = 4096
#: The least that a motion takes in real time: no host reads its end by being quick.
_LEAST_REAL_S = 0.03
#: nm in one unit; wavenumbers are the exception.
_UNITS = {"NM": 1.0, "UM": 1000.0}


@dataclass(eq=False)
class _Command:
    """A command that waits for its turn, and how many times ABORT had been said when it came."""

    text: str
    aborts: int


class _Cs260bRefusal(Exception):
    """An entry of the error queue."""


_DEVICE_ERROR = '-300, "Device-specific error"'
_UNKNOWN, _BAD_DATA, _OUT_OF_RANGE = '-113, "Undefined header"', '-104, "Data type error"', '-222, "Data out of range"'


class MockCornerstone260B(UsbDevice):
    """The instrument; `light` feels its grating, slits, filter wheel and shutter."""

    def __init__(self, light: MeasuredLight, serial_number: str = "CB-260B-01") -> None:
        super().__init__(
            UsbIdentity(0x1FDE, 0x0014, (0, 0, 0), "Newport Corporation", "CS260B", serial_number),
            (UsbInterface(0, (0xFE, 0x03, 0x01), (UsbEndpoint(BULK_OUT), UsbEndpoint(BULK_IN))),),
        )
        self._light = light
        self._message = bytearray()
        self._requests: deque[tuple[int, int]] = deque()  # tag and largest size of answers that the host waits for
        self._answers = bytearray()
        self._waiting: deque[_Command] = deque()
        self._worker: threading.Thread | None = None
        self._motions = 0
        self._aborts = self._current = 0
        self._events = 0x80  # power on
        self._errors: deque[str] = deque()
        self._settings: dict[str, float] = {"GRATING": 1, "FILTER": 1, "OUTPORT": 1, "SHUTTER": 0}
        self._nm = 0.0
        self._units = "NM"
        self._slits_um = {1: 3000.0, 2: 3000.0, 3: 3000.0}

    # --- USBTMC -------------------------------------------------------------------------------------------------------

    def control(self, setup: bytes, data: bytes, cancelled: Cancelled) -> bytes:
        kind, request, value, _, length = struct.unpack("<BBHHH", setup)
        if kind == 0xA1 and request == 7:  # GET_CAPABILITIES: USBTMC 1.0, USB488 1.0, SCPI
            answer = bytes([1, 0, 0, 1, 0, 0]) + bytes(6) + bytes([0, 1, 0x04, 0x00]) + bytes(8)
        elif kind == 0xA1 and request == 5:  # INITIATE_CLEAR
            self._forget()
            answer = b"\x01"
        elif kind == 0xA1 and request == 6:  # CHECK_CLEAR_STATUS
            answer = b"\x01\x00"
        elif kind == 0xA1 and request == 128:  # READ_STATUS_BYTE: message available, error queue
            with self.changed:
                status = (0x10 if self._answers else 0) | (0x04 if self._errors else 0)
            answer = bytes([1, value & 0x7F, status])
        elif kind == 0xA2 and request in (1, 3):  # INITIATE_ABORT_BULK_OUT, _IN
            with self.changed:
                self._requests.clear()
            answer = bytes([1, value & 0xFF])
        elif kind == 0xA2 and request in (2, 4):  # CHECK_ABORT_..._STATUS
            answer = b"\x01" + bytes(7)
        else:
            raise Stalled(f"request {setup.hex()} isn't known")
        return answer[:length]

    def bulk_out(self, endpoint: int, data: bytes, cancelled: Cancelled) -> None:
        if endpoint != BULK_OUT:
            super().bulk_out(endpoint, data, cancelled)
        if len(data) < _HEADER.size:
            raise Stalled(f"a USBTMC header of {len(data)} bytes")
        message, tag, complement, size, attributes = _HEADER.unpack_from(data)
        if tag == 0 or tag ^ complement != 0xFF:
            raise Stalled(f"a USBTMC tag {tag:#04x} with complement {complement:#04x}")
        if message == REQUEST_DEV_DEP_MSG_IN:
            with self.changed:
                self._requests.append((tag, size))
                self.changed.notify_all()
        elif message == DEV_DEP_MSG_OUT and size <= len(data) - _HEADER.size:
            self._message += data[_HEADER.size : _HEADER.size + size]
            if attributes & _END_OF_MESSAGE or len(self._message) > _LONGEST_MESSAGE:
                text, self._message = bytes(self._message), bytearray()
                self._take(text.decode("latin-1"))
        else:
            raise Stalled(f"a USBTMC message {message} of {size} bytes")

    def bulk_in(self, endpoint: int, length: int, cancelled: Cancelled) -> bytes:
        if endpoint != BULK_IN:
            return super().bulk_in(endpoint, length, cancelled)
        with self.changed:
            self.wait_for(lambda: bool(self._requests and self._answers), cancelled)
            tag, most = self._requests.popleft()
            end = self._answers.find(b"\n") + 1 or len(self._answers) + 1  # one that broke off never ends
            count = min(end, len(self._answers), most, max(0, length - _HEADER.size))
            piece = bytes(self._answers[:count])
            del self._answers[:count]
        head = _HEADER.pack(REQUEST_DEV_DEP_MSG_IN, tag, tag ^ 0xFF, count, int(count == end))
        return head + piece + bytes(-count % 4)

    def on_reset(self) -> None:
        self._forget()

    def _forget(self) -> None:
        with self.changed:
            self._message.clear()
            self._requests.clear()
            self._answers.clear()
            self._waiting.clear()

    # --- commands -----------------------------------------------------------------------------------------------------

    def _take(self, text: str) -> None:
        for line in text.replace("\r", "\n").split("\n"):
            for part in line.split(";"):
                command = " ".join(part.upper().split())
                if command in ("IDLE?", "ABORT", "SYSTEM:ERROR?", "SYST:ERR?"):
                    if command.startswith("SYST"):
                        self._catch_up()
                    self._obey(command)
                elif command:
                    self._enqueue(command)

    def _catch_up(self) -> None:
        """Let what was said before be taken, but for what waits for a motion: its error is asked for next."""
        with self.changed:
            self.changed.wait_for(
                lambda: not self._waiting or self._waiting[0].text in ("*WAI", "*OPC?") or not self.plugged, timeout=5.0
            )

    def _enqueue(self, command: str) -> None:
        with self.changed:
            self._waiting.append(_Command(command, self._aborts))
            if self._worker is None:
                self._worker = threading.Thread(target=self._work, name="cs260b", daemon=True)
                self._worker.start()

    def _work(self) -> None:
        while True:
            with self.changed:
                if not self._waiting:
                    self._worker = None
                    return
                entry = self._waiting[0]
                command, self._current = entry.text, entry.aborts
                if command in ("*WAI", "*OPC?"):
                    while self._motions and self.plugged and self._waiting:
                        self.changed.wait(0.05)
            self._obey(command)
            with self.changed:
                if self._waiting and self._waiting[0] is entry:
                    self._waiting.popleft()
                    self.changed.notify_all()

    def _begin_motion(self, seconds: float, arrive: Callable[[], None]) -> None:
        with self.changed:
            self._motions += 1
            begun = self._current

        def move() -> None:
            self._light.clock.sleep(seconds)
            time.sleep(_LEAST_REAL_S)
            with self.changed:
                if begun == self._aborts:
                    arrive()
                self._motions -= 1
                self.changed.notify_all()

        threading.Thread(target=move, name="cs260b-motion", daemon=True).start()

    def _obey(self, command: str) -> None:
        try:
            answer = self._execute(command)
        except _Cs260bRefusal as refusal:
            with self.changed:
                self._errors.append(str(refusal))
                self._events |= 0x20 if str(refusal).startswith("-11") else 0x10
            return
        if answer is not None:
            try:
                data = self.broken(answer.encode() + b"\r\n")
            except Stalled:  # a fault of the kind `error`: no answer, and an error to be asked for
                data = b""
                with self.changed:
                    self._errors.append(_DEVICE_ERROR)
            with self.changed:
                self._answers += data
                self.changed.notify_all()

    def _execute(self, command: str) -> str | None:
        word, _, argument = command.partition(" ")
        if word.endswith("?"):
            return self._answer(word[:-1])
        if word == "ABORT":
            with self.changed:
                self._aborts += 1
        elif word == "GOWAVE":
            self._move_to(self._nanometres(_number(argument)))
        elif word == "UNITS":
            if argument not in (*_UNITS, "WN"):
                raise _Cs260bRefusal(_OUT_OF_RANGE)
            self._units = argument
        elif word == "SHUTTER" and argument in ("O", "C"):
            self._set(word, float(argument == "O"))
        elif word in self._settings or word == "GRAT":
            self._set("GRATING" if word == "GRAT" else word, _number(argument))
        elif match := re.fullmatch(r"SLIT([123])MICRONS", word):
            width_um = _number(argument)
            if not 4.0 <= width_um <= 3000.0:
                raise _Cs260bRefusal(_OUT_OF_RANGE)
            self._begin_motion(0.5, lambda: self._set_slit(int(match[1]), width_um))
        elif word not in ("*CLS", "*RST", "*OPC", "*WAI"):
            raise _Cs260bRefusal(_UNKNOWN)
        if word == "*CLS":
            self._errors.clear()
        return None

    def _answer(self, what: str) -> str:  # noqa: PLR0911  (a question a line)
        if what == "*IDN":
            return f"Newport,CS260B,{self.identity.serial_number},1.0"
        if what == "WAVE":
            return f"{self._in_units(self._nm):.3f}"
        if what == "UNITS":
            return self._units
        if what == "*OPC":
            return "1"  # it waited for its turn: everything before is done
        if what == "IDLE":
            with self.changed:
                return "0" if self._motions or self._waiting else "1"
        if what in ("SYSTEM:ERROR", "SYST:ERR"):
            with self.changed:
                return self._errors.popleft() if self._errors else "0, No Error"
        if what in ("ERROR", "STB", "*STB", "*ESR"):
            return self._status(what)
        if what == "INFO":
            return f"CS260B SN {self.identity.serial_number}"
        if what == "GRAT":
            return f"{self._settings['GRATING']:.0f},{1200 if self._settings['GRATING'] == 1 else 600},VIS"
        if match := re.fullmatch(r"SLIT([123])MICRONS", what):
            return f"{self._slits_um[int(match[1])]:.0f}"
        if match := re.fullmatch(r"FILTER([1-6])LABEL", what):
            return f"FILTER{match[1]}"
        if what in self._settings:
            return f"{self._settings[what]:.0f}"
        raise _Cs260bRefusal(_UNKNOWN)

    def _status(self, what: str) -> str:
        """`error?` and `stb?` as the RS-232 port has them, the event register of IEEE 488.2; reading clears."""
        with self.changed:
            if what == "*ESR":
                events, self._events = self._events, 0
                return str(events)
            if what in ("STB", "*STB"):
                return "20" if self._errors else "00"
            last, self._errors = (list(self._errors) or [""])[-1], deque()
            return "0" if not last else "1" if last.startswith("-113") else "2"

    def _set_slit(self, slit: int, width_um: float) -> None:
        self._slits_um[slit] = width_um
        if slit == 1:
            self._light.set_slit_um(width_um)

    def _nanometres(self, value: float) -> float:
        if self._units == "WN":
            return 1e7 / value if value > 0 else 0.0
        return value * _UNITS[self._units]

    def _in_units(self, nm: float) -> float:
        if self._units == "WN":
            return 1e7 / nm if nm > 0 else 0.0
        return nm / _UNITS[self._units]

    def _move_to(self, nm: float) -> None:
        if not 0 <= nm <= _UPPER_NM:
            raise _Cs260bRefusal(_OUT_OF_RANGE)

        def arrive() -> None:
            self._nm = nm
            self._light.set_wavelength(nm)

        self._begin_motion(abs(nm - self._nm) / _NM_PER_S, arrive)

    def _set(self, what: str, value: float) -> None:
        most = {"GRATING": 2, "FILTER": 6, "OUTPORT": 2, "SHUTTER": 1}[what]
        if value != int(value) or not (0 if what == "SHUTTER" else 1) <= value <= most:
            raise _Cs260bRefusal(_OUT_OF_RANGE)
        if what == "SHUTTER":
            self._light.set_shutter(bool(value))
            self._settings[what] = value
        elif value != self._settings[what]:

            def arrive() -> None:
                self._settings[what] = value
                if what == "FILTER":
                    self._light.set_filter(int(value))

            self._begin_motion(29.0 if what == "GRATING" else 1.5, arrive)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise _Cs260bRefusal(_BAD_DATA) from error
