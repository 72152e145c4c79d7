"""A station's instruments as bluesky's devices: plain classes with the methods of `bluesky.protocols`.

A driver's calls block. Each runs in a thread of its own and is represented by a `Status` with a time-out. On pause and
stop, bluesky calls the devices' `pause` and `stop`, which close the shutter and darken the screen.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import wait
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.camera.base import Camera as CameraDriver
from drivers.camera.base import Frame, StreamingCamera, capture_together
from drivers.camera.stream import MOST_LOST, FrameStream
from drivers.display.base import Display
from drivers.errors import Garbled, InstrumentError, Interrupted, NoAnswer, Refused
from drivers.light_source.base import LightSource
from drivers.monochromator.base import Monochromator
from drivers.photodiode.base import IrradianceMeasurement, Photodiode
from drivers.spectroradiometer.base import Spectroradiometer
from drivers.stage.base import Stage
from lab.capture.blocking_calls import STOP_S, Status, bounded, in_thread
from lab.capture.by_hand import ByHand
from lab.capture.records import StoredFile
from lab.formats.recording_set import DataSheet
from sim.camera import Side
from sim.spectrum import Spectrum

WriteFrame = Callable[[str, Side, NDArray[np.uint16]], StoredFile]
WriteSpectrum = Callable[[str, Spectrum], StoredFile]

#: Time-outs (s) of a move, of what placing a target takes beside the stage's own time-out (`Stage.place_timeout_s`), of
#: a measurement of light, and of what a camera does beside the exposures and the readouts, whose own time-outs
#: (`Camera.readout_s`) come on top: the drivers' messages say more.
MOVE_S, PLACE_S, MEASURE_S, READOUT_S = 90.0, 60.0, 180.0, 30.0


class Device:
    """Base of the devices. bluesky asks for a name, a parent (none here), and readings by key."""

    parent = None

    def __init__(self, name: str) -> None:
        self.name = name

    def readings(self) -> dict[str, float | str]:
        """Return the device's values in an event, by key. A key's value always has the same type."""
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
    """The stage: which target stands before the cameras. Movable to a target's name."""

    def __init__(self, stage: Stage) -> None:
        super().__init__("target")
        self.stage = stage
        self.value: str | None = None  # None: not known

    def set(self, target: str) -> Status:
        def place() -> None:
            self.value = None
            self.stage.place(target)
            self.value = target

        return Status("stage", place, self.stage.place_timeout_s + PLACE_S)

    async def stop(self, success: bool = True) -> None:
        await bounded("stage", self.stage.stop)

    def readings(self) -> dict[str, float | str]:
        return {"target": self.value or ""}


class HandDevice(TargetDevice):
    """What the stage's operator changes by hand. Movable to the name of an adjustment; `by_hand` has it on disk from
    before he is asked until it is put back."""

    def __init__(self, stage: Stage, by_hand: ByHand) -> None:
        super().__init__(stage)
        self.by_hand = by_hand

    def set(self, target: str) -> Status:
        def change() -> None:
            self.value = None
            self.by_hand.note_asked(target)
            self.stage.place(target)
            self.by_hand.note_done(target)
            self.value = target

        return Status("stage", change, self.stage.place_timeout_s + PLACE_S)


@dataclass(frozen=True)
class LightSetting:
    """Wavelength (nm; 0: white light) and slit width (um; None: unchanged)."""

    wavelength_nm: float
    slit_um: float | None = None


class LightDevice(Device):
    """The monochromator's grating and slits. Movable to a `LightSetting`, or a wavelength (nm) alone."""

    def __init__(self, monochromator: Monochromator) -> None:
        super().__init__("monochromator")
        self.monochromator = monochromator
        self.value: LightSetting | None = None
        self.bandwidth_nm = 0.0

    def set(self, setting: LightSetting | float) -> Status:
        light = setting if isinstance(setting, LightSetting) else LightSetting(float(setting))

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
        await bounded("monochromator", self.monochromator.stop)

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
        self._moving = threading.Lock()
        self._barred = False

    def set(self, opened: bool) -> Status:
        def move() -> None:
            with self._moving:
                self.value = None
                if opened and self._barred:
                    raise InstrumentError("monochromator: the run was halted; its shutter stays closed")
                if opened:
                    self.monochromator.open_shutter()
                else:
                    self.monochromator.close_shutter()
                self.value = opened

        return Status("monochromator", move, MOVE_S)

    def bar(self) -> None:
        """Close the shutter now, whatever the monochromator does, and open it no more. Raises InstrumentError where it
        doesn't say that it is closed."""
        self._barred = True
        self.monochromator.stop()
        with self._moving:  # one that was about to open it has done so, or was refused
            shut(self.monochromator)
            self.value = False

    async def stop(self, success: bool = True) -> None:
        self.value = None
        await bounded("monochromator", self.monochromator.close_shutter)

    async def pause(self) -> None:
        await self.stop()
        self.value = False

    def resume(self) -> None:
        """Do nothing: after a pause, each step sets the bench and opens the shutter if it needs light."""

    def readings(self) -> dict[str, float | str]:
        return {"shutter_open": float(bool(self.value))}


