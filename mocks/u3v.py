"""A USB3 Vision camera as a USB device: GenCP control, registers, zipped GenICam XML, and the stream.

Everything a driver can learn stands in registers that a real camera has; light comes from the bench through one call,
`Bench.expose`. The registers' layout is this maker's own and stands in the XML alone.

Source: EMVA GenCP 1.2; A3 USB3 Vision 1.1; EMVA SFNC 2.7 for the features' names, PFNC for the pixel formats.
"""

from __future__ import annotations

import hashlib
import importlib.resources
import io
import string
import struct
import threading
import time
import zipfile
from collections import deque
from dataclasses import dataclass

import numpy as np

from mocks.bench import UInt16Array
from mocks.ready_frames import BAYER_RG8, BAYER_RG12, BAYER_RG12P, BeforeCameras, encode, payload_bytes
from mocks.usb_device import Cancelled, UsbDevice, UsbEndpoint, UsbIdentity, UsbInterface
from sim.camera import Side

MAKER, MODEL, FAMILY, VERSION = "calibench", "Mock U3V 480x640", "Mock U3V", "1.0.2"
CONTROL_OUT, CONTROL_IN, STREAM_IN = 0x01, 0x81, 0x82
MAX_COMMAND, MAX_ACK = 1024, 1024

# Where this maker put what the standard leaves open.
SBRM, SIRM, MANIFEST, XML, FEATURES = 0x1_0000, 0x2_0000, 0x3_0000, 0x4_0000, 0x10_0000
(
    SENSOR_WIDTH,
    SENSOR_HEIGHT,
    WIDTH,
    HEIGHT,
    OFFSET_X,
    OFFSET_Y,
    PIXEL_FORMAT,
    PAYLOAD_SIZE,
    ACQUISITION_START,
    ACQUISITION_STOP,
    ACQUISITION_MODE,
    TRIGGER_CONTROL,
    TRIGGER_SOFTWARE,
    EXPOSURE_TICKS,
    GAIN,
    TEMPERATURE,
    PIXEL_PITCH,
    BINNING,
    LINE_SELECTOR,
    LINE_MODE,  # one word a line
    LINE_MODE_1,
    LINE_SOURCE,
    LINE_SOURCE_1,
    GAMMA_ENABLE,
    BLACK_LEVEL,
    PARAMS_LOCKED,
    WHITE_AUTO,
    LIGHT_SOURCE,
    TEST_PATTERN,
    BALANCE_SELECTOR,
    BALANCE_RED,  # one word a channel
    BALANCE_GREEN,
    BALANCE_BLUE,
) = (FEATURES + 4 * n for n in range(33))
FEATURE_BYTES = 4 * 33

TICKS_PER_US = 10
MOST_EXPOSURE_US = 60e6
MOST_GAIN_DB = 24.0
TRIGGER_ON = 1 << 0
SOURCE_SHIFT, SOURCE_SOFTWARE, SOURCE_LINE = 4, 0, 1
_MOST_QUEUED = 4
#: Gains of red, green and blue after the converter, by `LightSourcePreset`: Off, Daylight5000K, Tungsten.
_PRESETS = ((1.0, 1.0, 1.0), (1.7, 1.0, 1.9), (1.1, 1.0, 2.6))
_MOST_CODE = 4095

#: What the faults of serial instruments are to a camera's frames (`UsbDevice.fail`).
_AS_FRAMES = {
    "late": "late",
    "never": "never",
    "half": "short",
    "wrong": "damaged",
    "error": "halt",
    "drop": "lost-trailer",
    "unplug": "unplug",
    "torn": "torn",
    "repeated": "repeated",
    "missed": "missed",
}

#: What a camera can be told to do wrong, once or several times (`U3vDevice.inject`).
FAULTS = {
    "late": "the next frame comes a second after it should",
    "never": "the next frame never comes",
    "short": "the next frame's payload breaks off",
    "lost-trailer": "the next frame's trailer is lost",
    "damaged": "the next frame's trailer says that data were discarded",
    "torn": "a transfer in the middle of the next frame is lost, its trailer says nothing",
    "repeated": "the next frame comes twice",
    "missed": "the next trigger isn't heard",
    "unplug": "the cable is pulled in the middle of the next frame",
    "busy": "the next command is refused as busy",
    "pending": "the next command is answered after a pending acknowledge",
    "silent": "the next command is lost",
    "lost-ack": "the next command is done, its acknowledge lost",
    "garbled": "the next acknowledge is garbled",
    "halt": "the stream endpoint halts before the next frame",
}


