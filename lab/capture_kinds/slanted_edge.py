"""Slanted edges (ISO 12233): the modulation transfer function by field position and orientation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

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
from sim.parameters import Frozen, Quantity


class EdgeLayout(Frozen):
    """Nominal place of one edge in a frame: `region` (row0, col0, row1, col1) in px, end excluded; `angle_deg` from the
    vertical; `field_mm`: [row, col] of its centre from the optical axis, at the sensor."""

    name: str
    region: tuple[int, int, int, int]
    angle_deg: float
    field_mm: tuple[float, float]


class EdgeLayouts(Frozen):
    """The edges in one camera's frame."""

    regions: tuple[EdgeLayout, ...]


class EdgeTarget(Target):
    """A knife edge before the sphere."""

    kind: Literal["slanted_edge"]
    angle_deg: float
    left: EdgeLayouts | None = None
    right: EdgeLayouts | None = None

    @property
    def instruction(self) -> str:
        return f"put the knife edge before the sphere, {self.angle_deg:g} degrees from the vertical"


class EdgeSequence(Sequence):
    """`frames` of every knife edge of the station. A frame shows the edge in several regions; each region is a capture
    of its own."""

    name: ClassVar[str] = "edge"
    purpose: ClassVar[str] = "MTF over the field and over orientations"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (EdgeTarget,)

    frames: Annotated[int, Quantity("1", "frames of each edge", lower=1, upper=1000)] = 4
    level: Level = 0.7

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls(frames=2 if quick else 4) if cls.possible(station) else None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        station.one(EdgeTarget)
        made: list[Step] = []
        for name, edge in station.list_targets(EdgeTarget).items():
            lit = Setting(target=name, wavelength_nm=0.0)
            found = exposure_step(f"edge/{name}", f"slanted edge {name}", lit, self.level)
            light = spectrum_path(found.id)
            made.append(found)
            for frame in range(1, self.frames + 1):
                id = f"edge/{name}/{frame}"
                captures = []
                for side in station.sides:
                    layout = edge.left if side == "left" else edge.right
                    for region in () if layout is None else layout.regions:
                        keys = planned_keys(id, side) | {
                            "id": f"{name}-{frame}-{region.name}-{side}",
                            "kind": "slanted_edge",
                            "region": region.region,
                            "angle_deg": region.angle_deg,
                            "light_radiance": light,
                            "field_mm": region.field_mm,
                        }
                        captures.append(SlantedEdgeCapture.model_validate(keys))
                made.append(
                    Step(
                        id=id,
                        what=f"slanted edge {name} at {edge.angle_deg:g} deg, frame {frame} of {self.frames}",
                        setting=lit,
                        exposure=RelativeExposure(of=found.id),
                        captures=tuple(captures),
                    )
                )
        return tuple(made)


class SlantedEdgeCapture(Capture):
    """One straight edge in `region` (row0, col0, row1, col1, end excluded); None: the edges are searched for.

    `angle_deg`: from the vertical, nominal; positive turns the edge's top to the right.
    """

    shows: ClassVar[str] = "a straight edge in each region"
    sequence: ClassVar[type[Sequence] | None] = EdgeSequence
    shares_frame: ClassVar[bool] = True

    kind: Literal["slanted_edge"]
    region: tuple[int, int, int, int] | None = None
    angle_deg: float | None = None
    dark_radiance: SpectrumPath | None = None
    light_radiance: SpectrumPath | None = None
    field_mm: tuple[float, float] | None = None  # [row, col] from the optical axis, at the sensor

    def problems(self, rows: int, cols: int) -> Iterator[str]:
        if self.region is None:
            return
        row0, col0, row1, col1 = self.region
        if not (0 <= row0 < row1 <= rows and 0 <= col0 < col1 <= cols):
            yield (
                f"region {list(self.region)} isn't inside the frame of {rows} x {cols}; "
                "give [row0, col0, row1, col1], end excluded"
            )


KIND = SlantedEdgeCapture
