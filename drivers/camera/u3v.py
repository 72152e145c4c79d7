"""USB3 Vision cameras, of any maker, over pyusb.

The standard's own registers (ABRM, SBRM, SIRM), read over GenCP, say who the camera is and where its XML and its stream
lie. Everything else (exposure, gain, trigger) is found through that XML, which is read from the camera at connect
(`drivers.camera.genapi`).

Source: A3, USB3 Vision 1.1; bytes checked against `tests/drivers/camera/test_u3v.py`.
"""

from __future__ import annotations

import contextlib
import struct
from dataclasses import dataclass
from typing import Any

import usb.core
import usb.util

from drivers.camera.buffers import Grabbed
from drivers.camera.genapi import GenApiFeatures
from drivers.camera.gencp import (
    ABRM_DEVICE_VERSION,
    ABRM_MANUFACTURER,
    ABRM_MODEL,
    ABRM_RESPONSE_MS,
    ABRM_SBRM,
    ABRM_SERIAL,
    ATTEMPTS,
    LEAST_PACKET,
    RESPONSE_FLOOR_MS,
    SBRM_MAX_ACK,
    SBRM_MAX_COMMAND,
    SBRM_SIRM,
    GenCp,
    read_xml,
)
from drivers.camera.genicam import GenicamCamera, NoFrame
from drivers.camera.genicam_settings import CameraFeatures, set_if_there
from drivers.camera.u3v_stream import LEADER, TRAILER, StreamLayout, U3vStream
from drivers.errors import Garbled, InstrumentError, NoAnswer
from drivers.instrument import Identity
from drivers.usbip import open_device, translate

# Offsets of the stream's registers (SIRM).
SIRM_INFO, SIRM_CONTROL, SIRM_PAYLOAD, SIRM_LEADER, SIRM_TRAILER = 0x00, 0x04, 0x08, 0x10, 0x14
SIRM_MAX_LEADER, SIRM_TRANSFER_SIZE, SIRM_TRANSFER_COUNT = 0x18, 0x1C, 0x20
SIRM_FINAL_1, SIRM_FINAL_2, SIRM_MAX_TRAILER = 0x24, 0x28, 0x2C

_TRANSFER_BYTES = 1 << 20


@dataclass(frozen=True)
class _Interfaces:
    """Endpoints of the control and the stream interface."""

    control_interface: int
    stream_interface: int
    control_out: int
    control_in: int
    stream_in: int

    @classmethod
    def of(cls, device: usb.core.Device, who: str) -> _Interfaces:
        found: dict[int, usb.core.Interface] = {}
        for interface in device.get_active_configuration():
            if (interface.bInterfaceClass, interface.bInterfaceSubClass) == (0xEF, 0x05):
                found.setdefault(interface.bInterfaceProtocol, interface)
        if 0 not in found or 2 not in found:
            raise InstrumentError(
                f"{who}: this USB device is no USB3 Vision camera with a stream; correct the address in the station "
                "file"
            )

        def endpoint(interface: usb.core.Interface, incoming: bool) -> int:
            for item in interface:
                if bool(item.bEndpointAddress & 0x80) == incoming and item.bmAttributes & 3 == 2:
                    return int(item.bEndpointAddress)
            raise InstrumentError(f"{who}: interface {interface.bInterfaceNumber} lacks a bulk endpoint")

        control, stream = found[0], found[2]
        return cls(
            control.bInterfaceNumber,
            stream.bInterfaceNumber,
            endpoint(control, False),
            endpoint(control, True),
            endpoint(stream, True),
        )


