"""The mocks as peers of the drivers' contract (`drivers.contract`): each can be silenced, unplugged and slowed down."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from http.client import HTTPConnection
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from drivers.camera.basler import pylon_library
from drivers.contract.peer import Peer, RealInstrument
from drivers.errors import InstrumentError
from mocks.bench import Bench
from mocks.cm110 import MockCm110
from mocks.cornerstone260 import MockCornerstone260
from mocks.cornerstone260b import MockCornerstone260B
from mocks.cr300 import ColorimetryResearch
from mocks.cs2000 import MockCs2000
from mocks.display import Page, browse
from mocks.lamp import Lamp, LampClock
from mocks.pe4000 import MockPe4000
from mocks.pr655 import PhotoResearch
from mocks.scpi_meter import AREA_M2, MockScpiMeter
from mocks.scpi_meter import calibration_csv as diode_calibration
from mocks.sp2150 import MockSp2150
from mocks.specbos1211 import MockSpecbos1211
from mocks.spotread import MockSpotread
from mocks.stage import MockStage
from mocks.tethered import TetheredCamera, write_dng
from mocks.usb import UsbIpServer, stereo_pair
from mocks.usb2000plus import MockUsb2000Plus
from mocks.usb2000plus import calibration_csv as spectrometer_calibration
from mocks.usb_device import UsbDevice
from mocks.wire import Endpoint, Fault, FaultyLine, Grammar, Pty, Tcp, serve


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
    """A mock on a serial line or TCP. `slowness`: real seconds for each of its own where it is slow; `line` can be told
    to fail."""

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
        self.line = FaultyLine(make(self._light))
        self._plug = _Plug(Tcp("127.0.0.1", 0) if tcp else Pty(self.folder / "line"))
        self._stop, ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(
            target=serve,
            args=(self.line, self._plug, self._stop),
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
        self.device, self._clock, self._slowness = devices[0], clock, slowness
        self._server = UsbIpServer(devices)
        self.address = self._server.url(devices[0].identity.serial_number)
        self.settings = settings
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def with_file(self, setting: str, text: str) -> UsbPeer:
        """Return a file that came with the instrument, named to the driver by a setting."""
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        file = Path(self._folder.name) / f"{setting}.csv"
        file.write_text(text, encoding="utf-8")
        self.settings[setting] = str(file)
        return self

    def mute(self, silent: bool) -> None:
        self.device.mute(silent)

    def unplug(self) -> None:
        self.device.unplug()

    def plug(self) -> None:
        self.device.plug()

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
        self.camera = TetheredCamera(self._folder, self._bench)
        self.camera.start()
        self.address = str(self._folder)
        self.settings = {"settle_s": 0.1, "timeout_s": 2.0, **self.camera.settings}

    def mute(self, silent: bool) -> None:
        self.camera.fail((Fault("never", onwards=True),) if silent else ())

    def unplug(self) -> None:
        self._folder.rename(self._folder.with_suffix(".gone"))

    def plug(self) -> None:
        self._folder.with_suffix(".gone").rename(self._folder)

    def slow(self, slowly: bool) -> bool:
        self._bench.clock.real_time_factor = float(slowly)
        return True

    def close(self) -> None:
        self._bench.clock.real_time_factor = 0.0
        self.camera.close()
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
        self.page = _SilentPage(Lamp())
        self.plug()

    def mute(self, silent: bool) -> None:
        self.page.silent = silent

    def plug(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=browse, args=(self.page, self.address, self._stop), daemon=True)
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
        spec = find_spec("genicam")
        if spec is None or spec.origin is None:
            raise InstrumentError("GenTL cameras: genicam isn't installed; install calibench[gentl]")
        producer = Path(spec.origin).with_name("viky.cti")
        if not producer.is_file():
            raise InstrumentError(f"{producer} isn't there: this build of genicam has no producer")
        description = Path(__file__).with_name("viky.xml")
        super().__init__("VikyTL_DEV_red", {"producer": str(producer), "description": str(description)})


class ProcessPeer(Peer):
    """A program of others in the instrument's place, a process of its own on loopback; one at a time on this
    computer."""

    exposes = True

    def __init__(self, name: str, command: Sequence[str], environment: dict[str, str] | None = None) -> None:
        self._command, self._environment = command, os.environ | (environment or {})
        self._lock = (Path(tempfile.gettempdir()) / f"calibench-{name}.lock").open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        self.plug()

    def _answers(self) -> bool:
        """Return whether it can be talked to."""
        raise NotImplementedError

    def plug(self) -> None:
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self._environment,
            start_new_session=True,  # what it starts in its turn is stopped and ended with it
        )
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            with contextlib.suppress(OSError):
                if self._answers():
                    return
            time.sleep(0.05)
        self.close()
        raise RuntimeError(f"{self._command[0]} doesn't answer")

    def unplug(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(30)

    def mute(self, silent: bool) -> None:
        os.killpg(self._process.pid, signal.SIGSTOP if silent else signal.SIGCONT)

    def slow(self, slowly: bool) -> bool:
        return self.exposes  # in real time

    def close(self) -> None:
        self.unplug()
        self._lock.close()


class AravisFakeCamera(ProcessPeer):
    """The fake GigE camera of the package aravis-tools."""

    program, exposes = "arv-fake-gv-camera-0.8", False

    def __init__(self) -> None:
        if shutil.which(self.program) is None:
            raise InstrumentError(f"{self.program} isn't installed (scripts/install-aravis)")
        self.address, self.settings = "127.0.0.1", {"timeout_s": 2.0}
        super().__init__("aravis", [self.program, "-i", "127.0.0.1"])

    def _answers(self) -> bool:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(0.1)
            asking.sendto(bytes.fromhex("42 01 00 02 00 00 00 01"), ("127.0.0.1", 3956))  # GVCP: who is there
            return bool(asking.recv(1024))


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


#: What the Alpaca simulators are like, as somebody left them: binned.
ALPACA_DEVICES = """devices:
  camera:
    0: {name: Simulator Camera, description: "", driverinfo: Camera Simulator, driverversion: "1.0",
        interfaceversion: 3, connected: false, cameraxsize: 640, cameraysize: 480, binx: 2, biny: 2,
        startx: 8, starty: 4, numx: 200, numy: 100, maxbinx: 4, maxbiny: 4, canabortexposure: true,
        canstopexposure: true, exposuremin: 0.001, exposuremax: 3600.0, gain: 1, gains: ["1", "2", "3"],
        maxadu: 4095, sensortype: 2, bayeroffsetx: 1, bayeroffsety: 0, pixelsizex: 3.45, pixelsizey: 3.45,
        ccdtemperature: -5.0, readoutmode: 0, readoutmodes: [Fast, Normal], offset: 1, camera_state: 0}
  telescope: {0: {name: Telescope}}
  focuser: {0: {name: Focuser}}
  covercalibrator:
    0: {name: Simulator Lamp, description: "", driverinfo: Cover Calibrator Simulator, driverversion: "1.0",
        interfaceversion: 1, brightness: 7, calibratorchanging: false, calibratorstate: 3, covermoving: false,
        coverstate: 1, maxbrightness: 255}
