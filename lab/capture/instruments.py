"""A station's devices, connected, and their safe state: shutter closed, screen dark, all motion stopped."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from datetime import datetime
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.camera.base import SensorInfo
from drivers.errors import InstrumentError
from drivers.found_settings import making_safe
from drivers.instrument import Instrument, Setting
from drivers.monochromator.base import Monochromator
from lab.capture.blocking_calls import STOP_S, in_thread
from lab.capture.by_hand import ByHand
from lab.capture.devices import (
    CamerasDevice,
    Device,
    HandDevice,
    LampDevice,
    LightDevice,
    PhotodiodeDevice,
    RadiometerDevice,
    ScreenDevice,
    ShutterDevice,
    TargetDevice,
    WriteFrame,
    WriteSpectrum,
    shut,
)
from lab.capture.records import now
from lab.capture.station import Drivers, Station
from lab.capture_kinds.base import Adjustment, CaptureLimits, FixedExposure, Step
from lab.capture_kinds.irradiance import irradiance_nm
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import DataSheet, InstrumentSnapshot
from sim.camera import Side
from sim.parameters import Frozen

#: How long (s) the other instruments of a station wait for the shutter's answer before they are stopped: to reach all
#: of them at once takes seconds where the cores are busy.
HEAD_START_S = 0.5


class BenchState(Frozen):
    """State of the bench in a run. `wavelength_nm` 0: white light. `lamp_levels`: the light source's, a share 0..1 of
    its most for each channel that is lit. None: there is no such instrument, or it moves."""

    shutter_open: bool | None = None
    wavelength_nm: float | None = None
    lamp_levels: dict[str, float] | None = None
    temperature_c: dict[Side, float] = {}


Shutter = Literal["closed", "unknown", "none"]


class SafeState(Frozen):
    """How a station's instruments were brought into their safe state. `shutter`: `closed` by the monochromator's own
    answer, `unknown` where it didn't give one, `none` where the station has no monochromator; `complaints`: a line for
    each instrument that failed to stop; `at`: when (UTC)."""

    shutter: Shutter
    complaints: tuple[str, ...] = ()
    at: datetime


class Instruments:
    """A station's devices, connected by `connect`. One per run of a session."""

    def __init__(
        self,
        station: Station,
        drivers: Drivers,
        *,
        write_frame: WriteFrame,
        write_spectrum: WriteSpectrum,
        cells: Callable[[str], NDArray[np.uint8]],
        by_hand: ByHand,
    ) -> None:
        self.station, self.drivers, self.by_hand = station, drivers, by_hand
        sheets = {side: camera.datasheet for side, camera in station.cameras.items()}
        self.cameras = CamerasDevice(drivers.cameras, sheets, write_frame)
        self.target = TargetDevice(drivers.stage) if drivers.stage else None
        self._hands: dict[type[Adjustment], HandDevice] = {}
        self.light = LightDevice(drivers.monochromator) if drivers.monochromator else None
        self.shutter = ShutterDevice(drivers.monochromator) if drivers.monochromator else None
        self.screen = ScreenDevice(drivers.display, cells) if drivers.display else None
        radiometer = drivers.spectroradiometer
        self.radiometer = RadiometerDevice(radiometer, write_spectrum) if radiometer else None
        self.lamp = LampDevice(drivers.light_source) if drivers.light_source else None
        self.photodiode = PhotodiodeDevice(drivers.photodiode) if drivers.photodiode else None

    @property
    def limits(self) -> CaptureLimits:
        """The station's limits."""
        return self.station.limits

    def hand(self, adjustment: str) -> HandDevice:
        """Return what an adjustment is a state of. Raises InputError where nobody can be asked for it."""
        if self.drivers.stage is None:
            raise InputError(
                f"station: {adjustment!r} is set by hand and there is no [stage] to ask for it; add one (driver "
                "'prompt' asks you)"
            )
        return self._hands.setdefault(self.by_hand.kind_of(adjustment), HandDevice(self.drivers.stage, self.by_hand))

    def questions(self, step: Step) -> tuple[str, ...]:
        """Return what a step will ask of the operator's hand, a line each."""
        asked = [name for name in step.setting.by_hand if self.hand(name).value != name]
        return tuple(f"by hand: {self.station.targets[name].instruction} ({name})" for name in asked)

    @property
    def devices(self) -> tuple[Device, ...]:
        """All devices that the station has, the cameras last."""
        light = (self.light, self.shutter, self.lamp, self.screen)
        every = (self.target, *light, self.radiometer, self.photodiode, self.cameras)
        return tuple(device for device in every if device is not None)

    def state(self) -> BenchState:
        """State of the bench as the devices last reported it; the temperatures are those of the last frames."""
        taken = {side: frame.temperature_c for side, frame in self.cameras.frames.items()}
        return BenchState(
            shutter_open=self.shutter.value if self.shutter is not None else None,
            wavelength_nm=self.light.value.wavelength_nm if self.light is not None and self.light.value else None,
            lamp_levels=dict(self.lamp.levels) if self.lamp is not None and self.lamp.value is not None else None,
            temperature_c={side: value for side, value in taken.items() if value is not None},
        )

    def connect(self, go_on: Callable[[], None] = lambda: None) -> dict[str, InstrumentSnapshot]:
        """Connect to every instrument and bring it into its safe state. Returns what each says of itself, by
        name.

        `go_on` is called before each; what it raises ends the connecting.

        Raises DeviceError where an instrument doesn't answer, and where a camera's pixels or colour filters contradict
        its data sheet."""
        snapshots: dict[str, InstrumentSnapshot] = {}
        for name, driver in self.drivers.all.items():
            go_on()
            try:
                driver.connect()
                driver.stop()
                snapshots[name] = _snapshot(driver)
            except InstrumentError as error:
                raise DeviceError(named_complaint(name, error)) from error
        for side, camera in self.drivers.cameras.items():
            if (difference := contradiction(side, camera.sensor(), self.station.cameras[side].datasheet)) is not None:
                raise DeviceError(difference)
        return snapshots

    def check(self, steps: Sequence[Step]) -> None:
        """Raise DeviceError for what these steps need and an instrument can't do; nothing moves, and nothing is
        exposed.

        That is a wavelength, a slit width, a channel of the light source, an exposure, a gain, the line that triggers a
        camera, and a screen of another size."""
        for asks, whence in self._demands(steps):
            try:
                asks()
            except InstrumentError as error:
                raise DeviceError("; ".join(filter(None, (str(error), whence)))) from error
        for name in sorted({step.setting.target for step in steps if step.setting.target and step.setting.pattern}):
            self._check_screen(name)

    def _demands(self, steps: Sequence[Step]) -> Iterator[tuple[Callable[[], None], str]]:
        """Yield what is asked of the instruments without moving them, and, in words, where the plan's value comes
        from."""
        yield from self._light_demands(steps)
        exposures = self._exposures(steps)
        for number, camera in enumerate(self.drivers.cameras.values()):
            yield partial(camera.check_trigger, "line" if number else "software"), ""
            for whence, exposure_s, gain_db in exposures:
                yield partial(camera.check, exposure_s, gain_db), whence

    def _light_demands(self, steps: Sequence[Step]) -> Iterator[tuple[Callable[[], None], str]]:
        """Yield the part of `_demands` that bears on the light."""
        lights = {(nm, step.sequence) for step in steps if (nm := step.setting.wavelength_nm) is not None}
        for wavelength_nm, sequence in sorted(lights):
            whence = f"the sequence {sequence} needs it: give it other wavelengths, or leave it out"
            if self.light is not None:
                yield partial(self.light.monochromator.check_nm, wavelength_nm), whence
        if self.photodiode is not None:
            lit = {(nm, step.sequence) for step in steps if (nm := irradiance_nm(step)) is not None}
            for wavelength_nm, sequence in sorted(lit):
                whence = f"the sequence {sequence} needs it: give it other wavelengths, or leave the photodiode out"
                yield partial(self.photodiode.photodiode.check_nm, wavelength_nm), whence
        if self.light is not None:
            for slit_um in sorted({step.setting.slit_um for step in steps if step.setting.slit_um is not None}):
                yield (
                    partial(self.light.monochromator.check_slit_um, slit_um),
                    "it stands as slit_um under [limits] of the station file",
                )
        lamps = {tuple(step.setting.lamp.items()): step.sequence for step in steps if step.setting.lamp}
        for channels, sequence in lamps.items():
            if self.lamp is not None:
                whence = f"the sequence {sequence} needs it: give it another light, or leave it out"
                yield partial(self.lamp.check, dict(channels)), whence

    def _exposures(self, steps: Sequence[Step]) -> Iterable[tuple[str, float, float]]:
        """Return every exposure (s) and gain (dB) of a plan, and in words where they come from."""
        limits = self.limits
        lights: dict[tuple[str, float, float], None] = {}
        for step in steps:
            own_db = step.setting.gain_db
            gain_db = limits.gain_db if own_db is None else own_db
            gain = "gain_db under [limits] of the station file" if own_db is None else f"a gain of {own_db:g} dB"
            if isinstance(step.exposure, FixedExposure):
                lights[f"the sequence {step.sequence} needs it, with {gain}", step.exposure.exposure_s, gain_db] = None
            elif step.exposure is not None:
                for key, exposure_s in (("min", limits.exposure_min_s), ("max", limits.exposure_max_s)):
                    whence = f"exposure_{key}_s and {gain} allow it: correct them"
                    lights[whence, exposure_s, gain_db] = None
        return lights

    def _check_screen(self, target: str) -> None:
        """Raise DeviceError where the display's screen isn't as large as the station file has it: something scales its
        pixels."""
        wanted = self.station.targets[target].screen_px if target in self.station.targets else None
        if self.screen is None or wanted is None:
            return
        try:
            shown_px = self.screen.display.screen_px()
        except InstrumentError as error:
            raise DeviceError(named_complaint("display", error)) from error
        if shown_px != wanted:
            raise DeviceError(
                f"display: its screen has {shown_px[0]} x {shown_px[1]} px, [targets.{target}] in the station file "
                f"says {wanted[0]} x {wanted[1]}: "
                "the system scales its pixels, or it is another screen; set its scaling to 100 %, or correct rows and "
                "cols there"
            )

    def make_safe(self) -> SafeState:
        """Close the shutter, darken the screen, stop all motion: every instrument at once, within `STOP_S`."""
        return made_safe(self.drivers, lambda driver: None)

    def close(self) -> None:
        """Close all connections. Never raises."""
        closing = [in_thread(driver.close) for driver in self.drivers.all.values()]
        until = time.monotonic() + STOP_S
        for future in closing:
            try:
                future.result(max(0.0, until - time.monotonic()))
            except Exception:
                continue


