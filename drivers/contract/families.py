"""What each family's contract asks: an everyday call, a long one, the safe state, and settings within limits and
refused beyond."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.camera.base import Camera, StreamingCamera
from drivers.camera.stream import FrameStream
from drivers.display.base import Display
from drivers.errors import Disconnected, InstrumentError, NoAnswer
from drivers.light_source.base import LightSource
from drivers.monochromator.base import Monochromator
from drivers.photodiode.base import Photodiode
from drivers.spectroradiometer.base import Spectroradiometer
from drivers.stage.base import Stage


class NotMet(Exception):
    """What the contract asks for doesn't hold; the message says what was found."""


def require(holds: bool, otherwise: str) -> None:
    """Raise `NotMet` with `otherwise` unless something holds.

    >>> require(holds=True, otherwise="the shutter stays open")
    """
    if not holds:
        raise NotMet(otherwise)


def require_refused(call: Callable[[], object], what: str) -> None:
    """Raise `NotMet` unless the call ends with an `InstrumentError` of one line.

    call : that has to be refused
    what : it asks for, in words

    >>> def open_shutter():
    ...     raise InstrumentError("lamp: no shutter; leave it out")
    >>> require_refused(open_shutter, "a shutter")
    """
    try:
        call()
    except InstrumentError as error:
        require("\n" not in str(error), f"{what}: the message has several lines")
        return
    raise NotMet(f"{what} was taken")


class FamilyContract(ABC):
    """The checks of one family, on a connected driver."""

    kind: type

    @abstractmethod
    def everyday(self, driver: Any) -> None:
        """Make a call that needs the instrument, and is right or raises `NotMet`."""

    @abstractmethod
    def takes_long(self, driver: Any) -> None:
        """Make a call that takes seconds where the peer is slow."""

    @abstractmethod
    def settings(self, driver: Any) -> None:
        """Set what is within limits, and what is beyond, which has to be refused."""

    def require_safe(self, driver: Any) -> None:
        """Whether it is in its safe state; where that can't be asked, whether it works on."""
        self.everyday(driver)


class MonochromatorContract(FamilyContract):
    """Wavelengths, shutter, filters, slits."""

    kind = Monochromator

    def everyday(self, driver: Monochromator) -> None:
        require(0.0 <= driver.wavelength_nm() <= 1e5, f"it stands at {driver.wavelength_nm()} nm")

    def takes_long(self, driver: Monochromator) -> None:
        driver.move_nm(400.0 if driver.wavelength_nm() > 550.0 else 700.0)
        driver.open_shutter()  # one that is parked in place of a shutter moves now

    def settings(self, driver: Monochromator) -> None:
        driver.move_nm(500.0)
        driver.open_shutter()
        for wavelength_nm in (450.0, 632.8, 0.0):
            driver.check_nm(wavelength_nm)  # refuses nothing that it can do
            driver.move_nm(wavelength_nm)
            reached_nm = driver.wavelength_nm()
            require(abs(reached_nm - wavelength_nm) <= 0.5, f"set to {wavelength_nm} nm it is at {reached_nm} nm")
        for wrong_nm in (-1.0, 1e6, math.nan, math.inf):
            require_refused(lambda wrong_nm=wrong_nm: driver.move_nm(wrong_nm), f"{wrong_nm} nm")  # type: ignore[misc]
        require(driver.wavelength_nm() <= 0.5, "a refused wavelength moved it")
        for opened in (False, True, False):
            (driver.open_shutter if opened else driver.close_shutter)()
            require(driver.shutter_is_open() is opened, f"the shutter was set to open = {opened} and isn't")
        before = driver.slit_um()
        driver.check_slit_um(500.0)
        driver.set_slit_um(500.0)
        require(abs(driver.slit_um() - 500.0) <= 5.0, f"a slit of 500 um was set and {driver.slit_um()} um is read")
        require(driver.bandwidth_nm() > 0.0, "its bandwidth isn't above 0")
        driver.set_slit_um(before)
        for wrong_um in (-1.0, 1e9):
            require_refused(lambda wrong_um=wrong_um: driver.set_slit_um(wrong_um), f"a slit of {wrong_um} um")  # type: ignore[misc]

    def require_safe(self, driver: Monochromator) -> None:
        require(not driver.shutter_is_open(), "its shutter is open")