"""


class AlpacaSimulator(ProcessPeer):
    """The server of the package alpaca-simulators: a camera and a lamp, both number 0."""

    def __init__(self) -> None:
        if find_spec("alpaca_simulators") is None:
            raise InstrumentError("Alpaca: alpaca-simulators isn't installed (scripts/install-peers)")
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        file = Path(self._folder.name) / "devices.yaml"
        file.write_text(ALPACA_DEVICES, encoding="utf-8")
        self._port = _free_port()
        self.address, self.settings = f"127.0.0.1:{self._port}/0", {"timeout_s": 3.0}
        super().__init__("alpaca", [sys.executable, "-m", "mocks.alpaca_simulator", str(self._port), str(file)])

    def _answers(self) -> bool:
        for path in ("camera/0/connected", "covercalibrator/0/calibratorstate"):  # it loads what they need: seconds
            connection = HTTPConnection("127.0.0.1", self._port, timeout=30.0)
            connection.request("GET", f"/api/v1/{path}")
            connection.getresponse().read()
            connection.close()
        return True

    def close(self) -> None:
        super().close()
        self._folder.cleanup()


class IndiSimulator(ProcessPeer):
    """INDI's server with its simulated camera and lamp, as somebody left them: binned."""

    def __init__(self, device: str = "CCD Simulator") -> None:
        if shutil.which("indiserver") is None:
            raise InstrumentError("INDI: indiserver isn't installed (scripts/install-peers)")
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        self._port = _free_port()
        self.exposes = device == "CCD Simulator"
        self.address, self.settings = f"127.0.0.1:{self._port}/{device}", {"timeout_s": 3.0}
        command = ["indiserver", "-p", str(self._port), "indi_simulator_ccd", "indi_simulator_lightpanel"]
        super().__init__("indi", command, {"HOME": self._folder.name})

    def _answers(self) -> bool:
        with socket.create_connection(("127.0.0.1", self._port), 1.0) as line:
            line.settimeout(5.0)
            line.sendall(b"<getProperties version='1.7' device='CCD Simulator'/>")
            heard = b""
            while b"SIM_YRES" not in heard:
                piece = line.recv(1 << 16)
                if not piece:
                    return False
                heard += piece
            for name, numbers in (
                ("SIMULATOR_SETTINGS", {"SIM_XRES": 512, "SIM_YRES": 512}),
                ("POLLING_PERIOD", {"PERIOD_MS": 10}),
            ):
                ones = "".join(f"<oneNumber name='{name}'>{value}</oneNumber>" for name, value in numbers.items())
                line.sendall(f"<newNumberVector device='CCD Simulator' name='{name}'>{ones}</newNumberVector>".encode())
            time.sleep(0.2)
        return True

    def close(self) -> None:
        super().close()
        self._folder.cleanup()


