"""Mock USB devices for pyusb: plugged into a backend in this process, or exported over USB/IP.

`backend("u3v")` is an `IBackend` with a camera plugged in, `"u3v-stereo"` one with two that trigger one another,
`"cornerstone260b"` one with a monochromator, `"usb2000plus"` one with a spectrometer.
`serve_usbip(devices, host, port)` exports the same device models by the real USB/IP protocol: to `drivers.usbip`, and
to Linux's own `usbip attach` alike.

Source: Linux kernel, Documentation/usb/usbip_protocol.rst (protocol version 1.1.1).
"""

from __future__ import annotations

import contextlib
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from drivers.usbip import Pipe, PipeBackend, RemoteDevice, timeout_error, usb_error
from mocks.bench import Bench
from mocks.cornerstone260b import MockCornerstone260B
from mocks.ready_frames import BeforeCameras
from mocks.u3v import TriggerLine, U3vDevice
from mocks.usb2000plus import MockUsb2000Plus
from mocks.usb_device import Abandoned, UsbDevice, UsbFault
from mocks.wire import MeasuredLight

SERIAL_NUMBERS = {"left": "CB-U3V-0001", "right": "CB-U3V-0002"}


def stereo_pair(bench: BeforeCameras) -> tuple[U3vDevice, U3vDevice]:
    """Return both cameras of a bench, wired to trigger one another."""
    line = TriggerLine()
    return (
        U3vDevice(bench, "left", SERIAL_NUMBERS["left"], line),
        U3vDevice(bench, "right", SERIAL_NUMBERS["right"], line),
    )


_INSTRUMENTS: dict[str, Callable[[Any], Sequence[UsbDevice]]] = {
    "cornerstone260b": lambda bench: (MockCornerstone260B(bench),),
    "u3v": lambda bench: stereo_pair(bench)[:1],
    "u3v-stereo": stereo_pair,
    "usb2000plus": lambda bench: (MockUsb2000Plus(bench),),
}


def devices(name: str, bench: BeforeCameras | MeasuredLight | None = None) -> tuple[UsbDevice, ...]:
    """Return the device models of one instrument, on a bench of its own if none is given; cameras need a bench.

    Raises ValueError for an unknown name.
    """
    if name not in _INSTRUMENTS:
        raise ValueError(f"no USB instrument {name!r}: there are {', '.join(_INSTRUMENTS)}")
    return tuple(_INSTRUMENTS[name](bench if bench is not None else Bench()))


def backend(name: str, bench: Bench | None = None) -> InProcessBackend:
    """Return a pyusb backend with an instrument plugged in; `.plugged_in` are its device models.

    name : `u3v`, `u3v-stereo`, `cornerstone260b` or `usb2000plus`
    bench : the light path that it stands on; by default a new one

    >>> import usb.core
    >>> usb.core.find(backend=backend("usb2000plus")).idVendor == 0x2457
    True
    """
    return InProcessBackend(devices(name, bench))


class InProcessPipe(Pipe):
    """Calls a device model directly."""

    def __init__(self, device: UsbDevice) -> None:
        self._device = device

    def submit(self, endpoint: int, setup: bytes, data: bytes | None, length: int, timeout_ms: int) -> bytes:
        deadline = time.monotonic() + timeout_ms / 1000 if timeout_ms > 0 else float("inf")
        try:
            return self._device.transfer(endpoint, setup, data, length, lambda: time.monotonic() > deadline)
        except Abandoned:
            raise timeout_error() from None
        except UsbFault as fault:
            raise usb_error(-fault.status, f"mock USB transfer on endpoint {endpoint:#04x}") from fault

    def close(self) -> None:
        """Do nothing: nothing is held."""


class InProcessBackend(PipeBackend):
    """Device models as pyusb devices."""

    def __init__(self, plugged_in: Sequence[UsbDevice]) -> None:
        self.plugged_in = tuple(plugged_in)

    def devices(self) -> list[RemoteDevice]:
        return [
            RemoteDevice(1, index + 1, device.speed, device)
            for index, device in enumerate(self.plugged_in)
            if device.plugged
        ]

    def open_pipe(self, device: RemoteDevice) -> InProcessPipe:
        return InProcessPipe(device.place)


