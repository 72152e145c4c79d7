"""A station's instruments as bluesky sees them, and the plan that takes one step with them.

Plain classes after `bluesky.protocols`. A driver's calls block, so each runs in a thread of its own, behind a status with a
time-out; a driver that breaks its promise to come back can then not hang a session. Whatever ends or halts a run, the
shutter closes and the screen goes dark: on pause and stop through bluesky, and by `Instruments.make_safe` after all else.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

import bluesky.plan_stubs as bps
import numpy as np
from bluesky.utils import Msg
from numpy.typing import NDArray

from drivers.camera.base import Camera as CameraDriver
from drivers.camera.base import Frame, capture_together
from drivers.display.base import Display
from drivers.errors import InstrumentError, NoAnswer, Refused
from drivers.instrument import Identity
from drivers.monochromator.base import Monochromator
from drivers.spectroradiometer.base import Spectroradiometer
from drivers.stage.base import Stage
from lab.capture.sequences.steps import FindExposure, FixedExposure, RelativeExposure, Step
from lab.capture.station import Drivers, Limits, Station
from lab.capture.store import StoredFile
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import Camera as DataSheet
from lab.formats.recording_set import Narrowband
from sim.camera import Side
from sim.spectrum import Spectrum

T = TypeVar("T")
Plan = Generator[Msg, Any, T]
WriteFrame = Callable[[str, Side, NDArray[np.uint16]], StoredFile]
WriteSpectrum = Callable[[str, Spectrum], StoredFile]

#: Longest times (s) for an instrument to come back: the drivers' own time-outs are shorter and say more.
MOVE_S, PLACE_S, MEASURE_S, READOUT_S, STOP_S = 90.0, 660.0, 180.0, 30.0, 15.0
#: A test frame above or below these shares of the range tells only in which direction to go: 10 % below the data sheet's
#: full well, for a sensor may saturate below its data sheet.
SATURATED, UNLIT = 0.9, 0.01
TRIES = 14


def in_thread(call: Callable[[], T]) -> Future[T]:
    """Run a blocking call in a daemon thread: one that never returns must not keep the process from ending."""
    future: Future[T] = Future()
    # From here on it can't be cancelled, as little as the call can: whoever gives up on it just doesn't look any more.
    future.set_running_or_notify_cancel()

    def work() -> None:
        try:
            result = call()
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    threading.Thread(target=work, daemon=True, name="instrument").start()
    return future


class Status:
    """A `bluesky.protocols.Status` of a blocking call, failed with `NoAnswer` if it isn't back within `timeout_s`."""

    def __init__(self, who: str, call: Callable[[], object], timeout_s: float) -> None:
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[Any], None]] = []
        self._done = threading.Event()
        self._error: BaseException | None = None
        self._watch = threading.Timer(timeout_s, self._late, args=(who, timeout_s))
        self._watch.daemon = True
        self._watch.start()
        in_thread(call).add_done_callback(lambda future: self._finish(future.exception()))

    def _late(self, who: str, timeout_s: float) -> None:
        self._finish(NoAnswer(f"{who}: not back after {timeout_s:g} s; check its power and its cable"))

    def _finish(self, error: BaseException | None) -> None:
        with self._lock:
            if self._done.is_set():
                return
            self._error = error
            self._done.set()
            callbacks, self._callbacks = self._callbacks, []
        self._watch.cancel()
        for callback in callbacks:
            with contextlib.suppress(RuntimeError):  # the run was aborted meanwhile: its loop is closed, nobody waits
                callback(self)

    def add_callback(self, callback: Callable[[Any], None]) -> None:
        with self._lock:
            if not self._done.is_set():
                self._callbacks.append(callback)
                return
        callback(self)

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        if not self._done.wait(timeout):
            raise TimeoutError("not done yet")
        return self._error

    @property
    def done(self) -> bool:
        return self._done.is_set()

    @property
    def success(self) -> bool:
        return self._done.is_set() and self._error is None


