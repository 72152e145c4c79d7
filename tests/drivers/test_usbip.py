"""The USB/IP client against a scripted server: bytes of the kernel's protocol document, time-outs, broken servers."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import usb.core
import usb.util
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import Disconnected
from drivers.usbip import Configuration, UsbIpBackend, find, open_device

# A device 1209:000a at bus id 1-1: path, bus id, busnum 1, devnum 5, speed 5, ids, release, class, configurations,
# interfaces.
DEVICE = (
    b"/sys/devices/x".ljust(256, b"\0")
    + b"1-1".ljust(32, b"\0")
    + bytes.fromhex("00000001 00000005 00000005 1209 000a 0102 ef 02 01 01 01 01")
)
DEVLIST_REQUEST = bytes.fromhex("0111 8005 00000000")
DEVLIST_REPLY = bytes.fromhex("0111 0005 00000000 00000001") + DEVICE + bytes.fromhex("ef 05 00 00")
IMPORT_REQUEST = bytes.fromhex("0111 8003 00000000") + b"1-1".ljust(32, b"\0")
IMPORT_REPLY = bytes.fromhex("0111 0003 00000000") + DEVICE

DEVICE_DESCRIPTOR = bytes.fromhex("12 01 0003 ef 02 01 09 0912 0a00 0201 01 02 03 01")
CONFIGURATION = bytes.fromhex(
    "09 02 2000 01 01 00 80 fa"  # 32 bytes, one interface
    "09 04 00 00 02 ef 05 00 00"
    "07 05 81 02 0004 00"
    "07 05 01 02 0004 00"
)


def receive(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = connection.recv(count - len(data))
        if not piece:
            raise ConnectionError
        data += piece
    return data


class Server:
    """Answers each connection with `serve(connection)`; keeps what the client sent after the import."""

    def __init__(self, urb: Callable[[Server, socket.socket, bytes], None] | None = None) -> None:
        self.heads: list[bytes] = []
        self._urb = urb
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._threads = [threading.Thread(target=self._run, daemon=True)]
        self._threads[0].start()

    def _run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(connection,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        with connection:
            try:
                request = receive(connection, 8)
                if request == DEVLIST_REQUEST:
                    connection.sendall(DEVLIST_REPLY)
                elif request + receive(connection, 32) == IMPORT_REQUEST:
                    connection.sendall(IMPORT_REPLY)
                    while True:
                        self.answer(connection, receive(connection, 48))
            except (ConnectionError, OSError):
                return

    def answer(self, connection: socket.socket, head: bytes) -> None:
        self.heads.append(head)
        _, number, _, _, endpoint = struct.unpack_from(">IIIII", head)
        setup = head[40:48]
        if endpoint == 0 and setup[:2] == b"\x80\x06":
            kind, length = setup[3], struct.unpack_from("<H", setup, 6)[0]
            text = bytes([10, 3]) + "CB-1".encode("utf-16-le")
            data = {1: DEVICE_DESCRIPTOR, 2: CONFIGURATION, 3: bytes.fromhex("04030904") if setup[2] == 0 else text}[
                kind
            ]
            self.reply(connection, number, data[:length])
        elif endpoint == 0 and setup[:2] == b"\x80\x08":
            self.reply(connection, number, b"\x01")
        elif endpoint == 0:
            self.reply(connection, number, b"", 0)
        elif self._urb is not None:
            self._urb(self, connection, head)

    @staticmethod
    def reply(connection: socket.socket, number: int, data: bytes, count: int | None = None, status: int = 0) -> None:
        count = len(data) if count is None else count
        connection.sendall(
            struct.pack(">IIIII", 3, number, 0, 0, 0) + struct.pack(">iiiii8x", status, count, 0, 0, 0) + data
        )

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(2.0)


@contextmanager
def device(
    urb: Callable[[Server, socket.socket, bytes], None] | None = None,
) -> Iterator[tuple[usb.core.Device, Server]]:
    server = Server(urb)
    found = open_device(f"usbip://127.0.0.1:{server.port}/CB-1")
    try:
        yield found, server
    finally:
        usb.util.dispose_resources(found)
        server.close()


def test_descriptors_and_serial_number() -> None:
    with device() as (found, server):
        assert (found.idVendor, found.idProduct, found.serial_number, found.speed) == (0x1209, 0x000A, "CB-1", 5)
        interface = found[0][(0, 0)]
        assert [endpoint.bEndpointAddress for endpoint in interface] == [0x81, 0x01]
        assert interface[0].wMaxPacketSize == 1024
        # CMD_SUBMIT: command 1, sequence 1, device 1:5, direction in, endpoint 0; no flags, 18 bytes, no frame, not
        # isochronous, no interval; GET_DESCRIPTOR(device)
        assert server.heads[0] == bytes.fromhex(
            "00000001 00000001 00010005 00000001 00000000 00000000 00000012 00000000 ffffffff 00000000 8006000100001200"
        )


def test_bus_id_names_a_device_too() -> None:
    server = Server()
    found = find(UsbIpBackend("127.0.0.1", server.port), "1-1")
    assert found.idProduct == 0x000A
    server.close()


def test_bulk_transfers() -> None:
    written: list[bytes] = []

    def urb(server: Server, connection: socket.socket, head: bytes) -> None:
        number, direction = struct.unpack_from(">I", head, 4)[0], struct.unpack_from(">I", head, 12)[0]
        length = struct.unpack_from(">i", head, 24)[0]
        if direction == 0:
            written.append(receive(connection, length))
            server.reply(connection, number, b"", length)
        else:
            server.reply(connection, number, b"answer")

    with device(urb) as (found, server):
        assert found.write(0x01, b"question", 1000) == 8
        assert written == [b"question"]
        assert bytes(found.read(0x81, 64, 1000)) == b"answer"
        # endpoint numbers go out without the direction bit
        assert [struct.unpack_from(">III", head, 12) for head in server.heads[-2:]] == [(0, 1, 0), (1, 1, 0)]


def test_time_out_takes_the_request_back() -> None:
    unlinks: list[bytes] = []

    def urb(server: Server, connection: socket.socket, head: bytes) -> None:
        if head[:4] == bytes([0, 0, 0, 2]):
            unlinks.append(head)
            number = struct.unpack_from(">I", head, 4)[0]
            connection.sendall(struct.pack(">IIIII", 4, number, 0, 0, 0) + struct.pack(">i24x", -104))

    class Unlinking(Server):
        def answer(self, connection: socket.socket, head: bytes) -> None:
            if head[:4] == bytes([0, 0, 0, 2]):
                urb(self, connection, head)
            else:
                super().answer(connection, head)

    server = Unlinking(lambda *_: None)
    found = open_device(f"usbip://127.0.0.1:{server.port}/CB-1")
    with pytest.raises(usb.core.USBTimeoutError):
        found.read(0x81, 64, 50)
    # CMD_UNLINK names the request: the one before its own number
    (head,) = unlinks
    assert struct.unpack_from(">I", head, 20)[0] == struct.unpack_from(">I", head, 4)[0] - 1
    assert found.serial_number == "CB-1"  # the line goes on
    usb.util.dispose_resources(found)
    server.close()


def test_answer_that_crosses_its_cancellation_counts() -> None:
    class Late(Server):
        def answer(self, connection: socket.socket, head: bytes) -> None:
            if head[:4] == bytes([0, 0, 0, 2]):
                number, target = struct.unpack_from(">I", head, 4)[0], struct.unpack_from(">I", head, 20)[0]
                self.reply(connection, target, b"just in time")
                connection.sendall(struct.pack(">IIIII", 4, number, 0, 0, 0) + struct.pack(">i24x", 0))
            else:
                super().answer(connection, head)

    server = Late(lambda *_: None)
    found = open_device(f"usbip://127.0.0.1:{server.port}/CB-1")
    assert bytes(found.read(0x81, 64, 50)) == b"just in time"
    usb.util.dispose_resources(found)
    server.close()


def test_stall() -> None:
    def urb(server: Server, connection: socket.socket, head: bytes) -> None:
        server.reply(connection, struct.unpack_from(">I", head, 4)[0], b"", 0, status=-32)

    with device(urb) as (found, _), pytest.raises(usb.core.USBError, match="EPIPE") as caught:
        found.read(0x81, 64, 1000)
    assert caught.value.errno == 32


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        bytes.fromhex("0111 0005 00000001"),  # refused
        bytes.fromhex("0106 0005 00000000 00000000"),  # another version
        DEVLIST_REPLY[:100],
    ],
)
def test_servers_that_are_none(reply: bytes) -> None:
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            receive(connection, 8)
            connection.sendall(reply)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    with pytest.raises(Disconnected) as caught:
        open_device(f"usbip://127.0.0.1:{listener.getsockname()[1]}/X")
    assert "\n" not in str(caught.value)
    thread.join(2.0)
    listener.close()


def test_server_that_sends_nonsense_after_the_import() -> None:
    class Mad(Server):
        def answer(self, connection: socket.socket, head: bytes) -> None:
            if head[16:20] != bytes(4):
                connection.sendall(b"\xff" * 48)
            else:
                super().answer(connection, head)

    server = Mad()
    found = open_device(f"usbip://127.0.0.1:{server.port}/CB-1")
    with pytest.raises(usb.core.USBError, match="ENODEV"):
        found.read(0x81, 64, 1000)
    usb.util.dispose_resources(found)
    server.close()


@settings(max_examples=100)
@given(st.binary(max_size=60))
def test_no_bytes_break_the_descriptor_reader(tail: bytes) -> None:
    data = struct.pack("<BBHBBBBB", 9, 2, 9 + len(tail), 1, 1, 0, 0x80, 250) + tail
    try:
        parsed = Configuration.parse(data)
    except usb.core.USBError:
        return
    assert all(number >= 0 for number in parsed.interfaces())
