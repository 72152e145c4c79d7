"""Self-tests of a station's instruments, and a station file drafted from the instruments that are connected."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from drivers.camera.base import Camera, SensorInfo
from drivers.contract.families import CONTRACTS, NotMet
from drivers.discovery import Found
from drivers.errors import InstrumentError
from drivers.instrument import Instrument
from drivers.registry import driver
from drivers.transcript import TranscriptFile
from lab.capture.instruments import contradiction
from lab.capture.station import Address, Drivers, Station, drivers_of
from lab.errors import DeviceError, InputError, cannot_write
from lab.formats.recording_set import DataSheet

#: Longest time (s) for the self-test of one instrument: a measurement of a dark source takes minutes.
TEST_S = 300.0
#: Longest exposure (s) that a drafted station file allows, however long its cameras can.
MOST_EXPOSURE_S = 10.0


@dataclass(frozen=True)
class SelfTest:
    """Result of one instrument's self-test: its name in the station, its identity (maker, model, serial number,
    firmware), whether it works, and the finding in words."""

    name: str
    identity: str
    works: bool
    words: str


def self_tests(drivers: Drivers, sheets: Mapping[str, DataSheet] = MappingProxyType({})) -> Iterator[SelfTest]:
    """Connect to each instrument, bring it into its safe state, use it once for its purpose, check that it is safe, and
    disconnect.

    `sheets`: the cameras' data sheets by side, compared with what the cameras report.
    """
    for name, instrument in drivers.all.items():
        yield _self_test(name, instrument, sheets.get(name.partition(" ")[2]))


def self_test(station: Station, name: str, connect: Callable[[Station], Drivers] = drivers_of) -> SelfTest:
    """Return the self-test of one instrument (`monochromator`, `cameras.left`, ...). Raises InputError if the station
    hasn't got it."""
    _entry(station, name)
    side = _format_device_name(name).partition(" ")[2]
    return _self_test(
        _format_device_name(name), connect(station).all[_format_device_name(name)], data_sheets(station).get(side)
    )


def data_sheets(station: Station) -> dict[str, DataSheet]:
    """Return the cameras' data sheets by side."""
    return {side: camera.datasheet for side, camera in station.cameras.items()}


def _format_device_name(name: str) -> str:
    """Return a device's name in messages: `camera left` for `cameras.left`."""
    family, _, side = name.partition(".")
    return f"camera {side}" if side else family


def _entry(station: Station, name: str) -> Address:
    entry = station.devices.get(name.replace("camera.", "cameras."))
    if entry is None:
        raise InputError(f"the station has no {name}; it has {', '.join(station.devices)}")
    return entry


def _self_test(name: str, instrument: Instrument, sheet: DataSheet | None = None) -> SelfTest:
    tests: list[SelfTest] = []

    def test() -> None:
        who = ""
        try:
            instrument.connect()
            instrument.stop()
            identity = instrument.identity()
            who = " ".join(filter(None, (identity.maker, identity.model, identity.serial_number, identity.firmware)))
            contract = CONTRACTS[name.split(maxsplit=1)[0]]
            contract.everyday(instrument)
            instrument.stop()
            contract.require_safe(instrument)
            works, words = True, "works, and is in its safe state"
            if sheet is not None and isinstance(instrument, Camera):
                difference = contradiction(name.partition(" ")[2], instrument.sensor(), sheet)
                works, words = difference is None, difference or words
        except (InstrumentError, NotMet) as error:
            works, words = False, str(error)
        try:
            instrument.close()
        except InstrumentError as error:
            works, words = False, str(error)
        tests.append(SelfTest(name, who, works, words))

    worker = threading.Thread(target=test, daemon=True)
    worker.start()
    worker.join(TEST_S)
    return tests[0] if tests else SelfTest(name, "", False, f"didn't end within {TEST_S:g} s; switch it off and on")


def record_transcript(station: Station, name: str, file: Path) -> SelfTest:
    """Return a self-test of one instrument (`monochromator`, `cameras.left`, ...), with a transcript of its messages in
    a file.

    Raises InputError if the station has no such instrument or the file can't be written.
    """
    entry = _entry(station, name)
    try:
        recorder = TranscriptFile(file)
    except OSError as error:
        raise cannot_write(file, error, "name another file") from error
    try:
        answer = _format_device_name(name)
        try:
            made = driver(answer.partition(" ")[0], entry.driver)(entry.address, recorder=recorder, **entry.settings)
        except (InstrumentError, TypeError) as error:
            raise DeviceError(f"{name}: {error}") from error
        return _self_test(answer, made)
    finally:
        recorder.close()


