"""USB3 Vision cameras, of any maker, over pyusb.

The standard's own registers (ABRM, SBRM, SIRM), read over GenCP, say who the camera is and where its XML and its stream
lie. Everything else (exposure, gain, trigger) is found through that XML, which is read from the camera at connect
(`drivers.camera.genapi`).

Source: A3, USB3 Vision 1.1; bytes checked against `tests/drivers/camera/test_u3v.py`."""

from __future__ import annotations

import contextlib
import errno
import queue
import struct
import threading
import time
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
import usb.core
import usb.util
from numpy.typing import NDArray

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
    STATUS,
    GenCp,
    read_xml,
)
from drivers.camera.genicam import GenicamCamera, NoFrame
from drivers.camera.genicam_settings import CameraFeatures, set_if_there
from drivers.camera.pixel_format import PIXEL_FORMATS
from drivers.errors import Garbled, InstrumentError, NoAnswer
from drivers.instrument import Identity
from drivers.usbip import open_device, translate

# ----------------------------------------------------------------------------------------------------------------------
# The stream of a USB3 Vision camera: leader, payload and trailer put together to frames, by a thread that always has a
# transfer waiting.
#
# A leader is looked for before every frame, so that a frame which comes in part costs itself alone.
#
# Source: A3, USB3 Vision 1.1, section 5.


LEADER_MAGIC, TRAILER_MAGIC = 0x4C563355, 0x54563355  # "U3VL", "U3VT"
LEADER = struct.Struct("<IHHQHHQIIIIIHH")  # 52 bytes
TRAILER = struct.Struct("<IHHQHHQI")  # 32 bytes

#: Frames that wait for whoever reads them; the camera itself drops the next ones.
BUFFERS = 4
#: How often (s) the thread looks whether it is to end, while nothing comes.
_LOOK_S = 0.1
#: Longest wait (s) for a transfer within a frame, after which it is looked whether the stream ends: shorter waits would
#: fall into transfers more often.
_WAIT_S = 1.0


@dataclass(frozen=True)
class StreamLayout:
    """The transfers of one frame (bytes), as the stream's registers (SIRM) were set."""

    leader_bytes: int
    trailer_bytes: int
    transfers: tuple[int, ...]


@dataclass(frozen=True)
class _Leader:
    frame_id: int
    camera_time_ns: int
    code: int
    cols: int
    rows: int
    padding: int

    @classmethod
    def of(cls, data: bytes) -> _Leader | None:
        """None if it is no leader."""
        if len(data) < LEADER.size or LEADER.unpack_from(data)[0] != LEADER_MAGIC:
            return None
        (_, _, _, frame_id, _, _, time_ns, code, cols, rows, _, _, padding, _) = LEADER.unpack_from(data)
        return cls(frame_id, time_ns, code, cols, rows, padding)

    @property
    def payload_bytes(self) -> int:
        """Bytes of the whole payload; 0 for a pixel format that isn't known."""
        layout = PIXEL_FORMATS.get(self.code)
        return 0 if layout is None else (layout.payload_bytes(self.cols) + self.padding) * self.rows


