"""The plan that takes one step: set the bench, measure the light, find the exposure, expose.

It yields bluesky's messages itself: each of the library's plan stubs formats the whole call stack, for a warning that
is never needed here."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from bluesky.utils import Msg

from lab.capture.devices import LampDevice, LightSetting, PhotodiodeDevice, Shot, ShownPattern
from lab.capture.instruments import Instruments
from lab.capture.records import StoredFile
from lab.capture_kinds.base import Capture, FindExposure, FixedExposure, Reading, RelativeExposure, Step
from lab.capture_kinds.irradiance import irradiance_nm
from lab.errors import DeviceError, InputError
from sim.camera import Side

T = TypeVar("T")
Plan = Generator[Msg, Any, T]

#: A level above SATURATED or below UNLIT (shares of the range) tells only the direction of the search. SATURATED is 10
#: % below the data sheet's full well, because a sensor may saturate below its data sheet.
SATURATED, UNLIT = 0.9, 0.01
TRIES = 14  # test exposures at most

#: Frames that are read and not kept before a capture in new light or after a test exposure. In a camera with image lag
#: q (the share of a frame's signal that is added to the next), earlier light then adds the share q^3 to the capture.
DUMMY_FRAMES = 2


@dataclass(frozen=True)
class Taken:
    """The outcome of a step: its result for the journal, its files, and its completed captures."""

    result: dict[str, Any]
    files: tuple[StoredFile, ...] = ()
    captures: tuple[Capture, ...] = ()


def arrange(step: Step, instruments: Instruments) -> Plan[None]:
    """Set the bench for the step, moving only what differs. Raises InputError for a missing instrument."""
    setting, light, cameras = step.setting, instruments.light, instruments.cameras
    moves: list[tuple[Any, Any]] = []
    if setting.target is not None:
        if instruments.target is None:
            raise InputError(
                f"station: step {step.id!r} needs target {setting.target!r} and there is no [stage]; add one (driver "
                "'prompt' asks you)"
            )
        moves.append((instruments.target, setting.target))
    for name in setting.by_hand:  # before all else: the same hand puts the target there
        yield from adjust(name, instruments)
    if light is not None and instruments.shutter is not None:
        if setting.wavelength_nm is None:
            moves.append((instruments.shutter, False))
        else:
            moves.append((light, LightSetting(setting.wavelength_nm, setting.slit_um)))
    lamp = _lamp_of(step, instruments)
    if lamp is not None and not (setting.lamp and lamp.value == setting.lamp):
        moves.append((lamp, setting.lamp))
    if instruments.screen is not None:
        moves.append((instruments.screen, ShownPattern(setting.pattern, setting.cell_px if setting.pattern else 1)))
    moves = [(device, value) for device, value in moves if device.value != value]
    for device, value in moves:
        yield Msg("set", device, value, group="arrange")
    if lamp is not None and setting.lamp and lamp.value == setting.lamp:
        yield Msg("set", lamp, setting.lamp, group="arrange")  # it reads back that nobody has switched it off
    yield Msg("wait", None, group="arrange")
    # Last: before the grating has arrived, the light has another wavelength.
    opens = instruments.shutter is not None and setting.wavelength_nm is not None and not instruments.shutter.value
    if opens:
        yield from _set_shutter(instruments, True)
    cameras.in_series = cameras.in_series and not moves and not opens


def _lamp_of(step: Step, instruments: Instruments) -> LampDevice | None:
    """Return the light source. Raises InputError where a step needs one and there is none."""
    if step.setting.lamp and instruments.lamp is None:
        raise InputError(f"station: step {step.id!r} needs a [light_source]; add it to the station file")
    return instruments.lamp


def adjust(name: str, instruments: Instruments) -> Plan[None]:
    """Have an adjustment set by hand, where it isn't known to be so. Raises InputError where nobody can be asked."""
    hand = instruments.hand(name)
    if hand.value != name:
        yield Msg("set", hand, name, group="by hand")
        yield Msg("wait", None, group="by hand")
        instruments.cameras.in_series = False


def _set_shutter(instruments: Instruments, opened: bool) -> Plan[None]:
    yield Msg("set", instruments.shutter, opened, group="shutter")
    yield Msg("wait", None, group="shutter")


