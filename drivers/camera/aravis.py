"""GigE Vision and USB3 Vision cameras of any maker through Aravis (0.8), by GObject introspection.

The library runs in a process of its own (`drivers.apart`): its calls on a camera that is silent take up to 15 s, and a
camera that was gone can't be controlled again by the process that had it.

Aravis is a library of the distribution (Debian: `gir1.2-aravis-0.8`, `python3-gi`; `scripts/install-aravis` installs
them). A virtual environment doesn't see the distribution's `gi`; it is loaded from there alone, if it was built for
this version of Python."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from functools import cache, cached_property
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from typing import Any, TypeVar

from drivers.apart import Apart
from drivers.camera.buffers import Grabbed
from drivers.camera.genicam import GenicamCamera
from drivers.camera.genicam_settings import AskedFeatures
from drivers.errors import Disconnected, InstrumentError, InUse, NoAnswer
from drivers.instrument import Identity, Setting

_T = TypeVar("_T")
_DISTRIBUTION = "/usr/lib/python3/dist-packages"
_BUFFERS = 4
_CLEARED = 1
#: Longest time (s) until an interpreter has loaded the library.
_LOADING_S = 20.0
_STATUS = {
    2: "it came after the time-out",
    3: "packets are missing",
    4: "its packets have wrong numbers",
    5: "too large",
    7: "aborted",
}


@cache
def _library() -> Any:
    """Return the module `Aravis`. Raises `InstrumentError` where it isn't installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImportWarning)  # gi's importer is of an old kind
            gi = _introspection()
            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise InstrumentError(
            f"GigE cameras: Aravis isn't installed for this Python ({' '.join(str(error).split())}); run "
            "scripts/install-aravis"
        ) from error
    return Aravis


@cache
def _glib_error() -> type[Exception]:
    _library()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ImportWarning)
        from gi.repository import GLib
    return GLib.Error


def _introspection() -> Any:
    try:
        import gi
    except ImportError:
        spec = PathFinder.find_spec("gi", [_DISTRIBUTION])
        if spec is None or spec.loader is None:
            raise
        gi = module_from_spec(spec)
        sys.modules["gi"] = gi
        try:
            spec.loader.exec_module(gi)
        except ImportError:
            del sys.modules["gi"]
            raise
    return gi


def _error_of(error: Exception, who: str, doing: str) -> InstrumentError:
    message = " ".join(str(getattr(error, "message", error)).split())
    if "imeout" in message:
        return NoAnswer(f"{who}: no answer while {doing}; check the cable, the power and the firewall")
    if "Not found" in message or "not found" in message or "Invalid" in message:
        return InstrumentError(f"{who}: {doing} failed ({message}); check that the camera has it")
    return Disconnected(f"{who}: {doing} failed ({message}); plug it in again, the next call reconnects")


class _AravisFeatures:
    """A camera's features through Aravis."""

    def __init__(self, camera: Any, who: str) -> None:
        self._camera, self._who = camera, who

    def do(self, doing: str, action: Callable[[], _T]) -> _T:
        """Run a call of the library; its error as ours."""
        try:
            return action()
        except _glib_error() as error:
            raise _error_of(error, self._who, doing) from error

    def has(self, name: str) -> bool:
        return bool(self.do(f"looking for {name}", lambda: self._camera.is_feature_available(name)))

    def get(self, name: str) -> Setting:
        kinds = _library()
        node = self._camera.get_device().get_feature(name)
        read: Callable[[str], Setting] = self._camera.get_string
        if isinstance(node, kinds.GcBoolean):
            read = self._camera.get_boolean
        elif isinstance(node, kinds.GcFloatNode):
            read = self._camera.get_float
        elif isinstance(node, kinds.GcIntegerNode) and not isinstance(node, kinds.GcEnumeration):
            read = self._camera.get_integer
        elif isinstance(node, kinds.GcFloat):
            read = self._camera.get_float
        return self.do(f"reading {name}", lambda: read(name))

    def set(self, name: str, value: Setting) -> None:
        if isinstance(value, bool):
            self.do(f"setting {name}", lambda: self._camera.set_boolean(name, value))
        elif isinstance(value, str):
            self.do(f"setting {name}", lambda: self._camera.set_string(name, value))
        elif isinstance(value, float):
            self.do(f"setting {name}", lambda: self._camera.set_float(name, value))
        else:
            self.do(f"setting {name}", lambda: self._camera.set_integer(name, value))

    def entries(self, name: str) -> Collection[str]:
        return tuple(
            self.do(f"reading what {name} may be", lambda: self._camera.dup_available_enumerations_as_strings(name))
        )

    def limits(self, name: str) -> tuple[float, float]:
        bounds = self.do(f"reading the limits of {name}", lambda: self._camera.get_float_bounds(name))
        return float(bounds.min), float(bounds.max)

    def execute(self, name: str) -> None:
        self.do(f"executing {name}", lambda: self._camera.execute_command(name))