async def _bounded(who: str, call: Callable[[], object], timeout_s: float = STOP_S) -> None:
    """Await a blocking call, for so long at most."""
    try:
        await asyncio.wait_for(asyncio.wrap_future(in_thread(call)), timeout_s)
    except TimeoutError as error:
        raise NoAnswer(f"{who}: not back after {timeout_s:g} s; check its power and its cable") from error


class Device:
    """What bluesky asks of every device: a name, no parent, and readings under its own name."""

    parent = None

    def __init__(self, name: str) -> None:
        self.name = name

    def readings(self) -> dict[str, float | str]:
        """What the device adds to an event, by key; the type of a value never changes."""
        raise NotImplementedError

    def read(self) -> dict[str, Any]:
        """See `bluesky.protocols.Readable`."""
        at = time.time()
        return {key: {"value": value, "timestamp": at} for key, value in self.readings().items()}

    def describe(self) -> dict[str, Any]:
        """See `bluesky.protocols.Readable`."""
        return {
            key: {"source": self.name, "dtype": "string" if isinstance(value, str) else "number", "shape": []}
            for key, value in self.readings().items()
        }


class TargetDevice(Device):
    """The stage: which target stands in front of the cameras. Movable to a target's name."""

    def __init__(self, stage: Stage) -> None:
        super().__init__("target")
        self.stage = stage
        self.value: str | None = None  # None: not known

    def set(self, target: str) -> Status:
        def place() -> None:
            self.value = None
            self.stage.place(target)
            self.value = target

        return Status("stage", place, PLACE_S)

    async def stop(self, success: bool = True) -> None:
        await _bounded("stage", self.stage.stop)

    def readings(self) -> dict[str, float | str]:
        return {"target": self.value or ""}


@dataclass(frozen=True)
class Light:
    """Wavelength (nm, 0: white) and slit width (um, None: as it is)."""

    wavelength_nm: float
    slit_um: float | None = None


class LightDevice(Device):
    """The monochromator's grating and slits. Movable to a `Light`."""

    def __init__(self, monochromator: Monochromator) -> None:
        super().__init__("monochromator")
        self.monochromator = monochromator
        self.value: Light | None = None
        self.bandwidth_nm = 0.0

    def set(self, light: Light) -> Status:
        def move() -> None:
            self.value = None
            if light.slit_um is not None:
                self.monochromator.set_slit_um(light.slit_um)
            self.monochromator.move_nm(light.wavelength_nm)
            self.bandwidth_nm = self.monochromator.bandwidth_nm()
            self.value = light

        return Status("monochromator", move, MOVE_S)

    async def stop(self, success: bool = True) -> None:
        self.value = None
        await _bounded("monochromator", self.monochromator.stop)

    def readings(self) -> dict[str, float | str]:
        return {
            "wavelength_nm": self.value.wavelength_nm if self.value else -1.0,
            "bandwidth_nm": self.bandwidth_nm,
        }


class ShutterDevice(Device):
    """The monochromator's shutter. Movable to True (open) or False; closed while a run is paused."""

    def __init__(self, monochromator: Monochromator) -> None:
        super().__init__("shutter")
        self.monochromator = monochromator
        self.value: bool | None = None

    def set(self, opened: bool) -> Status:
        def move() -> None:
            self.value = None
            if opened:
                self.monochromator.open_shutter()
            else:
                self.monochromator.close_shutter()
            self.value = opened

        return Status("monochromator", move, MOVE_S)

    async def stop(self, success: bool = True) -> None:
        self.value = None
        await _bounded("monochromator", self.monochromator.close_shutter)

    async def pause(self) -> None:
        await self.stop()

    def resume(self) -> None:
        """Nothing: a step sets the bench anew after a pause, and opens the shutter if it needs it."""

    def readings(self) -> dict[str, float | str]:
        return {"shutter_open": float(bool(self.value))}


@dataclass(frozen=True)
class Pattern:
    """What the screen is to show, by its path in the session; None: dark."""

    path: str | None = None
    cell_px: int = 1