def shut(monochromator: Monochromator) -> None:
    """Stop a monochromator and ask for its shutter. Raises InstrumentError where it says that it is open still.

    One that isn't connected yet ignores a stop: it is connected then, and told to close. A stop by another thread,
    which closes the shutter as well, ends the question: it is asked again within `STOP_S`, without another stop, which
    would end the question of that thread in turn."""
    until = time.monotonic() + STOP_S
    monochromator.stop()
    while True:
        try:
            monochromator.connect()
            if opened := monochromator.shutter_is_open():
                monochromator.close_shutter()
                opened = monochromator.shutter_is_open()
        except Interrupted:
            if time.monotonic() >= until:
                raise
        else:
            break
    if opened:
        raise InstrumentError("monochromator: its shutter is open though it was told to close; block the light by hand")


class LampDevice(Device):
    """The light source. Movable to shares 0..1 by channel, what isn't named dark; dark while a run is paused.

    `levels`: the shares that it said of itself when it was lit, by channel."""

    def __init__(self, light_source: LightSource) -> None:
        super().__init__("light_source")
        self.light_source = light_source
        self.value: dict[str, float] | None = None
        self.levels: dict[str, float] = {}
        self._moving = threading.Lock()
        self._barred = False

    def check(self, shares: Mapping[str, float]) -> None:
        """Raise InstrumentError for a channel that it hasn't got; nothing changes."""
        channels = self.light_source.channels()
        if unknown := shares.keys() - set(channels):
            raise InstrumentError(
                f"light source: no channel {min(unknown)!r}; it has {', '.join(channels)}: correct channels under "
                "[light_source.lights] of the station file"
            )

    def set(self, shares: Mapping[str, float]) -> Status:
        wanted = dict(shares)

        def light() -> None:
            with self._moving:
                if self.value == wanted:
                    self._check_still_lit()
                    return
                before, self.value = self.value, None
                self.check(wanted)
                # First what goes dark: channels may share a place, in which one of them can be lit at a time.
                if before is None:
                    self.light_source.stop()
                for channel in before or {}:
                    if channel not in wanted:
                        self._set_level(0.0, channel)
                for channel, share in wanted.items():
                    self._set_level(share, channel)
                self.levels = {channel: self.light_source.level(channel) for channel in wanted}
                self._check_lit(wanted)
                self.value = wanted

        return Status("light source", light, MOVE_S)

    def _set_level(self, share: float, channel: str) -> None:
        if self._barred and share > 0.0:
            raise InstrumentError("light source: the run was halted; it stays dark")
        self.light_source.set_level(share, channel)

    def _check_lit(self, wanted: Mapping[str, float]) -> None:
        """Raise InstrumentError where a channel that was lit says that it is dark."""
        for channel, share in wanted.items():
            if share > 0.0 and self.levels[channel] == 0.0:
                raise InstrumentError(
                    f"light source: channel {channel} was set to {share:g} and says that it is dark: the level is less "
                    "than half of its smallest step, or somebody switched it off; ask for a higher level, or switch it "
                    "on"
                )

    def bar(self) -> None:
        """Darken it now, whatever it does, and light it no more. Raises InstrumentError where it doesn't get dark."""
        self._barred = True
        self.light_source.stop()
        with self._moving:  # what was about to light a channel has done so, or was refused
            self.light_source.stop()
            self.value = {}

    def _check_still_lit(self) -> None:
        """Raise InstrumentError where a channel isn't as it was set: somebody's hand may have switched it off."""
        for channel, share in self.levels.items():
            if (level := self.light_source.level(channel)) != share:
                self.value = None
                raise InstrumentError(
                    f"light source: channel {channel} was set to {share:g} and is at {level:g} now; look who switches "
                    "it, and resume"
                )

    async def stop(self, success: bool = True) -> None:
        self.value = None
        await bounded("light source", self.light_source.stop)

    async def pause(self) -> None:
        await self.stop()

    def resume(self) -> None:
        """Do nothing: after a pause, each step sets the light source."""

    def readings(self) -> dict[str, float | str]:
        lit = self.levels if self.value else {}
        return {"lamp_levels": ", ".join(f"{channel}={share:g}" for channel, share in lit.items())}


@dataclass(frozen=True)
class ShownPattern:
    """The pattern on the screen, by its path in the session (None: the screen is dark), and its screen pixels per
    cell."""

    path: str | None = None
    cell_px: int = 1