class LibraryPeer(Peer):
    """A library's own simulated camera, in the process that the driver starts for it (`drivers.apart`).

    `file`: what the driver opens; without it there is no such camera.
    """

    def __init__(self, served: str, file: Path, address: str, **settings: Any) -> None:
        self._served, self._file = served, file
        self.address, self.settings = address, settings

    def _signal(self, number: signal.Signals) -> None:
        """Give the driver's processes a signal."""
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError):  # it ended meanwhile
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == os.getpid() and self._served.encode() in (entry / "cmdline").read_bytes():
                    os.kill(int(entry.name), number)

    def mute(self, silent: bool) -> None:
        self._signal(signal.SIGSTOP if silent else signal.SIGCONT)

    def unplug(self) -> None:
        self._file.rename(self._file.with_suffix(".gone"))
        self._signal(signal.SIGKILL)

    def plug(self) -> None:
        self._file.with_suffix(".gone").rename(self._file)

    def slow(self, slowly: bool) -> bool:
        return True  # it exposes in real time

    def close(self) -> None:
        self._signal(signal.SIGKILL)


class VirtualCamera(LibraryPeer):
    """libgphoto2's virtual camera, of the package gphoto2's wheel: it hands out one picture again and again."""

    def __init__(self) -> None:
        if find_spec("gphoto2") is None:
            raise InstrumentError("gphoto2 cameras: gphoto2 isn't installed; install calibench[gphoto2]")
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        self.picture = Path(self._folder.name) / "picture.jpg"  # the only ending that it looks for
        codes = np.random.default_rng(1).integers(64, 4096, (48, 64), dtype=np.uint16)
        write_dng(self.picture, codes, 0.0)
        super().__init__("drivers.camera.gphoto2:Library", self.picture, "", timeout_s=3.0)
        self.plug()

    def unplug(self) -> None:
        os.environ.pop("VCAMERADIR", None)
        self._signal(signal.SIGKILL)

    def plug(self) -> None:
        os.environ["VCAMERADIR"] = self._folder.name

    def slow(self, slowly: bool) -> bool:
        return False

    def close(self) -> None:
        self.unplug()
        self._folder.cleanup()


#: Micro-Manager's own simulated camera and shutter, as somebody left them: binned, and mirrored.
DEMO_CAMERA = """Property,Core,Initialize,0
Device,Camera,DemoCamera,DCam
Device,Shutter,DemoCamera,DShutter
Property,Core,Initialize,1
Property,Camera,Binning,2
Property,Camera,TransposeCorrection,1
Property,Camera,TransposeMirrorX,1
Property,Camera,PixelType,16bit
Property,Camera,BitDepth,12
Property,Core,Camera,Camera
Property,Core,Shutter,Shutter
"""


class DemoCamera(LibraryPeer):
    """Micro-Manager's DemoCamera, of the package mm-test-adapters."""

    def __init__(self) -> None:
        spec = find_spec("mm_test_adapters")
        if spec is None or spec.origin is None or find_spec("pymmcore_plus") is None:
            raise InstrumentError("Micro-Manager cameras: mm-test-adapters isn't installed; install calibench[peers]")
        self._folder = tempfile.TemporaryDirectory(prefix="calibench-peer-")
        file = Path(self._folder.name) / "demo.cfg"
        file.write_text(DEMO_CAMERA, encoding="utf-8")
        super().__init__(
            "drivers.camera.micromanager:Core",
            file,
            f"{file}#Camera",
            adapters=str(Path(spec.origin).with_name("libs")),
            timeout_s=3.0,
            connect_timeout_s=20.0,
        )

    def close(self) -> None:
        super().close()
        self._folder.cleanup()


def lit_bench() -> Bench:
    """Return a bench with white light in front of the cameras, its loops compiled and its first frame drawn."""
    bench = Bench(seed=4)
    bench.place("sphere")
    bench.set_filter(2)
    bench.set_shutter(True)
    bench.expose("left", 0.005)
    return bench


def cornerstone260() -> Peer:
    """Return a mock of the Cornerstone 260 monochromator on a serial line."""
    return LinePeer(MockCornerstone260, light=Bench(), timeout_s=1.0, move_timeout_s=20.0)


def cornerstone260b() -> Peer:
    """Return a mock of the CS260B monochromator on USB."""
    bench = Bench()
    return UsbPeer((MockCornerstone260B(bench),), bench.clock, timeout_s=0.5, move_timeout_s=20.0)


