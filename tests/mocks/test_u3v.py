"""The mock camera by its bytes alone: what a host that isn't ours sees and does."""

from __future__ import annotations

import hashlib
import io
import struct
import time
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocks.bench import Bench
from mocks.ready_frames import encode, pack_12p, payload_bytes
from mocks.truth import hidden_truth
from mocks.u3v import FAULTS, TriggerLine, U3vDevice
from mocks.usb_device import Abandoned, Stalled, Unplugged

ABRM_SIRM = 0x2_0000


@pytest.fixture(scope="module")
def bench() -> Bench:
    bench = Bench(seed=2)
    bench.set_shutter(True)
    bench.set_filter(2)
    bench.place("sphere")
    return bench


class Host:
    """Speaks GenCP by hand."""

    def __init__(self, device: U3vDevice) -> None:
        self.device = device
        self.request = 0

    def out(self, packet: bytes) -> None:
        self.device.transfer(0x01, bytes(8), packet, 0, lambda: False)

    def into(self, endpoint: int, length: int, patience_s: float = 30.0) -> bytes:
        deadline = time.monotonic() + patience_s
        return self.device.transfer(endpoint, bytes(8), None, length, lambda: time.monotonic() > deadline)

    def ask(self, command: int, body: bytes) -> tuple[int, bytes]:
        """(status, body of the acknowledge)."""
        self.request += 1
        self.out(b"U3VC" + struct.pack("<HHHH", 0x4000, command, len(body), self.request) + body)
        answer = self.into(0x81, 1024)
        magic, status, acknowledge, size, request = struct.unpack_from("<4sHHHH", answer)
        assert (magic, acknowledge, size, request) == (b"U3VC", command + 1, len(answer) - 12, self.request)
        return status, answer[12:]

    def read(self, address: int, count: int) -> bytes:
        status, data = self.ask(0x0800, struct.pack("<QHH", address, 0, count))
        assert status == 0
        return data

    def write(self, address: int, data: bytes) -> int:
        return self.ask(0x0802, struct.pack("<Q", address) + data)[0]

    def put(self, address: int, value: int) -> None:
        assert self.write(address, struct.pack("<I", value)) == 0

    def xml(self) -> ET.Element:
        (table,) = struct.unpack("<Q", self.read(0x1D0, 8))
        (count,) = struct.unpack("<Q", self.read(table, 8))
        assert count == 1
        _, schema, address, size, digest = struct.unpack("<IIQQ20s20x", self.read(table + 8, 64))
        assert (schema >> 10) & 0x3F == 1
        data = b"".join(self.read(address + at, min(1000, size - at)) for at in range(0, size, 1000))
        assert hashlib.sha1(data).digest() == digest
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return ET.fromstring(archive.read(archive.namelist()[0]))

    def register(self, name: str) -> int:
        """Address of a register by its node's name."""
        for node in self.xml().iter():
            if node.get("Name") == name:
                address = node.find("{*}Address")
                assert address is not None
                return int(str(address.text), 0)
        raise KeyError(name)

    def stream(self, transfer: int = 614400, count: int = 1, final: int = 0) -> None:
        for offset, value in ((0x18, 52), (0x1C, transfer), (0x20, count), (0x24, final), (0x28, 0), (0x2C, 32)):
            self.put(ABRM_SIRM + offset, value)
        self.put(ABRM_SIRM + 4, 1)


@pytest.fixture
def host(bench: Bench) -> Iterator[Host]:
    device = U3vDevice(bench, "left", "CB-7")
    yield Host(device)
    device.unplug()
    device.on_reset()


def test_golden_read(host: Host) -> None:
    """The packet of spec/instruments.md, byte by byte: 64 bytes at 4 under request id 0xff15."""
    host.out(bytes.fromhex("55335643 0040 0008 0c00 15ff 0400000000000000 0000 4000"))
    assert host.into(0x81, 1024) == bytes.fromhex("55335643 0000 0108 4000 15ff") + b"calibench".ljust(64, b"\0")