class ScreenDevice(Device):
    """The display. Movable to a `Pattern`; dark while a run is paused."""

    def __init__(self, display: Display, cells: Callable[[str], NDArray[np.uint8]]) -> None:
        super().__init__("screen")
        self.display, self.cells = display, cells
        self.value: Pattern | None = None

    def set(self, pattern: Pattern) -> Status:
        def show() -> None:
            self.value = None
            cells = np.zeros((1, 1), np.uint8) if pattern.path is None else self.cells(pattern.path)
            self.display.show(cells, pattern.cell_px)
            self.value = pattern

        return Status("display", show, MOVE_S)

    async def stop(self, success: bool = True) -> None:
        self.value = None
        await _bounded("display", self.display.stop)

    async def pause(self) -> None:
        await self.stop()

    def resume(self) -> None:
        """Nothing: a step shows its pattern anew after a pause."""

    def readings(self) -> dict[str, float | str]:
        return {"pattern": (self.value.path or "") if self.value else ""}


class RadiometerDevice(Device):
    """The spectroradiometer. Prepared with the path of the spectrum to come, triggered to measure it."""

    def __init__(self, radiometer: Spectroradiometer, write: WriteSpectrum) -> None:
        super().__init__("spectroradiometer")
        self.radiometer, self.write = radiometer, write
        self.path = ""
        self.stored: StoredFile | None = None
        self.refused: str | None = None  # why there is no spectrum, in the instrument's words

    def prepare(self, path: str) -> Status:
        self.path, self.stored, self.refused = path, None, None
        return Status("spectroradiometer", lambda: None, STOP_S)

    def trigger(self) -> Status:
        def measure() -> None:
            try:
                measured = self.radiometer.measure()
            except Refused as error:
                self.refused = str(error)
            else:
                self.stored = self.write(self.path, measured.radiance_w_sr_m2_nm)

        return Status("spectroradiometer", measure, MEASURE_S)

    def readings(self) -> dict[str, float | str]:
        return {"radiance": self.stored.path if self.stored else ""}


@dataclass(frozen=True)
class Shot:
    """One trigger of all cameras: exposures (s), gain (dB), and where the frames go; a side without a path isn't kept."""

    exposure_s: Mapping[Side, float]
    gain_db: float
    paths: Mapping[Side, str]


def level_of(frame: NDArray[np.uint16], sheet: DataSheet) -> float:
    """How much of its range a frame fills, 0..1: the 99.5th percentile of its brightest channel, black taken off.

    The range ends at the white level, or at the full well where the data sheet has it end below. A percentile, for a hot
    pixel must not set the exposure; of a channel's own pixels, for a chart's white patch is a few percent of the frame.
    """
    black = sheet.black_level_dn or 0.0
    top = sheet.saturation_dn
    if sheet.full_well_e is not None and sheet.conversion_gain_dn_per_e is not None:
        top = min(top, black + sheet.full_well_e * sheet.conversion_gain_dn_per_e)
    step = 1 if sheet.cfa == "MONO" else 2
    brightest = max(
        float(np.percentile(frame[row::step, col::step], 99.5)) for row in range(step) for col in range(step)
    )
    return (brightest - black) / (top - black)