# The layouts are written out here a second time on purpose: a mistake shared with the client would not be seen.

_VERSION = 0x0111
_URB_BYTES = 48
_MOST_TRANSFER = 64 * 1024 * 1024


def _usb_device_bytes(bus_id: str, number: int, device: UsbDevice) -> bytes:
    identity = device.identity
    return (
        f"/sys/devices/calibench/usb1/{bus_id}".encode().ljust(256, b"\0")
        + bus_id.encode().ljust(32, b"\0")
        + struct.pack(">III", 1, number, device.speed)
        + struct.pack(">HHH", identity.vendor_id, identity.product_id, identity.release)
        + bytes([*identity.device_class, 1, 1, len(device.interfaces)])
    )


@dataclass
class _ReceivedUrb:
    """A transfer that a client submitted."""

    number: int
    endpoint: int  # with its direction bit
    setup: bytes
    data: bytes | None
    length: int
    unlinked: threading.Event = field(default_factory=threading.Event)
    unlink_number: int | None = None  # of the request that cancels this one


class _Session:
    """One imported device on one connection: a thread reads requests, one thread an endpoint works them off in
    order."""

    def __init__(self, connection: socket.socket, device: UsbDevice) -> None:
        self._connection = connection
        self._device = device
        self._send_lock = threading.Lock()
        self._lock = threading.Lock()
        self._queues: dict[int, queue.Queue[_ReceivedUrb | None]] = {}
        self._workers: list[threading.Thread] = []
        self._pending: dict[int, _ReceivedUrb] = {}

    def run(self) -> None:
        """Serve until the client leaves."""
        try:
            while (head := _receive(self._connection, _URB_BYTES)) is not None:
                command, number, _, direction, endpoint = struct.unpack_from(">IIIII", head)
                if command == 1:
                    self._submit(head, number, direction, endpoint)
                elif command == 2:
                    self._unlink(number, struct.unpack_from(">I", head, 20)[0])
                else:
                    return
        finally:
            with self._lock:
                for urb in self._pending.values():
                    urb.unlinked.set()
            for waiting in self._queues.values():
                waiting.put(None)
            for worker in self._workers:
                worker.join()
            with contextlib.suppress(UsbFault):
                self._device.transfer(0x00, struct.pack("<BBHHH", 0x00, 9, 1, 0, 0), b"", 0, lambda: False)

    def _submit(self, head: bytes, number: int, direction: int, endpoint: int) -> None:
        _, length, _, _, _ = struct.unpack_from(">IiiII", head, 20)
        setup = head[40:48]
        if not 0 <= length <= _MOST_TRANSFER or endpoint > 15:
            raise ConnectionError(f"a request for {length} bytes on endpoint {endpoint}")
        data = None if direction else _receive(self._connection, length)
        if not direction and data is None:
            raise ConnectionError("a request broke off")
        urb = _ReceivedUrb(number, endpoint | direction << 7, setup, data, length)
        with self._lock:
            self._pending[number] = urb
        where = 0 if endpoint == 0 else urb.endpoint
        if where not in self._queues:
            self._queues[where] = queue.Queue()
            worker = threading.Thread(
                target=self._work, args=(self._queues[where],), name=f"usbip-{where:#04x}", daemon=True
            )
            self._workers.append(worker)
            worker.start()
        self._queues[where].put(urb)

    def _work(self, waiting: queue.Queue[_ReceivedUrb | None]) -> None:
        while (urb := waiting.get()) is not None:
            status, came, abandoned = 0, b"", urb.unlinked.is_set()
            try:
                if not abandoned:
                    came = self._device.transfer(urb.endpoint, urb.setup, urb.data, urb.length, urb.unlinked.is_set)
            except Abandoned:
                abandoned = True
            except UsbFault as fault:
                status = fault.status
            with self._lock:
                self._pending.pop(urb.number, None)
                # A request that ended before it could be cancelled is answered: what it took from the device would be
                # lost.
                if not abandoned:
                    count = len(came) if urb.data is None else len(urb.data) * (status == 0)
                    self._send(
                        struct.pack(">IIIII", 3, urb.number, 0, 0, 0)
                        + struct.pack(">iiiii8x", status, count, 0, 0, 0)
                        + came
                    )
                if urb.unlink_number is not None:
                    self._answer_unlink(urb.unlink_number, Abandoned.status if abandoned else 0)

    def _unlink(self, number: int, target: int) -> None:
        with self._lock:
            urb = self._pending.get(target)
            if urb is None:
                self._answer_unlink(number, 0)
            else:
                urb.unlink_number = number
                urb.unlinked.set()

    def _answer_unlink(self, number: int, status: int) -> None:
        self._send(struct.pack(">IIIII", 4, number, 0, 0, 0) + struct.pack(">i24x", status))

    def _send(self, data: bytes) -> None:
        with self._send_lock, contextlib.suppress(OSError):
            self._connection.sendall(data)


