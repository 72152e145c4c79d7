"""ASCOM Alpaca cameras, by HTTP: those of astronomers, on any computer whose server has their driver."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.alpaca import AlpacaDevice, AlpacaFeatures
from drivers.camera.base import SensorInfo
from drivers.camera.genicam_settings import CameraFeatures
from drivers.camera.single_frame import SingleFrameCamera
from drivers.errors import Garbled, InstrumentError, NoAnswer, Refused
from drivers.instrument import Identity, Setting

#: CameraState: it can begin an exposure; it has failed.
_IDLE, _ERROR = 0, 5
#: SensorType: one code a pixel with the colour filters RGGB, shifted by BayerOffsetX and -Y.
_MONOCHROME, _RGGB = 0, 2
_SETTINGS = (
    *("name", "sensorname", "driverinfo", "driverversion", "cameraxsize", "cameraysize", "maxadu", "sensortype"),
    *("binx", "biny", "startx", "starty", "numx", "numy", "gain", "offset", "readoutmode", "fastreadout"),
    *("electronsperadu", "fullwellcapacity", "pixelsizex", "cooleron", "setccdtemperature", "ccdtemperature"),
)


class AlpacaCamera(SingleFrameCamera):
    """The camera `host:port/NUMBER` of an Alpaca server.

    `readout_mode`: one of the camera's own names, None: as it is. `gain_db_per_unit` is of the property Gain.
    `settings`: those of `SingleFrameCamera`.
    """

    def __init__(
        self,
        address: str,
        *,
        readout_mode: str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(address, **settings)
        self._readout_mode = readout_mode
        self._device = AlpacaDevice(address, "camera", self._left_s, self._record)
        self._info: SensorInfo | None = None
        self._was_connected = True

    def _open(self) -> tuple[AlpacaFeatures, Identity]:
        identity = self._device.identity()
        self._was_connected = bool(self._device.get("connected"))
        self._device.put("connected", Connected=True)  # what it was set to can't be read or restored before
        return AlpacaFeatures(self._device), identity

    def _prepare(self, features: CameraFeatures) -> None:
        if not (self._was_connected and self._device.get("connected")):
            assert self._features is not None
            self._features.note("connected", False)
            self._device.put("connected", Connected=True)  # what a killed process left was restored: it may be off
        self._await_idle()
        cols, rows = int(self._device.get("cameraxsize")), int(self._device.get("cameraysize"))
        for name, value in (("startx", 0), ("starty", 0), ("binx", 1), ("biny", 1), ("numx", cols), ("numy", rows)):
            if features.get(name) != value:
                features.set(name, value)
                if features.get(name) != value:
                    raise InstrumentError(
                        f"{self._who}: {name} stays {features.get(name)}, and {value} is wanted; set it in its driver"
                    )
        if self._readout_mode is not None:
            offered = features.entries("readoutmode")
            if self._readout_mode not in offered:
                raise InstrumentError(
                    f"{self._who}: no readout mode {self._readout_mode!r}; it has {', '.join(offered) or 'none'}"
                )
            features.set("readoutmode", list(offered).index(self._readout_mode))
        pitch = self._device.get_if_there("pixelsizex")
        self._info = SensorInfo(
            rows,
            cols,
            self._readout_mode or "ASCOM",
            self._colour_filters(),
            int(self._device.get("maxadu")).bit_length(),
            None if pitch is None else float(pitch),
            exposure_s=(float(self._device.get("exposuremin")), float(self._device.get("exposuremax"))),
        )

    def _colour_filters(self) -> str | None:
        kind = self._device.get_if_there("sensortype")
        if kind == _MONOCHROME:
            return "MONO"
        if kind != _RGGB:
            raise InstrumentError(
                f"{self._who}: its sensor's type is {kind}; monochrome (0) and RGGB (2) are wanted: set raw in its "
                "driver"
            )
        shift_x, shift_y = int(self._device.get("bayeroffsetx")), int(self._device.get("bayeroffsety"))
        return "".join("RGGB"[2 * ((row + shift_y) % 2) + (col + shift_x) % 2] for row in (0, 1) for col in (0, 1))

    def _sensor(self) -> SensorInfo:
        assert self._info is not None
        return self._info

    def _check_gain(self, unit: float) -> None:
        if not float(unit).is_integer():
            raise InstrumentError(
                f"{self._who}: its gain is a whole number, and {unit:g} was asked for; ask for another"
            )
        names = self._device.get_if_there("gains")
        low, high = (0, len(names) - 1) if names else (self._device.get("gainmin"), self._device.get("gainmax"))
        if not low <= unit <= high:
            raise InstrumentError(f"{self._who}: gain {unit:g} is outside {low}..{high}; ask for another")

    def _set(self, features: CameraFeatures, exposure_s: float, gain: float | None) -> float:
        if gain is not None:
            features.set("gain", int(gain))
            if (set_gain := features.get("gain")) != int(gain):
                raise InstrumentError(
                    f"{self._who}: a gain of {gain:g} was set and {set_gain} is read; its driver counts otherwise: "
                    "leave the gain at 0 dB without gain_db_per_unit"
                )
        return exposure_s

    def _await_idle(self) -> None:
        """End an exposure that is under way, and return when a new one may begin."""
        state = self._device.get("camerastate")
        if state in (_IDLE, _ERROR):
            return
        self._abort()
        while self._device.get("camerastate") not in (_IDLE, _ERROR):
            if self._left_s() <= 0.01:
                raise NoAnswer(f"{self._who}: it doesn't become idle; end what uses it in its server")
            time.sleep(0.05)

    def _expose(self, exposure_s: float) -> None:
        self._await_idle()
        self._device.put("startexposure", Duration=exposure_s, Light=True)

    def _has_exposed(self) -> bool:
        if self._device.get("imageready"):
            return True
        if self._device.get("camerastate") == _ERROR:
            self._fired = None
            raise InstrumentError(f"{self._who}: the exposure failed in the camera; look into its server's log")
        return False

    def _read(self) -> NDArray[np.uint16]:
        picture = self._device.image()
        info = self._sensor()
        if picture.shape != (info.rows, info.cols):
            raise Garbled(
                f"{self._who}: a frame has {picture.shape} pixels, the sensor {(info.rows, info.cols)}; let no other "
                "program change its settings"
            )
        if picture.min() < 0 or picture.max() > 65535:
            raise Garbled(
                f"{self._who}: codes of {picture.min()}..{picture.max()}; 16 bits are wanted: set its driver so"
            )
        return picture.astype(np.uint16)

    def _temperature_c(self) -> float | None:
        temperature_c = self._device.get_if_there("ccdtemperature")
        return None if temperature_c is None else float(temperature_c)

    def _settings(self) -> dict[str, Setting]:
        settings = {name: self._device.get_if_there(name) for name in _SETTINGS}
        return {name: value for name, value in settings.items() if value is not None}

    def _abort(self) -> None:
        for able, method in (("canabortexposure", "abortexposure"), ("canstopexposure", "stopexposure")):
            if self._device.get_if_there(able):
                with suppress(Refused):  # it came to its end meanwhile
                    self._device.put(method)
                return

    def _release(self) -> None:
        """Each request had a connection of its own."""