class U3vCamera(GenicamCamera):
    """One USB3 Vision camera at `usbip://HOST:PORT/SERIAL` or `usb://SERIAL`, or an already found pyusb `device`.

    `settings`: those of `GenicamCamera`.
    """

    _records_bytes = True
    nodes: GenApiFeatures
    _control: GenCp

    def __init__(self, address: str, *, device: usb.core.Device | None = None, **settings: Any) -> None:
        super().__init__(address, **settings)
        self._given = device
        self._device: usb.core.Device | None = None
        self._stream: U3vStream | None = None

    # --- connection ---------------------------------------------------------------------------------------------------

    def _open(self) -> tuple[GenApiFeatures, Identity]:
        """Find the camera, read its registers and XML."""
        try:
            self._device = self._given if self._given is not None else open_device(self.address)
            self._claim(self._device)
        except usb.core.USBError as error:
            raise translate(error, self._who, "connecting") from error
        control = GenCp(self._device, self._at.control_out, self._at.control_in, self._who, self._recorder)
        self._control = control
        control.response_ms = max(control.integer(ABRM_RESPONSE_MS), RESPONSE_FLOOR_MS)
        sbrm = control.integer(ABRM_SBRM, 8)
        largest_command, largest_ack = control.integer(sbrm + SBRM_MAX_COMMAND), control.integer(sbrm + SBRM_MAX_ACK)
        control.max_command = max(LEAST_PACKET, largest_command)
        control.max_ack = max(LEAST_PACKET, min(largest_ack, 1 << 16))
        self._sirm = control.integer(sbrm + SBRM_SIRM, 8)
        identity = Identity(
            maker=control.text(ABRM_MANUFACTURER),
            model=control.text(ABRM_MODEL),
            serial_number=control.text(ABRM_SERIAL),
            firmware=control.text(ABRM_DEVICE_VERSION),
        )
        self.nodes = GenApiFeatures.of_xml(read_xml(control, self._who), control, self._who)
        self._stop_streaming()
        return self.nodes, identity

    def _claim(self, device: usb.core.Device) -> None:
        self._at = at = _Interfaces.of(device, self._who)
        for interface in (at.control_interface, at.stream_interface):
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(interface):
                    device.detach_kernel_driver(interface)
            usb.util.claim_interface(device, interface)
        for endpoint in (at.control_in, at.control_out, at.stream_in):
            device.clear_halt(endpoint)

    def _release(self) -> None:
        self._end_stream()
        device, self._device = self._device, None
        if device is not None:
            usb.util.dispose_resources(device)

    # --- frames -------------------------------------------------------------------------------------------------------

    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        with self._lock:
            super().configure(exposure_s, gain_db)
            if self._stream is not None:
                self._stream.timeout_s = self._frame_s()

    def _frame_s(self) -> float:
        """Longest time from a frame's leader to its end."""
        return (self._exposure_s or 0.0) + 0.5 * self._timeout_s

    def _start(self) -> None:
        layout = self._transfers()
        set_if_there(self.nodes, "TLParamsLocked", 1)
        self._control.write(self._sirm + SIRM_CONTROL, struct.pack("<I", 1))
        self._stream = U3vStream(self._device, self._at.stream_in, layout, self._frame_s())
        try:
            self.nodes.execute("AcquisitionStart")
        except BaseException:
            self._end_stream()
            raise

    def _transfers(self) -> StreamLayout:
        """Write the stream's transfer sizes: whole megabytes, then the remainder, rounded up to the camera's
        alignment."""
        control, sirm = self._control, self._sirm
        alignment = 1 << (control.integer(sirm + SIRM_INFO) >> 24)
        payload = control.integer(sirm + SIRM_PAYLOAD, 8)
        if not 0 < payload <= 1 << 30:
            raise Garbled(f"{self._who}: frames of {payload} bytes; check its Width, Height and PixelFormat")
        leader_bytes = -(-max(control.integer(sirm + SIRM_LEADER), LEADER.size) // alignment) * alignment
        trailer_bytes = -(-max(control.integer(sirm + SIRM_TRAILER), TRAILER.size) // alignment) * alignment
        size = -(-_TRANSFER_BYTES // alignment) * alignment
        count, rest = divmod(payload, size)
        final = -(-rest // alignment) * alignment
        for offset, value in (
            (SIRM_MAX_LEADER, leader_bytes),
            (SIRM_TRANSFER_SIZE, size),
            (SIRM_TRANSFER_COUNT, count),
            (SIRM_FINAL_1, final),
            (SIRM_FINAL_2, 0),
            (SIRM_MAX_TRAILER, trailer_bytes),
        ):
            control.write(sirm + offset, struct.pack("<I", value))
        return StreamLayout(leader_bytes, trailer_bytes, (size,) * count + ((final,) if final else ()))

    def _give_trigger(self, features: CameraFeatures) -> None:
        self._control.attempts = 1  # a trigger that is sent twice may expose twice
        try:
            features.execute("TriggerSoftware")
        except InstrumentError:
            self.disarm()  # whether it exposed isn't known: no frame of it may be taken for the next one
            raise
        finally:
            self._control.attempts = ATTEMPTS

    def _grab(self, timeout_s: float) -> Grabbed | None:
        assert self._stream is not None
        try:
            return self._stream.get(timeout_s)
        except usb.core.USBError as error:
            told = translate(error, self._who, f"reading a frame of {self._exposure_s:g} s")
            if isinstance(told, NoAnswer):  # a halted endpoint: the next start clears it
                self.disarm()
                raise NoFrame(str(told)) from error
            self._drop()
            raise told from error

    def _halt(self) -> None:
        """Stop, and discard what is still in the pipe."""
        assert self._device is not None
        self._stop_streaming()
        try:
            self._device.clear_halt(self._at.stream_in)
            for _ in range(64):
                self._device.read(self._at.stream_in, _TRANSFER_BYTES, 20)
        except usb.core.USBTimeoutError:
            return  # the pipe is empty
        except usb.core.USBError as error:
            raise translate(error, self._who, "stopping") from error

    def _stop_streaming(self) -> None:
        try:
            self.nodes.execute("AcquisitionStop")
            self._control.write(self._sirm + SIRM_CONTROL, struct.pack("<I", 0))
            set_if_there(self.nodes, "TLParamsLocked", 0)
        finally:
            self._end_stream()

    def _end_stream(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()