class CamerasDevice(Device):
    """All cameras, exposed by one trigger. Prepared with a `Shot`."""

    def __init__(
        self, cameras: Mapping[Side, CameraDriver], sheets: Mapping[Side, DataSheet], write: WriteFrame
    ) -> None:
        super().__init__("cameras")
        self.cameras, self.sheets, self.write = dict(cameras), dict(sheets), write
        self.shot = Shot(dict.fromkeys(self.cameras, 0.0), 0.0, {})
        self.frames: dict[Side, Frame] = {}
        self.levels: dict[Side, float] = dict.fromkeys(self.cameras, 0.0)
        self.stored: dict[Side, StoredFile] = {}

    def prepare(self, shot: Shot) -> Status:
        self.shot, self.frames, self.stored = shot, {}, {}

        def configure() -> None:
            for side, camera in self.cameras.items():
                camera.configure(shot.exposure_s[side], shot.gain_db)

        return Status("cameras", configure, READOUT_S)

    def trigger(self) -> Status:
        shot = self.shot

        def take() -> None:
            try:
                together = capture_together(list(self.cameras.values()))
            except NoAnswer:
                # A frame lost on a busy bus isn't a broken camera: nothing of it was kept, so once more is safe.
                together = capture_together(list(self.cameras.values()))
            frames = dict(zip(self.cameras, together, strict=True))
            for side, frame in frames.items():
                sheet = self.sheets[side]
                if frame.raw.shape != (sheet.rows, sheet.cols):
                    raise InstrumentError(
                        f"camera {side}: a frame of {frame.raw.shape[0]} x {frame.raw.shape[1]} pixels came, the data sheet in "
                        f"the station file says {sheet.rows} x {sheet.cols}; correct rows and cols there, or the camera's region"
                    )
            self.levels = {side: level_of(frame.raw, self.sheets[side]) for side, frame in frames.items()}
            self.stored = {side: self.write(path, side, frames[side].raw) for side, path in shot.paths.items()}
            self.frames = frames

        return Status("cameras", take, 2 * max(shot.exposure_s.values()) + READOUT_S)

    async def stop(self, success: bool = True) -> None:
        for side, camera in self.cameras.items():
            await _bounded(f"camera {side}", camera.stop)

    def readings(self) -> dict[str, float | str]:
        found: dict[str, float | str] = {}
        for side in self.cameras:
            found[f"{side}_exposure_s"] = self.frames[side].exposure_s if side in self.frames else 0.0
            found[f"{side}_level"] = self.levels[side]
            found[f"{side}_frame"] = self.stored[side].path if side in self.stored else ""
        return found


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
    ) -> None:
        self.station, self.drivers = station, drivers
        sheets = {side: camera.datasheet for side, camera in station.cameras.items()}
        self.cameras = CamerasDevice(drivers.cameras, sheets, write_frame)
        self.target = TargetDevice(drivers.stage) if drivers.stage else None
        self.light = LightDevice(drivers.monochromator) if drivers.monochromator else None
        self.shutter = ShutterDevice(drivers.monochromator) if drivers.monochromator else None
        self.screen = ScreenDevice(drivers.display, cells) if drivers.display else None
        radiometer = drivers.spectroradiometer
        self.radiometer = RadiometerDevice(radiometer, write_spectrum) if radiometer else None

    @property
    def limits(self) -> Limits:
        """What the sequences keep to."""
        return self.station.limits

    def connect(self) -> dict[str, Identity]:
        """Reach every instrument and bring it into its safe state; who they are, by name. Raises DeviceError."""
        found: dict[str, Identity] = {}
        for name, driver in self.drivers.all.items():
            try:
                driver.connect()
                driver.stop()
                found[name] = driver.identity()
            except InstrumentError as error:
                raise DeviceError(_named(name, error)) from error
        for side, camera in self.drivers.cameras.items():
            sensor, sheet = camera.sensor(), self.station.cameras[side].datasheet
            if (sensor.rows, sensor.cols) != (sheet.rows, sheet.cols):
                raise DeviceError(
                    f"camera {side}: has {sensor.rows} x {sensor.cols} pixels, its data sheet in the station file says "
                    f"{sheet.rows} x {sheet.cols}; correct rows and cols there, or the camera's region"
                )
            if sensor.cfa not in (None, sheet.cfa):
                raise DeviceError(
                    f"camera {side}: says its colour filters are {sensor.cfa}, its data sheet in the station file says "
                    f"{sheet.cfa}; correct cfa there"
                )
        return found

    def make_safe(self) -> list[str]:
        """Close the shutter, darken the screen, stop all motion: every instrument at once, each for `STOP_S` at most.

        What didn't obey is returned, one line each.
        """
        stopping = {name: in_thread(driver.stop) for name, driver in self.drivers.all.items()}
        complaints = []
        until = time.monotonic() + STOP_S
        for name, future in stopping.items():
            try:
                future.result(max(0.0, until - time.monotonic()))
            except TimeoutError:
                complaints.append(f"{name}: didn't stop within {STOP_S:g} s")
            except Exception as error:
                complaints.append(_named(name, error))
        return complaints

    def close(self) -> None:
        """Let go of all lines. Never raises."""
        closing = [in_thread(driver.close) for driver in self.drivers.all.values()]
        until = time.monotonic() + STOP_S
        for future in closing:
            try:
                future.result(max(0.0, until - time.monotonic()))
            except Exception:
                continue


