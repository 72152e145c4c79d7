"""A station's devices for bluesky plans of one's own: connected, frames and spectra written into a folder.

    with plan_devices(read_station("lab.toml"), Path("mine")) as bench:
        RunEngine()(bp.scan([bench.radiometer, bench.cameras], bench.light, 450, 650, 5))

They are the devices of `lab.capture.devices`, which sessions use, and go with ophyd-async's in one plan. Cameras are
`prepare`d with an exposure (s) or a `Shot`; each trigger writes `frames/NUMBER-SIDE.npy`, each measurement of the
spectroradiometer `spectra/NUMBER.csv`, and these paths stand in the events.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lab.capture.blocking_calls import Status
from lab.capture.by_hand import ByHand
from lab.capture.devices import (
    CamerasDevice,
    LampDevice,
    LightDevice,
    PhotodiodeDevice,
    RadiometerDevice,
    ScreenDevice,
    Shot,
    ShutterDevice,
    TargetDevice,
)
from lab.capture.durable_files import npy_bytes, write_durably
from lab.capture.instruments import Instruments
from lab.capture.records import Role, StoredFile
from lab.capture.station import Drivers, Station, drivers_of
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import Snapshots
from lab.formats.spectrum_csv import format_spectrum
from sim.camera import Side
from sim.spectrum import Spectrum


class PlanCameras(CamerasDevice):
    """The cameras, each trigger of which is kept under its own number. `prepare` with an exposure (s), or a `Shot`."""

    @cached_property
    def _numbers(self) -> Iterator[int]:
        return itertools.count(1)

    def prepare(self, shot: Shot | float) -> Status:
        if not isinstance(shot, Shot):
            shot = Shot(dict.fromkeys(self.cameras, float(shot)), 0.0, {})
        return super().prepare(shot)

    def trigger(self) -> Status:
        if not any(self.shot.exposure_s.values()):
            raise InputError("cameras: no exposure is set; yield from bps.prepare(cameras, SECONDS) first")
        number = next(self._numbers)
        self.shot = replace(self.shot, paths={side: f"frames/{number:05d}-{side}.npy" for side in self.cameras})
        return super().trigger()


class PlanRadiometer(RadiometerDevice):
    """The spectroradiometer, each measurement of which is kept under its own number."""

    @cached_property
    def _numbers(self) -> Iterator[int]:
        return itertools.count(1)

    def trigger(self) -> Status:
        self.path, self.stored, self.refused = f"spectra/{next(self._numbers):05d}.csv", None, None
        return super().trigger()


@dataclass(frozen=True)
class PlanDevices:
    """A station's devices; None for an instrument that it hasn't got. `instruments`: what each said of itself."""

    cameras: PlanCameras
    instruments: Snapshots
    target: TargetDevice | None = None
    light: LightDevice | None = None
    shutter: ShutterDevice | None = None
    screen: ScreenDevice | None = None
    radiometer: PlanRadiometer | None = None
    photodiode: PhotodiodeDevice | None = None
    lamp: LampDevice | None = None


@contextlib.contextmanager
def plan_devices(
    station: Station, folder: Path, connect: Callable[[Station], Drivers] = drivers_of
) -> Iterator[PlanDevices]:
    """Connect to a station's instruments for the block, and bring them into their safe state at its end.

    A screen's pattern is named by the path of an .npy file (uint8, 0 and 1) in `folder`. Raises DeviceError where an
    instrument doesn't answer, contradicts its data sheet, or doesn't reach its safe state.
    """

    def write(role: Role, path: str, content: bytes, side: Side | None = None) -> StoredFile:
        write_durably(folder / path, content)
        return StoredFile(role, path, hashlib.sha256(content).hexdigest(), len(content), side)

    def write_frame(path: str, side: Side, frame: NDArray[np.uint16]) -> StoredFile:
        return write("frame", path, npy_bytes(np.ascontiguousarray(frame, np.uint16)), side)

    def write_spectrum(path: str, spectrum: Spectrum) -> StoredFile:
        return write("spectrum", path, format_spectrum(spectrum).encode())

    drivers = connect(station)
    instruments = Instruments(
        station,
        drivers,
        write_frame=write_frame,
        write_spectrum=write_spectrum,
        cells=lambda path: np.load(folder / path, allow_pickle=False),
        by_hand=ByHand(folder, "plan", station),
    )
    try:
        there = instruments.connect()
        sheets = {side: camera.datasheet for side, camera in station.cameras.items()}
        radiometer = drivers.spectroradiometer
        yield PlanDevices(
            cameras=PlanCameras(drivers.cameras, sheets, write_frame),
            instruments=there,
            target=instruments.target,
            light=instruments.light,
            shutter=instruments.shutter,
            screen=instruments.screen,
            radiometer=PlanRadiometer(radiometer, write_spectrum) if radiometer else None,
            photodiode=instruments.photodiode,
            lamp=instruments.lamp,
        )
    finally:
        safe = instruments.make_safe()
        instruments.close()
        if safe.complaints:
            raise DeviceError(f"not brought into a safe state: {'; '.join(safe.complaints)}")