class SpectroradiometerContract(FamilyContract):
    """Spectra."""

    kind = Spectroradiometer

    def everyday(self, driver: Spectroradiometer) -> None:
        measurement = driver.measure()
        wavelength_nm, value = measurement.radiance_w_sr_m2_nm.arrays
        require(wavelength_nm.size >= 2 and bool(np.all(np.diff(wavelength_nm) > 0)), "its wavelengths don't ascend")
        require(bool(np.all(np.isfinite(value))) and float(np.max(value)) > 0, "its spectrum isn't finite and above 0")
        require(100.0 < wavelength_nm[0] < wavelength_nm[-1] < 3000.0, "its wavelengths aren't in nm")
        time_s = measurement.integration_time_s
        require(time_s is None or 0.0 < time_s < 3600.0, f"its integration time is {time_s} s")

    def takes_long(self, driver: Spectroradiometer) -> None:
        driver.measure()

    def settings(self, driver: Spectroradiometer) -> None:
        first, again = driver.measure(), driver.measure()
        require(
            first.radiance_w_sr_m2_nm.wavelength_nm == again.radiance_w_sr_m2_nm.wavelength_nm,
            "two measurements have different wavelengths",
        )
        require(first.serial_number == driver.identity().serial_number, "a measurement has another serial number")


class CameraContract(FamilyContract):
    """Exposures and frames."""

    kind = Camera
    longest_s = 3.0

    @staticmethod
    def _within(driver: Camera, exposure_s: float) -> float:
        """Return an exposure of about that which the camera has: its shortest may be longer, and some have a few
        alone."""
        for longer in (1.0, 1.25, 2.5, 5.0):
            try:
                driver.check(longer * exposure_s)
            except (NoAnswer, Disconnected):
                raise
            except InstrumentError:
                continue
            return longer * exposure_s
        return exposure_s

    def everyday(self, driver: Camera) -> None:
        driver.configure(self._within(driver, 0.005))
        frame, sensor = driver.capture(), driver.sensor()
        require(frame.raw.dtype == np.uint16, f"a frame's codes are {frame.raw.dtype}, not uint16")
        require(
            frame.raw.shape == (sensor.rows, sensor.cols),
            f"a frame has {frame.raw.shape} pixels, the sensor {(sensor.rows, sensor.cols)}",
        )

    def takes_long(self, driver: Camera) -> None:
        driver.configure(self.longest_s)
        driver.capture()

    def settings(self, driver: Camera) -> None:
        for exposure_s in (self._within(driver, 0.002), self._within(driver, 0.02)):
            driver.check(exposure_s)
            driver.check_trigger("software")
            driver.configure(exposure_s)
            frame = driver.capture()
            require(
                abs(frame.exposure_s - exposure_s) <= 0.1 * exposure_s,
                f"an exposure of {exposure_s} s was set and the frame states {frame.exposure_s} s",
            )
        before = driver.capture().frame_id
        require(driver.capture().frame_id == before + 1, "the frames' numbers don't go up by 1")
        if isinstance(driver, StreamingCamera):
            ids = [frame.frame_id for (frame,) in FrameStream([driver], 4)]
            require(ids == list(range(ids[0], ids[0] + 4)), f"a series of 4 frames has the numbers {ids}")
        sensor = driver.sensor()
        if sensor.bit_depth is not None:
            highest = int(frame.raw.max())
            require(highest < 2**sensor.bit_depth, f"a code of {highest} with {sensor.bit_depth} bits")
        for wrong_s in (0.0, -1.0, math.nan, math.inf, 1e9):
            require_refused(lambda wrong_s=wrong_s: driver.configure(wrong_s), f"an exposure of {wrong_s} s")  # type: ignore[misc]
            require_refused(lambda wrong_s=wrong_s: driver.check(wrong_s), f"an exposure of {wrong_s} s to be checked")  # type: ignore[misc]
        driver.configure(self._within(driver, 0.005))
        require_refused(driver.collect, "a frame that nobody triggered")


