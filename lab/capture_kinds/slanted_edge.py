"""Slanted edges (ISO 12233): the modulation transfer function by field position and orientation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

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
from lab.errors import InputError
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
    """`frames` of every knife edge of the station, or of `edges` alone. A frame shows the edge in several regions; each
    region is a capture of its own. `wavelength_nm`: of the light, 0 is white."""

    name: ClassVar[str] = "edge"
    purpose: ClassVar[str] = "MTF over the field and over orientations"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (EdgeTarget,)

    frames: Annotated[int, Quantity("1", "frames of each edge", lower=1, upper=1000)] = 4
    level: Level = 0.7
    wavelength_nm: Annotated[float, Quantity("nm", "wavelength of the light; 0: white", lower=0.0, upper=5000.0)] = 0.0
    edges: tuple[str, ...] = ()  # names of the targets; empty: all

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls(frames=2 if quick else 4) if cls.possible(station) else None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        return edge_steps(self, station, "edge", SlantedEdgeCapture)


def edge_steps(
    sequence: EdgeSequence,
    station: Equipment,
    stem: str,
    kind: type[EdgeCapture],
    by_hand: tuple[str, ...] = (),
    **keys: Any,
) -> tuple[Step, ...]:
    """Return the steps of a sequence's edges, whose ids begin with `stem`; `keys`: further ones of the captures,
    `by_hand`: adjustments. Raises InputError where the station lacks one of the edges."""
    station.one(EdgeTarget)
    there = station.list_targets(EdgeTarget)
    if unknown := [name for name in sequence.edges if name not in there]:
        raise InputError(f"edge.edges: the station has no knife edge {unknown[0]!r}; it has {', '.join(there)}")
    light_nm = sequence.wavelength_nm
    stem = f"{stem}/{light_nm:g}nm" if light_nm else stem
    prefix = stem.partition("/")[2].replace("/", "-")
    slit_um = station.limits.slit_um if light_nm else None
    made: list[Step] = []
    for name in sequence.edges or there:
        edge = there[name]
        lit = Setting(target=name, wavelength_nm=light_nm, slit_um=slit_um, by_hand=by_hand)
        found = exposure_step(f"{stem}/{name}", f"slanted edge {name}", lit, sequence.level)
        light = spectrum_path(found.id)
        made.append(found)
        for frame in range(1, sequence.frames + 1):
            id = f"{stem}/{name}/{frame}"
            captures = []
            for side in station.sides:
                layout = edge.left if side == "left" else edge.right
                for region in () if layout is None else layout.regions:
                    own = {
                        "id": "-".join(filter(None, (prefix, name, str(frame), region.name, side))),
                        "kind": get_args(kind.model_fields["kind"].annotation)[0],
                        "region": region.region,
                        "angle_deg": region.angle_deg,
                        "light_radiance": light,
                        "field_mm": region.field_mm,
                    }
                    captures.append(kind.model_validate(planned_keys(id, side) | own | keys))
            made.append(
                Step(
                    id=id,
                    what=f"slanted edge {name} at {edge.angle_deg:g} deg, frame {frame} of {sequence.frames}",
                    setting=lit,
                    exposure=RelativeExposure(of=found.id),
                    captures=tuple(captures),
                )
            )
    return tuple(made)


class EdgeCapture(Capture):
    """One straight edge in `region` (row0, col0, row1, col1, end excluded); None: the edges are searched for.

    `angle_deg`: from the vertical, nominal; positive turns the edge's top to the right.
    """

    shares_frame: ClassVar[bool] = True

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


class SlantedEdgeCapture(EdgeCapture):
    """A straight edge, in the light of `light_radiance`, at the data sheet's f-number."""

    shows: ClassVar[str] = "a straight edge in each region"
    sequence: ClassVar[type[Sequence] | None] = EdgeSequence

    kind: Literal["slanted_edge"]


KIND = SlantedEdgeCapture