def _snapshot(driver: Instrument) -> InstrumentSnapshot:
    """Return what a connected instrument says of itself. Raises InstrumentError."""

    def with_finite_numbers(values: Mapping[str, Setting]) -> dict[str, Setting]:
        return {
            key: str(setting) if isinstance(setting, float) and not math.isfinite(setting) else setting
            for key, setting in values.items()
        }

    return InstrumentSnapshot(
        **vars(driver.identity()),
        settings=with_finite_numbers(driver.settings()),
        found=with_finite_numbers(driver.found()),
        departures=driver.departures(),
    )


def made_safe(
    drivers: Drivers, first: Callable[[Instrument], None], on_shut: Callable[[], None] = lambda: None
) -> SafeState:
    """Stop every instrument of a station within `STOP_S`, after `first` was called with it: the monochromator, and all
    others at once when it has answered, `HEAD_START_S` later at most. `on_shut` is called as soon as it has answered
    that its shutter is closed."""
    answered = threading.Event()

    def stopped(driver: Instrument) -> None:
        with making_safe():  # whatever the disk does
            if not isinstance(driver, Monochromator):
                answered.wait(HEAD_START_S)
                first(driver)
                driver.stop()
                return
            try:
                first(driver)
                shut(driver)
                on_shut()
            finally:
                answered.set()

    if drivers.monochromator is None:
        answered.set()

    complaints = _complaints({name: in_thread(partial(stopped, driver)) for name, driver in drivers.all.items()})
    shutter: Shutter = "unknown" if "monochromator" in complaints else "closed"
    shutter = "none" if drivers.monochromator is None else shutter
    return SafeState(shutter=shutter, complaints=tuple(complaints.values()), at=now())