def test_bootstrap_registers(host: Host) -> None:
    assert host.read(0x144, 64).rstrip(b"\0") == b"CB-7"
    assert host.read(0x44, 64).startswith(b"Mock U3V")
    (sbrm,) = struct.unpack("<Q", host.read(0x1D8, 8))
    assert struct.unpack("<II", host.read(sbrm + 0x14, 8)) == (1024, 1024)
    assert struct.unpack("<Q", host.read(sbrm + 0x20, 8)) == (ABRM_SIRM,)
    payload, leader, trailer = struct.unpack("<QII", host.read(ABRM_SIRM + 8, 16))
    assert (payload, leader, trailer) == (640 * 480, 52, 32)  # it wakes up in 8 bits


@pytest.mark.parametrize(
    ("command", "body", "status"),
    [
        (0x0800, struct.pack("<QHH", 0x9000_0000, 0, 4), 0x8003),  # no such register
        (0x0800, struct.pack("<QHH", 0, 0, 0), 0x8002),
        (0x0800, struct.pack("<QHH", 0, 0, 2000), 0x8002),
        (0x0802, struct.pack("<QI", 0x144, 1), 0x8004),  # the serial number isn't ours to write
        (0x0802, struct.pack("<QI", 0x100000, 1), 0x8004),
        (0x0802, struct.pack("<Q", 0x100008), 0x800E),  # nothing to write
        (0x0802, struct.pack("<QH", 0x100008, 1), 0x8005),
        (0x0802, struct.pack("<QI", 0x100008, 641), 0x8002),  # odd, and wider than the sensor
        (0x0802, struct.pack("<QI", 0x100018, 0x01080001), 0x8002),  # Mono8
        (0x0802, struct.pack("<QI", ABRM_SIRM + 4, 1), 0xA004),  # streaming without buffers
        (0x0900, b"", 0x8001),
    ],
)
def test_refusals(host: Host, command: int, body: bytes, status: int) -> None:
    assert host.ask(command, body) == (status, b"")
    assert host.read(0x144, 4) == b"CB-7"


def test_a_wrong_size_is_an_invalid_header(host: Host) -> None:
    host.out(b"U3VC" + struct.pack("<HHHH", 0x4000, 0x0800, 99, 5) + bytes(12))
    assert host.into(0x81, 64) == b"U3VC" + struct.pack("<HHHH", 0x800E, 0x0801, 0, 5)


@settings(max_examples=80)
@given(st.binary(max_size=120), st.booleans())
def test_no_bytes_break_it(bench: Bench, packet: bytes, framed: bool) -> None:
    host = Host(U3vDevice(bench, "left", "CB-7"))
    host.out(b"U3VC" + packet if framed else packet)
    host.device.on_clear_halt(0x81)
    assert host.read(0x144, 4) == b"CB-7"


def test_a_command_without_acknowledge(host: Host) -> None:
    host.out(b"U3VC" + struct.pack("<HHHH", 0, 0x0802, 12, 3) + struct.pack("<QI", host.register("WidthReg"), 320))
    with pytest.raises(Abandoned):
        host.into(0x81, 64, 0.05)
    assert struct.unpack("<I", host.read(host.register("WidthReg"), 4)) == (320,)