class ScreenDevice(Device):
    """The display. Movable to a `ShownPattern`; dark while a run is paused."""

    def __init__(self, display: Display, cells: Callable[[str], NDArray[np.uint8]]) -> None:
        super().__init__("screen")
        self.display, self.cells = display, cells
        self.value: ShownPattern | None = None

    def set(self, pattern: ShownPattern) -> Status:
        def show() -> None:
            self.value = None
            cells = np.zeros((1, 1), np.uint8) if pattern.path is None else self.cells(pattern.path)
            self.display.show(cells, pattern.cell_px)
            self.value = pattern

        return Status("display", show, MOVE_S)

    async def stop(self, success: bool = True) -> None:
        self.value = None
        await bounded("display", self.display.stop)

    async def pause(self) -> None:
        await self.stop()

    def resume(self) -> None:
        """Do nothing: after a pause, each step shows its pattern."""

    def readings(self) -> dict[str, float | str]:
        return {"pattern": (self.value.path or "") if self.value else ""}


class RadiometerDevice(Device):
    """The spectroradiometer: prepared with the path of the next spectrum, triggered to measure and write it."""

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


class PhotodiodeDevice(Device):
    """The reference photodiode: prepared with the wavelength (nm) of the light, triggered to measure its irradiance (W
    m^-2).

    Prepared with None, it measures its dark current (A).
    """

    def __init__(self, photodiode: Photodiode) -> None:
        super().__init__("photodiode")
        self.photodiode = photodiode
        self.wavelength_nm: float | None = None
        self.dark_a: float | None = None  # None: not measured yet
        self.measured: IrradianceMeasurement | None = None

    def prepare(self, wavelength_nm: float | None) -> Status:
        self.wavelength_nm, self.measured = wavelength_nm, None
        return Status("photodiode", lambda: None, STOP_S)

    def trigger(self) -> Status:
        def measure() -> None:
            if self.wavelength_nm is None:
                self.dark_a = self.photodiode.measure_dark()
            else:
                self.measured = self.photodiode.measure(self.wavelength_nm)

        return Status("photodiode", measure, MEASURE_S)

    def readings(self) -> dict[str, float | str]:
        measured = self.measured
        return {
            "irradiance_w_m2": measured.irradiance_w_m2 if measured else 0.0,
            "sd_irradiance_w_m2": measured.sd_irradiance_w_m2 if measured else 0.0,
            "irradiance_calibration_sd_percent": 100.0 * measured.calibration_sd if measured else 0.0,
            "photodiode_dark_a": self.dark_a or 0.0,
        }


@dataclass(frozen=True)
class Shot:
    """One trigger of all cameras: exposures (s), gain (dB), and paths of the frames; the frame of a side without a path
    isn't kept.

    `repeats`: number of following shots with the same exposures and gain, with nothing moved in between; cameras that
    stream take them as one series.
    """

    exposure_s: Mapping[Side, float]
    gain_db: float
    paths: Mapping[Side, str]
    repeats: int = 0

    def same_settings(self, other: Shot) -> bool:
        """Return whether exposures and gain are those of the other shot."""
        return dict(self.exposure_s) == dict(other.exposure_s) and self.gain_db == other.gain_db


def level_of(frame: NDArray[np.uint16], sheet: DataSheet) -> float:
    """Level of a frame (rows, cols with the margins), a share of its range: (p - black level) / range, where p is the
    99.5th percentile of the brightest channel in the active area.

    The range (DN) goes from the black level to the code of saturation, or to the data sheet's full well where that is
    lower. A percentile, because a hot pixel must not set the exposure; channel by channel, because a chart's white
    patch is a few percent of the frame.
    """
    black = sheet.black_level_dn or 0.0
    top = sheet.saturation_dn
    if sheet.full_well_e is not None and sheet.conversion_gain_dn_per_e is not None:
        top = min(top, black + sheet.full_well_e * sheet.conversion_gain_dn_per_e)
    step = 1 if sheet.cfa == "MONO" else 2
    active = sheet.margins.active(frame)
    brightest = max(_percentile(active[row::step, col::step], 99.5) for row in range(step) for col in range(step))
    return (brightest - black) / (top - black)


def _percentile(codes: NDArray[np.uint16], percent: float) -> float:
    """`numpy.percentile` of codes, from their histogram: in a tenth of its time."""
    below = np.cumsum(np.bincount(codes.ravel()))
    rank = percent / 100.0 * (codes.size - 1)
    low, high = np.searchsorted(below, (np.floor(rank), np.ceil(rank)), side="right")
    return float(low + (rank - np.floor(rank)) * (high - low))


