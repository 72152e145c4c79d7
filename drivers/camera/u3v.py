"""USB3 Vision cameras, of any maker, over pyusb.

Control is GenCP: packets that read and write the camera's memory. The standard's own registers (ABRM, SBRM, SIRM) say who
the camera is and where its XML and its stream lie; everything else (exposure, gain, trigger) is found through that XML,
read from the camera at connect (`drivers.camera.genapi`).

Source: EMVA, GenICam GenCP 1.2; A3, USB3 Vision 1.1; bytes checked against `tests/drivers/camera/test_u3v.py`.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
import threading
import time
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import usb.core
import usb.util
from numpy.typing import NDArray

from drivers.camera.base import Camera, Frame, SensorInfo, Trigger
from drivers.camera.genapi import NodeMap
from drivers.errors import Disconnected, Garbled, InstrumentError, NoAnswer, Refused
from drivers.instrument import Identity, Recorder
from drivers.usbip import open_device, translate

# --- the standard's bytes ---------------------------------------------------------------------------------------------

PREFIX = struct.Struct("<IHHHH")  # magic, flags or status, command, size, request id
PREFIX_MAGIC = 0x43563355  # "U3VC"
REQUEST_ACK = 0x4000
READ_MEM, READ_MEM_ACK = 0x0800, 0x0801
WRITE_MEM, WRITE_MEM_ACK = 0x0802, 0x0803
PENDING_ACK = 0x0805
READ_COMMAND = struct.Struct("<QHH")  # address, reserved, count

LEADER_MAGIC, TRAILER_MAGIC = 0x4C563355, 0x54563355  # "U3VL", "U3VT"
LEADER = struct.Struct("<IHHQHHQIIIIIHH")  # 52 bytes
TRAILER = struct.Struct("<IHHQHHQI")  # 32 bytes

STATUS = {
    0x8001: "not implemented",
    0x8002: "invalid parameter",
    0x8003: "no register at this address",
    0x8004: "write-protected",
    0x8005: "bad alignment",
    0x8006: "access denied",
    0x8007: "busy",
    0x800B: "message timed out",
    0x800E: "invalid header",
    0x800F: "wrong configuration",
    0x8FFF: "error",
    0xA001: "resend not supported",
    0xA002: "stream endpoint halted",
    0xA003: "payload size not aligned",
    0xA004: "stream registers inconsistent",
    0xA100: "data discarded",
    0xA101: "data overrun",
}

# Addresses that the standard fixes (ABRM) and offsets in what they point at (SBRM, SIRM).
ABRM_MANUFACTURER, ABRM_MODEL, ABRM_DEVICE_VERSION, ABRM_SERIAL = 0x04, 0x44, 0xC4, 0x144
ABRM_RESPONSE_MS, ABRM_MANIFEST, ABRM_SBRM = 0x1CC, 0x1D0, 0x1D8
SBRM_MAX_COMMAND, SBRM_MAX_ACK, SBRM_SIRM = 0x14, 0x18, 0x20
SIRM_INFO, SIRM_CONTROL, SIRM_PAYLOAD, SIRM_LEADER, SIRM_TRAILER = 0x00, 0x04, 0x08, 0x10, 0x14
SIRM_MAX_LEADER, SIRM_TRANSFER_SIZE, SIRM_TRANSFER_COUNT = 0x18, 0x1C, 0x20
SIRM_FINAL_1, SIRM_FINAL_2, SIRM_MAX_TRAILER = 0x24, 0x28, 0x2C
MANIFEST_ENTRY = struct.Struct("<IIQQ20s20x")  # file version, schema, address, size, SHA-1
TEXT_BYTES = 64

_MOST_XML_BYTES = 16 * 1024 * 1024
_TRANSFER_BYTES = 1 << 20
_ATTEMPTS = 3
_LEAST_PACKET = PREFIX.size + 64
_RESPONSE_FLOOR_MS = 500


@dataclass(frozen=True)
class PixelFormat:
    """How pixels lie in the payload."""

    name: str
    code: int
    cfa: str
    bits: int
    packed: bool  # 12p, 10p: a stream of bits, least significant first; else 8 or 16 bits a pixel

    def payload_bytes(self, pixels: int) -> int:
        """Bytes that so many pixels take."""
        return (pixels * self.bits + 7) // 8 if self.packed else pixels * (1 if self.bits == 8 else 2)

    def unpack(self, payload: bytes | bytearray, rows: int, cols: int, padding: int = 0) -> NDArray[np.uint16]:
        """(rows, cols) uint16 of a payload whose rows are followed by `padding` bytes. Raises ValueError if it is short."""
        line = self.payload_bytes(cols) + padding
        if padding == 0:
            flat = self._unpack_flat(np.frombuffer(payload, np.uint8), rows * cols)
            return flat.reshape(rows, cols)
        data = np.frombuffer(payload, np.uint8, rows * line).reshape(rows, line)
        return np.stack([self._unpack_flat(row[: line - padding], cols) for row in data])

    def _unpack_flat(self, data: NDArray[np.uint8], pixels: int) -> NDArray[np.uint16]:
        need = self.payload_bytes(pixels)
        if data.size < need:
            raise ValueError(f"{data.size} bytes are too few for {pixels} pixels of {self.name}")
        data = data[:need]
        if not self.packed:
            return data.astype(np.uint16) if self.bits == 8 else data.view("<u2").astype(np.uint16)
        if self.bits == 12:
            padded = np.append(data, 0) if need % 3 else data
            low, middle, high = (padded[k::3].astype(np.uint16) for k in range(3))
            pairs = (len(padded) + 2) // 3
            out = np.zeros((pairs, 2), np.uint16)
            out[:, 0] = low | ((middle & 0x0F) << 8)
            out[: len(high), 1] = (middle[: len(high)] >> 4) | (high << 4)
            return out.reshape(-1)[:pixels]
        bits = np.unpackbits(data, bitorder="little")[: pixels * self.bits].reshape(pixels, self.bits)
        return bits.astype(np.uint16) @ (1 << np.arange(self.bits)).astype(np.uint16)


def _formats() -> dict[int, PixelFormat]:
    """PFNC's single-channel formats: code -> format. The pixel at [0, 0] names the Bayer phase."""
    phases = {"GR": "GRBG", "RG": "RGGB", "GB": "GBRG", "BG": "BGGR"}
    first = {8: 0x01080008, 10: 0x0110000C, 12: 0x01100010, 16: 0x0110002E}
    packed = {
        10: {"BG": 0x010A0052, "GB": 0x010A0054, "GR": 0x010A0056, "RG": 0x010A0058},
        12: {"BG": 0x010C0053, "GB": 0x010C0055, "GR": 0x010C0057, "RG": 0x010C0059},
    }
    mono = {8: 0x01080001, 10: 0x01100003, 12: 0x01100005, 14: 0x01100025, 16: 0x01100007}
    found = [PixelFormat(f"Mono{bits}", code, "MONO", bits, False) for bits, code in mono.items()]
    found += [
        PixelFormat("Mono10p", 0x010A0046, "MONO", 10, True),
        PixelFormat("Mono12p", 0x010C0047, "MONO", 12, True),
    ]
    for index, (short, cfa) in enumerate(phases.items()):
        found += [PixelFormat(f"Bayer{short}{bits}", code + index, cfa, bits, False) for bits, code in first.items()]
        found += [PixelFormat(f"Bayer{short}{bits}p", codes[short], cfa, bits, True) for bits, codes in packed.items()]
    return {item.code: item for item in found}