class AravisDevice:
    """Aravis with one camera, in the process apart: `open` comes first."""

    _camera: Any = None
    _stream: Any = None
    _nodes: Any = None

    def __init__(self, address: str) -> None:
        self.address = address

    def load(self) -> None:
        """Load the library. Raises `InstrumentError` where it isn't installed."""
        _library()

    def open(self) -> tuple[str, str, str, str]:
        """Find and control the camera; its maker, model, serial number and firmware."""
        library = _library()
        try:
            self._camera = library.Camera.new(self.address)
        except _glib_error() as error:
            raise Disconnected(
                f"camera {self.address}: Aravis finds no such camera ({getattr(error, 'message', error)}); check the "
                "cable, the power and the network"
            ) from error
        nodes = _AravisFeatures(self._camera, f"camera {self.address}")
        if not self._controls():
            raise InUse(f"camera {self.address}: another program controls it; close that one")
        self._nodes = nodes
        with suppress(_glib_error()):
            self._camera.stop_acquisition()  # one that a process left running that was killed
        names = [
            nodes.do("reading who it is", read) for read in (self._camera.get_vendor_name, self._camera.get_model_name)
        ]
        serial_number = next(
            (str(nodes.get(name)) for name in ("DeviceSerialNumber", "DeviceID") if nodes.has(name)), ""
        )
        firmware = str(nodes.get("DeviceVersion")) if nodes.has("DeviceVersion") else ""
        return names[0], names[1], serial_number, firmware

    def feature(self, method: str, *arguments: Any) -> Any:
        """Return what `_AravisFeatures` has and does."""
        return getattr(self._nodes, method)(*arguments)

    def start(self) -> None:
        """Queue buffers and start acquisition."""
        library = _library()
        payload = self._nodes.do("reading its frame's size", self._camera.get_payload)
        self._stream = self._nodes.do("opening its stream", lambda: self._camera.create_stream(None, None))
        for _ in range(_BUFFERS):
            self._stream.push_buffer(library.Buffer.new_allocate(payload))
        self._nodes.do("starting", self._camera.start_acquisition)

    def halt(self) -> None:
        """Stop acquisition, discard what is queued. Raises `Disconnected` where the camera has lost us meanwhile: one
        that was switched off and on hears no trigger of ours."""
        self._stream = None
        self._nodes.do("stopping", self._camera.stop_acquisition)
        if not self._controls():
            raise Disconnected(f"camera {self.address}: it has forgotten who controls it; the next call reconnects")

    def _controls(self) -> bool:
        """Return whether we control the camera; a USB camera's others can't."""
        device = self._camera.get_device()
        return not hasattr(device, "is_controller") or bool(device.is_controller())

    def grab(self, timeout_s: float) -> dict[str, Any] | None:
        """Return the fields of a `Grabbed`; None if nothing came in time."""
        buffer = self._stream.timeout_pop_buffer(round(timeout_s * 1e6))
        if buffer is None:
            return None
        status = int(buffer.get_status())
        if status == _CLEARED:  # nothing was written into it; seen with the fake camera on a busy computer
            self._stream.push_buffer(buffer)
            return None
        damage = "" if status == 0 else _STATUS.get(status, f"status {status}")
        grabbed = {
            "payload": b"" if damage else buffer.get_data(),
            "rows": 0 if damage else buffer.get_image_height(),
            "cols": 0 if damage else buffer.get_image_width(),
            "code": 0 if damage else buffer.get_image_pixel_format() & 0xFFFFFFFF,
            "frame_id": int(buffer.get_frame_id()),
            "damage": damage,
            "camera_time_ns": int(buffer.get_timestamp()) or None,
        }
        self._stream.push_buffer(buffer)
        return grabbed

    def close(self) -> None:
        """Let it go: a GigE camera's others may control it from now on."""
        leave = None if self._camera is None else getattr(self._camera.get_device(), "leave_control", None)
        if leave is not None:
            leave()


class AravisCamera(GenicamCamera):
    """The camera that Aravis knows as `address`: its identifier, or its IP address."""

    @staticmethod
    def enumerate_cameras() -> Iterator[tuple[str, str]]:
        """Yield (address, what it is) of every camera that Aravis finds."""
        library = _library()
        library.update_device_list()
        for index in range(library.get_n_devices()):
            texts = (
                library.get_device_vendor(index),
                library.get_device_model(index),
                library.get_device_serial_nbr(index),
            )
            yield (
                library.get_device_id(index),
                f"{' '.join(filter(None, texts))} ({library.get_device_protocol(index)})",
            )

    @cached_property
    def _device(self) -> Apart:
        return Apart(
            "drivers.camera.aravis:AravisDevice",
            self.address,
            who=f"camera {self.address}",
            start_timeout_s=_LOADING_S,
        )

    def _call(self, method: str, *arguments: Any, longer_s: float = 0.0) -> Any:
        return self._device.call(method, *arguments, timeout_s=self._timeout_s + longer_s)

    def _open(self) -> tuple[AskedFeatures, Identity]:
        self._device.start()
        self._device.call("load", timeout_s=_LOADING_S)
        identity = Identity(*self._call("open", longer_s=self._timeout_s))
        return AskedFeatures(lambda *asked: self._call("feature", *asked)), identity

    def _start(self) -> None:
        self._call("start")

    def _halt(self) -> None:
        self._call("halt")

    def _grab(self, timeout_s: float) -> Grabbed | None:
        grabbed = self._call("grab", timeout_s, longer_s=timeout_s)
        return None if grabbed is None else Grabbed(**grabbed)

    def _release(self) -> None:
        self._device.end()