class CamerasDevice(Device):
    """All cameras, exposed by one trigger: prepared with a `Shot`, triggered to take it and to write its frames."""

    def __init__(
        self, cameras: Mapping[Side, CameraDriver], sheets: Mapping[Side, DataSheet], write: WriteFrame
    ) -> None:
        super().__init__("cameras")
        self.cameras, self.sheets, self.write = dict(cameras), dict(sheets), write
        self.shot = Shot(dict.fromkeys(self.cameras, 0.0), 0.0, {})
        self.frames: dict[Side, Frame] = {}
        self.levels: dict[Side, float] = dict.fromkeys(self.cameras, 0.0)
        self.stored: dict[Side, StoredFile] = {}
        self.retaken: list[str] = []  # a line for each lost frame of the present shot that was taken again
        self._stream: FrameStream | None = None  # the series under way
        self.in_series = False  # whether the previous frame was kept and nothing has moved since

    def prepare(self, shot: Shot) -> Status:
        goes_on = self._stream is not None and self._stream.left > 0 and shot.same_settings(self.shot)
        self.shot, self.frames, self.stored, self.retaken = shot, {}, {}, []

        def configure() -> None:
            if goes_on:
                return
            self.end_stream()
            for side, camera in self.cameras.items():
                camera.configure(shot.exposure_s[side], shot.gain_db)

        return Status("cameras", configure, READOUT_S + self._readout_s)

    @property
    def _readout_s(self) -> float:
        return max(camera.readout_s for camera in self.cameras.values())

    def _expose(self, shot: Shot) -> Sequence[Frame]:
        """Return a frame of each camera, the next of the series under way if there is one. A lost or incomplete frame
        is taken again."""
        if self._stream is None and shot.repeats:
            streaming = [camera for camera in self.cameras.values() if isinstance(camera, StreamingCamera)]
            if len(streaming) == len(self.cameras):
                self._stream = FrameStream(streaming, 1 + shot.repeats, on_loss=self._note_loss)
        if self._stream is not None:
            frames = self._stream.next()
            if self._stream.left == 0:
                self._stream = None
            return frames
        try:
            return capture_together(list(self.cameras.values()))
        except (NoAnswer, Garbled) as error:
            # Nothing of the first try was kept, so a second one is safe.
            self.retaken.append(f"{error}; it is taken again")
            return capture_together(list(self.cameras.values()))

    def _note_loss(self, line: str) -> None:
        self.retaken.append(line)  # counts to the present shot

    def end_stream(self) -> None:
        """End the series under way; frames that it triggered and no shot asked for are dropped."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def trigger(self) -> Status:
        shot = self.shot

        def take() -> None:
            self.in_series = False
            try:
                together = self._expose(shot)
            except BaseException:
                self._stream = None  # it has closed itself
                raise
            frames = dict(zip(self.cameras, together, strict=True))
            for side, frame in frames.items():
                sheet = self.sheets[side]
                if frame.raw.shape != sheet.frame_shape:
                    rows, cols = sheet.frame_shape
                    raise InstrumentError(
                        f"camera {side}: a frame of {frame.raw.shape[0]} x {frame.raw.shape[1]} pixels came, the data "
                        "sheet in "
                        f"the station file says {rows} x {cols}; correct rows and cols, or the margins, there, or the "
                        "camera's region"
                    )
            self._keep(frames, shot)
            self.frames = frames
            self.in_series = bool(shot.paths)

        once_s = max(shot.exposure_s.values()) + self._readout_s
        return Status("cameras", take, (1 + MOST_LOST) * once_s + READOUT_S)

    def _keep(self, frames: Mapping[Side, Frame], shot: Shot) -> None:
        """Levels of the frames, and the files of those that are kept, all sides at once: hashing and the disk wait for
        nobody."""

        def kept(side: Side) -> tuple[float, StoredFile | None]:
            raw, path = frames[side].raw, shot.paths.get(side)
            stored = None if path is None else self.write(path, side, raw)
            return level_of(raw, self.sheets[side]), stored

        written = {side: in_thread(partial(kept, side)) for side in frames}
        wait(written.values())  # where one can't be written, the other's isn't written on while the step is taken again
        results = {side: future.result() for side, future in written.items()}
        self.levels = {side: level for side, (level, _) in results.items()}
        self.stored = {side: stored for side, (_, stored) in results.items() if stored is not None}

    async def pause(self) -> None:
        await bounded("cameras", self.end_stream)

    def resume(self) -> None:
        """Do nothing: after a pause, each step prepares the cameras."""

    async def stop(self, success: bool = True) -> None:
        self._stream = None
        for side, camera in self.cameras.items():
            await bounded(f"camera {side}", camera.stop)

    def readings(self) -> dict[str, float | str]:
        readings: dict[str, float | str] = {}
        for side in self.cameras:
            readings[f"{side}_exposure_s"] = self.frames[side].exposure_s if side in self.frames else 0.0
            readings[f"{side}_level"] = self.levels[side]
            readings[f"{side}_frame"] = self.stored[side].path if side in self.stored else ""
        return readings