def test_a_frame_byte_by_byte(host: Host, bench: Bench) -> None:
    """A window in 12 bits: leader, payload in two transfers, trailer."""
    for name, value in (
        ("Width", 32),
        ("Height", 16),
        ("OffsetX", 100),
        ("OffsetY", 50),
        ("PixelFormatCode", 0x01100011),
    ):
        host.put(host.register(name + "Reg"), value)
    assert struct.unpack("<I", host.read(host.register("PayloadSizeReg"), 4)) == (1024,)
    host.put(host.register("ExposureTicksReg"), 20_000)  # 2 ms
    host.put(host.register("LightSourcePresetReg"), 0)  # its codes are the bench's
    host.put(ABRM_SIRM + 0x1C, 0)
    host.stream(transfer=800, count=1, final=224)
    host.put(0x10002C, 1)  # trigger on, by software
    host.put(host.register("AcquisitionStartReg"), 1)
    before = bench.clock.now()
    host.put(host.register("TriggerSoftwareReg"), 1)
    leader = host.into(0x82, 52)
    assert leader[:20] == b"U3VL" + bytes([0, 0, 52, 0]) + bytes(8) + bytes([0, 0, 1, 0])
    assert struct.unpack_from("<QIIIIIHH", leader, 20)[1:] == (0x01100011, 32, 16, 100, 50, 0, 0)
    assert struct.unpack_from("<Q", leader, 20)[0] * 1e-9 == pytest.approx(before, abs=1e-3)
    first, second = host.into(0x82, 800), host.into(0x82, 224)
    assert (len(first), len(second)) == (800, 224)
    pixels = np.frombuffer(first + second, "<u2").reshape(16, 32)
    # the window keeps the mosaic's phase: in this light a green pixel has twice the signal of a blue one
    assert pixels[0::2, 1::2].mean() > 1.5 * pixels[1::2, 1::2].mean()
    assert pixels.mean() == pytest.approx(bench.expose("left", 0.002)[50:66, 100:132].mean(), rel=0.05)
    trailer = host.into(0x82, 32)
    assert trailer == b"U3VT" + bytes([0, 0, 32, 0]) + bytes(8) + bytes(4) + struct.pack("<QI", 1024, 16)
    with pytest.raises(Abandoned):
        host.into(0x82, 52, 0.05)
    host.put(host.register("TriggerSoftwareReg"), 1)
    assert struct.unpack_from("<Q", host.into(0x82, 52), 8) == (1,)


def test_without_a_trigger_frames_come_by_themselves(host: Host) -> None:
    host.stream(transfer=307200)
    host.put(host.register("AcquisitionStartReg"), 1)
    for number in range(3):
        leader = host.into(0x82, 52)
        assert leader[:4] == b"U3VL"
        assert struct.unpack_from("<Q", leader, 8) == (number,)
        assert len(host.into(0x82, 307200)) == 307200
        assert host.into(0x82, 32)[:4] == b"U3VT"
    host.put(host.register("AcquisitionStopReg"), 1)


def test_a_single_frame(host: Host) -> None:
    host.stream(transfer=307200)
    host.put(host.register("AcquisitionModeCodeReg"), 1)
    host.put(host.register("AcquisitionStartReg"), 1)
    assert host.into(0x82, 52)[:4] == b"U3VL"
    host.into(0x82, 307200)
    host.into(0x82, 32)
    with pytest.raises(Abandoned):
        host.into(0x82, 52, 0.1)


def test_geometry_is_fixed_while_acquiring(host: Host) -> None:
    host.put(0x10002C, 1)
    host.put(host.register("AcquisitionStartReg"), 1)
    assert host.write(host.register("WidthReg"), struct.pack("<I", 320)) == 0x8006
    host.put(host.register("AcquisitionStopReg"), 1)
    host.put(host.register("WidthReg"), 320)


def test_line_trigger_exposes_both_at_the_same_time(bench: Bench) -> None:
    line = TriggerLine()
    hosts = [Host(U3vDevice(bench, side, side, line)) for side in ("left", "right")]
    for source, host in enumerate(hosts):  # the left by software, the right by its line
        host.stream(transfer=307200)
        host.put(0x10002C, 1 | source << 4)
        host.put(host.register("AcquisitionStartReg"), 1)
    for name in ("LineModeReg", "LineSourceReg"):  # its Line1 an output that follows the exposure
        hosts[0].put(hosts[0].register(name) + 4, 1)
    hosts[0].put(hosts[0].register("TriggerSoftwareReg"), 1)
    stamps = [struct.unpack_from("<Q", host.into(0x82, 52), 20)[0] for host in hosts]
    assert stamps[0] == stamps[1]
    hosts[1].put(hosts[1].register("TriggerSoftwareReg"), 1)  # it doesn't listen to that
    hosts[1].into(0x82, 307200)
    hosts[1].into(0x82, 32)
    with pytest.raises(Abandoned):
        hosts[1].into(0x82, 52, 0.05)
    for host in hosts:
        host.device.on_reset()