PIXEL_FORMATS = _formats()
#: What is chosen if the camera offers it: the deepest first, plain before packed; 16 bits last, for most cameras only
#: shift their 10 or 12 bits up in it, and codes should be the converter's.
_PREFERENCE = sorted(PIXEL_FORMATS.values(), key=lambda item: (item.bits == 16, -item.bits, item.packed, item.name))


# --- control ----------------------------------------------------------------------------------------------------------


class GenCp:
    """The control channel: `read` and `write` of the camera's memory, each with time-out and repeat.

    Thread-safe. Raises `Refused` with GenCP's status, `NoAnswer`, `Disconnected`, `Garbled`.
    """

    def __init__(
        self, device: usb.core.Device, out: int, into: int, who: str, recorder: Recorder | None = None
    ) -> None:
        self._device, self._out, self._in = device, out, into
        self._who = who
        self._recorder = recorder
        self._lock = threading.Lock()
        self._request_id = 0
        self.response_ms = _RESPONSE_FLOOR_MS
        self.attempts = _ATTEMPTS
        # what every camera takes until it says more: one of the standard's texts
        self.max_command = self.max_ack = _LEAST_PACKET

    def read(self, address: int, length: int) -> bytes:
        """`length` bytes at `address`, in as many packets as the camera asks for."""
        data = bytearray()
        most = max(4, self.max_ack - PREFIX.size)
        while len(data) < length:
            count = min(length - len(data), most)
            answer = self._transact(READ_MEM, READ_COMMAND.pack(address + len(data), 0, count), READ_MEM_ACK)
            if len(answer) != count:
                raise Garbled(f"{self._who}: {len(answer)} bytes came for {count} asked at {address + len(data):#x}")
            data += answer
        return bytes(data)

    def write(self, address: int, data: bytes) -> None:
        """Write `data` at `address`."""
        most = max(4, self.max_command - PREFIX.size - 8)
        for at in range(0, len(data), most):
            piece = data[at : at + most]
            answer = self._transact(WRITE_MEM, struct.pack("<Q", address + at) + piece, WRITE_MEM_ACK)
            if len(answer) >= 4 and struct.unpack_from("<HH", answer)[1] not in (0, len(piece)):
                raise Garbled(f"{self._who}: not all of {len(piece)} bytes were written at {address + at:#x}")

    def integer(self, address: int, length: int = 4) -> int:
        """An unsigned little-endian integer."""
        return int.from_bytes(self.read(address, length), "little")

    def text(self, address: int) -> str:
        """One of the standard's 64-byte texts."""
        return self.read(address, TEXT_BYTES).split(b"\0", 1)[0].decode("utf-8", "replace")

    def _transact(self, command: int, body: bytes, expected: int) -> bytes:
        with self._lock:
            self._request_id = self._request_id % 0xFFFF + 1
            packet = PREFIX.pack(PREFIX_MAGIC, REQUEST_ACK, command, len(body), self._request_id) + body
            for attempt in range(self.attempts):  # a lost packet is repeated under its own number, as GenCP says
                try:
                    return self._once(packet, expected)
                except NoAnswer:
                    if attempt == self.attempts - 1:
                        raise
            raise AssertionError("unreachable")

    def _once(self, packet: bytes, expected: int) -> bytes:
        doing = f"accessing its memory ({packet[6:8][::-1].hex()})"
        try:
            self._record("sent", packet)
            self._device.write(self._out, packet, self.response_ms)
            deadline = time.monotonic() + self.response_ms / 1000
            while True:
                left_ms = max(1, int((deadline - time.monotonic()) * 1000))
                answer = bytes(self._device.read(self._in, self.max_ack, left_ms))
                self._record("received", answer)
                if len(answer) < PREFIX.size:
                    raise Garbled(f"{self._who}: answered {answer.hex() or 'nothing'} while {doing}")
                magic, status, command, size, request_id = PREFIX.unpack_from(answer)
                if magic != PREFIX_MAGIC or len(answer) < PREFIX.size + size:
                    raise Garbled(f"{self._who}: answered {answer[:16].hex()} while {doing}")
                if request_id != self._request_id:
                    continue  # the late answer to a request that was given up
                body = answer[PREFIX.size : PREFIX.size + size]
                if command == PENDING_ACK:
                    deadline = time.monotonic() + struct.unpack_from("<HH", body)[1] / 1000
                    continue
                if status:
                    meaning = STATUS.get(status, "unknown status")
                    raise Refused(f"{self._who}: refused {doing}: {meaning} ({status:#06x})", status)
                if command != expected:
                    raise Garbled(f"{self._who}: answered command {command:#06x} while {doing}")
                return body
        except usb.core.USBError as error:
            raise translate(error, self._who, doing) from error

    def _record(self, direction: str, data: bytes) -> None:
        if self._recorder is not None:
            self._recorder("sent" if direction == "sent" else "received", data)


