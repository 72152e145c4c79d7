"""Cameras of many makers through Micro-Manager's device adapters, by pymmcore-plus: calibench's extra `micromanager`.

Adapters run in a process of their own (`drivers.apart`): one that hangs or crashes ends no session.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.apart import Apart
from drivers.camera.base import SensorInfo
from drivers.camera.genicam_settings import AskedFeatures, CameraFeatures
from drivers.camera.single_frame import LibraryCamera
from drivers.errors import Disconnected, Garbled, InstrumentError
from drivers.instrument import Identity, Setting

#: Standard properties (MMDeviceConstants.h) that change the codes or their places, and where they don't.
NEUTRAL = {
    "Binning": "1",
    "TransposeCorrection": "0",
    "TransposeMirrorX": "0",
    "TransposeMirrorY": "0",
    "TransposeXY": "0",
}
#: What the core keeps and no property shows; `set` and `get` know them beside the camera's properties.
EXPOSURE_MS, REGION, AUTO_SHUTTER = "core:exposure_ms", "core:region", "core:auto_shutter"
_SERIAL_NUMBER = ("SerialNumber", "Serial Number", "Camera Serial Number", "S/N")
_TEMPERATURE = ("CCDTemperature RO", "CCDTemperature", "SensorTemperature", "Sensor Temperature")
_TOLERANCE = 0.1


class Core:
    """Micro-Manager's core with one configuration, in the process apart. An empty string: none is named."""

    def __init__(self, configuration: str, camera: str, shutter: str, adapters: str, timeout_s: str) -> None:
        from pymmcore_plus import CMMCorePlus

        self._core: Any = CMMCorePlus(mm_path=adapters or None)
        self._core.setTimeoutMs(max(1, round(1000 * float(timeout_s))))
        try:
            self._core.loadSystemConfiguration(configuration)
            if camera:
                self._core.setCameraDevice(camera)
            if shutter:
                self._core.setShutterDevice(shutter)
        except Exception as error:
            self.close()
            raise Disconnected(
                f"Micro-Manager: {configuration} can't be loaded ({' '.join(str(error).split())}); open it in "
                "Micro-Manager, and close it there before it is used here"
            ) from error
        self._camera: str = self._core.getCameraDevice()
        self._shutter: str = self._core.getShutterDevice()
        if not self._camera:
            raise InstrumentError(f"Micro-Manager: {configuration} has no camera; name it after `#` in the address")

    def identity(self) -> tuple[str, str, str, str]:
        """Return maker, model, serial number, firmware."""
        core = self._core
        return (
            core.getDeviceLibrary(self._camera),
            self._first("CameraName") or core.getDeviceName(self._camera),
            self._first(*_SERIAL_NUMBER),
            self._first("FirmwareVersion", "Firmware Version"),
        )

    def _first(self, *names: str) -> str:
        return next((str(self.get(name)) for name in names if self.has(name)), "")

    def properties(self) -> dict[str, str]:
        """Return all properties of the camera."""
        return {name: str(self.get(name)) for name in self._core.getDevicePropertyNames(self._camera)}

    def temperature_c(self) -> float | None:
        """Return the sensor's temperature, where the adapter tells."""
        reading = self._first(*_TEMPERATURE)
        return float(reading) if reading else None

    def has(self, name: str) -> bool:
        if name in (EXPOSURE_MS, REGION):
            return True
        if name == AUTO_SHUTTER:
            return bool(self._shutter)
        return bool(self._core.hasProperty(self._camera, name))

    def get(self, name: str) -> Setting:
        if name == EXPOSURE_MS:
            return float(self._core.getExposure(self._camera))
        if name == REGION:
            return " ".join(str(value) for value in self._core.getROI(self._camera))
        if name == AUTO_SHUTTER:
            return bool(self._core.getAutoShutter())
        return str(self._core.getProperty(self._camera, name))

    def set(self, name: str, value: Setting) -> None:
        if name == EXPOSURE_MS:
            self._core.setExposure(self._camera, float(value))
        elif name == REGION:
            self._core.clearROI()
            if value and str(value) != self.get(REGION):
                self._core.setROI(self._camera, *(int(part) for part in str(value).split()))
        elif name == AUTO_SHUTTER:
            self._core.setAutoShutter(bool(value))
        elif str(value) != self.get(name):
            self._core.setProperty(self._camera, name, str(value))
            self._core.waitForDevice(self._camera)

    def entries(self, name: str) -> tuple[str, ...]:
        return tuple(self._core.getAllowedPropertyValues(self._camera, name))

    def limits(self, name: str) -> tuple[float, float]:
        """Return the least and the greatest value; infinite where it has none."""
        if not self._core.hasProperty(self._camera, name) or not self._core.hasPropertyLimits(self._camera, name):
            return -math.inf, math.inf
        return (
            float(self._core.getPropertyLowerLimit(self._camera, name)),
            float(self._core.getPropertyUpperLimit(self._camera, name)),
        )

    def execute(self, name: str) -> None:
        raise InstrumentError(f"Micro-Manager: {name} is no command; it has none")

    def size(self) -> tuple[int, int, int, int, int]:
        """Return rows, columns, bits of a code, bytes of a pixel, colours of a pixel."""
        core = self._core
        return (
            core.getImageHeight(),
            core.getImageWidth(),
            core.getImageBitDepth(),
            core.getBytesPerPixel(),
            core.getNumberOfComponents(),
        )

    def expose(self) -> None:
        """Begin one exposure; the core opens and closes the shutter where that is automatic.

        The core allocates its buffer with the first one: 250 MB by default, which takes a busy computer
        seconds. Two pictures are enough.
        """
        buffer_mb = 1 + 2 * self._core.getImageBufferSize() // 2**20
        if self._core.getCircularBufferMemoryFootprint() != buffer_mb:
            self._core.setCircularBufferMemoryFootprint(buffer_mb)
        self._core.clearCircularBuffer()
        self._core.startSequenceAcquisition(self._camera, 1, 0.0, True)

    def exposed(self) -> bool:
        return bool(self._core.getRemainingImageCount() > 0) and not self._core.isSequenceRunning(self._camera)

    def picture(self) -> NDArray[Any]:
        return np.array(self._core.popNextImage())

    def abort(self) -> bool:
        """End an exposure and close the shutter; whether it says that it is open still."""
        if self._core.isSequenceRunning(self._camera):
            self._core.stopSequenceAcquisition(self._camera)
        if not self._shutter:
            return False
        self._core.setShutterOpen(self._shutter, False)
        self._core.waitForDevice(self._shutter)
        return bool(self._core.getShutterOpen(self._shutter))

    def close(self) -> None:
        self._core.unloadAllDevices()


