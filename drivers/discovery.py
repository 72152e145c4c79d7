"""What is connected to this computer, and which driver reaches it.

USB devices are recognised by their identifiers; cameras by the libraries that enumerate them. What stands on a serial
port says nothing by itself: `probe` asks each serial driver to connect.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import usb.core
from serial.tools import list_ports

from drivers.errors import PERMISSION_REMEDY, Disconnected, InstrumentError, InUse
from drivers.instrument import Identity
from drivers.registry import driver, drivers
from drivers.transport import Transport
from drivers.usbip import DEFAULT_PORT, UsbIpBackend, in_words

#: Longest time (s) for one answer of a serial driver that may be the wrong one.
_PROBE_TIMEOUT_S = 0.5


@dataclass(frozen=True)
class Found:
    """Something connected: its address, what it says it is, and the driver's family and name; empty where none is
    known."""

    address: str
    what: str
    family: str = ""
    name: str = ""
    needs: tuple[str, ...] = ()

    @property
    def driver(self) -> str:
        """`family.name`, or nothing."""
        return f"{self.family}.{self.name}" if self.name else ""


def find_all(usbip: str = "") -> Iterator[Found]:
    """Yield everything found: USB devices (and those that a USB/IP server `HOST[:PORT]` exports), cameras of installed
    libraries, serial ports."""
    yield from usb_devices()
    if usbip:
        yield from usbip_devices(usbip)
    for family, name in drivers():
        if family == "camera":
            yield from _enumerate(family, name)
    for port in list_ports.comports():
        if port.vid is not None or port.description not in ("", "n/a"):
            yield Found(port.device, f"serial port: {port.description}")


def usb_devices() -> Iterator[Found]:
    """Yield the instruments among this computer's USB devices."""
    with suppress(usb.core.USBError, usb.core.NoBackendError):
        for device in usb.core.find(find_all=True):
            if (instrument := _usb_device(device, "usb://")) is not None:
                yield instrument


def usbip_devices(server: str) -> Iterator[Found]:
    """Yield the instruments that a USB/IP server exports. Raises `Disconnected`."""
    host, _, port = server.partition(":")
    where = f"usbip://{host}:{port or DEFAULT_PORT}/"
    try:
        for device in usb.core.find(find_all=True, backend=UsbIpBackend(host, int(port or DEFAULT_PORT))):
            if (instrument := _usb_device(device, where)) is not None:
                yield instrument
    except (usb.core.USBError, ValueError) as error:
        raise Disconnected(
            f"{where}: {in_words(error)}; start a USB/IP server there, or correct the address"
        ) from error


def _usb_device(device: usb.core.Device, where: str) -> Found | None:
    family, name, needs = _usb_driver(device)
    if not name:
        return None
    try:
        serial_number, product = device.serial_number or "", device.product or ""
    except (usb.core.USBError, ValueError):
        serial_number, product = "", f"no permission to ask; {PERMISSION_REMEDY}"
    what = f"{product or 'USB device'} ({device.idVendor:04x}:{device.idProduct:04x}) {serial_number}".strip()
    usb.util.dispose_resources(device)
    return Found(f"{where}{serial_number}", what, family, name, needs)


def _usb_driver(device: usb.core.Device) -> tuple[str, str, tuple[str, ...]]:
    from seabreeze.pyseabreeze.transport import USBTransport

    from drivers.monochromator.cornerstone260b import MODELS, VENDOR

    if device.idVendor == VENDOR and device.idProduct in MODELS:
        return "monochromator", "cornerstone260b", ()
    if (device.idVendor, device.idProduct) in USBTransport.vendor_product_ids:
        return "spectroradiometer", "ocean_optics", ("calibration",)
    if (device.bDeviceClass, device.bDeviceSubClass, device.bDeviceProtocol) == (0xEF, 0x02, 0x01):
        with suppress(usb.core.USBError, NotImplementedError):
            for interface in device.get_active_configuration():
                if (interface.bInterfaceClass, interface.bInterfaceSubClass) == (0xEF, 0x05):
                    return "camera", "u3v", ()
    return "", "", ()


def _enumerate(family: str, name: str) -> Iterator[Found]:
    """Yield what a driver's own library lists, where the driver's class has a static method `enumerate_cameras`."""
    try:
        listing = getattr(driver(family, name), "enumerate_cameras", None)
        if listing is not None:
            for address, what in listing():
                yield Found(address, what, family, name)
    except InstrumentError:  # its library isn't installed
        return


def probe(address: str) -> Iterator[tuple[str, Identity | InstrumentError]]:
    """Ask each driver of a serial instrument whether its instrument is at this address; the first that connects is the
    last yielded.

    Each writes its own greeting there: not for a port on which something moves that understands none of them. Raises
    `Disconnected` for a port that can't be opened, `InUse` for one that another program holds.
    """
    port = Transport(address, "port")
    port.open()
    port.close()
    for family, name in drivers():
        made = driver(family, name)
        if not _is_serial(made):
            continue
        instrument: Any = made(address, timeout_s=_PROBE_TIMEOUT_S)
        try:
            instrument.connect()
            yield f"{family}.{name}", instrument.identity()
        except InUse:
            raise
        except InstrumentError as error:
            yield f"{family}.{name}", error
        else:
            return
        finally:
            with suppress(InstrumentError):
                instrument.close()


def _is_serial(made: Any) -> bool:
    """Return whether a driver speaks on a serial port and needs nothing but its address."""
    from drivers.stage.base import Stage
    from drivers.transport import WireInstrument

    if not (inspect.isclass(made) and issubclass(made, WireInstrument) and not issubclass(made, Stage)):
        return False
    if not made.on_a_port:
        return False
    needed = [p for p in inspect.signature(made).parameters.values() if p.default is p.empty]
    return [parameter.name for parameter in needed] == ["address"]
