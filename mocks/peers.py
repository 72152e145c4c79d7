"""The mocks as peers of the drivers' contract (`drivers.contract`): each can be silenced, unplugged and slowed down."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from drivers.camera.basler import pylon_library
from drivers.contract.peer import Peer, RealInstrument
from drivers.errors import InstrumentError
from mocks.bench import Bench
from mocks.cornerstone260 import MockCornerstone260
from mocks.cornerstone260b import MockCornerstone260B
from mocks.cr300 import ColorimetryResearch
from mocks.display import Page, browse
from mocks.lamp import Lamp, LampClock
from mocks.pr655 import PhotoResearch
from mocks.scpi_meter import AREA_M2, MockScpiMeter
from mocks.scpi_meter import calibration_csv as diode_calibration
from mocks.specbos1211 import MockSpecbos1211
from mocks.stage import MockStage
from mocks.tethered import TetheredCamera
from mocks.usb import UsbIpServer, stereo_pair
from mocks.usb2000plus import MockUsb2000Plus
from mocks.usb2000plus import calibration_csv as spectrometer_calibration
from mocks.usb_device import UsbDevice
from mocks.wire import Endpoint, Fault, Grammar, Pty, Tcp, serve


class _Plug(Endpoint):
    """An endpoint with a plug in its line, and a hand over its ears."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._lock = threading.Lock()
        self._plugged = True
        self.silent = False

    def open(self) -> None:
        with self._lock:
            self._endpoint.open()

    @property
    def address(self) -> str:
        return self._endpoint.address

    def read(self, timeout_s: float) -> bytes:
        with self._lock:
            if self._plugged:
                data = self._endpoint.read(timeout_s)
                return b"" if self.silent else data
        time.sleep(max(timeout_s, 0.005))
        return b""

    def write(self, data: bytes) -> None:
        with self._lock:
            if self._plugged and not self.silent:
                self._endpoint.write(data)

    def close(self) -> None:
        with self._lock:
            self._endpoint.close()

    def plug(self, plugged: bool) -> None:
        with self._lock:
            if plugged != self._plugged:
                (self._endpoint.open if plugged else self._endpoint.close)()
                self._plugged = plugged


