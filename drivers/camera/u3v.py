"""USB3 Vision cameras, of any maker, over pyusb.

The standard's own registers (ABRM, SBRM, SIRM), read over GenCP, say who the camera is and where its XML and its stream lie. Everything else
(exposure, gain, trigger) is found through that XML, which is read from the camera at connect (`drivers.camera.genapi`).

Source: A3, USB3 Vision 1.1; bytes checked against `tests/drivers/camera/test_u3v.py`.
"""

from __future__ import annotations

import contextlib
import math
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import usb.core
import usb.util

from drivers.camera.base import Camera, Frame, SensorInfo, Trigger
from drivers.camera.genapi import NodeMap
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
from drivers.camera.genicam_settings import (
    black_level,
    give_pulses,
    set_if_there,
    switch_processing_off,
    trigger_line,
)
from drivers.camera.pixel_format import PIXEL_FORMATS, PREFERENCE
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer
from drivers.instrument import Identity, Recorder
from drivers.usbip import open_device, translate

LEADER_MAGIC, TRAILER_MAGIC = 0x4C563355, 0x54563355  # "U3VL", "U3VT"
LEADER = struct.Struct("<IHHQHHQIIIIIHH")  # 52 bytes
TRAILER = struct.Struct("<IHHQHHQI")  # 32 bytes

# Offsets of the stream's registers (SIRM).
SIRM_INFO, SIRM_CONTROL, SIRM_PAYLOAD, SIRM_LEADER, SIRM_TRAILER = 0x00, 0x04, 0x08, 0x10, 0x14
SIRM_MAX_LEADER, SIRM_TRANSFER_SIZE, SIRM_TRANSFER_COUNT = 0x18, 0x1C, 0x20
SIRM_FINAL_1, SIRM_FINAL_2, SIRM_MAX_TRAILER = 0x24, 0x28, 0x2C

_TRANSFER_BYTES = 1 << 20
_LOOK_S = 0.1


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
            raise InstrumentError(f"{who}: this USB device is no USB3 Vision camera with a stream")

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