def _complaints(stopping: Mapping[str, Future[None]]) -> dict[str, str]:
    """Wait for instruments that are being stopped, `STOP_S` for all together. Returns a line for each that failed to
    stop, by its name."""
    complaints, until = {}, time.monotonic() + STOP_S
    for name, future in stopping.items():
        try:
            future.result(max(0.0, until - time.monotonic()))
        except TimeoutError:
            complaints[name] = f"{name}: didn't stop within {STOP_S:g} s"
        except Exception as error:
            complaints[name] = named_complaint(name, error)
    return complaints


def contradiction(side: str, sensor: SensorInfo, sheet: DataSheet) -> str | None:
    """Return what a camera says of itself that its data sheet in the station file contradicts, in a line; None:
    nothing."""
    where = "its data sheet in the station file says"
    if (sensor.rows, sensor.cols) != sheet.frame_shape:
        rows, cols = sheet.frame_shape
        return (
            f"camera {side}: has {sensor.rows} x {sensor.cols} pixels, {where} {rows} x {cols}; correct rows and cols, "
            "or the margins, there, or the camera's region"
        )
    if sensor.cfa not in (None, sheet.cfa):
        return f"camera {side}: says its colour filters are {sensor.cfa}, {where} {sheet.cfa}; correct cfa there"
    if sensor.bit_depth not in (None, sheet.bit_depth):
        return (
            f"camera {side}: its codes have {sensor.bit_depth} bits, {where} {sheet.bit_depth}; correct bit_depth "
            "there, or give the "
            "camera a pixel_format"
        )
    return None


def named_complaint(name: str, error: Exception) -> str:
    """Return an instrument's error as a line that names the instrument."""
    text = str(error)
    return text if name.split(maxsplit=1)[0] in text.lower() else f"{name}: {text}"
