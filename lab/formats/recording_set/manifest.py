"""The manifest's keys, name by name, and its JSON text.

An unknown key is kept and reported; an unknown kind of capture is reported and skipped. All other errors are
problems, one line each, and are reported together."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self, get_args

from pydantic import Field, ValidationError, field_validator, model_validator

from lab.capture_kinds.base import CAPTURES, AnyCapture, Capture, Open
from lab.capture_kinds.flat import FlatCapture
from lab.errors import InputError, one_line
from lab.plain_text import complaints_of, escaped
from sim.camera import Cfa, Shutter, Side
from sim.sensor.margins import NO_MARGINS, Margins

#
# The instruments say it themselves, before the first capture. Two snapshots are compared by `differences`.


#: A setting's value as an instrument reports it.
Value = str | bool | int | float

#: Settings that change by themselves, or are set for each capture and stand with it.
OF_A_CAPTURE = frozenset(
    {"AcquisitionFrameRate", "ExposureTime", "ExposureTimeAbs", "Gain", "GainRaw", "TriggerMode", "TriggerSelector"}
    | {"TriggerSource", "bandwidth_nm", "filter_place"}
)
#: Relative difference of two numbers up to which they are one setting, as a register rounds it.
ROUNDING = 1e-6


class InstrumentSnapshot(Open):
    """One instrument before the first capture.

    settings : every setting that bears on what is measured, by its name
    found : what a setting was before it was set for the measurement, where that changed it
    departures : what couldn't be set as a measurement wants it, in words: it belongs to all that was recorded
    """

    maker: str = ""
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    settings: dict[str, Value] = {}
    found: dict[str, Value] = {}
    departures: tuple[str, ...] = ()


Snapshots = Mapping[str, InstrumentSnapshot]


def differences(before: Snapshots, now: Snapshots) -> tuple[str, ...]:
    """Return what differs between two sets of instruments, by their names in messages (`camera left`): a line each.

    Nothing where one of them isn't known. Settings of `OF_A_CAPTURE`, and a camera's `Device...`, which says its
    identity again or its temperature, are left out.
    """
    if not before or not now:
        return ()
    lines = [f"{name}: is there, and wasn't" for name in now if name not in before]
    lines += [f"{name}: isn't there, and was" for name in before if name not in now]
    for name in (name for name in now if name in before):
        lines += _changed(name, before[name], now[name])
    return tuple(lines)


def _changed(name: str, before: InstrumentSnapshot, now: InstrumentSnapshot) -> Iterator[str]:
    for key in ("maker", "model", "serial_number", "firmware"):
        was, is_now = getattr(before, key), getattr(now, key)
        if was and is_now and was != is_now:  # one that doesn't say it may be the same
            yield f"{name}: {key.replace('_', ' ')} was {was}, is {is_now}"
    if not before.settings or not now.settings:  # recorded before settings were, or by a driver that tells none
        return
    for key in dict.fromkeys((*before.settings, *now.settings)):
        if key in OF_A_CAPTURE or key.startswith("Device"):
            continue
        was, is_now = before.settings.get(key), now.settings.get(key)
        if not _same(was, is_now):
            yield f"{name}: {key} was {format_setting(was)}, is {format_setting(is_now)}"


def _same(was: Value | None, is_now: Value | None) -> bool:
    if isinstance(was, int | float) and isinstance(is_now, int | float):
        return math.isclose(was, is_now, rel_tol=ROUNDING)
    return was == is_now


def format_setting(value: Value | None) -> str:
    """Return a setting's value in words."""
    return "not there" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


#: Rows and columns of a frame, at most: no sensor has more, and a manifest can't ask for any amount of memory.
MOST_PX = 1 << 15