def check_station(station: Station) -> list[SelfTest]:
    """Return the self-tests of a whole station."""
    return list(self_tests(drivers_of(station), data_sheets(station)))


def station_text(instruments: Iterable[Found]) -> str:
    """Return a station file (TOML) of the instruments that are connected. Cameras are asked for their pixels, colour
    filters and bit depth; what they don't tell becomes a comment. Raises DeviceError where there is no camera or one
    doesn't answer."""
    lines = [
        (
            "# Written by `calibench station init` from what is connected. Data sheets hold what the makers say: complete "  # noqa: E501
            "them."
        )
    ]
    sides = iter(("left", "right"))
    cameras = 0
    exposures: list[tuple[float, float]] = []
    taken: set[str] = set()
    there = list(instruments)
    pair = sum(instrument.family == "camera" for instrument in there) > 1
    for instrument in there:
        if instrument.family == "camera" and (side := next(sides, None)) is not None:
            sensor = _sensor(side, instrument)
            lines += ["", *_camera_table(side, instrument, sensor, pair)]
            cameras += 1
            if sensor.exposure_s is not None:
                exposures.append(sensor.exposure_s)
        elif instrument.family and instrument.family != "camera" and instrument.family not in taken:
            taken.add(instrument.family)
            lines += [
                "",
                f"# {instrument.what}",
                f"[{instrument.family}]",
                f'driver = "{instrument.name}"',
                f'address = "{instrument.address}"',
            ]
            lines += [f'{key} = ""  # to be filled in' for key in instrument.needs]
        else:
            lines += ["", f"# also connected: {instrument.what} at {instrument.address}"]
    if not cameras:
        raise DeviceError(
            "no camera is connected that a driver here reaches: plug it in, give --usbip HOST:PORT, or install its "
            "library "
            "(calibench[basler], Aravis); `calibench devices` shows what is"
        )
    if exposures:
        lines += ["", "[limits]", "# What every camera can; give less where that is enough."]
        lines += [f"exposure_min_s = {max(shortest for shortest, _ in exposures):.9g}"]
        lines += [f"exposure_max_s = {min(MOST_EXPOSURE_S, *(longest for _, longest in exposures)):.9g}"]
    lines += ["", "[targets.cap]", 'kind = "cap"']
    return "\n".join(lines) + "\n"


def _sensor(side: str, listed: Found) -> SensorInfo:
    camera: Any = driver(listed.family, listed.name)(listed.address)
    assert isinstance(camera, Camera)
    try:
        with camera:
            return camera.sensor()
    except InstrumentError as error:
        raise DeviceError(f"camera {side}: {error}") from error


def _camera_table(side: str, camera: Found, sensor: SensorInfo, pair: bool) -> list[str]:
    lines = [f"# {camera.what}", f"[cameras.{side}]", f'driver = "{camera.name}"', f'address = "{camera.address}"']
    if pair and side == "left":
        lines += ['# output_line = "Line1"  # it leads: the line on which it gives the pulse that triggers the other']
    elif pair:
        lines += ['trigger_line = "Software"  # or the line that is wired to the one that leads, as "Line0"']
    lines += [f"[cameras.{side}.datasheet]", f"rows = {sensor.rows}", f"cols = {sensor.cols}"]
    lines += [f'cfa = "{sensor.cfa or "MONO"}"' + ("" if sensor.cfa else "  # it doesn't say: correct this")]
    bits = sensor.bit_depth
    lines += [f"bit_depth = {bits or 12}" + ("" if bits else "  # it doesn't say: correct this")]
    if sensor.pixel_pitch_um is not None:
        lines += [f"pixel_pitch_um = {round(sensor.pixel_pitch_um, 4)}"]
    else:
        lines += ["# pixel_pitch_um ="]
    if sensor.black_level is not None:
        lines += [f"# it counts its black level as {sensor.black_level:g}; black_level_dn is that in codes"]
    lines += ["# f_number =", "# focal_length_mm =", "# full_well_e ="]
    return lines