def _shoot(instruments: Instruments, shot: Shot) -> Plan[None]:
    yield Msg("prepare", instruments.cameras, shot, group="shoot")
    yield Msg("wait", None, group="shoot")
    yield Msg("trigger", instruments.cameras, group="shoot")
    yield Msg("wait", None, group="shoot")


def find_exposure(
    wanted: FindExposure, instruments: Instruments, start_s: Mapping[Side, float], gain_db: float
) -> Plan[tuple[dict[Side, float], dict[Side, float]]]:
    """Search each camera's exposure (s) for the wanted level, with at most `TRIES` test frames that aren't kept.
    Returns exposures and levels. `gain_db`: of the cameras.

    After a saturated or unlit frame, the exposure is divided by 5 or multiplied by 10; after any other, it is
    multiplied by wanted level / level. Exposures stay within the station's limits. The last exposures are returned also
    where a camera missed the level."""
    limits = instruments.limits

    def clip_to_limits(exposure_s: float) -> float:
        return float(np.clip(exposure_s, limits.exposure_min_s, limits.exposure_max_s))

    exposure_s = {side: clip_to_limits(start_s[side]) for side in instruments.cameras.cameras}
    levels: dict[Side, float] = {}
    before: tuple[dict[Side, float], dict[Side, float]] | None = None
    for _ in range(TRIES):
        yield from _shoot(instruments, Shot(exposure_s, gain_db, {}))
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
            following[side] = clip_to_limits(exposure_s[side] * factor)
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
    """Return whether a frame is saturated below the data sheet's range: a shorter exposure hardly lowered its level."""
    if before is None or levels[side] < 0.3:
        return False
    shortened = exposure_s[side] / before[0][side]
    return shortened < 0.9 and levels[side] / before[1][side] > np.sqrt(shortened)


def repeats_ahead(steps: Sequence[Step | None]) -> list[int]:
    """Return how many of the steps that follow each at once only repeat its exposure.

    steps : in order; None: a step that isn't taken

    >>> repeats_ahead([None, None])
    [0, 0]
    """
    counts = [0] * len(steps)
    for at in range(len(steps) - 2, -1, -1):
        step, following = steps[at], steps[at + 1]
        if step is not None and following is not None and _repeats(step, following):
            counts[at] = counts[at + 1] + 1
    return counts


def _repeats(step: Step, following: Step) -> bool:
    """Return whether the second step does nothing but expose as the first did."""
    return (
        bool(step.captures and following.captures)
        and following.radiance is None
        and following.setting == step.setting
        and following.exposure == step.exposure
    )


def take(
    step: Step, instruments: Instruments, results: Mapping[str, Mapping[str, Any]], repeats: int = 0
) -> Plan[Taken]:
    """Take one step: set the bench, measure the light, find exposures or expose. `results`: those of earlier steps, by
    id; `repeats`: its number in `repeats_ahead`.

    If the spectroradiometer refuses to measure the light (too dark, too bright), a step with captures is skipped, with
    the reason in its result; in a step without captures this raises DeviceError, as later steps need the spectrum.
    Raises InputError for a missing instrument."""
    photodiode = _irradiance_meter(step, instruments)
    if photodiode is not None and photodiode.dark_a is None:
        yield from _dark_current(instruments)
    yield from arrange(step, instruments)
    files: list[StoredFile] = []
    result: dict[str, Any] = {}
    radiometer, cameras = instruments.radiometer, instruments.cameras
    if step.radiance is not None:
        if radiometer is None:
            raise InputError(f"station: step {step.id!r} needs a [spectroradiometer]; add it to the station file")
        yield Msg("prepare", radiometer, step.radiance, group="radiance")
        yield Msg("trigger", radiometer, group="radiance")
        yield Msg("wait", None, group="radiance")
        if radiometer.stored is None:
            reason = radiometer.refused or "spectroradiometer: gave no spectrum"
            if not step.captures:
                raise DeviceError(reason)
            return Taken({"skipped": reason})
        files.append(radiometer.stored)
        result["radiance"] = step.radiance
    if photodiode is not None:
        yield from _measure_irradiance(photodiode, irradiance_nm(step))
    captures: tuple[Capture, ...] = ()
    gain_db = instruments.limits.gain_db if step.setting.gain_db is None else step.setting.gain_db
    if isinstance(step.exposure, FindExposure):
        start_s = _start(instruments, results)
        exposure_s, levels = yield from find_exposure(step.exposure, instruments, start_s, gain_db)
        result |= {"exposure_s": exposure_s, "level": levels}
    elif step.exposure is not None:
        shot = Shot(
            _exposures(step, instruments, results),
            gain_db,
            {capture.side: capture.frame for capture in step.captures},
            repeats,
        )
        dummies = 0 if cameras.in_series or not step.captures else DUMMY_FRAMES
        retaken: list[str] = []
        for left in range(dummies, 0, -1):
            yield from _shoot(instruments, Shot(shot.exposure_s, shot.gain_db, {}, repeats + left))
            retaken += cameras.retaken
        yield from _shoot(instruments, shot)
        retaken += cameras.retaken
        files += cameras.stored.values()
        captures = _complete_keys(step, instruments, dummies)
        result |= {"level": dict(cameras.levels)}
        if retaken:
            result["retaken"] = retaken
    yield Msg("create", None, name=step.sequence)
    for device in instruments.devices:
        yield Msg("read", device)
    yield Msg("save")
    return Taken(result, tuple(files), captures)