class DataSheet(Open):
    """The manufacturer's data of one camera, which the fits test. None: not known.

    `rows`, `cols`: of the active area, which sees light. `margins`: masked pixels and overscan around it, which the
    frames hold, too.
    """

    rows: int = Field(gt=0, le=MOST_PX)
    cols: int = Field(gt=0, le=MOST_PX)
    margins: Margins = NO_MARGINS
    pixel_pitch_um: float | None = Field(default=None, gt=0)
    fill_factor: float | None = Field(default=None, gt=0, le=1)
    cfa: Cfa
    shutter: Shutter | None = None
    bit_depth: int = Field(ge=1, le=16)
    black_level_dn: float | None = Field(default=None, ge=0)
    white_level_dn: float | None = Field(default=None, gt=0)
    conversion_gain_dn_per_e: float | None = Field(default=None, gt=0)
    full_well_e: float | None = Field(default=None, gt=0)
    read_noise_e: float | None = Field(default=None, ge=0)
    dark_current_e_per_s: float | None = Field(default=None, ge=0)
    dsnu_e: float | None = Field(default=None, ge=0)
    prnu_percent: float | None = Field(default=None, ge=0)
    quantum_efficiency: dict[str, str] | None = None  # channel -> CSV path
    f_number: float | None = Field(default=None, gt=0)
    focal_length_mm: float | None = Field(default=None, gt=0)
    lens_transmittance: float | None = Field(default=None, gt=0, le=1)
    lens_file: str | None = None

    @field_validator("quantum_efficiency", mode="before")
    @classmethod
    def _known_channels(cls, value: Any) -> Any:
        return {key: path for key, path in value.items() if path is not None} if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _keeps_the_mosaic(self) -> Self:
        before = self.margins.lines[0][0], self.margins.lines[1][0]
        if self.cfa != "MONO" and any(number % 2 for number in before):
            raise ValueError(
                f"margins: {before[0]} rows and {before[1]} columns before the active area shift the colour filters; "
                "give an even number of each"
            )
        return self

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the colour channels, in the order R, G, B; `("Y",)` for a MONO sensor."""
        return ("Y",) if self.cfa == "MONO" else ("R", "G", "B")

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns of a frame, margins included."""
        return self.margins.frame_shape(self.rows, self.cols)

    @property
    def saturation_dn(self) -> float:
        """The highest code: `white_level_dn`, or what `bit_depth` allows where that is unknown."""
        return self.white_level_dn if self.white_level_dn is not None else float(2**self.bit_depth - 1)


class Manifest(Open):
    """The file `manifest.json`. `instruments`: by the names of a station's, `camera left` one of them; `changes`: what
    differs of them from the session before, a line each."""

    format: Literal["calibench-recording"] = "calibench-recording"
    version: Literal[1] = 1
    name: str = ""
    notes: str = ""
    cameras: dict[Side, DataSheet]
    instruments: dict[str, InstrumentSnapshot] = {}
    changes: tuple[str, ...] = ()
    captures: tuple[AnyCapture, ...]