def _named(name: str, error: Exception) -> str:
    text = str(error)
    return text if name.split(maxsplit=1)[0] in text.lower() else f"{name}: {text}"


# --- the plan ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Taken:
    """What a step gave: its result for the journal, its files, and its captures made complete."""

    result: dict[str, Any]
    files: tuple[StoredFile, ...] = ()
    captures: tuple[Any, ...] = ()


def arrange(step: Step, instruments: Instruments) -> Plan[None]:
    """Set the bench as the step wants it, moving only what stands otherwise. Raises InputError for what isn't there."""
    setting = step.setting
    group = "arrange"
    if setting.target is not None:
        if instruments.target is None:
            raise InputError(
                f"station: step {step.id!r} needs target {setting.target!r} and there is no [stage]; add one (driver 'prompt' asks you)"
            )
        if instruments.target.value != setting.target:
            yield from bps.abs_set(instruments.target, setting.target, group=group)
    if instruments.light is not None and instruments.shutter is not None:
        lit = setting.wavelength_nm is not None
        if not lit and instruments.shutter.value is not False:
            yield from bps.abs_set(instruments.shutter, False, group=group)
        if setting.wavelength_nm is not None:
            light = Light(setting.wavelength_nm, setting.slit_um)
            if instruments.light.value != light:
                yield from bps.abs_set(instruments.light, light, group=group)
    if instruments.screen is not None:
        pattern = Pattern(setting.pattern, setting.cell_px if setting.pattern else 1)
        if instruments.screen.value != pattern:
            yield from bps.abs_set(instruments.screen, pattern, group=group)
    yield from bps.wait(group=group)
    # Only now: opening the shutter before the grating has arrived would light the target with other wavelengths.
    if instruments.shutter is not None and setting.wavelength_nm is not None and not instruments.shutter.value:
        yield from bps.abs_set(instruments.shutter, True, wait=True)


def _shoot(instruments: Instruments, shot: Shot) -> Plan[None]:
    yield Msg("prepare", instruments.cameras, shot, group="shoot")
    yield from bps.wait(group="shoot")
    yield from bps.trigger(instruments.cameras, group="shoot")
    yield from bps.wait(group="shoot")


def find_exposure(
    wanted: FindExposure, instruments: Instruments, start_s: Mapping[Side, float]
) -> Plan[tuple[dict[Side, float], dict[Side, float]]]:
    """Exposures (s) and the levels they gave, camera by camera, by test frames that aren't kept.

    A frame that is saturated or unlit only says in which direction to go; any other tells the exposure by proportion. A
    camera that reaches a limit of the station keeps the limit.
    """
    limits = instruments.limits

    def bounded(exposure_s: float) -> float:
        return float(np.clip(exposure_s, limits.exposure_min_s, limits.exposure_max_s))

    exposure_s = {side: bounded(start_s[side]) for side in instruments.cameras.cameras}
    levels: dict[Side, float] = {}
    before: tuple[dict[Side, float], dict[Side, float]] | None = None
    for _ in range(TRIES):
        yield from _shoot(instruments, Shot(exposure_s, limits.gain_db, {}))
        levels = dict(instruments.cameras.levels)
        following = dict(exposure_s)
        for side, level in levels.items():
            if abs(level - wanted.level) <= wanted.tolerance and not _stuck(side, before, exposure_s, levels):
                continue
            if level >= SATURATED or _stuck(side, before, exposure_s, levels):
                factor = 0.2
            elif level < UNLIT:
                factor = 10.0
            else:
                factor = wanted.level / level
            following[side] = bounded(exposure_s[side] * factor)
        if following == exposure_s:
            break
        before, exposure_s = (exposure_s, levels), following
    return exposure_s, levels


