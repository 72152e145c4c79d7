"""GenCP, the control channel of USB3 Vision cameras: packets that read and write the camera's memory, and its XML.

Source: EMVA, GenICam GenCP 1.2; bytes checked against `tests/drivers/camera/test_u3v.py`.
"""

from __future__ import annotations

import contextlib
import errno
import io
import struct
import threading
import time
import zipfile
import zlib

import usb.core

from drivers.errors import Garbled, NoAnswer, Refused
from drivers.instrument import Recorder
from drivers.usbip import translate

PREFIX = struct.Struct("<IHHHH")  # magic, flags or status, command, size, request id
PREFIX_MAGIC = 0x43563355  # "U3VC"
REQUEST_ACK = 0x4000
READ_MEM, READ_MEM_ACK = 0x0800, 0x0801
WRITE_MEM, WRITE_MEM_ACK = 0x0802, 0x0803
PENDING_ACK = 0x0805
READ_COMMAND = struct.Struct("<QHH")  # address, reserved, count

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

# Addresses that the standard fixes (ABRM) and offsets in what they point at (SBRM).
ABRM_MANUFACTURER, ABRM_MODEL, ABRM_DEVICE_VERSION, ABRM_SERIAL = 0x04, 0x44, 0xC4, 0x144
ABRM_RESPONSE_MS, ABRM_MANIFEST, ABRM_SBRM = 0x1CC, 0x1D0, 0x1D8
SBRM_MAX_COMMAND, SBRM_MAX_ACK, SBRM_SIRM = 0x14, 0x18, 0x20
MANIFEST_ENTRY = struct.Struct("<IIQQ20s20x")  # file version, schema, address, size, SHA-1
TEXT_BYTES = 64

_MOST_XML_BYTES = 16 * 1024 * 1024
ATTEMPTS = 3
LEAST_PACKET = PREFIX.size + 64
RESPONSE_FLOOR_MS = 500


class GenCp:
    """The control channel: `read` and `write` of the camera's memory, each with time-out and repetition.

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
        self.response_ms = RESPONSE_FLOOR_MS
        self.attempts = ATTEMPTS
        # what every camera takes until it says more: one of the standard's texts
        self.max_command = self.max_ack = LEAST_PACKET

    def read(self, address: int, length: int) -> bytes:
        """Return `length` bytes at `address`, in packets of the size that the camera allows."""
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
        """Return an unsigned little-endian integer."""
        return int.from_bytes(self.read(address, length), "little")

    def text(self, address: int) -> str:
        """Return one of the standard's 64-byte texts."""
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
            if error.errno == errno.EPIPE:
                self._clear_halts()
            raise translate(error, self._who, doing) from error

    def _clear_halts(self) -> None:
        with contextlib.suppress(usb.core.USBError):
            for endpoint in (self._out, self._in):
                self._device.clear_halt(endpoint)

    def _record(self, direction: str, data: bytes) -> None:
        if self._recorder is not None:
            self._recorder("sent" if direction == "sent" else "received", data)


def read_xml(control: GenCp, who: str) -> bytes:
    """Return the camera's XML: the newest entry of its manifest, unzipped."""
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