class RecordingError(InputError):
    """All that is wrong with a recording set, one line each: what, where, remedy."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


@dataclass
class Findings:
    """Findings of the checks: `problems`, for which a set is refused, and `warnings`."""

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def manifest_json(manifest: Manifest) -> str:
    """Return a manifest as JSON text, with the keys that were given, unknown ones included."""
    kept = manifest.model_dump(mode="json", exclude_unset=True)
    head = {key: getattr(manifest, key) for key in ("format", "version", "name", "notes")}
    return json.dumps(head | kept, indent=1, ensure_ascii=False) + "\n"


def _schema_lines(where: str, error: ValidationError) -> Iterator[str]:
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"])
        if item["type"] == "missing":
            yield f"{where}: the key '{key}' is missing; add it"
        else:
            given = "" if isinstance(item["input"], dict | list) else f" (it is {item['input']!r})"
            yield f"{where}: {key or 'it'}: {item['msg'][:1].lower()}{item['msg'][1:]}{given}; correct it"


def _usable_captures(listed: list[Any], where: str, sides: Container[str], findings: Findings) -> list[Capture]:
    captures: list[Capture] = []
    for number, item in enumerate(listed):
        at = f"{where}: captures[{number}]"
        if not isinstance(item, dict):
            findings.problems.append(f"{at}: isn't an object; write the capture's keys")
            continue
        at += f" ({escaped(str(item['id']))})" if item.get("id") is not None else ""
        if lines := list(complaints_of(item)):
            findings.problems += [f"{at}: {line}" for line in lines]
            continue
        kind = item.get("kind")
        if not isinstance(kind, str):
            findings.problems.append(f"{at}: the kind is {kind!r}; write one of {', '.join(CAPTURES.names)}")
            continue
        if kind not in CAPTURES.models:
            findings.warnings.append(
                f"{at}: unknown kind '{kind}' is skipped; the kinds are {', '.join(CAPTURES.names)}"
            )
            continue
        if why := CAPTURES.models[kind].unsupported(item):
            findings.warnings.append(f"{at}: {why}")
            continue
        try:
            capture = CAPTURES.parse(item)
        except ValidationError as error:
            findings.problems += _schema_lines(at, error)
            continue
        if capture.side not in sides:
            findings.problems.append(f"{at}: no camera '{capture.side}' in cameras; describe it, or correct the side")
            continue
        captures.append(capture)
    return captures


def text_problems(document: Mapping[str, Any], *unasked: str) -> Iterator[str]:
    """Yield a line for each text of a manifest that has control characters, except in the keys `unasked`. Reports of
    instruments are never asked for: nobody can correct them, and they are escaped where they are shown."""
    asked = {key: value for key, value in document.items() if key not in ("instruments", "changes", *unasked)}
    return complaints_of(asked, several_lines=("notes",))


def parse_manifest(text: str, where: str) -> tuple[Manifest, list[str]]:
    """Return the manifest in JSON `text`, and warnings for what was skipped. Raises RecordingError, one line for each
    problem."""
    try:
        raw = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise RecordingError([f"{where}: isn't JSON ({one_line(error)}); write it again"]) from error
    if not isinstance(raw, dict):
        raise RecordingError([f"{where}: isn't a JSON object; write the keys of the recording-set format"])
    if raw.get("format") != "calibench-recording" or raw.get("version") != 1:
        given = f"format {raw.get('format')!r} version {raw.get('version')!r}"
        raise RecordingError([f"{where}: {given}, not 'calibench-recording' 1; give a recording set of that version"])
    findings = Findings()
    findings.problems += [f"{where}: {line}" for line in text_problems(raw, "captures")]
    listed, cameras = raw.get("captures"), raw.get("cameras")
    captures: list[Capture] = []
    if isinstance(listed, list):
        # Errors in the cameras themselves are reported below, once.
        sides = cameras if isinstance(cameras, dict) and cameras else get_args(Side)
        captures = _usable_captures(listed, where, sides, findings)
        raw["captures"] = ()
        if not captures and not findings.problems:
            findings.problems += [*findings.warnings, f"{where}: no capture that can be used; list what was captured"]
    manifest: Manifest | None = None
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:
        findings.problems += _schema_lines(where, error)
    if manifest is not None and not manifest.cameras:
        findings.problems.append(f"{where}: cameras is empty; describe the left camera at least")
    if findings.problems or manifest is None:
        raise RecordingError(findings.problems)
    return without_common_photons(manifest.model_copy(update={"captures": tuple(captures)}), where, findings.warnings)


#: Exposures from which on one number of photons for all flats is taken for that of a setting, not of an exposure: a
#: responsivity needs three different lights, so that nothing is lost.
EXPOSURES_OF_ONE_NUMBER = 3


def without_common_photons(manifest: Manifest, where: str, warnings: list[str]) -> tuple[Manifest, list[str]]:
    """Return the manifest with the numbers of photons taken out of the flats of a side that all state the same one at
    three exposures or more, and `warnings` with a line for each such side."""
    changed: dict[str, Capture] = {}
    for side in manifest.cameras:
        flats = [c for c in manifest.captures if isinstance(c, FlatCapture) and c.side == side and c.photons_per_pixel]
        exposures = {flat.exposure_s for flat in flats}
        if len({flat.photons_per_pixel for flat in flats}) != 1 or len(exposures) < EXPOSURES_OF_ONE_NUMBER:
            continue
        warnings.append(
            f"{where}: all {len(flats)} flats of the {side} camera ({flats[0].id} .. {flats[-1].id}) state "
            f"{flats[0].photons_per_pixel:g} photons a pixel at exposures of {min(exposures):g} to {max(exposures):g} "
            "s; these are numbers of one exposure, so they are taken as unknown: K is fitted, the quantum efficiency "
            "isn't; state the photons of each exposure"
        )
        changed |= {flat.id: flat.model_copy(update={"photons_per_pixel": None}) for flat in flats}
    captures = tuple(changed.get(capture.id, capture) for capture in manifest.captures)
    return manifest.model_copy(update={"captures": captures}) if changed else manifest, warnings