def _receive(connection: socket.socket, count: int) -> bytes | None:
    """Exactly `count` bytes, or None if the client left."""
    data = bytearray()
    while len(data) < count:
        try:
            piece = connection.recv(min(count - len(data), 1 << 20))
        except OSError:
            return None
        if not piece:
            return None
        data += piece
    return bytes(data)


class UsbIpServer:
    """A USB/IP server on a thread of its own; `address` is (host, port). Use as a context, or call `close`."""

    def __init__(self, exported: Sequence[UsbDevice], host: str = "127.0.0.1", port: int = 0) -> None:
        self._exported = {f"1-{index + 1}": device for index, device in enumerate(exported)}
        self._busy: set[str] = set()
        self._lock = threading.Lock()
        self._connections: set[socket.socket] = set()
        self._threads: set[threading.Thread] = set()
        self._listener = socket.create_server((host, port))
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._accepting = threading.Thread(target=self._accept, name="usbip-server", daemon=True)
        self._accepting.start()

    def url(self, serial_number: str) -> str:
        """Return the address of one device, as a station file names it."""
        return f"usbip://{self.address[0]}:{self.address[1]}/{serial_number}"

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(connection,), name="usbip-connection", daemon=True)
            with self._lock:
                self._connections.add(connection)
                self._threads.add(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._answer(connection)
        except (OSError, ConnectionError):
            pass  # the client left, or sent what isn't USB/IP: the connection ends
        finally:
            connection.close()
            with self._lock:
                self._connections.discard(connection)
                self._threads.discard(threading.current_thread())

    def _answer(self, connection: socket.socket) -> None:
        head = _receive(connection, 8)
        if head is None:
            return
        version, command, _ = struct.unpack(">HHI", head)
        if version != _VERSION:
            return
        if command == 0x8005:
            listed = [(bus_id, device) for bus_id, device in self._exported.items() if device.plugged]
            body = b"".join(
                _usb_device_bytes(bus_id, int(bus_id[2:]), device)
                + b"".join(bytes([*interface.interface_class, 0]) for interface in device.interfaces)
                for bus_id, device in listed
            )
            connection.sendall(struct.pack(">HHII", _VERSION, 0x0005, 0, len(listed)) + body)
        elif command == 0x8003:
            wanted = _receive(connection, 32)
            if wanted is not None:
                self._import(connection, wanted.split(b"\0", 1)[0].decode("ascii", "replace"))

    def _import(self, connection: socket.socket, bus_id: str) -> None:
        device = self._exported.get(bus_id)
        with self._lock:
            status = 1 if device is None or not device.plugged else 2 if bus_id in self._busy else 0
            if status == 0:
                self._busy.add(bus_id)
        if status or device is None:
            connection.sendall(struct.pack(">HHI", _VERSION, 0x0003, status))
            return
        try:
            connection.sendall(
                struct.pack(">HHI", _VERSION, 0x0003, 0) + _usb_device_bytes(bus_id, int(bus_id[2:]), device)
            )
            _Session(connection, device).run()
        finally:
            with self._lock:
                self._busy.discard(bus_id)

    def close(self) -> None:
        """Stop listening, end every connection, wait for the threads."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            connections, threads = list(self._connections), list(self._threads)
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in [self._accepting, *threads]:
            thread.join(5.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def serve_usbip(exported: Sequence[UsbDevice], host: str = "127.0.0.1", port: int = 0) -> UsbIpServer:
    """Export devices over USB/IP; returns the running server (`.address`, `.url(serial_number)`, `.close()`). Port 0:
    any."""
    return UsbIpServer(exported, host, port)
