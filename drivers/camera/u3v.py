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

import numpy as np
import usb.core
import usb.util
from numpy.typing import NDArray

from drivers.camera.base import TEMPERATURE_NS, Frame, SensorInfo, StreamingCamera, Trigger
from drivers.camera.buffers import Grabbed
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
from drivers.camera.u3v_stream import LEADER, TRAILER, StreamLayout, U3vStream
from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted, NoAnswer, Repeated
from drivers.instrument import Identity, Recorder
from drivers.usbip import GONE, open_device, translate

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


class U3vCamera(StreamingCamera):
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
        self._stream: U3vStream | None = None
        self._frame_id: int | None = None  # of the frame before, since acquisition started
        self._temperature: tuple[int, float] | None = None  # when (ns of the camera's clock), and degrees

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
        leader_bytes = -(-max(control.integer(sirm + SIRM_LEADER), LEADER.size) // alignment) * alignment
        trailer_bytes = -(-max(control.integer(sirm + SIRM_TRAILER), TRAILER.size) // alignment) * alignment
        size = -(-_TRANSFER_BYTES // alignment) * alignment
        count, rest = divmod(payload, size)
        final = -(-rest // alignment) * alignment
        self._layout = StreamLayout(leader_bytes, trailer_bytes, (size,) * count + ((final,) if final else ()))
        for offset, value in (
            (SIRM_MAX_LEADER, leader_bytes),
            (SIRM_TRANSFER_SIZE, size),
            (SIRM_TRANSFER_COUNT, count),
            (SIRM_FINAL_1, final),
            (SIRM_FINAL_2, 0),
            (SIRM_MAX_TRAILER, trailer_bytes),
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
            if self._stream is not None:
                self._stream.timeout_s = self._exposure_s + 0.5 * self._timeout_s

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
                self._frame_id = None
                self._stream = U3vStream(
                    self._device, self._at.stream_in, self._layout, self._exposure_s + 0.5 * self._timeout_s
                )
                try:
                    self.nodes.execute("AcquisitionStart")
                except BaseException:
                    self._end_stream()
                    raise
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
        with self._lock:
            while True:
                try:
                    return self._next_frame(0)
                except Repeated:
                    continue  # of a trigger before this one
                except InstrumentError:
                    self.disarm()  # nothing of it may be taken for the next frame
                    raise

    def next_frame(self) -> Frame:
        return self._next_frame(TEMPERATURE_NS)

    def _next_frame(self, temperature_ns: int) -> Frame:
        with self._lock, self._lost():
            if self._stream is None or self._armed is None or self._exposure_s is None or self._fired is None:
                raise InstrumentError(f"{self._who}: no frame was asked for; call arm and fire first")
            grabbed, buffer = self._await_frame(self._stream, self._exposure_s)
            try:
                if grabbed.frame_id == self._frame_id:
                    raise Repeated(f"{self._who}: frame {grabbed.frame_id} came twice; it is dropped")
                self._frame_id = grabbed.frame_id
                raw, pixel_format = grabbed.unpacked(self._who)
            finally:
                self._stream.done(buffer)
            time_ns = grabbed.camera_time_ns
            assert time_ns is not None
            return Frame(
                raw=raw,
                exposure_s=self._exposure_s,
                gain_db=self._gain_db,
                temperature_c=self._temperature_c(time_ns, temperature_ns),
                time=self._fired,
                pixel_format=pixel_format.name,
                frame_id=grabbed.frame_id,
                camera_time_ns=time_ns,
            )

    def _await_frame(self, stream: U3vStream, exposure_s: float) -> tuple[Grabbed, NDArray[np.uint8]]:
        """The next frame, whole or not; every now and then it is looked whether `stop` was called."""
        deadline = time.monotonic() + exposure_s + self._timeout_s
        while True:
            if self._stopped.is_set():
                raise Interrupted(f"{self._who}: stopped while waiting for a frame; start again")
            left_s = deadline - time.monotonic()
            try:
                came = stream.get(max(0.0, min(_LOOK_S, left_s)))
            except usb.core.USBError as error:
                if error.errno in GONE:
                    raise
                self.disarm()
                raise translate(error, self._who, f"reading a frame of {exposure_s:g} s") from error
            if came is not None:
                return came
            if left_s <= 0.0:
                waited = ""
                if self._armed == "line":
                    waited = f"; it waited for {self._wanted_line or 'Line0'}: the camera that leads needs output_line"
                raise NoAnswer(
                    f"{self._who}: no answer while reading a frame of {exposure_s:g} s; check the cable and the power{waited}"
                )

    def _temperature_c(self, time_ns: int, most_ns: int) -> float | None:
        """The sensor's temperature, read again where the one before is `most_ns` older than the frame."""
        if not self.nodes.has("DeviceTemperature"):
            return None
        if self._temperature is None or not 0 <= time_ns - self._temperature[0] < most_ns:
            self._temperature = time_ns, float(self.nodes.number("DeviceTemperature"))
        return self._temperature[1]

    def disarm(self) -> None:
        with self._lock:
            if self._device is not None and self._armed is not None:
                self._recover()

    def _recover(self) -> None:
        """Stop, and discard what is still in the pipe; the next `arm` starts anew."""
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
        self._end_stream()
        if device is not None:
            with contextlib.suppress(usb.core.USBError):
                usb.util.dispose_resources(device)

    def stop(self) -> None:
        """End the exposure under way, in whatever thread it is waited for."""
        self._stopped.set()
        with contextlib.suppress(InstrumentError, usb.core.USBError), self._lock:
            self._stopped.clear()
            if self._armed is not None:
                self._recover()
            elif self._device is not None:
                self._stop_acquisition()

    def close(self) -> None:
        with self._lock:
            self.stop()
            self._drop()
