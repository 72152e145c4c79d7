"""Cameras of any maker through its GenTL producer (a `.cti` file), by harvesters: `calibench[gentl]`.

Makers install their producers with their software, and name the folders in the environment variable
GENICAM_GENTL64_PATH. A producer can be opened once in a process, and looking for cameras anew lets all of its cameras
go: drivers share it, and it is closed with the last camera.

Source: EMVA, GenICam GenTL 1.6; `harvesters` 1.4.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np

from drivers.camera.buffers import Grabbed
from drivers.camera.genapi import GenApiFeatures, library_message
from drivers.camera.genicam import GenicamCamera
from drivers.errors import Disconnected, InstrumentError, InUse
from drivers.instrument import Identity

_T = TypeVar("_T")
_logger = logging.getLogger(__name__)  # the library tells here what it also raises
_logger.addHandler(logging.NullHandler())
SEARCH_PATH = "GENICAM_GENTL64_PATH"
_BUFFERS = 4
#: The library asks a producer with Python's lock held: it is asked for so long (s), and again after so long.
_ASK_S, _REST_S = 1e-4, 2e-3


def _library() -> Any:
    """Return the module `harvesters.core`. Raises `InstrumentError` where it isn't installed."""
    try:
        from harvesters import core
    except ImportError as error:
        raise InstrumentError(
            "GenTL cameras: harvesters isn't installed; install calibench with its extra gentl"
        ) from error
    return core