def test_xml_has_the_features_that_the_spec_asks_for(host: Host) -> None:
    names = {node.get("Name") for node in host.xml().iter()}
    assert names >= {
        "Width", "Height", "PixelFormat", "ExposureTime", "Gain", "TriggerMode", "AcquisitionStart", "AcquisitionStop",
        "PayloadSize", "DeviceTemperature", "DeviceSerialNumber", "TriggerSoftware",
    }  # fmt: skip
    references = {
        node.text
        for node in host.xml().iter()
        if node.tag.rpartition("}")[2] in ("pValue", "pVariable", "pMax", "pFeature")
    }
    assert references <= names


def test_nothing_hidden_can_be_read_from_it(host: Host) -> None:
    """All memory that answers, as floats and as text, against the hidden truth's numbers."""
    memory = b""
    for start, size in ((0, 0x1000), (0x1_0000, 0x60), (0x2_0000, 0x30), (0x3_0000, 72), (0x10_0000, 72)):
        memory += b"".join(host.read(start + at, min(1000, size - at)) for at in range(0, size, 1000))
    memory += ET.tostring(host.xml())
    camera = hidden_truth(2).cameras["left"]
    model = camera.model
    secrets = [model.conversion_gain_dn_per_e, model.read_noise_e, model.full_well_e, model.black_level_dn]
    secrets += [*camera.geometry.camera_matrix[0], *camera.geometry.distortion]
    secrets += [value for e in camera.effects for value in e.model_dump().values() if value is not None]
    for secret in secrets:
        if secret in (0.0, 1.0):
            continue
        assert struct.pack("<f", secret) not in memory
        assert struct.pack("<d", secret) not in memory
        assert f"{secret:.5g}".encode() not in memory


def test_descriptors(host: Host) -> None:
    device = host.device
    assert device.device_descriptor() == bytes.fromhex("12 01 0003 ef 02 01 09 0912 0a00 0201 01 02 03 01")
    whole = device.configuration_descriptor()
    assert struct.unpack_from("<H", whole, 2) == (len(whole),)
    kinds = []
    at = 0
    while at < len(whole):
        kinds.append((whole[at], whole[at + 1]))
        at += whole[at]
    # configuration, association, interface, U3V device information, 2 x (endpoint, companion), interface, endpoint,
    # companion
    assert kinds == [
        (9, 2),
        (8, 11),
        (9, 4),
        (20, 0x24),
        (7, 5),
        (6, 0x30),
        (7, 5),
        (6, 0x30),
        (9, 4),
        (7, 5),
        (6, 0x30),
    ]
    setup = struct.pack("<BBHHH", 0x80, 6, 3 << 8 | 3, 0x0409, 255)
    assert device.transfer(0x80, setup, None, 255, lambda: False) == bytes([10, 3]) + "CB-7".encode("utf-16-le")
    with pytest.raises(Stalled):
        device.transfer(0x80, struct.pack("<BBHHH", 0x80, 6, 9 << 8, 0, 8), None, 8, lambda: False)


def test_unplugged(host: Host) -> None:
    host.device.unplug()
    with pytest.raises(Unplugged):
        host.read(0, 4)
    host.device.plug()
    assert host.read(0x144, 4) == b"CB-7"


def test_faults_have_names(host: Host) -> None:
    with pytest.raises(ValueError, match=f"there are {next(iter(FAULTS))}"):
        host.device.inject("boredom")


def test_packing_by_hand() -> None:
    raw = np.array([[0xABC, 0x123, 0xFFF]], np.uint16)
    assert pack_12p(raw) == bytes.fromhex("bc3a12 ff0f")
    assert payload_bytes(0x010C0059, 3) == 5
    assert encode(raw, 0x01080009) == bytes.fromhex("ab12ff")
    assert encode(raw, 0x01100011) == bytes.fromhex("bc0a 2301 ff0f")
