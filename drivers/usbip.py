"""USB over TCP: a pyusb backend that speaks USB/IP, so that a device on another computer (or on the mock bench) is used
like one in a local port.

`usb.core.find(backend=UsbIpBackend(host, port))`; `open_device("usbip://host:port/SERIAL")` finds one by its serial
number or bus id. The remote side is any USB/IP server: Linux's `usbipd`, or `calibench bench`.

Source: Linux kernel, Documentation/usb/usbip_protocol.rst (protocol version 1.1.1). All integers are big-endian; setup
packets and descriptors are USB's own, little-endian.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import re
import socket
import struct
import threading
import time
from abc import abstractmethod
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import usb.core
from usb.backend import IBackend

from drivers.errors import PERMISSION_REMEDY, Disconnected, InstrumentError, InUse, NoAnswer

VERSION = 0x0111
OP_REQ_DEVLIST, OP_REP_DEVLIST = 0x8005, 0x0005
OP_REQ_IMPORT, OP_REP_IMPORT = 0x8003, 0x0003
USBIP_CMD_SUBMIT, USBIP_RET_SUBMIT = 1, 3
USBIP_CMD_UNLINK, USBIP_RET_UNLINK = 2, 4
DIRECTION_OUT, DIRECTION_IN = 0, 1
DEFAULT_PORT = 3240
NOT_ISOCHRONOUS = 0xFFFFFFFF

OP_HEADER = struct.Struct(">HHI")  # version, command, status
DEVICE = struct.Struct(">256s32sIIIHHHBBBBBB")
INTERFACE = struct.Struct(">BBBx")
HEADER = struct.Struct(">IIIII")  # command, sequence number, device id, direction, endpoint
SUBMIT = struct.Struct(">IiiII8s")  # flags, buffer length, start frame, packets, interval, setup
RETURN = struct.Struct(">iiiIi8x")  # status, actual length, start frame, packets, error count
UNLINK = struct.Struct(">I24x")
URB_HEADER_BYTES = HEADER.size + SUBMIT.size

#: Largest answer a server may announce; one frame of a 100-megapixel camera fits.
MOST_BYTES = 512 * 1024 * 1024
#: What `USBError.errno` is once a device is gone.
GONE = (errno.ENODEV, errno.EIO, errno.ESHUTDOWN)
_CONNECT_TIMEOUT_S = 5.0
_UNLINK_GRACE_S = 2.0
_CONTROL_TIMEOUT_MS = 5000
_BUSY_ATTEMPTS, _BUSY_PAUSE_S = 5, 0.03

_DEVICE_DESCRIPTOR, _CONFIGURATION, _STRING, _INTERFACE, _ENDPOINT = 1, 2, 3, 4, 5


@dataclass
class Descriptor:
    """A descriptor's fields under pyusb's names."""

    values: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        try:
            return self.values[name]
        except KeyError:
            raise AttributeError(name) from None


_FIELDS = {
    _DEVICE_DESCRIPTOR: (
        "<BBHBBBBHHHBBBB",
        (
            "bLength bDescriptorType bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 idVendor "
            "idProduct bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"
        ),
    ),
    _CONFIGURATION: (
        "<BBHBBBBB",
        "bLength bDescriptorType wTotalLength bNumInterfaces bConfigurationValue iConfiguration bmAttributes bMaxPower",
    ),
    _INTERFACE: (
        "<BBBBBBBBB",
        (
            "bLength bDescriptorType bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass "
            "bInterfaceSubClass bInterfaceProtocol iInterface"
        ),
    ),
    _ENDPOINT: ("<BBBBHB", "bLength bDescriptorType bEndpointAddress bmAttributes wMaxPacketSize bInterval"),
}


def _descriptor(kind: int, data: bytes, **more: Any) -> Descriptor:
    layout, names = _FIELDS[kind]
    size = struct.calcsize(layout)
    if len(data) < size or data[1] != kind:
        raise usb.core.USBError(f"a descriptor of type {kind} came as {data.hex()}", errno=errno.EPROTO)
    return Descriptor({**dict(zip(names.split(), struct.unpack_from(layout, data), strict=True)), **more})


@dataclass
class Configuration:
    """One configuration descriptor taken apart: interfaces' settings, and the endpoints of each."""

    descriptor: Descriptor
    settings: dict[tuple[int, int], tuple[Descriptor, list[Descriptor]]] = field(default_factory=dict)

    @classmethod
    def parse(cls, data: bytes) -> Configuration:
        """Parse GET_DESCRIPTOR's bytes. Class-specific descriptors go to `extra_descriptors` of what they follow."""
        configuration = cls(_descriptor(_CONFIGURATION, data, extra_descriptors=[]))
        owner = configuration.descriptor
        endpoints: list[Descriptor] = []
        at = data[0]
        while at + 2 <= len(data):
            length, kind = data[at], data[at + 1]
            if length < 2 or at + length > len(data):
                raise usb.core.USBError(f"a configuration breaks off at byte {at} of {len(data)}", errno=errno.EPROTO)
            piece = data[at : at + length]
            if kind == _INTERFACE:
                owner = _descriptor(_INTERFACE, piece, extra_descriptors=[])
                endpoints = []
                configuration.settings[owner.bInterfaceNumber, owner.bAlternateSetting] = (owner, endpoints)
            elif kind == _ENDPOINT:
                owner = _descriptor(_ENDPOINT, piece, bRefresh=0, bSynchAddress=0, extra_descriptors=[])
                endpoints.append(owner)
            else:
                owner.values["extra_descriptors"].extend(piece)
            at += length
        return configuration

    def interfaces(self) -> list[int]:
        """Return the interface numbers, ascending."""
        return sorted({number for number, _ in self.settings})