class _Producer:
    """One producer and its cameras, shared by the drivers of this process; open while one of them has a camera."""

    _all: dict[Path, _Producer] = {}

    def __init__(self, file: Path) -> None:
        self._file = file
        self._lock = threading.RLock()
        self._harvester: Any = None
        self._taken = 0

    @classmethod
    def of(cls, file: Path) -> _Producer:
        """Return the producer of a file."""
        return cls._all.setdefault(file.resolve(), cls(file.resolve()))

    @contextmanager
    def _open(self) -> Iterator[list[Any]]:
        """Open a producer. Raises `InstrumentError` for a file that is none."""
        with self._lock:
            if self._harvester is None:
                core = _library()
                harvester = core.Harvester(config=core.ParameterSet({core.ParameterKey.LOGGER: _logger}))
                try:
                    harvester.add_file(str(self._file), check_existence=True, check_validity=True)
                except OSError as error:
                    raise InstrumentError(
                        f"{self._file}: it isn't a GenTL producer ({' '.join(str(error).split()) or 'no such file'}); "
                        "correct producer in the station file"
                    ) from error
                harvester.update()
                self._harvester = harvester
            try:
                yield self._harvester.device_info_list
            finally:
                self._close_unused()

    def _close_unused(self) -> None:
        if self._taken == 0 and self._harvester is not None:
            harvester, self._harvester = self._harvester, None
            harvester.reset()

    def cameras(self) -> list[tuple[str, str]]:
        """(address, what it is) of each."""
        with self._open() as open_cameras:
            return [
                (
                    _read_info(camera, "serial_number") or camera.id_,
                    " ".join(filter(None, (_read_info(camera, name) for name in ("vendor", "model", "serial_number")))),
                )
                for camera in open_cameras
            ]

    def take(self, address: str, description: str | None) -> Any:
        """Return the camera with this serial number, identifier or name, opened; None if it has none such."""
        core = _library()
        key = core.ParameterKey
        asked: dict[Any, Any] = {
            key.NUM_BUFFERS_FOR_FETCH_CALL: _BUFFERS,
            key.TIMEOUT_PERIOD_ON_UPDATE_EVENT_DATA_CALL: 0,
            key.ENABLE_AUTO_CHUNK_DATA_UPDATE: False,
        }
        if description is not None:
            asked[key.REMOTE_DEVICE_SOURCE_XML_FILE_PATH] = description
        with self._open() as open_cameras:
            for camera in open_cameras:
                if address in (_read_info(camera, name) for name in ("serial_number", "id_", "user_defined_name")):
                    acquirer = self._open_camera(camera, core.ParameterSet(asked))
                    self._taken += 1
                    return acquirer
        return None

    def _open_camera(self, camera: Any, config: Any) -> Any:
        """Return the library opens a camera, and leaves it open where what follows fails: close it then."""
        made: list[Any] = []

        def create_device() -> Any:
            made.append(camera.module.create_device())
            return made[-1]

        camera.create_device = create_device
        try:
            with _interrupts_kept():
                return self._harvester.create(camera, config=config)
        except BaseException:
            for device in made:
                if device.is_open():
                    device.close()
            raise
        finally:
            del camera.create_device

    def give_back(self, acquirer: Any) -> None:
        """Let a camera go."""
        with self._lock:
            self._taken -= 1
            try:
                self._harvester.image_acquirers.remove(acquirer)
                acquirer.destroy()
            finally:
                self._close_unused()


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """The library puts a handler of its own in the place of Ctrl-C's; take it away again."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    kept = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, kept)


def _producers(file: str | None) -> list[_Producer]:
    """That of a file, or all that are installed."""
    if file is not None:
        return [_Producer.of(Path(file).expanduser())]
    folders = [Path(folder) for folder in os.environ.get(SEARCH_PATH, "").split(os.pathsep) if folder]
    return [_Producer.of(file) for folder in folders for file in sorted(folder.glob("*.cti"))]


class GentlCamera(GenicamCamera):
    """The camera that a producer knows by the serial number, identifier or name `address`.

    `producer`: its `.cti` file; None: all in the folders of GENICAM_GENTL64_PATH. `description`: a GenICam XML file to
    be taken instead of the camera's own. `settings`: those of `GenicamCamera`.
    """

    _producer: _Producer
    _acquirer: Any = None
    _incomplete = False

    def __init__(
        self, address: str, *, producer: str | None = None, description: str | None = None, **settings: Any
    ) -> None:
        super().__init__(address, **settings)
        self._producer_file, self._description = producer, description

    @staticmethod
    def enumerate_cameras() -> Iterator[tuple[str, str]]:
        """Yield (address, what it is) of every camera that the installed producers find."""
        _library()
        for producer in _producers(None):
            yield from producer.cameras()

    def _open(self) -> tuple[GenApiFeatures, Identity]:
        core = _library()
        if self._description is not None:
            try:
                ElementTree.parse(self._description)
            except (OSError, ElementTree.ParseError) as error:
                raise InstrumentError(
                    f"camera {self.address}: its description {self._description} can't be read ({error}); correct it "
                    "in the station file"
                ) from error
        producers = _producers(self._producer_file)
        if not producers:
            raise InstrumentError(
                f"camera {self.address}: no GenTL producer is installed; install the maker's software, which names it "
                f"in {SEARCH_PATH}, or "
                "name its .cti file as producer in the station file"
            )
        self._acquirer = next((acquirer for acquirer in map(self._take_from, producers) if acquirer is not None), None)
        if self._acquirer is None:
            there = ", ".join(address for producer in producers for address, _ in producer.cameras()) or "none"
            raise Disconnected(
                f"camera {self.address}: the GenTL producers find no such camera; there are: {there}; is it plugged in?"
            )
        note = core.Callback()
        note.emit = self._note_incomplete
        self._acquirer.add_callback(self._acquirer.Events.INCOMPLETE_BUFFER, note)
        nodes = GenApiFeatures(self._acquirer.remote_device.node_map, f"camera {self.address}")
        device = self._acquirer.device
        versions = (name for name in ("DeviceFirmwareVersion", "DeviceVersion") if nodes.has(name))
        firmware = next((str(nodes.get(name)) for name in versions), "")
        return nodes, Identity(
            _read_info(device, "vendor") or "",
            _read_info(device, "model") or "",
            _read_info(device, "serial_number") or device.id_,
            firmware,
        )

    def _take_from(self, producer: _Producer) -> Any:
        from genicam import genapi, gentl

        self._producer = producer
        try:
            return producer.take(self.address, self._description)
        except (gentl.ResourceInUseException, gentl.AccessDeniedException) as error:
            raise InUse(
                f"camera {self.address}: in use by another program or another instrument of the station; close that one"
            ) from error
        except (gentl.GenericException, genapi.GenericException) as error:
            raise Disconnected(
                f"camera {self.address}: can't be opened ({library_message(error)}); plug it in again, and close "
                "other programs that use it"
            ) from error

    def _start(self) -> None:
        self._do("starting", self._acquirer.start)

    def _halt(self) -> None:
        self._do("stopping", self._acquirer.stop)

    def _grab(self, timeout_s: float) -> Grabbed | None:
        until = time.monotonic() + timeout_s
        while True:
            self._incomplete = False
            grabbed = self._do("reading a frame", self._fetch)
            if grabbed is not None:
                return grabbed
            if self._incomplete:
                return Grabbed(b"", 0, 0, 0, 0, damage="the producer says that it is incomplete")
            if time.monotonic() >= until:
                return None
            time.sleep(_REST_S)

    def _fetch(self) -> Grabbed | None:
        buffer = self._acquirer.try_fetch(timeout=_ASK_S, is_raw=True)
        return None if buffer is None else self._copy_buffer(buffer)

    def _copy_buffer(self, buffer: Any) -> Grabbed:
        """Its memory is the library's own: it is filled again once it is given back."""
        from genicam import gentl

        kinds = gentl.PAYLOADTYPE_INFO_IDS
        whole = buffer.payload_type in (kinds.PAYLOAD_TYPE_IMAGE, kinds.PAYLOAD_TYPE_CHUNK_DATA)
        return Grabbed(
            payload=np.frombuffer(
                buffer.raw_buffer, np.uint8, offset=(_read_info(buffer, "image_offset") or 0) if whole else 0
            ),
            rows=int(buffer.height) if whole else 0,
            cols=int(buffer.width) if whole else 0,
            code=_read_info(buffer, "pixel_format") or self._format.code,
            frame_id=int(buffer.frame_id),
            padding=_read_info(buffer, "padding_x") or 0,
            damage=""
            if whole
            else f"it isn't one picture (payload type {buffer.payload_type}): switch other components off",
            camera_time_ns=_read_info(buffer, "timestamp_ns"),
            give_back=lambda: self._do("queueing a buffer", lambda: buffer.parent.queue_buffer(buffer)),
        )

    def _note_incomplete(self, context: object = None) -> None:
        self._incomplete = True

    def _do(self, doing: str, action: Callable[[], _T]) -> _T:
        from genicam import genapi, gentl

        try:
            return action()
        except (gentl.GenericException, genapi.GenericException) as error:
            raise Disconnected(
                f"{self._who}: {doing} failed ({library_message(error)}); plug it in again, the next call reconnects"
            ) from error

    def _release(self) -> None:
        acquirer, self._acquirer = self._acquirer, None
        if acquirer is not None:
            self._producer.give_back(acquirer)


def _read_info(of: Any, name: str) -> Any:
    """Return what a producer states of a camera or a buffer; None where it doesn't."""
    from genicam import gentl

    try:
        return getattr(of, name)
    except gentl.GenericException:
        return None
