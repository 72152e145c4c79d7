"""The station: the instruments and their addresses, the cameras' data sheets, and the targets at hand.

A station file is TOML; `calibench bench --station FILE` writes one for the mock bench. It holds what the lab knows
beforehand: addresses, data sheets, nominal layouts. Nothing in it is measured. The kinds of target are in
`lab.capture_kinds`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar, cast, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.camera.base import Camera as CameraDriver
from drivers.display.base import Display
from drivers.errors import InstrumentError
from drivers.instrument import Instrument
from drivers.light_source.base import LightSource
from drivers.monochromator.base import Monochromator
from drivers.photodiode.base import Photodiode
from drivers.registry import driver
from drivers.spectroradiometer.base import Spectroradiometer
from drivers.stage.base import Stage
from lab.capture_kinds.base import AnyTarget, CaptureLimits, Target, TargetT
from lab.capture_kinds.lamp import LampLight
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import DataSheet
from lab.formats.spectrum_csv import parse_spectrum
from lab.formats.toml_file import read_toml
from sim.camera import Side
from sim.parameters import Frozen
from sim.spectrum import Spectrum

T = TypeVar("T")

_FAMILIES = ("monochromator", "spectroradiometer", "photodiode", "light_source", "display", "stage")


class Address(BaseModel):
    """Which driver reaches an instrument, and where. Further keys are the driver's own settings."""

    model_config = ConfigDict(frozen=True, extra="allow")

    driver: str
    address: str = ""

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        if "address" not in self.model_fields_set and self.driver != "prompt":
            raise ValueError("address is missing; only the driver prompt, which asks a person, needs none")
        return self

    @property
    def settings(self) -> dict[str, Any]:
        """The keys that only the driver understands."""
        return dict(self.model_extra or {})


class StationCamera(Address):
    """One camera: its address and its data sheet.

    `datasheet` has the recording set's keys. Its `quantum_efficiency`, inline curves or paths of CSV files beside the
    station file, is moved to `quantum_efficiency` here.
    """

    datasheet: DataSheet
    quantum_efficiency: dict[str, Spectrum] = {}

    @model_validator(mode="before")
    @classmethod
    def _curves_apart(cls, value: Any) -> Any:
        if not isinstance(value, dict) or not isinstance(value.get("datasheet"), dict):
            return value
        sheet = dict(value["datasheet"])
        curves = sheet.pop("quantum_efficiency", None)
        return {"quantum_efficiency": curves or {}, **value, "datasheet": sheet}

    @model_validator(mode="after")
    def _known_keys(self) -> StationCamera:
        if unknown := self.datasheet.unknown_keys():
            raise ValueError(f"unknown key {', '.join(unknown)} in the data sheet; correct its spelling or take it out")
        return self


class StationLightSource(Address):
    """The light source: its address, and its lights by name. The first of them is the one that is used where nobody
    asks for another."""

    lights: dict[str, LampLight] = Field(min_length=1)


class Station(Frozen):
    """The content of a station file. `cameras` has a left one at least. None: the station has no such instrument.

    resume_automatically : whether the service resumes a session whose process died
    """

    name: str = ""
    resume_automatically: bool = False
    monochromator: Address | None = None
    spectroradiometer: Address | None = None
    photodiode: Address | None = None
    light_source: StationLightSource | None = None
    display: Address | None = None
    stage: Address | None = None
    cameras: dict[Side, StationCamera] = Field(min_length=1)
    targets: dict[str, AnyTarget] = {}
    limits: CaptureLimits = CaptureLimits()

    @model_validator(mode="after")
    def _one_instrument_a_port(self) -> Station:
        taken: dict[str, str] = {}
        tables = {family: getattr(self, family) for family in _FAMILIES}
        tables |= {f"cameras.{side}": camera for side, camera in self.cameras.items()}
        for table, entry in tables.items():
            if entry is None or not entry.address:
                continue
            # A port has several names: /dev/ttyUSB0, and a link in /dev/serial/by-id.
            port = str(Path(entry.address).resolve()) if entry.address.startswith("/") else entry.address
            first_table = taken.setdefault(port, table)
            if first_table != table:
                raise ValueError(
                    f"[{first_table}] and [{table}] both have the address {port}; one port serves one instrument: "
                    "correct one of them"
                )
        return self

    @property
    def addresses(self) -> frozenset[str]:
        """The addresses of its instruments, without those that have none (a person at a prompt) and so can't be
        shared."""
        entries = [*(getattr(self, family) for family in _FAMILIES), *self.cameras.values()]
        return frozenset(entry.address for entry in entries if entry is not None and entry.address)

    @property
    def machines(self) -> Station:
        """The station without those instruments that have no address (a person at a prompt), whom nothing reaches or
        stops."""
        people = [family for family in _FAMILIES if (entry := getattr(self, family)) is not None and not entry.address]
        return self.model_copy(update=dict.fromkeys(people))

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides that have a camera, left first."""
        return tuple(sorted(self.cameras))

    @property
    def lights(self) -> Mapping[str, LampLight]:
        """The lights of the light source by name; none where the station has no light source."""
        return {} if self.light_source is None else self.light_source.lights

    @property
    def f_number(self) -> float:
        """That of the cameras' data sheets. Raises InputError where one has none, or another one."""
        stated = {camera.datasheet.f_number for camera in self.cameras.values()}
        if len(stated) > 1 or None in stated:
            raise InputError(
                "station: the data sheets have no f_number, or not one and the same; "
                "give it under [cameras.SIDE.datasheet]"
            )
        return float(stated.pop() or 0.0)

    def frame_px(self, side: Side) -> tuple[int, int]:
        """Return rows and columns of one camera's frame."""
        sheet = self.cameras[side].datasheet
        return sheet.rows, sheet.cols

    @property
    def devices(self) -> dict[str, Address]:
        """Its instruments by the name of their table: `monochromator`, `cameras.left`."""
        addresses: dict[str, Address | None] = {family: getattr(self, family) for family in _FAMILIES}
        addresses |= {f"cameras.{side}": self.cameras[side] for side in self.sides}
        return {name: entry for name, entry in addresses.items() if entry is not None}

    def list_targets(self, kind: type[TargetT]) -> dict[str, TargetT]:
        """Return the targets of one kind by name, in the station file's order."""
        return {name: target for name, target in self.targets.items() if isinstance(target, kind)}

    def one(self, kind: type[Target]) -> str:
        """Name of the first target of one kind. Raises InputError if the station has none."""
        for name in self.list_targets(kind):
            return name
        wanted = get_args(kind.model_fields["kind"].annotation)[0]
        raise InputError(f"station: no target of kind {wanted!r}; add one under [targets] of the station file")

    def lacks(self, *families: str) -> tuple[str, ...]:
        """Return the instrument families that the station doesn't have."""
        return tuple(family for family in families if getattr(self, family) is None)