_OF_FRAMES = ("late", "never", "short", "lost-trailer", "damaged", "torn", "repeated", "missed", "unplug", "halt")


def _xml(rows: int, cols: int) -> bytes:
    """Return the camera's description of itself, with this sensor's size and the addresses above filled in."""
    places = {name: f"{value:#x}" for name, value in globals().items() if name.isupper() and isinstance(value, int)}
    template = string.Template((importlib.resources.files("mocks") / "u3v.xml").read_text("utf-8"))
    return template.substitute(
        places,
        ROWS=rows,
        COLS=cols,
        TICKS_PER_US=TICKS_PER_US,
        MOST_EXPOSURE_US=MOST_EXPOSURE_US,
        MOST_GAIN_DB=MOST_GAIN_DB,
    ).encode()


def _zip(xml: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("MockU3V_v1.0.2.xml"), xml, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def _float_of(bits: int) -> float:
    """Return a register's 32 bits as a float."""
    return float(struct.unpack("<f", struct.pack("<I", bits))[0])


def _float_bits(value: float) -> int:
    return int(struct.unpack("<I", struct.pack("<f", value))[0])


class TriggerLine:
    """The wire that runs from each camera's Line1 to the others' Line0; a pulse goes out where Line1 is set to follow
    the exposure."""

    def __init__(self) -> None:
        self._devices: list[U3vDevice] = []

    def connect(self, device: U3vDevice) -> None:
        """Solder a camera to the wire."""
        self._devices.append(device)

    def pulse(self, source: U3vDevice, start_s: float) -> None:
        """Tell the wired cameras that an exposure of `source` begins at virtual time `start_s`."""
        if not source.gives_pulses:
            return
        for device in self._devices:
            if device is not source:
                device.line_pulse(start_s)


class _GenCpRefusal(Exception):
    """A GenCP status other than success."""

    def __init__(self, status: int) -> None:
        super().__init__(f"{status:#06x}")
        self.status = status


@dataclass
class _Region:
    start: int
    data: bytearray
    writable: bool = False

    def holds(self, address: int, count: int) -> bool:
        return self.start <= address and address + count <= self.start + len(self.data)


class U3vDevice(UsbDevice):
    """One camera on the bench. `inject(fault)` makes it fail; `line` couples it to others."""

    speed = 5

    def __init__(self, bench: BeforeCameras, side: Side, serial_number: str, line: TriggerLine | None = None) -> None:
        companion = bytes([6, 0x30, 15, 0, 0, 0])
        super().__init__(
            UsbIdentity(
                0x1209,  # pid.codes' product 0x000A is free for tests
                0x000A,
                (0xEF, 0x02, 0x01),
                MAKER,
                MODEL,
                serial_number,
                usb_version=0x0300,
                release=0x0102,
                max_packet_0=9,
            ),
            (),
            association=bytes([8, 11, 0, 2, 0xEF, 0x05, 0x00, 0]),
        )
        index = self.string_index
        information = struct.pack(
            "<BBBII8BB",
            20,
            0x24,
            0x01,
            0x0001_0002,  # GenCP 1.2
            0x0001_0001,  # USB3 Vision 1.1
            index(f"CB01{hashlib.sha1(serial_number.encode()).hexdigest()[:8].upper()}"),
            index(MAKER),
            index(MODEL),
            index(FAMILY),
            index(VERSION),
            index("mock camera of the calibench bench"),
            index(serial_number),
            0,
            0x08,  # SuperSpeed
        )
        self.interfaces = (
            UsbInterface(
                0,
                (0xEF, 0x05, 0x00),
                (UsbEndpoint(CONTROL_IN, 2, 1024, 0, companion), UsbEndpoint(CONTROL_OUT, 2, 1024, 0, companion)),
                information,
            ),
            UsbInterface(1, (0xEF, 0x05, 0x02), (UsbEndpoint(STREAM_IN, 2, 1024, 0, companion),)),
        )
        self.side: Side = side
        self._bench = bench
        self._line = line
        if line is not None:
            line.connect(self)
        self._faults: deque[str] = deque()
        self._acks: deque[bytes] = deque()
        self._stream: deque[bytes] = deque()
        self._triggers: deque[float] = deque()
        self._acquiring = False
        self._worker: threading.Thread | None = None
        self._frame_id = 0
        self._rows, self._cols, pitch_um = bench.sensor(side)
        self._build_memory(serial_number, pitch_um)

    def _build_memory(self, serial_number: str, pitch_um: float) -> None:
        abrm = bytearray(0x1000)
        struct.pack_into("<I", abrm, 0x0000, 0x0001_0002)
        texts = {0x04: MAKER, 0x44: MODEL, 0x84: FAMILY, 0xC4: VERSION, 0x144: serial_number}
        for at, text in texts.items():
            abrm[at : at + 64] = text.encode().ljust(64, b"\0")
        struct.pack_into("<Q", abrm, 0x1C4, 0b1)  # a user-defined name isn't kept
        struct.pack_into("<IQQ", abrm, 0x1CC, 200, MANIFEST, SBRM)
        sbrm = bytearray(0x60)
        struct.pack_into("<IQQIII", sbrm, 0x00, 0x0001_0001, 0b1, 0, MAX_COMMAND, MAX_ACK, 1)
        struct.pack_into("<QI", sbrm, 0x20, SIRM, 0x30)
        struct.pack_into("<I", sbrm, 0x40, 0x08)
        sirm = bytearray(0x30)
        struct.pack_into("<I", sirm, 0x00, 2 << 24)  # transfers are multiples of 4 bytes
        struct.pack_into("<II", sirm, 0x10, 52, 32)
        archive = _zip(_xml(self._rows, self._cols))
        manifest = struct.pack("<Q", 1) + struct.pack(
            "<IIQQ20s20x", 0x0100_0002, 1 << 24 | 1 << 16 | 1 << 10, XML, len(archive), hashlib.sha1(archive).digest()
        )
        features = bytearray(FEATURE_BYTES)
        self._memory = {
            "abrm": _Region(0, abrm),
            "sbrm": _Region(SBRM, sbrm),
            "sirm": _Region(SIRM, sirm, writable=True),
            "manifest": _Region(MANIFEST, bytearray(manifest)),
            "xml": _Region(XML, bytearray(archive)),
            "features": _Region(FEATURES, features, writable=True),
        }
        for register, value in (
            (SENSOR_WIDTH, self._cols),
            (SENSOR_HEIGHT, self._rows),
            (WIDTH, self._cols),
            (HEIGHT, self._rows),
            (PIXEL_FORMAT, BAYER_RG8),
            (EXPOSURE_TICKS, 10_000 * TICKS_PER_US),
            (PIXEL_PITCH, round(pitch_um * 1000)),
            (LINE_MODE_1, 0),
            (GAMMA_ENABLE, 1),  # as cameras leave the factory
            (LIGHT_SOURCE, 1),
            (BALANCE_RED, _float_bits(1.0)),
            (BALANCE_GREEN, _float_bits(1.0)),
            (BALANCE_BLUE, _float_bits(1.0)),
            (BLACK_LEVEL, 64),
        ):
            self._put(register, value)
        self._update_payload()

    # --- faults -------------------------------------------------------------------------------------------------------

    def inject(self, fault: str, times: int = 1) -> None:
        """Let the camera do one of `FAULTS` the next `times` times. Raises ValueError for an unknown one."""
        if fault not in FAULTS:
            raise ValueError(f"no fault {fault!r}: there are {', '.join(FAULTS)}")
        with self.changed:
            self._faults.extend([fault] * times)

    def _failing(self, *faults: str) -> str | None:
        with self.changed:
            for fault in self._faults:
                if fault in faults:
                    self._faults.remove(fault)
                    return fault
        return None

    # --- registers ----------------------------------------------------------------------------------------------------

    def _get(self, register: int) -> int:
        at = register - FEATURES
        return int.from_bytes(self._memory["features"].data[at : at + 4], "little")

    def _put(self, register: int, value: int) -> None:
        struct.pack_into("<I", self._memory["features"].data, register - FEATURES, value)

    def _update_payload(self) -> None:
        size = payload_bytes(self._get(PIXEL_FORMAT), self._get(WIDTH) * self._get(HEIGHT))
        self._put(PAYLOAD_SIZE, size)
        struct.pack_into("<Q", self._memory["sirm"].data, 0x08, size)

    def _region(self, address: int, count: int) -> _Region:
        for region in self._memory.values():
            if region.holds(address, count):
                return region
        raise _GenCpRefusal(0x8003)

    def _read(self, address: int, count: int) -> bytes:
        if not 0 < count <= MAX_ACK - 12:
            raise _GenCpRefusal(0x8002)
        region = self._region(address, count)
        if region.start == FEATURES:
            celsius = self._bench.sensor_temperature_c(self.side)
            struct.pack_into("<i", region.data, TEMPERATURE - FEATURES, round(celsius * 100))
        at = address - region.start
        return bytes(region.data[at : at + count])

    def _write(self, address: int, data: bytes) -> None:
        region = self._region(address, len(data))
        if not region.writable:
            raise _GenCpRefusal(0x8004)
        if region.start == SIRM:
            self._write_stream(address, data)
        elif len(data) != 4 or address % 4:
            raise _GenCpRefusal(0x8005)
        else:
            self._write_feature(address, data)

    def _write_stream(self, address: int, data: bytes) -> None:
        region = self._memory["sirm"]
        at = address - SIRM
        if at < 4 or 0x08 <= at < 0x18:
            raise _GenCpRefusal(0x8004)
        if at == 0x04 and data[0] & 1:
            size, count, final_1, final_2 = struct.unpack_from("<IIII", region.data, 0x1C)
            if size * count + final_1 + final_2 < self._get(PAYLOAD_SIZE):
                raise _GenCpRefusal(0xA004)
            if any(part % 4 for part in (size, final_1, final_2)):
                raise _GenCpRefusal(0xA003)
        region.data[at : at + len(data)] = data
        if at == 0x04 and not data[0] & 1:
            with self.changed:
                self._stream.clear()

    def _write_feature(self, register: int, data: bytes) -> None:
        value = int.from_bytes(data, "little")
        if register in (SENSOR_WIDTH, SENSOR_HEIGHT, PAYLOAD_SIZE, TEMPERATURE, PIXEL_PITCH, BINNING, LINE_MODE):
            raise _GenCpRefusal(0x8004)
        if register in (WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, PIXEL_FORMAT):
            if self._acquiring:
                raise _GenCpRefusal(0x8006)
            self._check_window(register, value)
            self._put(register, value)
            self._update_payload()
        elif register == ACQUISITION_START:
            self._start()
        elif register == ACQUISITION_STOP:
            self._stop()
        elif register == TRIGGER_SOFTWARE:
            if self._get(TRIGGER_CONTROL) & TRIGGER_ON and self._trigger_source() == SOURCE_SOFTWARE:
                self._expose_now(self._bench.clock.now())
        else:
            self._check_value(register, value)
            self._put(register, value)

    def _check_window(self, register: int, value: int) -> None:
        if register == PIXEL_FORMAT:
            if value not in (BAYER_RG8, BAYER_RG12, BAYER_RG12P):
                raise _GenCpRefusal(0x8002)
            return
        window = {name: self._get(name) for name in (WIDTH, HEIGHT, OFFSET_X, OFFSET_Y)} | {register: value}
        fits = window[WIDTH] + window[OFFSET_X] <= self._cols and window[HEIGHT] + window[OFFSET_Y] <= self._rows
        if value % 2 or not fits or min(window[WIDTH], window[HEIGHT]) < 16:
            raise _GenCpRefusal(0x8002)

    @staticmethod
    def _check_value(register: int, value: int) -> None:
        if register == EXPOSURE_TICKS and not 10 * TICKS_PER_US <= value <= MOST_EXPOSURE_US * TICKS_PER_US:
            raise _GenCpRefusal(0x8002)
        if register == GAIN and not 0 <= _float_of(value) <= MOST_GAIN_DB:
            raise _GenCpRefusal(0x8002)
        if BALANCE_RED <= register <= BALANCE_BLUE and not 0.0625 <= _float_of(value) <= 16:
            raise _GenCpRefusal(0x8002)
        highest = {
            LINE_SELECTOR: 1,
            LINE_MODE_1: 1,
            LINE_SOURCE_1: 1,
            GAMMA_ENABLE: 1,
            BLACK_LEVEL: 255,
            PARAMS_LOCKED: 1,
            WHITE_AUTO: 2,
            LIGHT_SOURCE: 2,
            TEST_PATTERN: 1,
            BALANCE_SELECTOR: 2,
        }
        if register in highest and value > highest[register]:
            raise _GenCpRefusal(0x8002)
        if register == TRIGGER_CONTROL and (value >> SOURCE_SHIFT) & 0xF not in (SOURCE_SOFTWARE, SOURCE_LINE):
            raise _GenCpRefusal(0x8002)

    @property
    def gives_pulses(self) -> bool:
        """Whether Line1 is an output that follows the exposure."""
        return self._get(LINE_MODE_1) == 1 and self._get(LINE_SOURCE_1) == 1

    def _trigger_source(self) -> int:
        return (self._get(TRIGGER_CONTROL) >> SOURCE_SHIFT) & 0xF

    # --- control channel ----------------------------------------------------------------------------------------------

    def bulk_out(self, endpoint: int, data: bytes, cancelled: Cancelled) -> None:
        if endpoint != CONTROL_OUT:
            super().bulk_out(endpoint, data, cancelled)
        fault = self._failing("silent", "busy", "pending", "lost-ack", "garbled")
        if fault == "silent" or len(data) < 12 or data[:4] != b"U3VC":
            return
        _, flags, command, size, request_id = struct.unpack_from("<4sHHHH", data)
        status, body = 0, b""
        if size != len(data) - 12 or len(data) > MAX_COMMAND:
            status = 0x800E
        elif fault == "busy":
            status = 0x8007
        else:
            try:
                body = self._command(command, data[12:])
            except _GenCpRefusal as refusal:
                status = refusal.status
        if not flags & 0x4000 or fault == "lost-ack":
            return
        magic = b"U3VX" if fault == "garbled" else b"U3VC"
        with self.changed:
            if fault == "pending":
                self._acks.append(struct.pack("<4sHHHHHH", b"U3VC", 0, 0x0805, 4, request_id, 0, 1000))
            self._acks.append(struct.pack("<4sHHHH", magic, status, command | 1, len(body), request_id) + body)
            self.changed.notify_all()

    def _command(self, command: int, body: bytes) -> bytes:
        if command == 0x0800:
            if len(body) != 12:
                raise _GenCpRefusal(0x800E)
            address, _, count = struct.unpack("<QHH", body)
            return self._read(address, count)
        if command == 0x0802:
            if len(body) <= 8:
                raise _GenCpRefusal(0x800E)
            self._write(struct.unpack_from("<Q", body)[0], body[8:])
            return struct.pack("<HH", 0, len(body) - 8)
        raise _GenCpRefusal(0x8001)

    # --- stream -------------------------------------------------------------------------------------------------------

    def bulk_in(self, endpoint: int, length: int, cancelled: Cancelled) -> bytes:
        if endpoint not in (CONTROL_IN, STREAM_IN):
            return super().bulk_in(endpoint, length, cancelled)
        queue = self._acks if endpoint == CONTROL_IN else self._stream
        with self.changed:
            self.wait_for(lambda: bool(queue), cancelled)
            piece = queue.popleft()
            if len(piece) > length:  # the pipe keeps what the host hasn't room for
                queue.appendleft(piece[length:])
                piece = piece[:length]
            self.changed.notify_all()
            return piece

    def on_clear_halt(self, endpoint: int) -> None:
        with self.changed:
            (self._acks if endpoint == CONTROL_IN else self._stream).clear()

    def on_reset(self) -> None:
        self._stop()
        with self.changed:
            self._acks.clear()
            self._stream.clear()

    def line_pulse(self, start_s: float) -> None:
        """Take a pulse on Line0 at virtual time `start_s`."""
        control = self._get(TRIGGER_CONTROL)
        if control & TRIGGER_ON and self._trigger_source() == SOURCE_LINE:
            self._expose_now(start_s)

    def _expose_now(self, start_s: float) -> None:
        with self.changed:
            if not self._acquiring:
                return
            self._triggers.append(start_s)
            self.changed.notify_all()
        if self._line is not None:
            self._line.pulse(self, start_s)

    def _start(self) -> None:
        self._stop()
        with self.changed:
            self._acquiring = True
            self._frame_id = 0
            self._worker = threading.Thread(target=self._work, name=f"u3v-{self.side}", daemon=True)
            self._worker.start()

    def _stop(self) -> None:
        with self.changed:
            self._acquiring = False
            self._triggers.clear()
            worker, self._worker = self._worker, None
            self.changed.notify_all()
        if worker is not None and worker is not threading.current_thread():
            worker.join()

    def _next_start(self) -> float | None:
        """Wait for the next exposure's virtual start; None when acquisition has ended."""
        with self.changed:
            while self._acquiring and self.plugged:
                if self._triggers:
                    return self._triggers.popleft()
                free = not self._get(TRIGGER_CONTROL) & TRIGGER_ON
                if free and len(self._stream) < 2 * _MOST_QUEUED:
                    return self._bench.clock.now()
                self.changed.wait(0.25)
        return None

    def _work(self) -> None:
        while (start_s := self._next_start()) is not None:
            exposure_s = self._get(EXPOSURE_TICKS) / TICKS_PER_US * 1e-6
            raw = self._bench.expose(self.side, exposure_s, _float_of(self._get(GAIN)), start_s)
            self._send(self._process(raw), start_s)
            if self._get(ACQUISITION_MODE) == 1:
                with self.changed:
                    self._acquiring = False

    def _process(self, raw: UInt16Array) -> UInt16Array:
        """Return what the camera makes of the converter's codes: channel by channel times its white balance and its
        preset for the light."""
        if self._get(TEST_PATTERN):
            ramp = np.linspace(0.0, _MOST_CODE, raw.shape[1]).astype(np.uint16)
            return np.ascontiguousarray(np.broadcast_to(ramp, raw.shape))
        ratios = (_float_of(self._get(BALANCE_RED + 4 * channel)) for channel in range(3))
        red, green, blue = (a * b for a, b in zip(ratios, _PRESETS[self._get(LIGHT_SOURCE)], strict=True))
        if red == green == blue == 1.0:
            return raw
        factors = np.array([[red, green], [green, blue]])
        tiled = np.tile(factors, (-(-raw.shape[0] // 2), -(-raw.shape[1] // 2)))[: raw.shape[0], : raw.shape[1]]
        return np.asarray(np.minimum(np.round(raw * tiled), _MOST_CODE), np.uint16)

    def _send(self, raw: UInt16Array, start_s: float) -> None:
        top, left = self._get(OFFSET_Y), self._get(OFFSET_X)
        rows, cols = self._get(HEIGHT), self._get(WIDTH)
        pixel_format = self._get(PIXEL_FORMAT)
        payload = encode(raw[top : top + rows, left : left + cols], pixel_format)
        fault = self._failing(*_OF_FRAMES)
        seconds: float | None = None
        for fault_of_answer in self._faults_of_answer():
            fault, seconds = _AS_FRAMES[fault_of_answer.kind], fault_of_answer.value
        if fault == "missed":
            return
        frame_id, self._frame_id = self._frame_id, self._frame_id + 1
        if fault == "late":
            time.sleep(1.0 if seconds is None else seconds)
        if fault == "halt":
            self._state.halted.add(STREAM_IN)
        if fault == "short":
            payload = payload[: len(payload) // 2 // 4 * 4]
        leader = struct.pack(
            "<4sHHQHHQIIIIIHH",
            b"U3VL",
            0,
            52,
            frame_id,
            0,
            1,
            int(start_s * 1e9),
            pixel_format,
            cols,
            rows,
            left,
            top,
            0,
            0,
        )
        status = 0xA100 if fault in ("damaged", "short") else 0
        trailer = struct.pack("<4sHHQHHQI", b"U3VT", 0, 32, frame_id, status, 0, len(payload), rows)
        pieces = [leader, *self._split(payload), *([] if fault == "lost-trailer" else [trailer])]
        if fault == "unplug":
            pieces = pieces[:1]
        elif fault == "torn":
            del pieces[len(pieces) // 2]
        elif fault == "repeated":
            pieces += pieces
        with self.changed:
            enabled = self._memory["sirm"].data[0x04] & 1
            queued = sum(piece[:4] == b"U3VL" for piece in self._stream)
            if enabled and self._acquiring and queued < _MOST_QUEUED and fault != "never":
                self._stream.extend(pieces)
                self.changed.notify_all()
        if fault == "unplug" and seconds is None:
            self.unplug()
        elif fault == "unplug" and seconds is not None:
            self._unplug_for(seconds)

    def _split(self, payload: bytes) -> list[bytes]:
        """Return the payload in the transfers that the host asked for; the last one is filled up to whole 4 bytes."""
        size, count, final_1, final_2 = struct.unpack_from("<IIII", self._memory["sirm"].data, 0x1C)
        pieces, at = [], 0
        for part in [size] * count + [final_1, final_2]:
            if part == 0 or at >= len(payload):
                continue
            piece = payload[at : at + part]
            pieces.append(piece + bytes(-len(piece) % 4))
            at += part
        return pieces