class U3vCamera(Camera):
    """One USB3 Vision camera at `usbip://HOST:PORT/SERIAL` or `usb://SERIAL` (or an already found pyusb `device`).

    `pixel_format`: a format's name, or None for the deepest raw format of up to 14 bits that the camera offers (16
    only if it has no other). `timeout_s`: longest time beyond the exposure until a frame has arrived. `trigger_line`: the
    input that is wired to the camera that leads; None: Line0. `output_line`: the output of the camera that leads, on which
    `output_source` gives the pulses; None: it gives none.
    """

    def __init__(
        self,
        address: str,
        *,
        pixel_format: str | None = None,
        timeout_s: float = 3.0,
        trigger_line: str | None = None,
        output_line: str | None = None,
        output_source: str = "ExposureActive",
        device: usb.core.Device | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.address = address
        self._given = device
        self._wanted_format = pixel_format
        self._timeout_s = timeout_s
        self._wanted_line, self._output_line, self._output_source = trigger_line, output_line, output_source
        self._recorder = recorder
        self._who = f"camera {address}"
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._device: usb.core.Device | None = None
        self._armed: Trigger | None = None
        self._exposure_s: float | None = None
        self._gain_db = 0.0
        self._fired: datetime | None = None

    # --- connection ---------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Find the camera, read its registers and XML, choose the pixel format, and stop any acquisition."""
        with self._lock:
            self.close()
            device = self._given if self._given is not None else open_device(self.address)
            self._device = device
            try:
                self._open(device)
            except usb.core.USBError as error:
                self._drop()
                raise translate(error, self._who, "connecting") from error
            except InstrumentError:
                self._drop()
                raise

    def _open(self, device: usb.core.Device) -> None:
        at = _Interfaces.of(device, self._who)
        for interface in (at.control_interface, at.stream_interface):
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(interface):
                    device.detach_kernel_driver(interface)
            usb.util.claim_interface(device, interface)
        for endpoint in (at.control_in, at.control_out, at.stream_in):
            device.clear_halt(endpoint)
        self._at = at
        control = GenCp(device, at.control_out, at.control_in, self._who, self._recorder)
        self._control = control
        control.response_ms = max(control.integer(ABRM_RESPONSE_MS), RESPONSE_FLOOR_MS)
        sbrm = control.integer(ABRM_SBRM, 8)
        largest_command, largest_ack = control.integer(sbrm + SBRM_MAX_COMMAND), control.integer(sbrm + SBRM_MAX_ACK)
        control.max_command = max(LEAST_PACKET, largest_command)
        control.max_ack = max(LEAST_PACKET, min(largest_ack, 1 << 16))
        self._sirm = control.integer(sbrm + SBRM_SIRM, 8)
        self._identity = Identity(
            maker=control.text(ABRM_MANUFACTURER),
            model=control.text(ABRM_MODEL),
            serial_number=control.text(ABRM_SERIAL),
            firmware=control.text(ABRM_DEVICE_VERSION),
        )
        self._who = f"camera {self._identity.serial_number or self.address}"
        self.nodes = NodeMap(read_xml(control, self._who), control)
        self._stop_acquisition()
        self._choose_format()
        set_if_there(self.nodes, "AcquisitionMode", "Continuous")
        set_if_there(self.nodes, "ExposureMode", "Timed")
        switch_processing_off(self.nodes, self._who)
        set_if_there(self.nodes, "TriggerSelector", "FrameStart")
        self.nodes.set("TriggerMode", "On")
        if self._wanted_line is not None:
            trigger_line(self.nodes, self._who, self._wanted_line)
        if self._output_line is not None:
            give_pulses(self.nodes, self._who, self._output_line, self._output_source)
        self._prepare_stream()

    def _choose_format(self) -> None:
        offered = self.nodes.entries("PixelFormat")
        if self._wanted_format is not None:
            names = [self._wanted_format]
        else:
            names = [item.name for item in PREFERENCE if item.name in offered]
        for name in names:
            if name in offered and offered[name] in PIXEL_FORMATS:
                self.nodes.set("PixelFormat", name)
                self._format = PIXEL_FORMATS[offered[name]]
                return
        raise InstrumentError(
            f"{self._who}: pixel format {self._wanted_format or 'raw'} isn't offered or known; it offers {', '.join(offered)}"
        )

    def _prepare_stream(self) -> None:
        """Write the stream's transfer sizes: whole megabytes, then the remainder, rounded up to the camera's
        alignment."""
        control, sirm = self._control, self._sirm
        alignment = 1 << (control.integer(sirm + SIRM_INFO) >> 24)
        payload = control.integer(sirm + SIRM_PAYLOAD, 8)
        if not 0 < payload <= 1 << 30:
            raise Garbled(f"{self._who}: frames of {payload} bytes; check its Width, Height and PixelFormat")
        self._leader_bytes = -(-max(control.integer(sirm + SIRM_LEADER), LEADER.size) // alignment) * alignment
        self._trailer_bytes = -(-max(control.integer(sirm + SIRM_TRAILER), TRAILER.size) // alignment) * alignment
        size = -(-_TRANSFER_BYTES // alignment) * alignment
        count, rest = divmod(payload, size)
        final = -(-rest // alignment) * alignment
        self._payload_bytes = payload
        self._transfers = [size] * count + ([final] if final else [])
        for offset, value in (
            (SIRM_MAX_LEADER, self._leader_bytes),
            (SIRM_TRANSFER_SIZE, size),
            (SIRM_TRANSFER_COUNT, count),
            (SIRM_FINAL_1, final),
            (SIRM_FINAL_2, 0),
            (SIRM_MAX_TRAILER, self._trailer_bytes),
        ):
            control.write(sirm + offset, struct.pack("<I", value))

    def _ready(self) -> None:
        if self._device is None:
            exposure_s, gain_db = self._exposure_s, self._gain_db
            self.connect()
            if exposure_s is not None:
                self.configure(exposure_s, gain_db)

    def identity(self) -> Identity:
        with self._lock:
            self._ready()
            return self._identity

    def sensor(self) -> SensorInfo:
        with self._lock, self._lost():
            self._ready()
            pitch = self.nodes.number("SensorPixelWidth") if self.nodes.has("SensorPixelWidth") else None
            return SensorInfo(
                rows=int(self.nodes.number("Height")),
                cols=int(self.nodes.number("Width")),
                pixel_format=self._format.name,
                cfa=self._format.cfa,
                bit_depth=self._format.bits,
                pixel_pitch_um=None if pitch is None else float(pitch),
                black_level=black_level(self.nodes),
            )

    # --- frames -------------------------------------------------------------------------------------------------------

    def configure(self, exposure_s: float, gain_db: float = 0.0) -> None:
        if not (math.isfinite(exposure_s) and exposure_s > 0 and math.isfinite(gain_db)):
            raise InstrumentError(f"{self._who}: exposure {exposure_s} s at {gain_db} dB; give a positive time")
        with self._lock, self._lost():
            self._ready()
            self.nodes.set("ExposureTime", exposure_s * 1e6)
            if self.nodes.has("Gain"):
                self.nodes.set("Gain", gain_db)
            elif gain_db:
                raise InstrumentError(f"{self._who}: it has no gain to set to {gain_db} dB; leave it at 0")
            self._exposure_s = float(self.nodes.number("ExposureTime")) * 1e-6
            self._gain_db = float(self.nodes.number("Gain")) if self.nodes.has("Gain") else 0.0

    def arm(self, trigger: Trigger = "software") -> None:
        with self._lock, self._lost():
            self._ready()
            if self._exposure_s is None:
                raise InstrumentError(f"{self._who}: no exposure time was set; call configure first")
            if self._armed != trigger:
                self._stop_acquisition()
                line = "Software"
                if trigger == "line":
                    line = trigger_line(self.nodes, self._who, self._wanted_line)
                self.nodes.set("TriggerSource", line)
                set_if_there(self.nodes, "TLParamsLocked", 1)
                self._control.write(self._sirm + SIRM_CONTROL, struct.pack("<I", 1))
                self.nodes.execute("AcquisitionStart")
                self._armed = trigger
            self._fired = datetime.now(UTC)

    def fire(self) -> None:
        with self._lock, self._lost():
            if self._device is None or self._armed != "software":
                raise InstrumentError(f"{self._who}: it isn't armed for a software trigger; call arm first")
            self._fired = datetime.now(UTC)
            self._control.attempts = 1  # a trigger that is sent twice may expose twice
            try:
                self.nodes.execute("TriggerSoftware")
            except InstrumentError:
                self._recover()  # whether it exposed isn't known: no frame of it may be taken for the next one
                raise
            finally:
                self._control.attempts = ATTEMPTS

    def collect(self) -> Frame:
        with self._lock, self._lost():
            if self._device is None or self._armed is None or self._exposure_s is None or self._fired is None:
                raise InstrumentError(f"{self._who}: no frame was asked for; call arm and fire first")
            try:
                return self._collect(self._exposure_s, self._fired)
            except usb.core.USBError as error:
                failure = translate(error, self._who, f"reading a frame of {self._exposure_s:g} s")
            except InstrumentError as error:
                failure = error
            if self._armed == "line" and isinstance(failure, NoAnswer):
                line = self._wanted_line or "Line0"
                failure = NoAnswer(f"{failure}; it waited for {line}: the camera that leads needs output_line")
            self._recover()
            raise failure

    def _collect(self, exposure_s: float, fired: datetime) -> Frame:
        deadline = time.monotonic() + exposure_s + self._timeout_s
        leader = self._await_leader(deadline)
        if len(leader) < LEADER.size or LEADER.unpack_from(leader)[0] != LEADER_MAGIC:
            raise Garbled(f"{self._who}: a frame began with {leader[:8].hex()}, not with a leader; it is taken again")
        (_, _, _, frame_id, _, _, _, code, cols, rows, _, _, padding, _) = LEADER.unpack_from(leader)
        pixel_format = PIXEL_FORMATS.get(code)
        if pixel_format is None:
            raise Garbled(f"{self._who}: frame {frame_id} has the unknown pixel format {code:#010x}")
        payload = bytearray()
        for size in self._transfers:
            piece = self._stream(size, deadline)
            payload += piece
            if len(piece) < size:
                break  # a short transfer ends the payload
        expected = pixel_format.payload_bytes(cols) * rows + padding * rows
        if len(payload) < expected:
            if payload[-TRAILER.size :][:4] == struct.pack("<I", TRAILER_MAGIC):
                del payload[-TRAILER.size :]
            raise NoAnswer(
                f"{self._who}: frame {frame_id} has {len(payload)} of {expected} bytes; use a shorter cable or another port"
            )
        trailer = self._stream(self._trailer_bytes, deadline)
        if len(trailer) < TRAILER.size or TRAILER.unpack_from(trailer)[0] != TRAILER_MAGIC:
            raise Garbled(f"{self._who}: frame {frame_id} ended with {trailer[:8].hex()}, not with a trailer")
        _, _, _, trailer_id, status, _, valid, _ = TRAILER.unpack_from(trailer)
        if status or trailer_id != frame_id or valid < expected:
            raise Garbled(
                f"{self._who}: frame {frame_id} is damaged: {STATUS.get(status, hex(status))}, {valid} of {expected} bytes "
                f"valid, trailer of frame {trailer_id}"
            )
        temperature = float(self.nodes.number("DeviceTemperature")) if self.nodes.has("DeviceTemperature") else None
        return Frame(
            raw=pixel_format.unpack(payload, rows, cols, padding),
            exposure_s=exposure_s,
            gain_db=self._gain_db,
            temperature_c=temperature,
            time=fired,
            pixel_format=pixel_format.name,
            frame_id=frame_id,
        )

    def _await_leader(self, deadline: float) -> bytes:
        """The leader, one short packet; until it comes, it is looked every now and then whether `stop` was called."""
        while True:
            if self._stopped.is_set():
                raise Interrupted(f"{self._who}: stopped while waiting for a frame; start again")
            try:
                return self._stream(self._leader_bytes, min(deadline, time.monotonic() + _LOOK_S))
            except usb.core.USBTimeoutError:
                if time.monotonic() >= deadline:
                    raise

    def _stream(self, size: int, deadline: float) -> bytes:
        left_ms = max(1, int((deadline - time.monotonic()) * 1000))
        assert self._device is not None
        return bytes(self._device.read(self._at.stream_in, size, left_ms))

    def _recover(self) -> None:
        """After a broken frame: stop, and discard what is still in the pipe; the next `arm` starts anew."""
        try:
            self._stop_acquisition()
            assert self._device is not None
            self._device.clear_halt(self._at.stream_in)
            for _ in range(64):
                self._device.read(self._at.stream_in, _TRANSFER_BYTES, 20)
        except usb.core.USBTimeoutError:
            return  # the pipe is empty
        except (usb.core.USBError, InstrumentError):
            self._drop()

    def _stop_acquisition(self) -> None:
        self._armed = None
        self.nodes.execute("AcquisitionStop")
        self._control.write(self._sirm + SIRM_CONTROL, struct.pack("<I", 0))
        set_if_there(self.nodes, "TLParamsLocked", 0)

    @contextlib.contextmanager
    def _lost(self) -> Iterator[None]:
        """Forget a lost connection, so that the next call connects again."""
        try:
            yield
        except usb.core.USBError as error:
            self._drop()
            raise translate(error, self._who, "being used") from error
        except Disconnected:
            self._drop()
            raise

    def _drop(self) -> None:
        device, self._device, self._armed = self._device, None, None
        if device is not None:
            with contextlib.suppress(usb.core.USBError):
                usb.util.dispose_resources(device)

    def stop(self) -> None:
        """End the exposure under way, in whatever thread it is waited for."""
        self._stopped.set()
        with contextlib.suppress(InstrumentError, usb.core.USBError), self._lock:
            self._stopped.clear()
            if self._device is not None:
                self._stop_acquisition()

    def close(self) -> None:
        with self._lock:
            self.stop()
            self._drop()