def read_xml(control: GenCp, who: str) -> bytes:
    """The camera's XML: the newest entry of its manifest, unzipped."""
    table = control.integer(ABRM_MANIFEST, 8)
    count = control.integer(table, 8)
    if not 1 <= count <= 64:
        raise Garbled(f"{who}: its manifest lists {count} files")
    entries = [
        MANIFEST_ENTRY.unpack(control.read(table + 8 + index * MANIFEST_ENTRY.size, MANIFEST_ENTRY.size))
        for index in range(count)
    ]
    _, schema, address, size, _ = max(entries, key=lambda entry: entry[0])
    if not 0 < size <= _MOST_XML_BYTES:
        raise Garbled(f"{who}: its XML claims {size} bytes")
    data = control.read(address, size)
    if (schema >> 10) & 0x3F == 0:
        return data.rstrip(b"\0")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            member = next(info for info in archive.infolist() if info.filename.lower().endswith(".xml"))
            with archive.open(member) as stream:
                xml = stream.read(_MOST_XML_BYTES + 1)
    except (zipfile.BadZipFile, StopIteration, zlib.error, NotImplementedError, RuntimeError) as error:
        raise Garbled(f"{who}: its zipped XML can't be read ({error})") from error
    if len(xml) > _MOST_XML_BYTES:
        raise Garbled(f"{who}: its XML is larger than {_MOST_XML_BYTES} bytes")
    return xml