class MicroManagerCamera(LibraryCamera):
    """The camera of a configuration, `FILE.cfg` or `FILE.cfg#LABEL`; without a label the one that the file names.

    `adapters`: the folder of the device adapters; None: where pymmcore-plus finds Micro-Manager. `shutter`: label of
    the shutter that is open during an exposure alone; None: the one that the file names. `pixel_type`: the property's
    value, None: as it is. `properties`: others to be set, by name. `cfa`: the colour filters, as no adapter tells them.
    `gain_property`: the gain that `gain_db_per_unit` is of. `connect_timeout_s`: longest time until all devices of the
    configuration are loaded. `settings`: those of `SingleFrameCamera`.
    """

    def __init__(
        self,
        address: str,
        *,
        adapters: str | None = None,
        shutter: str | None = None,
        pixel_type: str | None = None,
        properties: Mapping[str, str] | None = None,
        cfa: str | None = None,
        gain_property: str = "Gain",
        connect_timeout_s: float = 60.0,
        **settings: Any,
    ) -> None:
        super().__init__(address, **settings)
        self._loading_s = connect_timeout_s
        self._wanted = dict(properties or {}) | ({} if pixel_type is None else {"PixelType": pixel_type})
        self._cfa, self._gain_property = cfa, gain_property
        self._size = (0, 0, 0, 0, 0)
        self._limits: tuple[float, float] | None = None
        file, _, label = address.partition("#")
        self._file = Path(file)
        self._library = Apart(
            "drivers.camera.micromanager:Core",
            file,
            label,
            shutter or "",
            adapters or "",
            str(self._timeout_s),
            who=f"camera {address}",
            start_timeout_s=connect_timeout_s,
        )

    def _open(self) -> tuple[AskedFeatures, Identity]:
        if not self._file.is_file():
            raise Disconnected(
                f"{self._who}: no configuration file {self._file}; save one in Micro-Manager, or correct the address"
            )
        return super()._open()

    def _prepare(self, features: CameraFeatures) -> None:
        self.ask("abort")
        features.set(REGION, "")
        if features.has(AUTO_SHUTTER):
            features.set(AUTO_SHUTTER, True)
        for name, value in (NEUTRAL | self._wanted).items():
            if not features.has(name):
                if name in self._wanted:
                    raise InstrumentError(f"{self._who}: it has no property {name!r}; correct it in the station file")
                continue
            features.set(name, value)
            if features.get(name) != value and not _same(features.get(name), value):
                raise InstrumentError(
                    f"{self._who}: {name} stays {features.get(name)!r}, and {value!r} is wanted; set it in "
                    "Micro-Manager"
                )
        self._size = self.ask("size")
        _, _, bits, in_bytes, colours = self._size
        if colours != 1 or in_bytes not in (1, 2):
            raise InstrumentError(
                f"{self._who}: its pixels are {colours} values of {8 * in_bytes // max(1, colours)} bits ({bits} "
                "used); one of 8 or 16 bits is wanted: set pixel_type to one of "
                f"{', '.join(features.entries('PixelType'))}"
            )
        limits = features.limits("Exposure")
        self._limits = (limits[0] * 1e-3, limits[1] * 1e-3) if math.isfinite(limits[1]) else None

    def _sensor(self) -> SensorInfo:
        rows, cols, bits, in_bytes, _ = self._size
        return SensorInfo(rows, cols, f"{8 * in_bytes} bits", self._cfa, bits, exposure_s=self._limits)

    def _check_gain(self, unit: float) -> None:
        low, high = self.ask("limits", self._gain_property)
        if not low <= unit <= high:
            raise InstrumentError(
                f"{self._who}: {self._gain_property} {unit:g} is outside {low:g}..{high:g}; ask for another gain"
            )

    def _set(self, features: CameraFeatures, exposure_s: float, gain: float | None) -> float:
        if gain is not None:
            features.set(self._gain_property, f"{gain:g}")
        features.set(EXPOSURE_MS, 1e3 * exposure_s)
        found_s = 1e-3 * float(features.get(EXPOSURE_MS))
        if abs(found_s - exposure_s) > _TOLERANCE * exposure_s:
            raise InstrumentError(
                f"{self._who}: an exposure of {exposure_s:g} s was set and {found_s:g} s is read; choose another"
            )
        return found_s

    def _expose(self, exposure_s: float) -> None:
        self.ask("expose")

    def _has_exposed(self) -> bool:
        return bool(self.ask("exposed"))

    def _read(self) -> NDArray[np.uint16]:
        picture: NDArray[Any] = self.ask("picture")
        rows, cols, bits, _, _ = self._size
        if picture.shape != (rows, cols) or picture.dtype not in (np.uint8, np.uint16):
            raise Garbled(
                f"{self._who}: a frame has {picture.shape} pixels of {picture.dtype}, not {(rows, cols)}; let no other "
                "program change its settings"
            )
        if int(picture.max()) >> bits:
            raise Garbled(f"{self._who}: a code of {int(picture.max())} with {bits} bits; correct its bit depth")
        return picture.astype(np.uint16)

    def _temperature_c(self) -> float | None:
        temperature_c: float | None = self.ask("temperature_c")
        return temperature_c

    def _settings(self) -> dict[str, Setting]:
        return dict(self.ask("properties"))

    def _abort(self) -> None:
        if self.ask("abort"):
            raise InstrumentError(f"{self._who}: its shutter stays open; close it by hand")


def _same(setting: Setting, wanted: str) -> bool:
    """Return whether a number is written otherwise: `1` for `1.0000`."""
    try:
        return math.isclose(float(setting), float(wanted), rel_tol=1e-6)
    except ValueError:
        return False