def _with_curves(tables: Any, folder: Path) -> Any:
    """Return the tables with CSV paths of quantum efficiencies replaced by their curves."""
    if not isinstance(tables, dict) or not isinstance(tables.get("cameras"), dict):
        return tables
    for side, camera in tables["cameras"].items():
        sheet = camera.get("datasheet") if isinstance(camera, dict) else None
        curves = sheet.get("quantum_efficiency") if isinstance(sheet, dict) else None
        if not isinstance(curves, dict):
            curves = {}
        for channel, curve in list(curves.items()):
            if isinstance(curve, str):
                where = f"{folder / curve} (cameras.{side}.datasheet.quantum_efficiency.{channel})"
                try:
                    curves[channel] = parse_spectrum((folder / curve).read_text(encoding="utf-8")).model_dump()
                except (OSError, UnicodeDecodeError, InputError) as error:
                    raise InputError(f"{where}: {error}") from error
        if isinstance(sheet, dict) and sheet.get("lens_file"):
            sheet["lens_file"] = str((folder / sheet["lens_file"]).resolve())
    return tables


def _complaints(error: ValidationError) -> Iterator[str]:
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"])
        problem = item["msg"].removeprefix("Value error, ")
        yield f"{key}: {problem}" if key else problem


def read_station(path: str | Path) -> Station:
    r"""Return the station in a TOML file. Raises InputError, one line that names every wrong key.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "station.toml"
    ...     left = 'driver = "u3v"\naddress = "usb://CAM-1"\n'
    ...     sheet = 'rows = 480\ncols = 640\ncfa = "MONO"\nbit_depth = 12\n'
    ...     _ = file.write_text(f'name = "bench"\n[cameras.left]\n{left}[cameras.left.datasheet]\n{sheet}')
    ...     read_station(file).name
    'bench'
    """
    file = Path(path)
    tables = read_toml(file, "give a station file, `calibench bench --station FILE` writes one")
    try:
        return Station.model_validate(_with_curves(tables, file.parent))
    except ValidationError as error:
        raise InputError(f"{file}: {'; '.join(_complaints(error))}; correct these keys") from error


@dataclass(frozen=True)
class Drivers:
    """The drivers of a station, not yet connected."""

    cameras: dict[Side, CameraDriver]
    stage: Stage | None = None
    monochromator: Monochromator | None = None
    spectroradiometer: Spectroradiometer | None = None
    display: Display | None = None
    photodiode: Photodiode | None = None
    light_source: LightSource | None = None

    @property
    def all(self) -> dict[str, Instrument]:
        """Every driver by the name that messages use."""
        named: dict[str, Instrument | None] = {
            "monochromator": self.monochromator,
            "stage": self.stage,
            "display": self.display,
            "spectroradiometer": self.spectroradiometer,
            "photodiode": self.photodiode,
            "light_source": self.light_source,
        }
        named |= {f"camera {side}": camera for side, camera in self.cameras.items()}
        return {name: address for name, address in named.items() if address is not None}


def _make(family: str, where: str, name: str, address: str, settings: dict[str, Any]) -> Any:
    try:
        return driver(family, name)(address, **settings)
    except TypeError as error:
        raise InputError(
            f"station: [{where}]: the driver {name!r} doesn't take these keys ({error}); correct them"
        ) from error
    except InstrumentError as error:
        raise DeviceError(str(error)) from error


def drivers_of(station: Station) -> Drivers:
    """Return the drivers that a station file names. Raises InputError for settings that a driver doesn't know,
    DeviceError if there is no such driver."""

    def make_driver(family: str, entry: Address | None) -> Any:
        return entry and _make(family, family, entry.driver, entry.address, entry.settings)

    stage = make_driver("stage", station.stage)
    if stage is not None:
        stage.instruct({name: target.instruction for name, target in station.targets.items()})
    return Drivers(
        cameras={
            side: cast(CameraDriver, _make("camera", f"cameras.{side}", entry.driver, entry.address, entry.settings))
            for side, entry in station.cameras.items()
        },
        stage=stage,
        monochromator=make_driver("monochromator", station.monochromator),
        spectroradiometer=make_driver("spectroradiometer", station.spectroradiometer),
        display=make_driver("display", station.display),
        photodiode=make_driver("photodiode", station.photodiode),
        light_source=make_driver("light_source", station.light_source),
    )