def _irradiance_meter(step: Step, instruments: Instruments) -> PhotodiodeDevice | None:
    """Return the photodiode, for a step beside whose captures it measures."""
    photodiode = instruments.photodiode
    if photodiode is None:
        return None
    photodiode.measured = None  # that of an earlier step
    return None if irradiance_nm(step) is None else photodiode


def _measure_irradiance(photodiode: PhotodiodeDevice, wavelength_nm: float | None) -> Plan[None]:
    """Measure the irradiance of light of one wavelength; with None, the photodiode's dark current."""
    yield Msg("prepare", photodiode, wavelength_nm, group="irradiance")
    yield Msg("trigger", photodiode, group="irradiance")
    yield Msg("wait", None, group="irradiance")


def _dark_current(instruments: Instruments) -> Plan[None]:
    """Close the shutter, darken the light source, and measure the photodiode's dark current."""
    assert instruments.photodiode is not None
    if instruments.lamp is not None and instruments.lamp.value != {}:
        yield Msg("set", instruments.lamp, {}, group="lamp")
        yield Msg("wait", None, group="lamp")
    if instruments.shutter is not None and instruments.shutter.value is not False:
        yield from _set_shutter(instruments, False)
    yield from _measure_irradiance(instruments.photodiode, None)


def _start(instruments: Instruments, results: Mapping[str, Mapping[str, Any]]) -> dict[Side, float]:
    """Initial exposures (s) of a search: the result of the latest search, else 10 ms."""
    exposures_s = [result["exposure_s"] for result in results.values() if "exposure_s" in result]
    return {side: float(exposures_s[-1][side]) if exposures_s else 0.01 for side in instruments.cameras.cameras}


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


def _complete_keys(step: Step, instruments: Instruments, dummies: int) -> tuple[Capture, ...]:
    """Return the step's captures with the keys that the trigger, the `dummies` before it, and the instruments tell."""
    without = instruments.photodiode if instruments.photodiode and instruments.photodiode.measured is None else None
    readings = {
        key: value
        for device in instruments.devices
        if device is not without
        for key, value in device.readings().items()
    }
    completed = []
    for capture in step.captures:
        frame = instruments.cameras.frames[capture.side]
        statements: dict[str, Any] = {
            "exposure_s": frame.exposure_s,
            "gain_db": frame.gain_db,
            "temperature_c": frame.temperature_c,
            "time": frame.time,
            "dummy_frames": dummies or None,
            "lamp_levels": dict(instruments.lamp.levels) if instruments.lamp and step.setting.lamp else None,
        }
        for key, field in type(capture).model_fields.items():
            for mark in field.metadata:
                if isinstance(mark, Reading):
                    statements[key] = readings.get(mark.key)
        completed.append(
            capture.model_copy(update={key: value for key, value in statements.items() if value is not None})
        )
    return tuple(completed)
