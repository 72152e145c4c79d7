"""Cameras tethered by USB or PTP/IP through libgphoto2, by python-gphoto2: calibench's extra `gphoto2`.

The library runs in a process of its own (`drivers.apart`). With VCAMERADIR in the environment it brings a camera of its
own, which copies the pictures of that folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from fractions import Fraction
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.apart import Apart
from drivers.camera.base import SensorInfo
from drivers.camera.genicam_settings import CameraFeatures
from drivers.camera.raw_folder import TOLERANCE, RawPicture, read_raw
from drivers.camera.single_frame import LibraryCamera
from drivers.errors import Disconnected, Garbled, InstrumentError
from drivers.instrument import Recorder, Setting

#: Names of one setting on cameras of different makers; the first that a camera has is meant.
_EXPOSURES = ("shutterspeed", "shutterspeed2", "exptime")
_SENSITIVITIES = ("iso", "isospeed")
_FORMATS = ("imageformat", "imagequality")
#: What has to be so where a camera has it: nothing chooses for itself.
NEUTRAL = {"autofocus": "Off", "isoauto": "Off", "autoiso": "Off", "longexpnr": "Off", "highisonr": "Off"}
_EVENT_MS = 20


def seconds(choice: str) -> float | None:
    """Read the exposure time that a choice of the camera means.

    choice : `1/60`, `0.0100s`, `2.5`, `30"`

    Returns s; None for `Bulb`, `Auto` and so on.

    >>> seconds("1/50"), seconds("2.5"), seconds("Bulb")
    (0.02, 2.5, None)
    """
    fraction = re.fullmatch(r"(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?\s*(?:s|sec|\")?", choice.strip())
    if fraction is None:
        return None
    value = float(Fraction(fraction[1]) / Fraction(fraction[2] or 1)) if float(fraction[2] or 1) else 0.0
    return value or None


class Library:
    """libgphoto2 with one camera, in the process apart."""

    def __init__(self, address: str) -> None:
        import gphoto2

        self._library = gphoto2
        self._camera: Any = None
        cameras = list(gphoto2.Camera.autodetect())
        ports = [port for _, port in cameras]
        wanted = [address] if address.startswith(("usb:", "ptpip:")) else ports
        for port in wanted:
            camera = gphoto2.Camera()
            infos = gphoto2.PortInfoList()
            infos.load()
            try:
                camera.set_port_info(infos[infos.lookup_path(port)])
                camera.init()
            except gphoto2.GPhoto2Error as error:
                if len(wanted) == 1:
                    raise Disconnected(
                        f"gphoto2: the camera at {port} can't be used ({error}); switch it on, and close what else "
                        "uses it"
                    ) from error
                continue
            self._camera = camera
            if address.startswith(("usb:", "ptpip:")) or address in ("", self._first("serialnumber")):
                return
            camera.exit()
            self._camera = None
        listed = ", ".join(f"{model} at {port}" for model, port in cameras) or "none"
        raise Disconnected(f"gphoto2: no camera {address!r}; it finds {listed}: plug it in and switch it on")

    def identity(self) -> tuple[str, str, str, str]:
        """Return maker, model, serial number, firmware."""
        first = self._first
        return first("manufacturer"), first("cameramodel"), first("serialnumber"), first("deviceversion")

    def _first(self, *names: str) -> str:
        return next((str(self.get(name)) for name in names if self.has(name)), "")

    def _widget(self, name: str) -> Any:
        return self._camera.get_single_config(name)

    def has(self, name: str) -> bool:
        try:
            self._widget(name)
        except self._library.GPhoto2Error as error:
            if error.code != self._library.GP_ERROR_BAD_PARAMETERS:
                raise
            return False
        return True

    def get(self, name: str) -> Setting:
        setting: Setting = self._widget(name).get_value()
        return setting

    def set(self, name: str, value: Setting) -> None:
        widget = self._widget(name)
        widget.set_value(value)
        self._camera.set_single_config(name, widget)

    def entries(self, name: str) -> tuple[str, ...]:
        widget = self._widget(name)
        return tuple(widget.get_choice(index) for index in range(widget.count_choices()))

    def limits(self, name: str) -> tuple[float, float]:
        raise InstrumentError(f"gphoto2: {name} has choices, no limits")

    def execute(self, name: str) -> None:
        raise InstrumentError(f"gphoto2: {name} is no command")

    def settings(self) -> dict[str, Setting]:
        """Return all settings, by name."""
        settings: dict[str, Setting] = {}

        def look(widget: Any) -> None:
            inner = list(widget.get_children())
            if not inner:
                with suppress(self._library.GPhoto2Error):
                    settings[widget.get_name()] = widget.get_value()
            for child in inner:
                look(child)

        look(self._camera.get_config())
        return settings

    def expose(self) -> None:
        """Trigger it; files of an exposure before that come now aren't this one's."""
        while self.files():
            continue
        self._camera.trigger_capture()

    def files(self) -> list[tuple[str, str]]:
        """Return folder and name of what the camera wrote since it was asked last."""
        library, files = self._library, []
        while True:
            kind, event = self._camera.wait_for_event(_EVENT_MS)
            if kind == library.GP_EVENT_FILE_ADDED:
                files.append((event.folder, event.name))
            elif kind == library.GP_EVENT_TIMEOUT:
                return files

    def fetch(self, folder: str, name: str, wanted: bool) -> bytes:
        """Return a file's bytes where it is wanted; it is deleted on the camera: it was made for this."""
        data = b""
        if wanted:
            file = self._camera.file_get(folder, name, self._library.GP_FILE_TYPE_NORMAL)
            data = bytes(file.get_data_and_size())
        with suppress(self._library.GPhoto2Error):  # one in the camera's memory is gone by itself
            self._camera.file_delete(folder, name)
        return data

    def close(self) -> None:
        self._camera.exit()