@dataclass
class RemoteDevice:
    """pyusb's `dev`: the address of a device, and its descriptors once they were read."""

    bus: int
    address: int
    speed: int
    place: Any  # how the backend finds it again
    device: bytes = b""
    configurations: list[bytes] = field(default_factory=list)
    _parsed: list[Configuration] = field(default_factory=list)

    def configuration(self, index: int) -> Configuration:
        """Return the parsed configuration `index`. Raises IndexError past the last, which ends pyusb's iteration."""
        if not self._parsed:
            self._parsed = [Configuration.parse(data) for data in self.configurations]
        return self._parsed[index]


class Pipe:
    """An open device: submits USB requests. Implemented over TCP here, and in the process by the mocks."""

    @abstractmethod
    def submit(self, endpoint: int, setup: bytes, data: bytes | None, length: int, timeout_ms: int) -> bytes:
        """Submit one transfer. `endpoint` with its direction bit; `setup` (8 bytes) for endpoint 0; `data` of an OUT
        transfer, None for IN of `length` bytes. Returns what came (IN). Raises `usb.core.USBError` or
        `USBTimeoutError`.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the device."""


def timeout_error() -> usb.core.USBTimeoutError:
    """Return the exception that pyusb's own backends raise on a time-out.

    >>> timeout_error().errno == errno.ETIMEDOUT
    True
    """
    return usb.core.USBTimeoutError("Operation timed out", error_code=-7, errno=errno.ETIMEDOUT)


def usb_error(status: int, what: str) -> usb.core.USBError:
    """Return a USB error.

    status : errno, positive
    what : beginning of the message

    >>> str(usb_error(errno.ENODEV, "the camera"))
    '[Errno 19] the camera: ENODEV'
    """
    return usb.core.USBError(f"{what}: {errno.errorcode.get(status, status)}", errno=status)