class LinePeer(Peer):
    """A mock on a serial line or TCP. `slowness`: real seconds for each of its own where it is slow."""

    def __init__(
        self,
        make: Callable[[Any], Grammar],
        *,
        tcp: bool = False,
        light: Lamp | Bench | None = None,
        slowness: float = 1.0,
        address: Callable[[str], str] = lambda address: address,
        **settings: Any,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        self.folder = Path(self._folder.name)
        self._light = light if light is not None else Lamp(20.0)
        self._slowness = slowness
        self._plug = _Plug(Tcp("127.0.0.1", 0) if tcp else Pty(self.folder / "line"))
        self._stop, ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(
            target=serve,
            args=(make(self._light), self._plug, self._stop),
            kwargs={"announce": lambda address: ready.set()},
            daemon=True,
        )
        self._thread.start()
        if not ready.wait(30):
            raise RuntimeError("the mock didn't start")
        self.address, self.settings = address(self._plug.address), settings

    def mute(self, silent: bool) -> None:
        self._plug.silent = silent

    def unplug(self) -> None:
        self._plug.plug(False)

    def plug(self) -> None:
        self._plug.plug(True)

    def slow(self, slowly: bool) -> bool:
        clock = self._light.clock
        assert hasattr(clock, "real_time_factor")
        clock.real_time_factor = self._slowness if slowly else 0.0
        return self._slowness > 0

    def close(self) -> None:
        self.slow(False)
        self._stop.set()
        self._thread.join(30)
        self._folder.cleanup()


class UsbPeer(Peer):
    """Mock USB devices, exported over USB/IP; the driver has the first."""

    def __init__(self, devices: Sequence[UsbDevice], clock: Any, *, slowness: float = 1.0, **settings: Any) -> None:
        self._devices, self._clock, self._slowness = devices, clock, slowness
        self._server = UsbIpServer(devices)
        self.address = self._server.url(devices[0].identity.serial_number)
        self.settings = settings
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def with_file(self, setting: str, text: str) -> UsbPeer:
        """A file that came with the instrument, named to the driver by a setting."""
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        file = Path(self._folder.name) / f"{setting}.csv"
        file.write_text(text, encoding="utf-8")
        self.settings[setting] = str(file)
        return self

    def mute(self, silent: bool) -> None:
        self._devices[0].mute(silent)

    def unplug(self) -> None:
        self._devices[0].unplug()

    def plug(self) -> None:
        self._devices[0].plug()

    def slow(self, slowly: bool) -> bool:
        self._clock.real_time_factor = self._slowness if slowly else 0.0
        return self._slowness > 0

    def close(self) -> None:
        self.slow(False)
        self._server.close()
        if self._folder is not None:
            self._folder.cleanup()


class TetheredPeer(Peer):
    """A camera whose software writes raw files into a folder."""

    def __init__(self) -> None:
        self._parent = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        self._folder = Path(self._parent.name) / "tethered"
        self._folder.mkdir()
        self._bench = lit_bench()
        self._camera = TetheredCamera(self._folder, self._bench)
        self._camera.start()
        self.address = str(self._folder)
        self.settings = {"settle_s": 0.1, "timeout_s": 2.0, **self._camera.settings}

    def mute(self, silent: bool) -> None:
        self._camera.fail((Fault("never", onwards=True),) if silent else ())

    def unplug(self) -> None:
        self._folder.rename(self._folder.with_suffix(".gone"))

    def plug(self) -> None:
        self._folder.with_suffix(".gone").rename(self._folder)

    def slow(self, slowly: bool) -> bool:
        self._bench.clock.real_time_factor = float(slowly)
        return True

    def close(self) -> None:
        self._bench.clock.real_time_factor = 0.0
        self._camera.close()
        self._parent.cleanup()


class _SilentPage(Page):
    silent = False

    def receive(self, message: str | bytes) -> list[str]:
        answers = super().receive(message)
        return [] if self.silent else answers


class DisplayPeer(Peer):
    """A page without a browser."""

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.address = f"127.0.0.1:{probe.getsockname()[1]}"
        self.settings = {"timeout_s": 1.0, "connect_timeout_s": 2.0}
        self._page = _SilentPage(Lamp())
        self.plug()

    def mute(self, silent: bool) -> None:
        self._page.silent = silent

    def plug(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=browse, args=(self._page, self.address, self._stop), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        self._stop.set()
        self._thread.join(30)

    def slow(self, slowly: bool) -> bool:
        return False

    def close(self) -> None:
        self.unplug()


class PromptPeer(Peer):
    """A person at the terminal who does what is asked."""

    def __init__(self) -> None:
        self.address = ""
        self._here = True
        self.settings = {"ask": self._answer}

    def _answer(self, question: str) -> str:
        if not self._here:
            raise EOFError
        return ""

    def mute(self, silent: bool) -> None:
        self._here = not silent

    def unplug(self) -> None:
        self._here = False

    def plug(self) -> None:
        self._here = True

    def slow(self, slowly: bool) -> bool:
        return False

    def close(self) -> None:
        """Nothing is held."""


class EmulatedBasler(RealInstrument):
    """The first of the two cameras that pypylon emulates itself: it can't be silenced or unplugged."""

    def __init__(self) -> None:
        os.environ.setdefault("PYLON_CAMEMU", "2")
        pylon_library()  # raises where it isn't installed
        super().__init__("0815-0000", {})


class VikyCamera(RealInstrument):
    """The first of the three cameras of GenICam's own GenTL producer, described as one that can be triggered
    (`viky.xml`).

    The package `genicam` brings the producer. It can't be silenced or unplugged.
    """

    def __init__(self) -> None:
        found = find_spec("genicam")
        if found is None or found.origin is None:
            raise InstrumentError("GenTL cameras: genicam isn't installed; install calibench[gentl]")
        producer = Path(found.origin).with_name("viky.cti")
        if not producer.is_file():
            raise InstrumentError(f"{producer} isn't there: this build of genicam has no producer")
        description = Path(__file__).with_name("viky.xml")
        super().__init__("VikyTL_DEV_red", {"producer": str(producer), "description": str(description)})


class AravisFakeCamera(Peer):
    """The fake GigE camera of the package aravis-tools, a process of its own, on loopback; one at a time on this
    computer."""

    program = "arv-fake-gv-camera-0.8"

    def __init__(self) -> None:
        if shutil.which(self.program) is None:
            raise InstrumentError(f"{self.program} isn't installed (scripts/install-aravis)")
        self._lock = (Path(tempfile.gettempdir()) / "calibench-aravis.lock").open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        self.address, self.settings = "127.0.0.1", {"timeout_s": 2.0}
        self.plug()

    def plug(self) -> None:
        self._process = subprocess.Popen(
            [self.program, "-i", "127.0.0.1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        discovery = bytes.fromhex("42 01 00 02 00 00 00 01")  # GVCP: who is there
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(0.1)
            for _ in range(300):
                asking.sendto(discovery, ("127.0.0.1", 3956))
                with contextlib.suppress(OSError):
                    if asking.recv(1024):
                        return
                    time.sleep(0.05)
        raise RuntimeError(f"{self.program} doesn't answer")

    def unplug(self) -> None:
        self._process.kill()
        self._process.wait(30)

    def mute(self, silent: bool) -> None:
        self._process.send_signal(signal.SIGSTOP if silent else signal.SIGCONT)

    def slow(self, slowly: bool) -> bool:
        return False

    def close(self) -> None:
        self.unplug()
        self._lock.close()


def lit_bench() -> Bench:
    """A bench with white light in front of the cameras, its loops compiled and its first frame drawn."""
    bench = Bench(seed=4)
    bench.place("sphere")
    bench.set_filter(2)
    bench.set_shutter(True)
    bench.expose("left", 0.005)
    return bench


def cornerstone260() -> Peer:
    return LinePeer(MockCornerstone260, light=Bench(), timeout_s=1.0, move_timeout_s=20.0)


def cornerstone260b() -> Peer:
    bench = Bench()
    return UsbPeer((MockCornerstone260B(bench),), bench.clock, timeout_s=0.5, move_timeout_s=20.0)


def specbos1211() -> Peer:
    return LinePeer(MockSpecbos1211, slowness=5.0, timeout_s=0.5, fetch_timeout_s=0.5, measure_timeout_s=2.0)


def pr655() -> Peer:
    return LinePeer(PhotoResearch, slowness=3.0, timeout_s=0.5, measure_timeout_s=2.0)


def cr300() -> Peer:
    return LinePeer(ColorimetryResearch, slowness=5.0, timeout_s=0.5, measure_timeout_s=2.0)


def ocean_optics() -> Peer:
    lamp = Lamp(20.0, LampClock())
    peer = UsbPeer((MockUsb2000Plus(lamp),), lamp.clock, slowness=2.0, averages=2)
    return peer.with_file("calibration", spectrometer_calibration())


def u3v() -> Peer:
    bench = lit_bench()
    return UsbPeer(stereo_pair(bench)[:1], bench.clock, timeout_s=2.0)


def basler() -> Peer:
    return EmulatedBasler()


def gentl() -> Peer:
    return VikyCamera()


def aravis() -> Peer:
    return AravisFakeCamera()


def raw_folder() -> Peer:
    return TetheredPeer()


def operator_stage() -> Peer:
    return LinePeer(MockStage, tcp=True, timeout_s=1.0, place_timeout_s=5.0)


def prompt_stage() -> Peer:
    return PromptPeer()


def browser_display() -> Peer:
    return DisplayPeer()


def scpi_photodiode() -> Peer:
    peer = LinePeer(
        MockScpiMeter,
        tcp=True,
        slowness=5.0,
        address=lambda address: "TCPIP0::{}::{}::SOCKET".format(*address.removeprefix("socket://").split(":")),
        area_mm2=1e6 * AREA_M2,
        calibration_sd_percent=0.5,
        timeout_s=2.0,
        readings=4,
    )
    file = peer.folder / "calibration.csv"
    file.write_text(diode_calibration(), encoding="utf-8")
    peer.settings["calibration"] = str(file)
    return peer
