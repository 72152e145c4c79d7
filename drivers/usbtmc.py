"""USBTMC: messages to an instrument on USB, and its answers, over pyusb.

A bulk-out message carries the text; an answer is asked for by a bulk-out request and read from bulk-in. Source: USB-IF,
USBTMC 1.0; USB488 1.0.
"""

from __future__ import annotations

import contextlib
import struct

import usb.core
import usb.util

from drivers.errors import Garbled, InstrumentError
from drivers.instrument import Recorder
from drivers.transport import shown
from drivers.usbip import translate

_HEADER = struct.Struct("<BBBxIB3x")  # message, tag, its complement, size, attributes
_MESSAGE, _REQUEST, _END_OF_MESSAGE = 1, 2, 1
_LONGEST = 0x5000
_INITIATE_CLEAR, _CHECK_CLEAR = 5, 6


class UsbTmc:
    """One instrument; `device` is an open pyusb device. Raises `drivers.errors.InstrumentError` for every failure."""

    def __init__(
        self, device: usb.core.Device, who: str, *, timeout_s: float, recorder: Recorder | None = None
    ) -> None:
        self.who, self.timeout_s = who, timeout_s
        self._device = device
        self._record = recorder or (lambda direction, data: None)
        self._tag = 0
        try:
            interface = self._interface()
            self._number = int(interface.bInterfaceNumber)
            ends = {
                bool(end.bEndpointAddress & 0x80): int(end.bEndpointAddress)
                for end in interface
                if end.bmAttributes & 3 == 2
            }
            if set(ends) != {False, True}:
                raise InstrumentError(
                    f"{who}: its USBTMC interface lacks a bulk endpoint; correct the address in the station file"
                )
            self._out, self._in = ends[False], ends[True]
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(self._number):
                    device.detach_kernel_driver(self._number)
            usb.util.claim_interface(device, self._number)
            self.clear()
        except usb.core.USBError as error:
            raise translate(error, who, "connecting") from error

    def _interface(self) -> usb.core.Interface:
        for interface in self._device.get_active_configuration():
            if (interface.bInterfaceClass, interface.bInterfaceSubClass) == (0xFE, 0x03):
                return interface
        raise InstrumentError(f"{self.who}: this USB device speaks no USBTMC; correct the address in the station file")

    def clear(self) -> None:
        """Discard what a host before left half said, on both sides."""
        wait_ms = round(self.timeout_s * 1000)
        try:
            self._device.ctrl_transfer(0xA1, _INITIATE_CLEAR, 0, self._number, 1, wait_ms)
            for _ in range(100):
                state = self._device.ctrl_transfer(0xA1, _CHECK_CLEAR, 0, self._number, 2, wait_ms)
                if len(state) < 1 or state[0] != 2:  # pending
                    break
            self._device.clear_halt(self._out)
        except usb.core.USBError as error:
            raise translate(error, self.who, "clearing its line") from error

    def write(self, text: str) -> None:
        """Send one message."""
        data = text.encode("ascii") + b"\r\n"
        self._send(_MESSAGE, len(data), _END_OF_MESSAGE, data, text)
        self._record("sent", data)

    def ask(self, text: str, timeout_s: float | None = None) -> str:
        """Send a query; its answer, without its line end."""
        self.write(text)
        answer = bytearray()
        wait_ms = round(1000 * (self.timeout_s if timeout_s is None else timeout_s))
        while True:
            self._send(_REQUEST, _LONGEST, 0, b"", text)
            try:
                piece = bytes(self._device.read(self._in, _LONGEST, wait_ms))
            except usb.core.USBError as error:
                raise translate(error, self.who, f"asking {text!r}") from error
            if len(piece) < _HEADER.size:
                raise self._strange(text, piece)
            message, tag, complement, size, attributes = _HEADER.unpack_from(piece)
            if (message, tag, complement) != (_REQUEST, self._tag, self._tag ^ 0xFF) or size > len(
                piece
            ) - _HEADER.size:
                raise self._strange(text, piece)
            answer += piece[_HEADER.size : _HEADER.size + size]
            if attributes & _END_OF_MESSAGE:
                self._record("received", bytes(answer))
                return answer.decode("latin-1").strip()
            if len(answer) > _LONGEST:
                raise self._strange(text, bytes(answer[:16]))

    def _send(self, message: int, size: int, attributes: int, data: bytes, text: str) -> None:
        self._tag = self._tag % 255 + 1
        head = _HEADER.pack(message, self._tag, self._tag ^ 0xFF, size, attributes)
        whole = head + data
        try:
            self._device.write(self._out, whole + bytes(-len(whole) % 4), round(self.timeout_s * 1000))
        except usb.core.USBError as error:
            raise translate(error, self.who, f"sending {text!r}") from error

    def _strange(self, text: str, piece: bytes) -> Garbled:
        return Garbled(
            f"{self.who}: answered {text!r} with {shown(piece[:24])}; check that the right instrument is at this "
            "address"
        )

    def close(self) -> None:
        """Let the device go; never raises."""
        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(self._device)