def cm110() -> Peer:
    """Return a mock of the CM110 monochromator on a serial line."""
    return LinePeer(
        MockCm110,
        light=Bench(),
        dark_nm=200.0,
        dispersion_nm_per_mm=7.0,
        slit_um=500.0,
        timeout_s=0.5,
        move_timeout_s=20.0,
    )


def sp2150() -> Peer:
    """Return a mock of the SP-2150 monochromator on a serial line."""
    return LinePeer(MockSp2150, light=Bench(), slit_um=500.0, dark_place=6, timeout_s=1.0, move_timeout_s=20.0)


def specbos1211() -> Peer:
    """Return a mock of the specbos 1211 spectroradiometer on a serial line."""
    return LinePeer(MockSpecbos1211, slowness=5.0, timeout_s=0.5, fetch_timeout_s=0.5, measure_timeout_s=2.0)


def argyll() -> Peer:
    peer = LinePeer(MockSpotread, tcp=True, timeout_s=5.0, measure_timeout_s=3.0)
    peer.settings["program"] = spotread_command(peer.address)
    peer.address = "1"
    return peer


def spotread_command(address: str) -> str:
    """Return the program that stands in for spotread: `program` of the driver. `address`: of its mock, by TCP."""
    file = Path(__file__).with_name("spotread_program.py")
    return shlex.join([sys.executable, "-I", "-S", str(file), address.removeprefix("socket://")])


def pr655() -> Peer:
    """Return a mock of the PR-655 spectroradiometer on a serial line."""
    return LinePeer(PhotoResearch, slowness=3.0, timeout_s=0.5, measure_timeout_s=2.0)


def cr300() -> Peer:
    """Return a mock of the CR-300 spectroradiometer on a serial line."""
    return LinePeer(ColorimetryResearch, slowness=5.0, timeout_s=0.5, measure_timeout_s=2.0)


def cs2000() -> Peer:
    """Return a mock of the CS-2000 spectroradiometer on a serial line."""
    return LinePeer(MockCs2000, slowness=2.0, timeout_s=0.5, measure_timeout_s=5.0)


def ocean_optics() -> Peer:
    """Return a mock of the USB2000+ spectrometer on USB, before a lamp, with its calibration file."""
    lamp = Lamp(20.0, LampClock())
    peer = UsbPeer((MockUsb2000Plus(lamp),), lamp.clock, slowness=2.0, averages=2)
    return peer.with_file("calibration", spectrometer_calibration())


def u3v() -> Peer:
    """Return a mock of a USB3 Vision camera in white light."""
    bench = lit_bench()
    return UsbPeer(stereo_pair(bench)[:1], bench.clock, timeout_s=2.0)


def basler() -> Peer:
    """Return the camera that Basler's pylon emulates."""
    return EmulatedBasler()


def gentl() -> Peer:
    """Return the camera that GenICam's own GenTL producer simulates."""
    return VikyCamera()


def aravis() -> Peer:
    """Return the fake camera of Aravis."""
    return AravisFakeCamera()


def alpaca() -> Peer:
    """Return the camera of an Alpaca simulator."""
    return AlpacaSimulator()


def indi() -> Peer:
    """Return the camera of INDI's simulator."""
    return IndiSimulator()


def gphoto2() -> Peer:
    """Return the virtual camera of libgphoto2."""
    return VirtualCamera()


def alpaca_lamp() -> Peer:
    """Return the light source of an Alpaca simulator; it takes no pictures."""
    peer = AlpacaSimulator()
    peer.exposes = False
    return peer


def indi_lamp() -> Peer:
    """Return the light panel of INDI's simulator."""
    return IndiSimulator("Light Panel Simulator")


def pe4000() -> Peer:
    """Return a mock of the pE-4000 light source on a serial line."""
    return LinePeer(MockPe4000, slowness=0.0, timeout_s=0.5, load_timeout_s=10.0)


def micromanager() -> Peer:
    """Return the demo camera of Micro-Manager."""
    return DemoCamera()


def raw_folder() -> Peer:
    """Return a tethered camera that writes its raws into a folder."""
    return TetheredPeer()


def operator_stage() -> Peer:
    """Return a mock of the operator's stage on a TCP port."""
    return LinePeer(MockStage, tcp=True, timeout_s=1.0, place_timeout_s=5.0)


def prompt_stage() -> Peer:
    """Return a stage whose person confirms at once."""
    return PromptPeer()


def browser_display() -> Peer:
    """Return the display's page as a client without a browser asks for it."""
    return DisplayPeer()


def scpi_photodiode() -> Peer:
    """Return a mock of a SCPI photodiode meter on a TCP port, with its calibration file."""
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