def _stuck(
    side: Side,
    before: tuple[dict[Side, float], dict[Side, float]] | None,
    exposure_s: Mapping[Side, float],
    levels: Mapping[Side, float],
) -> bool:
    """Whether a shorter exposure left a bright frame as bright: it is saturated, wherever the data sheet ends the range."""
    if before is None or levels[side] < 0.3:
        return False
    shortened = exposure_s[side] / before[0][side]
    return shortened < 0.9 and levels[side] / before[1][side] > np.sqrt(shortened)


def take(step: Step, instruments: Instruments, results: Mapping[str, Mapping[str, Any]]) -> Plan[Taken]:
    """Take one step: set the bench, measure the light, find exposures or expose. `results`: those of earlier steps, by id.

    A wavelength whose light the spectroradiometer refuses to measure is left out, with the reason in the result; any other
    refusal is a DeviceError, for later steps rely on the spectrum.
    """
    yield from arrange(step, instruments)
    files: list[StoredFile] = []
    result: dict[str, Any] = {}
    radiometer, cameras = instruments.radiometer, instruments.cameras
    if step.radiance is not None:
        if radiometer is None:
            raise InputError(f"station: step {step.id!r} needs a [spectroradiometer]; add it to the station file")
        yield Msg("prepare", radiometer, step.radiance, group="radiance")
        yield from bps.trigger(radiometer, group="radiance")
        yield from bps.wait(group="radiance")
        if radiometer.stored is None:
            reason = radiometer.refused or "spectroradiometer: gave no spectrum"
            if not step.captures:
                raise DeviceError(reason)
            return Taken({"skipped": reason})
        files.append(radiometer.stored)
        result["radiance"] = step.radiance
    captures: tuple[Any, ...] = ()
    if isinstance(step.exposure, FindExposure):
        exposure_s, levels = yield from find_exposure(step.exposure, instruments, _start(instruments, results))
        result |= {"exposure_s": exposure_s, "level": levels}
    elif step.exposure is not None:
        shot = Shot(
            _exposures(step, instruments, results),
            instruments.limits.gain_db,
            {capture.side: capture.frame for capture in step.captures},
        )
        yield from _shoot(instruments, shot)
        files += cameras.stored.values()
        captures = _completed(step, instruments)
        result |= {"level": dict(cameras.levels)}
    yield from bps.create(name=step.sequence)
    for device in (instruments.target, instruments.light, instruments.shutter, instruments.screen, radiometer, cameras):
        if device is not None:
            yield from bps.read(device)
    yield from bps.save()
    return Taken(result, tuple(files), captures)


def _start(instruments: Instruments, results: Mapping[str, Mapping[str, Any]]) -> dict[Side, float]:
    """Where a search for an exposure starts: at what the latest search found, else at 10 ms."""
    found = [result["exposure_s"] for result in results.values() if "exposure_s" in result]
    return {side: float(found[-1][side]) if found else 0.01 for side in instruments.cameras.cameras}


def _exposures(step: Step, instruments: Instruments, results: Mapping[str, Mapping[str, Any]]) -> dict[Side, float]:
    sides = instruments.cameras.cameras
    if isinstance(step.exposure, FixedExposure):
        return dict.fromkeys(sides, step.exposure.exposure_s)
    assert isinstance(step.exposure, RelativeExposure)
    limits = instruments.limits
    base = results[step.exposure.of]["exposure_s"]
    return {
        side: float(np.clip(base[side] * step.exposure.factor, limits.exposure_min_s, limits.exposure_max_s))
        for side in sides
    }


def _completed(step: Step, instruments: Instruments) -> tuple[Any, ...]:
    """The step's captures with what only the trigger tells."""
    completed = []
    for capture in step.captures:
        frame = instruments.cameras.frames[capture.side]
        told: dict[str, Any] = {
            "exposure_s": frame.exposure_s,
            "gain_db": frame.gain_db,
            "temperature_c": frame.temperature_c,
            "time": frame.time,
        }
        if isinstance(capture, Narrowband) and instruments.light is not None:
            told["bandwidth_nm"] = instruments.light.bandwidth_nm
        completed.append(capture.model_copy(update={key: value for key, value in told.items() if value is not None}))
    return tuple(completed)
