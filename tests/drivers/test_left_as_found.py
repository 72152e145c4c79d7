"""Instruments are left as they were found: after `close`, and by whoever connects next after a process was killed."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial
import usb.core

from drivers.camera.u3v import U3vCamera
from drivers.found_settings import FoundSettings
from drivers.monochromator.cornerstone260 import Cornerstone260
from mocks.bench import Bench
from mocks.cornerstone260 import MockCornerstone260
from mocks.u3v import LIGHT_SOURCE, TRIGGER_CONTROL, U3vDevice
from mocks.usb import InProcessBackend, UsbIpServer
from mocks.wire import Tcp

#: Uses an instrument and says so, then waits to be killed. Its arguments: the driver's module and class, the address,
#: the folder, the use.
USER = """
import sys, time
from importlib import import_module
from pathlib import Path
from drivers.found_settings import FoundSettings
module, name, address, folder, use = sys.argv[1:]
FoundSettings.keep_in(Path(folder))
driver = getattr(import_module(module), name)(address, timeout_s=20.0)
driver.connect()
exec(use)
print("used", flush=True)
time.sleep(600)
"""


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    FoundSettings.keep_in(tmp_path / "data" / "instruments")
    return tmp_path / "data" / "instruments"


@pytest.fixture
def killed(kept: Path) -> Iterator[Callable[[type, str, str], None]]:
    """Let another process use an instrument, and kill it with -9 in the middle."""
    users: list[subprocess.Popen[str]] = []

    def kill(driver: type, address: str, use: str) -> None:
        user = subprocess.Popen(
            [sys.executable, "-c", USER, driver.__module__, driver.__name__, address, str(kept), use],
            stdout=subprocess.PIPE,
            text=True,
        )
        users.append(user)
        assert user.stdout is not None
        assert user.stdout.readline() == "used\n"
        user.send_signal(signal.SIGKILL)
        user.wait(30)
        user.stdout.close()

    yield kill
    for user in users:
        user.kill()
        user.wait(30)


def _registers(device: U3vDevice) -> dict[str, int]:
    names = ("WIDTH", "PIXEL_FORMAT", "TRIGGER_CONTROL", "EXPOSURE_TICKS", "GAIN", "GAMMA_ENABLE", "LIGHT_SOURCE")
    module = sys.modules[U3vDevice.__module__]
    return {name: device._get(getattr(module, name)) for name in names}


@pytest.fixture
def camera_as_somebody_left_it() -> U3vDevice:
    device = U3vDevice(Bench(seed=4), "left", "CB-1")
    device._put(LIGHT_SOURCE, 2)
    return device


def test_a_camera_is_as_it_was_after_close(camera_as_somebody_left_it: U3vDevice, kept: Path) -> None:
    before = _registers(camera_as_somebody_left_it)
    found = usb.core.find(backend=InProcessBackend([camera_as_somebody_left_it]))
    with U3vCamera("usb://mock", device=found, timeout_s=60.0) as camera:
        camera.configure(0.002, 3.0)
        camera.capture()
        assert _registers(camera_as_somebody_left_it) != before
        assert (kept / "camera-CB-1.json").is_file()
    assert _registers(camera_as_somebody_left_it) == before
    assert not kept.exists()


def test_a_camera_is_as_it_was_after_a_kill(
    camera_as_somebody_left_it: U3vDevice, killed: Callable[[type, str, str], None]
) -> None:
    device = camera_as_somebody_left_it
    before = _registers(device)
    server = UsbIpServer([device])
    try:
        address = server.url("CB-1")
        killed(U3vCamera, address, "driver.configure(0.02); driver.arm(); driver.fire()")
        assert device._get(TRIGGER_CONTROL) != before["TRIGGER_CONTROL"]
        with U3vCamera(address, timeout_s=60.0) as camera:
            camera.configure(0.002)
        assert _registers(device) == before
    finally:
        server.close()


def _speaks_without_a_handshake(address: str) -> bool:
    """Whether a plain program gets its answer and nothing after it."""
    with serial.serial_for_url(address, timeout=1.0) as port:
        port.write(b"WAVE?\r\n")
        told = port.read_until(b"\n") + port.read_until(b"\n")
        port.timeout = 0.3
        return told.startswith(b"WAVE?") and port.read(8) == b""


def test_the_handshake_is_as_it_was_after_a_kill(
    served: Callable[..., str], killed: Callable[[type, str, str], None]
) -> None:
    address = served(MockCornerstone260(Bench()), Tcp("127.0.0.1", 0))
    assert _speaks_without_a_handshake(address)
    killed(Cornerstone260, address, "driver.wavelength_nm()")
    assert not _speaks_without_a_handshake(address)
    with Cornerstone260(address) as mono:
        mono.wavelength_nm()
    assert _speaks_without_a_handshake(address)


def test_a_handshake_that_was_on_stays_on(served: Callable[..., str], kept: Path) -> None:
    address = served(MockCornerstone260(Bench()), Tcp("127.0.0.1", 0))
    with serial.serial_for_url(address, timeout=1.0) as port:
        port.write(b"HANDSHAKE 1\r\n")
        port.read_until(b"00\r\n")
    with Cornerstone260(address):
        assert not kept.exists()
    assert not _speaks_without_a_handshake(address)
