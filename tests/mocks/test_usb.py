"""The USB/IP server by its bytes, as the kernel's protocol document lays them out, and the in-process backend."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator

import pytest
import usb.core
import usb.util
from hypothesis import given, settings
from hypothesis import strategies as st

from mocks import usb as mock_usb
from mocks.bench import Bench
from mocks.usb import UsbIpServer, serve_usbip, stereo_pair

GET_DEVICE_DESCRIPTOR = bytes.fromhex("8006000100001200")


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(seed=3)


@pytest.fixture
def server(bench: Bench) -> Iterator[UsbIpServer]:
    with serve_usbip(stereo_pair(bench)) as server:
        yield server


class Client:
    def __init__(self, server: UsbIpServer) -> None:
        self.socket = socket.create_connection(server.address, 5.0)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, text: str, tail: bytes = b"") -> None:
        self.socket.sendall(bytes.fromhex(text) + tail)

    def get(self, count: int) -> bytes:
        data = b""
        while len(data) < count and (piece := self.socket.recv(count - len(data))):
            data += piece
        return data

    def use(self, bus_id: str) -> bytes:
        self.send("0111 8003 00000000", bus_id.encode().ljust(32, b"\0"))
        return self.get(8)

    def submit(self, number: int, direction: int, endpoint: int, length: int, setup: bytes = bytes(8)) -> None:
        head = struct.pack(">IIIII", 1, number, 0x00010001, direction, endpoint)
        self.socket.sendall(head + struct.pack(">IiiII", 0, length, 0, 0xFFFFFFFF, 0) + setup)

    def unlink(self, number: int, target: int) -> None:
        self.socket.sendall(struct.pack(">IIIII", 2, number, 0x00010001, 0, 0) + struct.pack(">I24x", target))


def test_device_list(server: UsbIpServer) -> None:
    with Client(server) as client:
        client.send("0111 8005 00000000")
        assert client.get(12) == bytes.fromhex("0111 0005 00000000 00000002")
        first, second = client.get(312 + 8), client.get(312 + 8)
    assert first[:256].rstrip(b"\0").startswith(b"/sys/devices/")
    assert first[256:288].rstrip(b"\0") == b"1-1"
    # bus 1, device 1, super speed; ids, release; class, subclass, protocol, configuration, configurations, interfaces
    assert first[288:312] == bytes.fromhex("00000001 00000001 00000005 1209 000a 0102 ef 02 01 01 01 02")
    assert first[312:] == bytes.fromhex("ef 05 00 00 ef 05 02 00")
    assert second[256:288].rstrip(b"\0") == b"1-2"


def test_import_control_and_time_in_line(server: UsbIpServer) -> None:
    with Client(server) as client:
        assert client.use("1-2") == bytes.fromhex("0111 0003 00000000")
        assert len(client.get(312)) == 312
        client.submit(7, 1, 0, 18, GET_DEVICE_DESCRIPTOR)
        assert client.get(48) == bytes.fromhex(
            "00000003 00000007 00000000 00000000 00000000" + "00000000 00000012"
        ) + bytes(20)
        assert client.get(18).hex() == "1201" + "0003" + "ef020109" + "09120a000201" + "01020301"


def test_stall_is_an_errno(server: UsbIpServer) -> None:
    with Client(server) as client:
        client.use("1-1")
        client.get(312)
        client.submit(1, 1, 0, 8, bytes.fromhex("8006000900000800"))  # a descriptor that isn't there
        assert struct.unpack(">IIIIIii", client.get(48)[:28])[5:] == (-32, 0)


def test_unlink_takes_a_waiting_request_back(server: UsbIpServer) -> None:
    with Client(server) as client:
        client.use("1-1")
        client.get(312)
        client.submit(1, 1, 1, 64)  # nothing was asked: no acknowledge will come
        client.unlink(2, 1)
        assert client.get(48) == struct.pack(">IIIIIi", 4, 2, 0, 0, 0, -104) + bytes(24)
        client.unlink(3, 1)  # has gone already
        assert client.get(48) == struct.pack(">IIIIIi", 4, 3, 0, 0, 0, 0) + bytes(24)
        client.submit(4, 1, 0, 18, GET_DEVICE_DESCRIPTOR)
        assert struct.unpack(">II", client.get(66)[:8]) == (3, 4)


def test_control_isn_t_held_up_by_a_waiting_stream(server: UsbIpServer) -> None:
    with Client(server) as client:
        client.use("1-1")
        client.get(312)
        client.submit(1, 1, 2, 1024)
        client.submit(2, 1, 0, 18, GET_DEVICE_DESCRIPTOR)
        assert struct.unpack(">II", client.get(66)[:8]) == (3, 2)


@pytest.mark.parametrize("bus_id", ["9-9", "", "../.."])
def test_unknown_devices(server: UsbIpServer, bus_id: str) -> None:
    with Client(server) as client:
        assert client.use(bus_id) == bytes.fromhex("0111 0003 00000001")


def test_a_device_has_one_user(server: UsbIpServer) -> None:
    with Client(server) as first:
        first.use("1-1")
        first.get(312)
        with Client(server) as second:
            assert second.use("1-1") == bytes.fromhex("0111 0003 00000002")
        with Client(server) as other:
            assert other.use("1-2") == bytes.fromhex("0111 0003 00000000")


@settings(max_examples=30)
@given(st.binary(min_size=1, max_size=120), st.booleans())
def test_no_bytes_break_the_server(bench: Bench, data: bytes, after_import: bool) -> None:
    with serve_usbip(stereo_pair(bench)) as server:
        with Client(server) as client:
            if after_import:
                client.use("1-1")
                client.get(312)
            with contextlib.suppress(ConnectionResetError, BrokenPipeError):  # it may hang up on nonsense
                client.socket.sendall(data)
                with contextlib.suppress(OSError):  # it has hung up already
                    client.socket.shutdown(socket.SHUT_WR)
                while client.socket.recv(4096):
                    pass
        with Client(server) as client:
            client.send("0111 8005 00000000")
            assert len(client.get(12)) == 12


def test_backends_by_name(bench: Bench) -> None:
    serials = [
        device.serial_number for device in usb.core.find(find_all=True, backend=mock_usb.backend("u3v-stereo", bench))
    ]
    assert serials == ["CB-U3V-0001", "CB-U3V-0002"]
    assert len(list(usb.core.find(find_all=True, backend=mock_usb.backend("u3v", bench)))) == 1
    with pytest.raises(ValueError, match="no USB instrument 'toaster'"):
        mock_usb.backend("toaster")


def test_any_pyusb_program_can_talk_to_the_camera(bench: Bench) -> None:
    """pyusb alone: the golden ReadMem of spec/instruments.md."""
    device = usb.core.find(idVendor=0x1209, idProduct=0x000A, backend=mock_usb.backend("u3v", bench))
    device.set_configuration()
    interface = device.get_active_configuration()[(0, 0)]
    out = usb.util.find_descriptor(interface, custom_match=lambda e: not e.bEndpointAddress & 0x80)
    into = usb.util.find_descriptor(interface, custom_match=lambda e: e.bEndpointAddress & 0x80)
    out.write(bytes.fromhex("55335643 0040 0008 0c00 15ff 0400000000000000 0000 4000"), 1000)
    assert bytes(into.read(1024, 1000)) == bytes.fromhex("55335643 0000 0108 4000 15ff") + b"calibench".ljust(64, b"\0")
    with pytest.raises(usb.core.USBTimeoutError):
        into.read(64, 30)
    device.clear_halt(into)
    device.reset()
    usb.util.dispose_resources(device)