class PipeBackend(IBackend):  # type: ignore[misc]  # pyusb is untyped
    """pyusb's backend on pipes: standard requests and descriptors, once for all transports."""

    #: Devices that the last enumeration couldn't ask who they are, as somebody uses them.
    in_use = 0

    @abstractmethod
    def devices(self) -> Sequence[RemoteDevice]:
        """Return the devices that are connected now."""

    @abstractmethod
    def open_pipe(self, device: RemoteDevice) -> Pipe:
        """Open a device for transfers."""

    def enumerate_devices(self) -> Iterator[RemoteDevice]:
        self.in_use = 0
        for device in self.devices():
            try:
                self._read_descriptors(device)
            except usb.core.USBError as error:
                self.in_use += error.errno == errno.EBUSY
                continue  # in use, or just unplugged: others may still be usable
            yield device

    def _read_descriptors(self, device: RemoteDevice) -> None:
        if device.device:
            return
        pipe = self.open_pipe(device)
        try:
            descriptor = self._get_descriptor(pipe, _DEVICE_DESCRIPTOR, 0, 18)
            for index in range(descriptor[17]):
                head = self._get_descriptor(pipe, _CONFIGURATION, index, 9)
                total = struct.unpack_from("<H", head, 2)[0]
                device.configurations.append(self._get_descriptor(pipe, _CONFIGURATION, index, total))
            device.device = descriptor
        finally:
            pipe.close()

    @staticmethod
    def _get_descriptor(pipe: Pipe, kind: int, index: int, length: int) -> bytes:
        setup = struct.pack("<BBHHH", 0x80, 6, kind << 8 | index, 0, length)
        data = pipe.submit(0x80, setup, None, length, _CONTROL_TIMEOUT_MS)
        if len(data) < min(length, 9):
            raise usb.core.USBError(f"a descriptor of type {kind} came as {data.hex()}", errno=errno.EPROTO)
        return data

    def get_device_descriptor(self, dev: RemoteDevice) -> Descriptor:
        return _descriptor(
            _DEVICE_DESCRIPTOR,
            dev.device,
            bus=dev.bus,
            address=dev.address,
            speed=dev.speed,
            port_number=None,
            port_numbers=None,
        )

    def get_configuration_descriptor(self, dev: RemoteDevice, config: int) -> Descriptor:
        return dev.configuration(config).descriptor

    def get_interface_descriptor(self, dev: RemoteDevice, intf: int, alt: int, config: int) -> Descriptor:
        configuration = dev.configuration(config)
        number = configuration.interfaces()[intf]
        if (number, alt) not in configuration.settings:
            raise IndexError(f"interface {number} has no alternate setting {alt}")
        return configuration.settings[number, alt][0]

    def get_endpoint_descriptor(self, dev: RemoteDevice, ep: int, intf: int, alt: int, config: int) -> Descriptor:
        configuration = dev.configuration(config)
        return configuration.settings[configuration.interfaces()[intf], alt][1][ep]

    def get_parent(self, dev: RemoteDevice) -> None:
        return None

    def open_device(self, dev: RemoteDevice) -> Pipe:
        return self.open_pipe(dev)

    def close_device(self, dev_handle: Pipe) -> None:
        dev_handle.close()

    def _request(self, pipe: Pipe, kind: int, request: int, value: int, index: int) -> None:
        pipe.submit(0x00, struct.pack("<BBHHH", kind, request, value, index, 0), b"", 0, _CONTROL_TIMEOUT_MS)

    def set_configuration(self, dev_handle: Pipe, config_value: int) -> None:
        self._request(dev_handle, 0x00, 9, config_value, 0)

    def get_configuration(self, dev_handle: Pipe) -> int:
        setup = struct.pack("<BBHHH", 0x80, 8, 0, 0, 1)
        return dev_handle.submit(0x80, setup, None, 1, _CONTROL_TIMEOUT_MS)[0]

    def set_interface_altsetting(self, dev_handle: Pipe, intf: int, altsetting: int) -> None:
        self._request(dev_handle, 0x01, 11, altsetting, intf)

    def claim_interface(self, dev_handle: Pipe, intf: int) -> None:
        """Do nothing: an open device is held with all of its interfaces."""

    def release_interface(self, dev_handle: Pipe, intf: int) -> None:
        """Do nothing, as for claiming."""

    def clear_halt(self, dev_handle: Pipe, ep: int) -> None:
        self._request(dev_handle, 0x02, 1, 0, ep)

    def reset_device(self, dev_handle: Pipe) -> None:
        self._request(dev_handle, 0x00, 9, 1, 0)

    def is_kernel_driver_active(self, dev_handle: Pipe, intf: int) -> bool:
        return False

    def detach_kernel_driver(self, dev_handle: Pipe, intf: int) -> None:
        """Do nothing: no kernel driver of this computer holds the device."""

    def attach_kernel_driver(self, dev_handle: Pipe, intf: int) -> None:
        """Do nothing, as for detaching."""

    def _read(self, dev_handle: Pipe, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        data = dev_handle.submit(ep, bytes(8), None, len(buff) * buff.itemsize, timeout)
        memoryview(buff).cast("B")[: len(data)] = data
        return len(data)

    def _write(self, dev_handle: Pipe, ep: int, intf: int, data: array[int], timeout: int) -> int:
        dev_handle.submit(ep, bytes(8), data.tobytes(), 0, timeout)
        return len(data)

    bulk_read = intr_read = _read
    bulk_write = intr_write = _write

    def ctrl_transfer(
        self,
        dev_handle: Pipe,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array[int],
        timeout: int,
    ) -> int:
        size = len(data) * data.itemsize
        setup = struct.pack("<BBHHH", bmRequestType, bRequest, wValue, wIndex, size)
        if bmRequestType & 0x80:
            came = dev_handle.submit(0x80, setup, None, size, timeout)
            memoryview(data).cast("B")[: len(came)] = came
            return len(came)
        dev_handle.submit(0x00, setup, data.tobytes(), 0, timeout)
        return size


@dataclass
class _PendingUrb:
    """A transfer that was submitted to the server, and its answer."""

    incoming: bool
    done: threading.Event = field(default_factory=threading.Event)
    status: int = 0
    data: bytes = b""


def receive_exactly(connection: socket.socket, count: int) -> bytes:
    """Return `count` bytes of a stream. Raises ConnectionError if it ends before."""
    data = bytearray(count)
    view = memoryview(data)
    at = 0
    while at < count:
        got = connection.recv_into(view[at:])
        if got == 0:
            raise ConnectionError(f"the connection was closed after {at} of {count} bytes")
        at += got
    return bytes(data)


class TcpPipe(Pipe):
    """An imported device: requests carry a sequence number, and a thread passes each answer to the thread that waits
    for it."""

    def __init__(self, connection: socket.socket, device_id: int) -> None:
        self._socket = connection
        self._device_id = device_id
        self._sequence = itertools.count(1)
        self._pending: dict[int, _PendingUrb] = {}
        self._unlinking: dict[int, int] = {}  # sequence number of the unlink -> that of what it cancels
        self._lock = threading.Lock()
        self._closed = False
        self._reader = threading.Thread(target=self._receive, name="usbip", daemon=True)
        self._reader.start()

    def submit(self, endpoint: int, setup: bytes, data: bytes | None, length: int, timeout_ms: int) -> bytes:
        incoming = data is None
        urb = _PendingUrb(incoming)
        with self._lock:
            if self._closed:
                raise usb_error(errno.ENODEV, "the USB/IP connection is closed")
            number = next(self._sequence)
            self._pending[number] = urb
            size = length if data is None else len(data)
            head = HEADER.pack(
                USBIP_CMD_SUBMIT, number, self._device_id, DIRECTION_IN if incoming else DIRECTION_OUT, endpoint & 0x0F
            )
            try:
                self._socket.sendall(head + SUBMIT.pack(0, size, 0, NOT_ISOCHRONOUS, 0, setup) + (data or b""))
            except OSError as error:
                self._pending.pop(number, None)
                raise usb_error(errno.ENODEV, f"the USB/IP connection broke ({error})") from error
        if not urb.done.wait(timeout_ms / 1000 if timeout_ms > 0 else None):
            self._unlink(number, urb)
            if urb.status == -errno.ECONNRESET or not urb.done.is_set():
                raise timeout_error()
        if urb.status == -errno.ETIMEDOUT:
            raise timeout_error()
        if urb.status:
            raise usb_error(-urb.status, f"USB transfer on endpoint {endpoint:#04x}")
        if len(urb.data) > length and incoming:
            raise usb_error(errno.EOVERFLOW, f"USB transfer on endpoint {endpoint:#04x}")
        return urb.data

    def _unlink(self, number: int, urb: _PendingUrb) -> None:
        """Cancel a request; its answer counts if it ended in the meantime."""
        with self._lock:
            if urb.done.is_set() or self._closed:
                return
            cancel = next(self._sequence)
            self._unlinking[cancel] = number
            with contextlib.suppress(OSError):
                self._socket.sendall(
                    HEADER.pack(USBIP_CMD_UNLINK, cancel, self._device_id, DIRECTION_OUT, 0) + UNLINK.pack(number)
                )
        urb.done.wait(_UNLINK_GRACE_S)

    def _receive(self) -> None:
        # ends with an exception, always: the socket was closed, or the server sends what can't be followed
        with contextlib.suppress(OSError):
            while True:
                head = receive_exactly(self._socket, URB_HEADER_BYTES)
                command, number, _, _, _ = HEADER.unpack_from(head)
                if command == USBIP_RET_SUBMIT:
                    self._take_return(number, head)
                elif command == USBIP_RET_UNLINK:
                    self._take_unlinked(number, struct.unpack_from(">i", head, HEADER.size)[0])
                else:
                    break
        self._fail_all()

    def _take_return(self, number: int, head: bytes) -> None:
        status, length, _, _, _ = RETURN.unpack_from(head, HEADER.size)
        with self._lock:
            urb = self._pending.pop(number, None)
        if urb is None:
            raise ConnectionError(f"the server answered request {number}, which wasn't asked")
        if not 0 <= length <= MOST_BYTES:
            raise ConnectionError(f"the server announced {length} bytes")
        urb.data = receive_exactly(self._socket, length) if urb.incoming and length else b""
        urb.status = status
        urb.done.set()

    def _take_unlinked(self, number: int, status: int) -> None:
        with self._lock:
            target = self._unlinking.pop(number, 0)
            # status 0: the request had ended, and its own answer has come or comes
            urb = self._pending.pop(target, None) if status else None
        if urb is not None:
            urb.status = status
            urb.done.set()

    def _fail_all(self) -> None:
        with self._lock:
            self._closed = True
            waiting, self._pending = list(self._pending.values()), {}
        for urb in waiting:
            urb.status = -errno.ENODEV
            urb.done.set()
        self._socket.close()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        if threading.current_thread() is not self._reader:
            self._reader.join(_UNLINK_GRACE_S)
        self._socket.close()


class UsbIpBackend(PipeBackend):
    """The devices that a USB/IP server exports."""

    def __init__(self, host: str, port: int = DEFAULT_PORT, timeout_s: float = _CONNECT_TIMEOUT_S) -> None:
        self.host, self.port, self.timeout_s = host, port, timeout_s

    def _ask(self, command: int, body: bytes = b"") -> socket.socket:
        try:
            connection = socket.create_connection((self.host, self.port), self.timeout_s)
        except OSError as error:
            raise usb_error(
                errno.ENODEV, f"no USB/IP server at {self.host}:{self.port} ({error.strerror or error})"
            ) from error
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.sendall(OP_HEADER.pack(VERSION, command, 0) + body)
            version, answer, status = OP_HEADER.unpack(receive_exactly(connection, OP_HEADER.size))
            if version != VERSION or answer != command & 0x7FFF:
                raise usb_error(
                    errno.EPROTO, f"{self.host}:{self.port} answered {version:#06x} {answer:#06x}: not USB/IP 1.1.1"
                )
            if status:
                raise usb_error(errno.EBUSY, f"{self.host}:{self.port} refused the device with status {status}")
        except OSError as error:
            connection.close()
            if isinstance(error, usb.core.USBError):
                raise
            raise usb_error(errno.EPROTO, f"no answer from {self.host}:{self.port} ({error})") from error
        return connection

    def devices(self) -> list[RemoteDevice]:
        with self._ask(OP_REQ_DEVLIST) as connection:
            try:
                (count,) = struct.unpack(">I", receive_exactly(connection, 4))
                devices = []
                for _ in range(min(count, 1024)):
                    fields = DEVICE.unpack(receive_exactly(connection, DEVICE.size))
                    receive_exactly(connection, INTERFACE.size * fields[-1])
                    bus_id = fields[1].split(b"\0", 1)[0]
                    devices.append(RemoteDevice(fields[2], fields[3], fields[4], bus_id))
            except OSError as error:
                raise usb_error(errno.EPROTO, f"the list of {self.host}:{self.port} broke off ({error})") from error
        return devices

    def open_pipe(self, device: RemoteDevice) -> TcpPipe:
        for attempt in range(_BUSY_ATTEMPTS):
            try:
                connection = self._ask(OP_REQ_IMPORT, device.place.ljust(32, b"\0"))
                break
            except usb.core.USBError as error:
                if error.errno != errno.EBUSY or attempt == _BUSY_ATTEMPTS - 1:
                    raise
                time.sleep(_BUSY_PAUSE_S)  # another client may just be reading its serial number
        try:
            receive_exactly(connection, DEVICE.size)
        except OSError as error:
            connection.close()
            raise usb_error(errno.EPROTO, f"{self.host}:{self.port} broke off ({error})") from error
        connection.settimeout(
            None
        )  # the thread waits for as long as the device is open; requests have their own time-outs
        return TcpPipe(connection, device.bus << 16 | device.address)


def find(backend: IBackend | None, serial_number: str) -> usb.core.Device:
    """Return the device with this serial number (or bus id, over USB/IP) on a backend; None: the computer's own USB
    ports.

    Raises `Disconnected` if it isn't there, naming those that are.
    """
    serial_numbers: list[str] = []
    try:
        candidates = list(usb.core.find(find_all=True, backend=backend))
    except usb.core.NoBackendError as error:
        raise Disconnected("no libusb on this computer: install libusb-1.0, or use a camera over usbip://") from error
    except usb.core.USBError as error:
        raise Disconnected(f"USB: {in_words(error)}; start a USB/IP server there, or correct the address") from error
    for device in candidates:
        place = getattr(device._ctx.dev, "place", b"")
        if isinstance(place, bytes) and place.decode("ascii", "replace") == serial_number:
            return device
        try:
            candidate_serial = device.serial_number or ""
        except (usb.core.USBError, ValueError):
            continue  # not ours to read
        if candidate_serial == serial_number:
            return device
        serial_numbers.append(candidate_serial)
        usb.util.dispose_resources(device)
    there = ", ".join(name for name in serial_numbers if name) or "none"
    absent = f"no USB device with serial number {serial_number}; there are: {there}"
    if in_use := getattr(backend, "in_use", 0):
        raise InUse(
            f"{absent}, and {in_use} in use by another program or another instrument of the station: close that one, "
            "or correct the address"
        )
    raise Disconnected(f"{absent}; plug it in and switch it on, or correct the address")


def open_device(address: str) -> usb.core.Device:
    """Return a device by address: `usbip://HOST[:PORT]/SERIAL`, or `usb://SERIAL` in a local port.

    Raises `InstrumentError` for an address of another form, `Disconnected` where nothing answers.
    """
    parts = urlsplit(address)
    serial_number = parts.path.strip("/")
    if parts.scheme == "usbip" and parts.hostname and serial_number:
        return find(UsbIpBackend(parts.hostname, parts.port or DEFAULT_PORT), serial_number)
    if parts.scheme == "usb" and parts.netloc:
        return find(None, parts.netloc)
    raise InstrumentError(f"{address!r} is no USB address; write usbip://HOST:PORT/SERIAL or usb://SERIAL")


def in_words(error: usb.core.USBError) -> str:
    """Return what an error says, without its number before and its name behind.

    >>> in_words(usb_error(errno.ENODEV, "the camera"))
    'the camera'
    """
    return re.sub(r"^\[Errno -?\d+\] |: E[A-Z]+$", "", str(error))


def translate(error: usb.core.USBError, who: str, doing: str) -> InstrumentError:
    """Return the driver's error for one of pyusb's, in one line."""
    if isinstance(error, usb.core.USBTimeoutError):
        return NoAnswer(f"{who}: no answer while {doing}; check the cable and the power")
    if error.errno in GONE:
        return Disconnected(f"{who}: the connection was lost while {doing} ({error}); plug it in again")
    if error.errno == errno.EPIPE:
        return NoAnswer(f"{who}: halted its endpoint while {doing}; the halt is cleared, try again")
    if error.errno == errno.EBUSY:
        return InUse(f"{who}: in use by another program or another instrument of the station; close that one")
    if error.errno == errno.EACCES:
        return InstrumentError(f"{who}: no permission for this USB device; {PERMISSION_REMEDY}")
    return InstrumentError(f"{who}: USB error while {doing}: {error}")
