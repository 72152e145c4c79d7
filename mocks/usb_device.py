"""What every mock USB device does: descriptors, standard requests, halts, and being unplugged.

A device answers `transfer` for one request at a time on each endpoint; what carries it there (the in-process backend or
the USB/IP server of `mocks.usb`) doesn't matter to it.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from mocks.wire import Fault, FaultPlan

#: Asked from time to time by a device that waits: has whoever asked lost patience?
Cancelled = Callable[[], bool]

_POLL_S = 0.02


class UsbFault(Exception):
    """A transfer that ends otherwise than well; `status` is the negative errno that USB/IP reports."""

    status = -71


class Stalled(UsbFault):
    """The endpoint is halted, or the request isn't known."""

    status = -32


class Unplugged(UsbFault):
    """The device is gone."""

    status = -19


class Abandoned(UsbFault):
    """Whoever asked gave up."""

    status = -104


@dataclass(frozen=True)
class UsbIdentity:
    """The fields of a device descriptor that tell devices apart."""

    vendor_id: int
    product_id: int
    device_class: tuple[int, int, int]
    maker: str
    product: str
    serial_number: str
    usb_version: int = 0x0200
    release: int = 0x0100
    max_packet_0: int = 64


@dataclass(frozen=True)
class UsbEndpoint:
    """One endpoint descriptor; `extra` follows it (a SuperSpeed companion)."""

    address: int
    attributes: int = 2  # bulk
    max_packet: int = 512
    interval: int = 0
    extra: bytes = b""

    def bytes(self) -> bytes:
        return struct.pack("<BBBBHB", 7, 5, self.address, self.attributes, self.max_packet, self.interval) + self.extra


@dataclass(frozen=True)
class UsbInterface:
    """One interface descriptor with its class-specific descriptors (`extra`) and endpoints."""

    number: int
    interface_class: tuple[int, int, int]
    endpoints: tuple[UsbEndpoint, ...]
    extra: bytes = b""

    def bytes(self) -> bytes:
        head = struct.pack("<BBBBBBBBB", 9, 4, self.number, 0, len(self.endpoints), *self.interface_class, 0)
        return head + self.extra + b"".join(endpoint.bytes() for endpoint in self.endpoints)


@dataclass
class _UsbDeviceState:
    """What a reset of the device undoes: its configuration, and which endpoints (with direction bit) are halted."""

    configuration: int = 1
    halted: set[int] = field(default_factory=set)


