"""INDI cameras, by XML over TCP: those of astronomers, and DSLRs through its gphoto driver, of any computer."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.camera.base import SensorInfo
from drivers.camera.genicam_settings import CameraFeatures
from drivers.camera.single_frame import SingleFrameCamera
from drivers.errors import Garbled, InstrumentError
from drivers.indi import IndiDevice
from drivers.instrument import Identity, Setting

_EXPOSURE, _PICTURE, _ABORT = "CCD_EXPOSURE", "CCD1", "CCD_ABORT_EXPOSURE"
#: Properties that change the codes, their places or where they go, and what they have to be.
NEUTRAL = {
    "UPLOAD_MODE": "UPLOAD_CLIENT",
    "CCD_TRANSFER_FORMAT": "FORMAT_FITS",
    "CCD_COMPRESSION": "INDI_DISABLED",
    "CCD_FRAME_TYPE": "FRAME_LIGHT",
    "CCD_FAST_TOGGLE": "INDI_DISABLED",
    "CCD_VIDEO_STREAM": "STREAM_OFF",
}
#: A frame's own exposure time may differ by so much from the one asked for.
_TOLERANCE = 0.1


class IndiCamera(SingleFrameCamera):
    """The camera `host:port/NAME` of an INDI server.

    `capture_format`: one of the camera's own names, None: as it is. `gain_db_per_unit` is of CCD_GAIN.
    `settings`: those of `SingleFrameCamera`.
    """

    def __init__(
        self,
        address: str,
        *,
        capture_format: str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(address, **settings)
        self._capture_format = capture_format
        self._device = IndiDevice(address, self._left_s, self._record)
        self._info: SensorInfo | None = None
        self._was_connected = True

    def _open(self) -> tuple[IndiDevice, Identity]:
        self._device.open()
        self._was_connected = self._device.get("CONNECTION") == "CONNECT"
        self._connect()  # what it was set to can't be read or restored before
        return self._device, self._device.identity()

    def _connect(self) -> None:
        self._device.connect(_EXPOSURE, "CCD_FRAME", "CCD_INFO", "CCD_BINNING", _PICTURE)
        self._device.await_number("CCD_INFO", "CCD_MAX_X")

    def _prepare(self, features: CameraFeatures) -> None:
        if not self._was_connected:
            assert self._features is not None
            self._features.note("CONNECTION", "DISCONNECT")
        self._connect()  # what a killed process left was restored: it may be off
        self._device.send_blobs()
        if self._device.state(_EXPOSURE) == "Busy":
            self._abort()
        wanted = NEUTRAL | ({} if self._capture_format is None else {"CCD_CAPTURE_FORMAT": self._capture_format})
        for name, value in wanted.items():
            if features.has(name) and features.get(name) != value:
                features.set(name, value)
        cols, rows = (int(self._device.number("CCD_INFO", name)) for name in ("CCD_MAX_X", "CCD_MAX_Y"))
        self._set_numbers(features, "CCD_BINNING", HOR_BIN=1, VER_BIN=1)
        self._set_numbers(features, "CCD_FRAME", X=0, Y=0, WIDTH=cols, HEIGHT=rows)
        pitch_um = self._device.number("CCD_INFO", "CCD_PIXEL_SIZE")
        self._info = SensorInfo(
            rows,
            cols,
            str(features.get("CCD_CAPTURE_FORMAT")) if features.has("CCD_CAPTURE_FORMAT") else "FITS",
            self._colour_filters(),
            int(self._device.number("CCD_INFO", "CCD_BITSPERPIXEL")),
            pitch_um or None,
            exposure_s=features.limits(f"{_EXPOSURE}.CCD_EXPOSURE_VALUE"),
        )

    def _set_numbers(self, features: CameraFeatures, name: str, **wanted: int) -> None:
        if all(self._device.number(name, element) == value for element, value in wanted.items()):
            return
        features.set(name, ";".join(f"{element}={value}" for element, value in wanted.items()))
        for element, value in wanted.items():
            if (number := self._device.number(name, element)) != value:
                raise InstrumentError(
                    f"{self._who}: {name} {element} stays {number:g}, and {value} is wanted; set it in its driver"
                )

    def _colour_filters(self) -> str:
        pattern = self._device.text("CCD_CFA", "CFA_TYPE")
        if not pattern:
            return "MONO"
        shift_x, shift_y = (int(float(self._device.text("CCD_CFA", f"CFA_OFFSET_{axis}") or 0)) for axis in "XY")
        return "".join(pattern[2 * ((row + shift_y) % 2) + (col + shift_x) % 2] for row in (0, 1) for col in (0, 1))

    def _sensor(self) -> SensorInfo:
        assert self._info is not None
        return self._info

    def _check_gain(self, unit: float) -> None:
        low, high = self._device.limits("CCD_GAIN.GAIN")
        if not low <= unit <= high:
            raise InstrumentError(f"{self._who}: gain {unit:g} is outside {low:g}..{high:g}; ask for another")

    def _set(self, features: CameraFeatures, exposure_s: float, gain: float | None) -> float:
        if gain is not None:
            features.set("CCD_GAIN", f"GAIN={gain:g}")
            if abs((set_gain := self._device.number("CCD_GAIN", "GAIN")) - gain) > 1e-6:
                raise InstrumentError(
                    f"{self._who}: a gain of {gain:g} was set and {set_gain:g} is read; ask for another"
                )
        return exposure_s

    def _expose(self, exposure_s: float) -> None:
        self._device.catch_up()
        if self._device.state(_EXPOSURE) == "Busy":  # it heard late of an exposure that was given up
            self._abort()
        self._device.begin(_EXPOSURE, f"CCD_EXPOSURE_VALUE={exposure_s!r}", picture=_PICTURE)

    def _has_exposed(self) -> bool:
        if self._device.blob(_PICTURE, 0.02) is not None:
            return True
        if self._device.state(_EXPOSURE) == "Alert":
            raise InstrumentError(f"{self._who}: the exposure failed in the camera; look into its server's log")
        return False

    def _read(self) -> NDArray[np.uint16]:
        from astropy.io import fits

        data = self._device.blob(_PICTURE, 0.0)
        assert data is not None
        try:
            with fits.open(BytesIO(data), memmap=False) as file:
                header, codes = file[0].header, np.array(file[0].data)
        except (OSError, ValueError, TypeError, IndexError) as error:
            message = " ".join(str(error).split())
            raise Garbled(f"{self._who}: a frame of {len(data)} bytes isn't FITS ({message}); ask again") from error
        info = self._sensor()
        if codes.shape != (info.rows, info.cols):
            raise Garbled(
                f"{self._who}: a frame has {codes.shape} pixels, the sensor {(info.rows, info.cols)}; let no other "
                "program change its settings"
            )
        exposed_s = float(header.get("EXPTIME", self._exposure_s))
        assert self._exposure_s is not None
        if abs(exposed_s - self._exposure_s) > _TOLERANCE * self._exposure_s:
            raise Garbled(
                f"{self._who}: a frame says {exposed_s:g} s, {self._exposure_s:g} s were asked for; let no other "
                "program expose"
            )
        if codes.min() < 0 or codes.max() > 65535:
            raise Garbled(f"{self._who}: codes of {codes.min()}..{codes.max()}; 16 bits are wanted: set its driver so")
        if str(header.get("ROWORDER", "TOP-DOWN")).strip() == "BOTTOM-UP":
            codes = codes[::-1]
        return codes.astype(np.uint16)

    def _temperature_c(self) -> float | None:
        name = "CCD_TEMPERATURE"
        return self._device.number(name, "CCD_TEMPERATURE_VALUE") if self._device.has(name) else None

    def _settings(self) -> dict[str, Setting]:
        return self._device.settings()

    def _abort(self) -> None:
        if self._device.has(_ABORT):
            self._device.execute(_ABORT)
            self._device.forget_blob(_PICTURE)

    def _release(self) -> None:
        self._device.close()
