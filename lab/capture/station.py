"""The station: which instruments stand where, what the makers say of the cameras, and which targets are at hand.

A station file is TOML; `calibench bench --station FILE` writes one for the mock bench. Everything here is the lab's own
knowledge: addresses, data sheets, nominal layouts. Nothing in it is measured, and nothing in it is believed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.camera.base import Camera as CameraDriver
from drivers.display.base import Display
from drivers.errors import InstrumentError
from drivers.instrument import Instrument
from drivers.monochromator.base import Monochromator
from drivers.registry import driver
from drivers.spectroradiometer.base import Spectroradiometer
from drivers.stage.base import Stage
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import Camera, parse_spectrum
from sim.camera import Side
from sim.parameters import Frozen
from sim.spectrum import Spectrum

T = TypeVar("T")


class Address(BaseModel):
    """Which driver reaches an instrument, and where. Further keys are the driver's own settings."""

    model_config = ConfigDict(frozen=True, extra="allow")

    driver: str
    address: str

    @property
    def settings(self) -> dict[str, Any]:
        """The keys that only the driver understands."""
        return dict(self.model_extra or {})


class StationCamera(Address):
    """One camera: how to reach it, and the maker's word on it.

    `datasheet` has the recording set's keys; its `quantum_efficiency`, inline curves (or paths of CSV files beside the
    station file), is taken out into `quantum_efficiency` here.
    """

    datasheet: Camera
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


class Cap(Frozen):
    """No light reaches the cameras."""

    kind: Literal["cap"]


class Sphere(Frozen):
    """The port of the integrating sphere: uniform diffuse light from the monochromator."""

    kind: Literal["sphere"]


class ChartLayout(Frozen):
    corners: tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]


class ReflectanceChart(Frozen):
    kind: Literal["colorchecker"]
    chart: str = "ColorChecker24"
    left: ChartLayout | None = None
    right: ChartLayout | None = None


class EdgeRegion(Frozen):
    """Where one edge lies in a frame, nominally."""

    name: str
    region: tuple[int, int, int, int]
    angle_deg: float
    field_mm: tuple[float, float]


class EdgeLayout(Frozen):
    regions: tuple[EdgeRegion, ...]


class KnifeEdge(Frozen):
    """A knife edge before the sphere."""

    kind: Literal["slanted_edge"]
    angle_deg: float
    left: EdgeLayout | None = None
    right: EdgeLayout | None = None


class ScreenLayout(Frozen):
    camera_px_per_screen_px: float = Field(gt=0)
    visible: tuple[int, int, int, int]  # in screen px: what surely lies inside the frame


class ScreenTarget(Frozen):
    """The screen that the display driver draws on."""

    kind: Literal["screen"]
    rows: int = Field(gt=0)
    cols: int = Field(gt=0)
    pixel_mm: float = Field(gt=0)
    left: ScreenLayout | None = None
    right: ScreenLayout | None = None


class CharucoBoard(Frozen):
    """One pose of a ChArUco board."""

    kind: Literal["charuco"]
    dictionary: str
    squares: tuple[int, int]
    square_mm: float = Field(gt=0)
    marker_mm: float = Field(gt=0)
    pose: str


Target = Annotated[
    Cap | Sphere | ReflectanceChart | KnifeEdge | ScreenTarget | CharucoBoard, Field(discriminator="kind")
]
TargetT = TypeVar("TargetT", Cap, Sphere, ReflectanceChart, KnifeEdge, ScreenTarget, CharucoBoard)


class Limits(Frozen):
    """What the sequences keep to."""

    exposure_min_s: float = Field(default=20e-6, gt=0)
    exposure_max_s: float = Field(default=10.0, gt=0)
    gain_db: float = 0.0
    slit_um: float | None = Field(default=None, gt=0)  # None: as the instrument stands


class Station(Frozen):
    """What is where. `cameras` has a left one at least; an instrument that isn't there is None."""

    name: str = ""
    monochromator: Address | None = None
    spectroradiometer: Address | None = None
    display: Address | None = None
    stage: Address | None = None
    cameras: dict[Side, StationCamera] = Field(min_length=1)
    targets: dict[str, Target] = {}
    limits: Limits = Limits()

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides that have a camera, left first."""
        return tuple(sorted(self.cameras))

    def having(self, kind: type[TargetT]) -> dict[str, TargetT]:
        """Targets of one kind by name, in the station file's order."""
        return {name: target for name, target in self.targets.items() if isinstance(target, kind)}

    def one(self, kind: type[TargetT]) -> str:
        """Name of the first target of one kind. Raises InputError if the station has none."""
        for name in self.having(kind):
            return name
        wanted = kind.model_fields["kind"].annotation
        raise InputError(
            f"station: no target of kind {wanted.__args__[0]!r}; add one under [targets] of the station file"  # type: ignore[union-attr]
        )


def _with_curves(tables: Any, folder: Path) -> Any:
    """CSV paths of quantum efficiencies replaced by the curves in them."""
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
        yield f"{key or 'it'}: {item['msg']}"


def read_station(path: str | Path) -> Station:
    """The station in a TOML file. Raises InputError with one line that names every key that can't be used."""
    file = Path(path)
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{file}: can't be read ({error.strerror}); give a station file, `calibench bench --station FILE` writes one"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: isn't TOML ({error}); correct that place") from error
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

    @property
    def all(self) -> dict[str, Instrument]:
        """Every driver by the name that messages use."""
        named: dict[str, Instrument | None] = {
            "monochromator": self.monochromator,
            "stage": self.stage,
            "display": self.display,
            "spectroradiometer": self.spectroradiometer,
        }
        named |= {f"camera {side}": camera for side, camera in self.cameras.items()}
        return {name: found for name, found in named.items() if found is not None}


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
    """The drivers that a station file names. Raises InputError for settings that a driver doesn't know, DeviceError if
    there is no such driver."""

    def made(family: str, entry: Address | None) -> Any:
        return entry and _make(family, family, entry.driver, entry.address, entry.settings)

    return Drivers(
        cameras={
            side: cast(CameraDriver, _make("camera", f"cameras.{side}", entry.driver, entry.address, entry.settings))
            for side, entry in station.cameras.items()
        },
        stage=made("stage", station.stage),
        monochromator=made("monochromator", station.monochromator),
        spectroradiometer=made("spectroradiometer", station.spectroradiometer),
        display=made("display", station.display),
    )