class UsbDevice:
    """Base of the mock devices. Subclasses give `interfaces` and override `bulk_out`, `bulk_in` and `control`.

    `speed` is USB/IP's (3 high, 5 super). `association` precedes the interfaces in the configuration.
    """

    speed = 3

    def __init__(self, identity: UsbIdentity, interfaces: tuple[UsbInterface, ...], association: bytes = b"") -> None:
        self.identity = identity
        self.interfaces = interfaces
        self.plugged = True
        self.changed = threading.Condition()
        self._association = association
        self._state = _UsbDeviceState()
        self._strings = ["", identity.maker, identity.product, identity.serial_number]
        self._line_faults = FaultPlan()
        self.answers = 0
        self._silent = False

    # --- descriptors --------------------------------------------------------------------------------------------------

    def string_index(self, text: str) -> int:
        """Return the index of a string descriptor with this text, added if it isn't there."""
        if text not in self._strings:
            self._strings.append(text)
        return self._strings.index(text)

    def device_descriptor(self) -> bytes:
        """Return the 18 bytes of the device descriptor."""
        identity = self.identity
        return struct.pack(
            "<BBHBBBBHHHBBBB",
            18,
            1,
            identity.usb_version,
            *identity.device_class,
            identity.max_packet_0,
            identity.vendor_id,
            identity.product_id,
            identity.release,
            1,
            2,
            3,
            1,
        )

    def configuration_descriptor(self) -> bytes:
        """Return the one configuration with all that belongs to it."""
        body = self._association + b"".join(interface.bytes() for interface in self.interfaces)
        return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), len(self.interfaces), 1, 0, 0x80, 250) + body

    def _descriptor(self, kind: int, index: int) -> bytes:
        if kind == 1:
            return self.device_descriptor()
        if kind == 2 and index == 0:
            return self.configuration_descriptor()
        if kind == 3 and index < len(self._strings):
            text = struct.pack("<H", 0x0409) if index == 0 else self._strings[index].encode("utf-16-le")
            return bytes([2 + len(text), 3]) + text
        raise Stalled(f"no descriptor of type {kind}, index {index}")

    # --- transfers ----------------------------------------------------------------------------------------------------

    def transfer(self, endpoint: int, setup: bytes, data: bytes | None, length: int, cancelled: Cancelled) -> bytes:
        """Carry out one transfer: `data` of an OUT, None for an IN of at most `length` bytes. Raises `UsbFault`."""
        if not self.plugged:
            raise Unplugged(self.identity.serial_number)
        if self._silent:
            with self.changed:
                self.wait_for(lambda: not self._silent, cancelled)
        if endpoint & 0x0F == 0:
            return self._setup(setup, data, cancelled)[: length if data is None else None]
        if endpoint in self._state.halted:
            raise Stalled(f"endpoint {endpoint:#04x} is halted")
        if data is None:
            return self.bulk_in(endpoint, length, cancelled)
        self.bulk_out(endpoint, data, cancelled)
        return b""

    def _setup(self, setup: bytes, data: bytes | None, cancelled: Cancelled) -> bytes:  # noqa: PLR0911  (a request a line)
        kind, request, value, index, length = struct.unpack("<BBHHH", setup)
        if kind & 0x60:
            return self.control(setup, data or b"", cancelled)
        match kind, request:
            case 0x80 | 0x81, 6:
                return self._descriptor(value >> 8, value & 0xFF)[:length]
            case 0x80, 8:
                return bytes([self._state.configuration])
            case 0x81, 10:
                return b"\0"
            case 0x80 | 0x81 | 0x82, 0:
                return bytes([int(index in self._state.halted), 0])
            case 0x00, 9:
                self._state.configuration = value & 0xFF
                self.on_reset()
                return b""
            case 0x02, 1:
                self._state.halted.discard(index & 0xFF)
                self.on_clear_halt(index & 0xFF)
                return b""
            case 0x02, 3:
                self._state.halted.add(index & 0xFF)
                return b""
            case (0x00 | 0x01, 1 | 3 | 11) | (0x00, 5):
                return b""
        raise Stalled(f"request {setup.hex()} isn't known")

    def wait_for(self, ready: Callable[[], bool], cancelled: Cancelled) -> None:
        """Wait, holding `changed`, until `ready()`. Raises `Abandoned` or `Unplugged`."""
        while not ready():
            if not self.plugged:
                raise Unplugged(self.identity.serial_number)
            if cancelled():
                raise Abandoned(self.identity.serial_number)
            self.changed.wait(_POLL_S)

    def unplug(self) -> None:
        """Pull the cable: everything under way and to come fails, until `plug`."""
        with self.changed:
            self.plugged = False
            self.changed.notify_all()

    def plug(self) -> None:
        """Put the cable back; the device has forgotten what it was doing."""
        with self.changed:
            self.plugged = True
            self._state = _UsbDeviceState()
        self.on_reset()

    # --- faults -------------------------------------------------------------------------------------------------------

    def fail(self, faults: Iterable[Fault]) -> None:
        """Break answers, which count from 1, as serial instruments' answers break; a camera's answers are its
        frames."""
        self._line_faults = FaultPlan(faults)
        self.answers = 0

    def mute(self, silent: bool) -> None:
        """Let every transfer wait, as if the device hung; or go on."""
        with self.changed:
            self._silent = silent
            self.changed.notify_all()

    def _faults_of_answer(self) -> list[Fault]:
        """Return the faults of the answer that is about to go out."""
        self.answers += 1
        return self._line_faults.of(self.answers)

    def _unplug_for(self, seconds: float) -> None:
        self.unplug()
        back = threading.Timer(seconds, self.plug)
        back.daemon = True
        back.start()

    def broken(self, answer: bytes) -> bytes:
        """Return an answer as its faults leave it; empty: nothing goes out."""
        for fault in self._faults_of_answer():
            if fault.kind == "late":
                time.sleep(3.0 if fault.value is None else fault.value)
            elif fault.kind in ("never", "drop"):
                answer = b""
            elif fault.kind == "half":
                answer = answer[: len(answer) // 2]
            elif fault.kind == "wrong":
                answer = b"?" * max(1, len(answer) - 2) + answer[-2:]
            elif fault.kind == "error":
                raise Stalled(f"answer {self.answers} fails as it was told to")
            elif fault.kind == "unplug":
                self._unplug_for(1.0 if fault.value is None else fault.value)
                answer = b""
        return answer

    # --- for subclasses -----------------------------------------------------------------------------------------------

    def control(self, setup: bytes, data: bytes, cancelled: Cancelled) -> bytes:
        """Return a class or vendor request."""
        raise Stalled(f"request {setup.hex()} isn't known")

    def bulk_out(self, endpoint: int, data: bytes, cancelled: Cancelled) -> None:
        """Take data for an OUT endpoint."""
        raise Stalled(f"no endpoint {endpoint:#04x}")

    def bulk_in(self, endpoint: int, length: int, cancelled: Cancelled) -> bytes:
        """Return at most `length` bytes of an IN endpoint; waits until there are some."""
        raise Stalled(f"no endpoint {endpoint:#04x}")

    def on_reset(self) -> None:
        """Note that the configuration was set anew."""

    def on_clear_halt(self, endpoint: int) -> None:
        """Note that a halt of an endpoint was cleared."""