class Gphoto2Camera(LibraryCamera):
    """A camera that libgphoto2 knows, by its port (`usb:001,005`, `ptpip:ADDRESS`) or its serial number; an empty
    address: the only one.

    It has to stand on manual. `image_format`: the choice that makes it write raw files alone; None: the one with `raw`
    in its name that writes nothing else. `settings`: others to be set, by gphoto2's names. `base_iso`: the sensitivity
    at 0 dB; a gain of 6 dB is twice that. The first call that asks for the sensor's size takes a picture.
    """

    def __init__(
        self,
        address: str,
        *,
        image_format: str | None = None,
        settings: Mapping[str, str] | None = None,
        base_iso: float = 100.0,
        connect_timeout_s: float = 20.0,
        timeout_s: float = 10.0,
        trigger_line: str | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(address, timeout_s=timeout_s, trigger_line=trigger_line, recorder=recorder)
        self._loading_s = connect_timeout_s
        self._image_format, self._wanted, self._base_iso = image_format, dict(settings or {}), base_iso
        self._shutter = ""
        self._times: dict[float, str] = {}
        self._sample: RawPicture | None = None
        self._files: list[tuple[str, str]] = []
        self._library = Apart(
            "drivers.camera.gphoto2:Library", address, who=f"camera {address}", start_timeout_s=connect_timeout_s
        )

    def _prepare(self, features: CameraFeatures) -> None:
        for name, value in NEUTRAL.items():
            if features.has(name) and value in features.entries(name):
                self._choose(features, name, value)
        format_name = next((name for name in _FORMATS if features.has(name)), None)
        if format_name is not None:
            choices = features.entries(format_name)
            raw = [
                choice
                for choice in choices
                if "raw" in choice.lower() and "+" not in choice and "jpeg" not in choice.lower()
            ]
            chosen = self._image_format or next(iter(raw), None)
            if chosen is not None:
                self._choose(features, format_name, chosen)
        for name, value in self._wanted.items():
            self._choose(features, name, value)
        self._shutter = next((name for name in _EXPOSURES if features.has(name)), "")
        if not self._shutter:
            raise InstrumentError(f"{self._who}: its exposure time can't be set; set it to manual (M)")
        times = {seconds(choice): choice for choice in features.entries(self._shutter)}
        self._times = {time_s: choice for time_s, choice in times.items() if time_s is not None}
        if not self._times:
            raise InstrumentError(f"{self._who}: it offers no exposure time; set it to manual (M)")

    def _choose(self, features: CameraFeatures, name: str, value: str) -> None:
        if not features.has(name):
            raise InstrumentError(f"{self._who}: it has no setting {name!r}; correct it in the station file")
        choices = features.entries(name)
        if choices and value not in choices:
            raise InstrumentError(f"{self._who}: {name} can't be {value!r}; it has {', '.join(choices)}")
        if features.get(name) != value:
            features.set(name, value)
            if (setting := features.get(name)) != value:
                raise InstrumentError(f"{self._who}: {name} stays {setting!r}, and {value!r} is wanted; set it by hand")

    def _sensor(self) -> SensorInfo:
        if self._sample is None:
            exposure_s = min(self._times)
            self._set(self._known(), exposure_s, None)
            self._expose(exposure_s)
            self._await_exposed(exposure_s)
            self._sample = self._picture()
        sample = self._sample
        rows, cols = sample.raw.shape
        return SensorInfo(
            rows,
            cols,
            "raw file",
            sample.cfa,
            sample.bit_depth,
            black_level=sample.black_level,
            exposure_s=(min(self._times), max(self._times)),
        )

    def _known(self) -> CameraFeatures:
        assert self._features is not None
        return self._features

    def _check_settings(self, exposure_s: float, gain_db: float) -> float | None:
        if not (math.isfinite(exposure_s) and exposure_s > 0 and math.isfinite(gain_db)):
            raise InstrumentError(f"{self._who}: exposure {exposure_s} s at {gain_db} dB; give a positive time")
        nearest = self._nearest(exposure_s)
        if abs(nearest - exposure_s) > TOLERANCE * exposure_s:
            raise InstrumentError(
                f"{self._who}: it has no exposure of {exposure_s:g} s, the nearest is {nearest:g} s; ask for that "
                f"({min(self._times):g}..{max(self._times):g} s)"
            )
        name = next((name for name in _SENSITIVITIES if self._known().has(name)), None)
        if name is None:
            if gain_db:
                raise InstrumentError(f"{self._who}: it has no ISO to set for {gain_db:g} dB; leave it at 0")
            return None
        wanted = self._base_iso * 10 ** (gain_db / 20.0)
        offered = [float(choice) for choice in self._known().entries(name) if choice.isdigit()]
        nearest = min(offered, key=lambda iso: abs(iso - wanted), default=0.0)
        if abs(nearest - wanted) > TOLERANCE * wanted:
            raise InstrumentError(f"{self._who}: {gain_db:g} dB is ISO {wanted:.0f}, the nearest is {nearest:.0f}")
        return nearest

    def _nearest(self, exposure_s: float) -> float:
        return min(self._times, key=lambda time_s: abs(math.log(time_s / exposure_s)))

    def _check_gain(self, unit: float) -> None:
        """`_check_settings` has."""

    def _set(self, features: CameraFeatures, exposure_s: float, gain: float | None) -> float:
        nearest = self._nearest(exposure_s)
        self._choose(features, self._shutter, self._times[nearest])
        if gain is not None:
            self._choose(features, next(name for name in _SENSITIVITIES if features.has(name)), f"{gain:.0f}")
        return nearest

    def _expose(self, exposure_s: float) -> None:
        self._files = []
        self.ask("expose")

    def _has_exposed(self) -> bool:
        self._files += self.ask("files")
        return bool(self._files)

    def _picture(self) -> RawPicture:
        self._files += self.ask("files")  # a second one of the same trigger
        raw = [file for file in self._files if not file[1].lower().endswith((".jpg", ".jpeg"))] or self._files
        data = [self.ask("fetch", *file, file in raw[:1]) for file in self._files]
        if len(raw) > 1:
            raise Garbled(
                f"{self._who}: {len(raw)} pictures came for one trigger; switch bracketing and series off, and let the "
                "camera write one raw file a picture"
            )
        return read_raw(BytesIO(next(content for content in data if content)), raw[0][1], self._who)

    def _read(self) -> NDArray[np.uint16]:
        picture, sample = self._picture(), self._sample
        self._sample = sample = sample or picture
        if picture.raw.shape != sample.raw.shape or picture.cfa != sample.cfa:
            raise Garbled(
                f"{self._who}: a picture has {picture.raw.shape} pixels of {picture.cfa}, those before had "
                f"{sample.raw.shape} of {sample.cfa}; keep the camera's picture size"
            )
        exposure_s = self._exposure_s or 0.0
        if picture.exposure_s and abs(picture.exposure_s - exposure_s) > TOLERANCE * exposure_s:
            raise InstrumentError(
                f"{self._who}: a picture was exposed for {picture.exposure_s:g} s, and {exposure_s:g} s were asked "
                "for: set the camera to manual (M)"
            )
        return picture.raw

    def _settings(self) -> dict[str, Setting]:
        settings: dict[str, Setting] = self.ask("settings")
        return settings

    def _abort(self) -> None:
        """It has no such command: files that still come are dropped before the next exposure."""
