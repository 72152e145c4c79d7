"""The ColorChecker in white light: a check of colour and linearity that no fit uses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import model_validator

from lab.capture_kinds.base import (
    Capture,
    Equipment,
    Level,
    RelativeExposure,
    Sequence,
    Setting,
    SpectrumPath,
    Step,
    Target,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from lab.capture_kinds.lamp import LAMP_INSTRUMENTS, ColourTemperature, LampLevel, check_lamp, lamp_channels, lamp_words
from lab.errors import InputError
from sim.parameters import Frozen, Quantity
from sim.scene.scenes import Corners, ReflectanceChart, Scene
from sim.spectrum import Spectrum

#: The only chart whose reflectances are known.
KNOWN_CHART = "ColorChecker24"


class ChartLayout(Frozen):
    """Nominal place of the patch grid in one camera's frame: [row, col] (px) of its corners dark skin, bluish green,
    black, white."""

    corners: Corners


class ChartTarget(Target):
    """A reflectance chart."""

    kind: Literal["colorchecker"]
    chart: str = KNOWN_CHART
    left: ChartLayout | None = None
    right: ChartLayout | None = None

    @property
    def instruction(self) -> str:
        return f"put the {self.chart} before the cameras, in the lamp's light"


class ChartSequence(Sequence):
    """`frames` of the chart in white light, after a measurement of the radiance of a white diffuser. With a
    `lamp_level` above 0 in the light source's light of `colour_temperature_k`, else the first of the station file."""

    name: ClassVar[str] = "chart"
    purpose: ClassVar[str] = "check of colour and linearity that no fit uses"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (ChartTarget,)

    frames: Annotated[int, Quantity("1", "frames of the chart", lower=1, upper=1000)] = 4
    level: Level = 0.75
    lamp_level: LampLevel = 0.0
    colour_temperature_k: ColourTemperature = None

    @model_validator(mode="after")
    def _lamp_lit(self) -> Self:
        check_lamp(self.lamp_level, self.colour_temperature_k)
        return self

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls(frames=2 if quick else 4) if cls.possible(station) else None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station, LAMP_INSTRUMENTS if self.lamp_level else None)
        name = station.one(ChartTarget)
        target = station.list_targets(ChartTarget)[name]
        lit, stem = Setting(target=name, wavelength_nm=0.0), "colorchecker"
        if self.lamp_level:
            lit = Setting(target=name, lamp=lamp_channels(station.lights, self.lamp_level, self.colour_temperature_k))
            stem = f"{stem}/{lamp_words(self.lamp_level, self.colour_temperature_k)}"
        made = [exposure_step(stem, "ColorChecker", lit, self.level)]
        light = spectrum_path(made[0].id)
        for frame in range(1, self.frames + 1):
            id = f"{stem}/{frame}"
            captures = []
            for side in station.sides:
                layout = target.left if side == "left" else target.right
                if layout is None:
                    raise InputError(
                        f"station: target {name!r} has no [targets.{name}.{side}] corners; "
                        "add the four [row, col] of the patch grid as this camera sees it"
                    )
                keys = {
                    **{"kind": "chart", "chart": target.chart, "corners": layout.corners, "radiance": light},
                    "colour_temperature_k": self.colour_temperature_k,
                }
                captures.append(ChartCapture.model_validate(planned_keys(id, side) | keys))
            made.append(
                Step(
                    id=id,
                    what=f"ColorChecker, frame {frame} of {self.frames}",
                    setting=lit,
                    exposure=RelativeExposure(of=made[0].id),
                    captures=tuple(captures),
                )
            )
        return tuple(made)


class ChartCapture(Capture):
    """A reflectance chart. `radiance`: of a perfect white diffuser under the same light."""

    shows: ClassVar[str] = "a reflectance chart"
    sequence: ClassVar[type[Sequence] | None] = ChartSequence

    kind: Literal["chart"]
    chart: str
    corners: Corners  # [row, col]: dark skin, bluish green, black, white
    radiance: SpectrumPath

    @classmethod
    def unsupported(cls, document: dict[str, Any]) -> str | None:
        if document.get("chart") in (None, KNOWN_CHART):
            return None
        return f"unknown chart {document['chart']!r} is skipped; only {KNOWN_CHART} is known"

    def problems(self, rows: int, cols: int) -> Iterator[str]:
        for row, col in self.corners:
            if not (-0.5 <= row <= rows - 0.5 and -0.5 <= col <= cols - 0.5):
                yield f"corner [{row:g}, {col:g}] is outside the frame of {rows} x {cols}; give [row, col]"

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Scene | None:
        return ReflectanceChart(self.corners, spectrum(self.radiance), self.chart)


KIND = ChartCapture