# --- the camera -------------------------------------------------------------------------------------------------------


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

    `pixel_format`: a format's name, or None for the deepest raw one of up to 14 bits that the camera offers (16 only if it has
    no other). `timeout_s`: how long beyond the
    exposure a frame may take.
    """

    def __init__(
        self,
        address: str,
        *,
        pixel_format: str | None = None,
        timeout_s: float = 3.0,
        device: usb.core.Device | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.address = address
        self._given = device
        self._wanted_format = pixel_format
        self._timeout_s = timeout_s
        self._recorder = recorder
        self._who = f"camera {address}"
        self._lock = threading.RLock()
        self._device: usb.core.Device | None = None
        self._armed: Trigger | None = None
        self._exposure_s: float | None = None
        self._gain_db = 0.0
        self._fired: datetime | None = None

    # --- connection ---------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Find the camera, read its registers and XML, choose the pixel format, and stop whatever it was doing."""
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
        control.response_ms = max(control.integer(ABRM_RESPONSE_MS), _RESPONSE_FLOOR_MS)
        sbrm = control.integer(ABRM_SBRM, 8)
        largest_command, largest_ack = control.integer(sbrm + SBRM_MAX_COMMAND), control.integer(sbrm + SBRM_MAX_ACK)
        control.max_command = max(_LEAST_PACKET, largest_command)
        control.max_ack = max(_LEAST_PACKET, min(largest_ack, 1 << 16))
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
        self._set_if_there("AcquisitionMode", "Continuous")
        self._set_if_there("ExposureMode", "Timed")
        for automatic in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto"):
            self._set_if_there(automatic, "Off")
        self._set_if_there("TriggerSelector", "FrameStart")
        self.nodes.set("TriggerMode", "On")
        self._prepare_stream()

    def _set_if_there(self, feature: str, value: str) -> None:
        if self.nodes.has(feature) and value in self.nodes.entries(feature):
            self.nodes.set(feature, value)

    def _choose_format(self) -> None:
        offered = self.nodes.entries("PixelFormat")
        if self._wanted_format is not None:
            names = [self._wanted_format]
        else:
            names = [item.name for item in _PREFERENCE if item.name in offered]
        for name in names:
            if name in offered and offered[name] in PIXEL_FORMATS:
                self.nodes.set("PixelFormat", name)
                self._format = PIXEL_FORMATS[offered[name]]
                return
        raise InstrumentError(
            f"{self._who}: pixel format {self._wanted_format or 'raw'} isn't offered or known; it offers {', '.join(offered)}"
        )

    def _prepare_stream(self) -> None:
        """Write the stream's transfer sizes: whole megabytes, then what is left, rounded up to the camera's alignment."""
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
                self.nodes.set("TriggerSource", "Software" if trigger == "software" else "Line0")
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
                self._control.attempts = _ATTEMPTS

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
            self._recover()
            raise failure

    def _collect(self, exposure_s: float, fired: datetime) -> Frame:
        deadline = time.monotonic() + exposure_s + self._timeout_s
        leader = self._stream(self._leader_bytes, deadline)
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

    def _stream(self, size: int, deadline: float) -> bytes:
        left_ms = max(1, int((deadline - time.monotonic()) * 1000))
        assert self._device is not None
        return bytes(self._device.read(self._at.stream_in, size, left_ms))

    def _recover(self) -> None:
        """After a broken frame: stop, throw away what is still in the pipe; the next `arm` starts afresh."""
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

    @contextlib.contextmanager
    def _lost(self) -> Iterator[None]:
        """A lost connection is forgotten, so that the next call connects again."""
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
        with contextlib.suppress(InstrumentError, usb.core.USBError), self._lock:
            if self._device is not None:
                self._stop_acquisition()

    def close(self) -> None:
        with self._lock:
            self.stop()
            self._drop()