class U3vStream:
    """Reads the stream endpoint on a thread of its own, from its making to `close`.

    `timeout_s`: longest time from a frame's leader to its end; it may be changed.
    """

    def __init__(self, device: usb.core.Device, endpoint: int, layout: StreamLayout, timeout_s: float) -> None:
        self._device, self._endpoint, self.timeout_s = device, endpoint, timeout_s
        self._head = array("B", bytes(max(layout.leader_bytes, layout.trailer_bytes)))
        self._pieces = [array("B", bytes(size)) for size in layout.transfers]
        self._leader: _Leader | None = None  # one that came where a trailer was due
        # The one given back last is filled next: of those that are never needed, no page is touched.
        self._free: queue.LifoQueue[NDArray[np.uint8]] = queue.LifoQueue()
        for _ in range(BUFFERS):
            self._free.put(np.empty(sum(layout.transfers), np.uint8))
        self._came: queue.SimpleQueue[Grabbed | usb.core.USBError] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="u3v-stream", daemon=True)
        self._thread.start()

    def get(self, timeout_s: float) -> Grabbed | None:
        """Return the next frame; None if none came in time. Raises the `USBError` that ended the stream."""
        with contextlib.suppress(queue.Empty):
            came = self._came.get(timeout=timeout_s)
            if isinstance(came, usb.core.USBError):
                self._came.put(came)
                raise came
            return came
        return None

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        self._thread.join(2 * _LOOK_S + min(2 * _WAIT_S, self.timeout_s))

    # --- the thread -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                leader = self._next_leader()
                buffer = None if leader is None else self._next_buffer()
                if leader is not None and buffer is not None:
                    self._came.put(self._frame(leader, buffer))
        except usb.core.USBError as error:
            self._came.put(error)

    def _next_leader(self) -> _Leader | None:
        """Return the leader of the next frame; what comes before one belongs to a frame whose leader was lost. None if
        nothing comes."""
        leader, self._leader = self._leader, None
        if leader is not None:
            return leader
        try:
            return _Leader.of(self._read(self._head, _LOOK_S))
        except usb.core.USBTimeoutError:
            return None

    def _next_buffer(self) -> NDArray[np.uint8] | None:
        while not self._ending.is_set():
            with contextlib.suppress(queue.Empty):
                return self._free.get(timeout=_LOOK_S)
        return None

    def _read(self, into: array[int], timeout_s: float) -> bytes:
        count = self._device.read(self._endpoint, into, max(1, int(1000 * timeout_s)))
        return into[:count].tobytes()

    def _frame(self, leader: _Leader, buffer: NDArray[np.uint8]) -> Grabbed:
        """Return the rest of a frame; what is missing of it stands in its `damage`."""
        deadline = time.monotonic() + self.timeout_s
        at, trailer, late = 0, b"", ""
        try:
            for piece in self._pieces:
                count = self._fill(piece, deadline)
                if count < len(piece) and count >= TRAILER.size and _is(piece, TRAILER_MAGIC):
                    trailer = piece[:count].tobytes()
                    break
                if count < len(piece) and count >= LEADER.size and _is(piece, LEADER_MAGIC):
                    self._leader = _Leader.of(piece[:count].tobytes())
                    break
                buffer[at : at + count] = np.frombuffer(piece, np.uint8, count)
                at += count
                if count < len(piece):
                    break  # a short transfer ends the payload
            if not trailer and self._leader is None:
                trailer = self._head[: self._fill(self._head, deadline)].tobytes()
                self._leader = _Leader.of(trailer)
        except usb.core.USBTimeoutError:
            late = f", and nothing more for {self.timeout_s:g} s"
        return Grabbed(
            payload=buffer[:at],
            rows=leader.rows,
            cols=leader.cols,
            code=leader.code,
            frame_id=leader.frame_id,
            padding=leader.padding,
            damage=_damage(leader, at, trailer, late),
            camera_time_ns=leader.camera_time_ns,
            give_back=lambda: self._free.put(buffer),
        )

    def _fill(self, piece: array[int], deadline: float) -> int:
        """Read a transfer until the deadline or the stream's end; the bytes that came. A long exposure is waited for in
        parts, so that a stop needn't wait for its end: a wait that ends within the transfer is followed by another for
        the rest of it."""
        came = 0
        while True:
            began = time.monotonic()
            part = piece if came == 0 else piece[came:]
            wait_ms = min(self._left_ms(deadline), int(1000 * _WAIT_S))
            try:
                count = self._device.read(self._endpoint, part, wait_ms)
            except usb.core.USBTimeoutError:
                count = 0
            if came:
                piece[came : came + count] = part[:count]
            came += count
            now = time.monotonic()
            if came == len(piece) or (count and now - began < wait_ms / 1000):
                return came
            if now >= deadline or self._ending.is_set():
                if came:
                    return came
                raise usb.core.USBTimeoutError("nothing came in time", errno=errno.ETIMEDOUT)

    @staticmethod
    def _left_ms(deadline: float) -> int:
        return max(1, int(1000 * (deadline - time.monotonic())))


def _is(piece: array[int], magic: int) -> bool:
    return piece[:4].tobytes() == struct.pack("<I", magic)


def _damage(leader: _Leader, came: int, trailer: bytes, late: str) -> str:
    """Return what is wrong with a frame of which `came` bytes of payload came; nothing if it is whole."""
    expected = leader.payload_bytes
    if came < expected:
        return f"{came} of {expected} bytes came{late}"
    if len(trailer) < TRAILER.size or TRAILER.unpack_from(trailer)[0] != TRAILER_MAGIC:
        return f"its trailer was lost{late}"
    _, _, _, frame_id, status, _, valid, _ = TRAILER.unpack_from(trailer)
    if status:
        return f"{STATUS.get(status, hex(status))}, {valid} of {expected} bytes valid"
    if frame_id != leader.frame_id:
        return f"its trailer is that of frame {frame_id}"
    return "" if valid >= expected else f"{valid} of {expected} bytes are valid"


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
        interfaces: dict[int, usb.core.Interface] = {}
        for interface in device.get_active_configuration():
            if (interface.bInterfaceClass, interface.bInterfaceSubClass) == (0xEF, 0x05):
                interfaces.setdefault(interface.bInterfaceProtocol, interface)
        if 0 not in interfaces or 2 not in interfaces:
            raise InstrumentError(
                f"{who}: this USB device is no USB3 Vision camera with a stream; correct the address in the station "
                "file"
            )

        def endpoint(interface: usb.core.Interface, incoming: bool) -> int:
            for item in interface:
                if bool(item.bEndpointAddress & 0x80) == incoming and item.bmAttributes & 3 == 2:
                    return int(item.bEndpointAddress)
            raise InstrumentError(f"{who}: interface {interface.bInterfaceNumber} lacks a bulk endpoint")

        control, stream = interfaces[0], interfaces[2]
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
            failure = translate(error, self._who, f"reading a frame of {self._exposure_s:g} s")
            if isinstance(failure, NoAnswer):  # a halted endpoint: the next start clears it
                self.disarm()
                raise NoFrame(str(failure)) from error
            self._drop()
            raise failure from error

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