class StageContract(FamilyContract):
    """Targets."""

    kind = Stage

    @staticmethod
    def _targets(driver: Stage) -> tuple[str, ...]:
        return driver.targets() or ("cap", "sphere")

    def everyday(self, driver: Stage) -> None:
        for name in reversed(self._targets(driver)[:2]):
            driver.place(name)
        require(driver.placed() != "", "it doesn't say what is placed")

    def takes_long(self, driver: Stage) -> None:
        driver.place(self._targets(driver)[1])

    def settings(self, driver: Stage) -> None:
        for name in self._targets(driver)[:3]:
            driver.place(name)
            require(driver.placed() == name, f"{name} was asked for and {driver.placed()!r} is read")
        if driver.targets():
            require_refused(lambda: driver.place("no-such-target"), "a target that isn't there")


class DisplayContract(FamilyContract):
    """Patterns."""

    kind = Display

    def everyday(self, driver: Display) -> None:
        shown = driver.show(np.ones((2, 2), np.uint8), 4)
        require(shown.cell_px == 4 and shown.canvas_px == shown.screen_px, f"it shows {shown}")

    def takes_long(self, driver: Display) -> None:
        driver.show(np.ones((2, 2), np.uint8), 8)

    def settings(self, driver: Display) -> None:
        rows, cols = driver.screen_px()
        driver.show(np.zeros((1, 1), np.uint8), 1)
        require_refused(lambda: driver.show(np.ones((rows + 1, cols), np.uint8), 1), "a pattern larger than the screen")
        require_refused(lambda: driver.show(np.full((2, 2), 7, np.uint8), 1), "a pattern of other values than 0 and 1")
        require_refused(lambda: driver.show(np.ones((2, 2), np.uint8), 0), "cells of 0 pixels")


class PhotodiodeContract(FamilyContract):
    """Currents and irradiances."""

    kind = Photodiode

    def everyday(self, driver: Photodiode) -> None:
        require(math.isfinite(driver.measure_dark()), "its dark current isn't finite")

    def takes_long(self, driver: Photodiode) -> None:
        driver.measure_dark()

    def settings(self, driver: Photodiode) -> None:
        irradiance = driver.measure(550.0)
        require(math.isfinite(irradiance.irradiance_w_m2), f"its irradiance is {irradiance.irradiance_w_m2} W/m2")
        require(irradiance.sd_irradiance_w_m2 > 0.0, "its irradiance has no uncertainty")
        for wrong_nm in (-1.0, 1e6, math.nan):
            require_refused(lambda wrong_nm=wrong_nm: driver.measure(wrong_nm), f"{wrong_nm} nm")  # type: ignore[misc]


class LightSourceContract(FamilyContract):
    """Levels of light."""

    kind = LightSource

    def everyday(self, driver: LightSource) -> None:
        require(0.0 <= driver.level() <= 1.0, f"its level is {driver.level()}")

    def takes_long(self, driver: LightSource) -> None:
        driver.set_level(0.0 if driver.level() > 0.5 else 1.0)

    def settings(self, driver: LightSource) -> None:
        for channel in driver.channels():
            for level in (1.0, 0.5, 0.0):
                driver.set_level(level, channel)
                read_level = driver.level(channel)
                require(abs(read_level - level) <= 0.05, f"a level of {level} was set and {read_level} is read")
        for wrong in (-0.1, 1.1, math.nan):
            require_refused(lambda wrong=wrong: driver.set_level(wrong), f"a level of {wrong}")  # type: ignore[misc]
        require_refused(lambda: driver.set_level(0.5, "no-such-channel"), "a channel that isn't there")


CONTRACTS: dict[str, FamilyContract] = {
    "monochromator": MonochromatorContract(),
    "spectroradiometer": SpectroradiometerContract(),
    "camera": CameraContract(),
    "stage": StageContract(),
    "display": DisplayContract(),
    "photodiode": PhotodiodeContract(),
    "light_source": LightSourceContract(),
}
