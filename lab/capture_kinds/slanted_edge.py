"""Slanted edges (ISO 12233): the modulation transfer function by field position and orientation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import Field, model_validator

from lab.capture_kinds.base import (
    Adjustment,
    Capture,
    Equipment,
    Level,
    RelativeExposure,
    Sequence,
    Setting,
    SpectrumPath,
    Step,
    Target,
    back_step,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from lab.capture_kinds.lamp import LAMP_INSTRUMENTS, ColourTemperature, LampLevel, check_lamp, lamp_channels, lamp_words
from lab.errors import InputError
from sim.camera import Side
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


class TurnTarget(Adjustment):
    """How far the holder of the knife edges is turned by hand about the middle of the frames, its top to the right
    (deg); 0 is one, too, the usual one."""

    changes: ClassVar[str] = "the knife edges' holder"

    kind: Literal["turn"]
    angle_deg: float = Field(ge=-180.0, le=180.0)

    @property
    def instruction(self) -> str:
        if self.angle_deg == 0.0:
            return "turn the holder of the knife edges back to its usual place, and move nothing else"
        to = "right" if self.angle_deg > 0.0 else "left"
        by = f"by {abs(self.angle_deg):g} degrees from its usual place, its top to the {to}"
        return f"turn the holder of the knife edges {by}, and move nothing else"

    def is_usual(self, station: Equipment) -> bool:
        return self.angle_deg == 0.0


def turn_layout(region: EdgeLayout, turn_deg: float, rows: int, cols: int) -> EdgeLayout | None:
    """Return where an edge lies in a frame after its holder was turned about the middle of the frame.

    region : where it lies before
    turn_deg : positive takes the top of the edge to the right; the angle stays within -45 to 135 deg
    rows, cols : of the frame, px

    Returns None where the region is no longer whole in the frame.

    >>> edge = EdgeLayout(name="top", region=(0, 40, 20, 60), angle_deg=5.0, field_mm=(0.0, 0.0))
    >>> turn_layout(edge, 90.0, 100, 100).region
    (40, 80, 60, 100)
    """
    turn = math.radians(turn_deg)
    row0, col0, row1, col1 = region.region
    at_row, at_col = _turn_place(0.5 * (row0 + row1 - rows), 0.5 * (col0 + col1 - cols), turn)
    top, left = round(0.5 * rows + at_row - 0.5 * (row1 - row0)), round(0.5 * cols + at_col - 0.5 * (col1 - col0))
    place = (top, left, top + row1 - row0, left + col1 - col0)
    if top < 0 or left < 0 or place[2] > rows or place[3] > cols:
        return None
    field_row, field_col = _turn_place(*region.field_mm, turn)
    angle = (region.angle_deg + turn_deg + 45.0) % 180.0 - 45.0
    return EdgeLayout(
        name=region.name, region=place, angle_deg=round(angle, 6), field_mm=(round(field_row, 4), round(field_col, 4))
    )


def _turn_place(row: float, col: float, turn: float) -> tuple[float, float]:
    """Return a place after a turn (rad) about the origin that takes the top, towards negative rows, to the right."""
    return row * math.cos(turn) + col * math.sin(turn), col * math.cos(turn) - row * math.sin(turn)


class EdgeSequence(Sequence):
    """`frames` of every knife edge of the station, or of `edges` alone. A frame shows the edge in several regions; each
    region is a capture of its own. `wavelength_nm`: of the light, 0 is white. `turn_deg`: by how much an operator's
    hand turns the edges for it, and back at its end. With a `lamp_level` above 0 the light source lights the edges: its
    light of `colour_temperature_k`, or of `wavelength_nm`, else the first of the station file."""

    name: ClassVar[str] = "edge"
    purpose: ClassVar[str] = "MTF over the field and over orientations"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (EdgeTarget,)
    adjustments: ClassVar[tuple[type[Adjustment], ...]] = (TurnTarget,)

    frames: Annotated[int, Quantity("1", "frames of each edge", lower=1, upper=1000)] = 4
    level: Level = 0.7
    wavelength_nm: Annotated[float, Quantity("nm", "wavelength of the light; 0: white", lower=0.0, upper=5000.0)] = 0.0
    turn_deg: Annotated[
        float,
        Quantity("deg", "turn of the knife edges by hand, their top to the right; 0: none", lower=-180.0, upper=180.0),
    ] = 0.0
    lamp_level: LampLevel = 0.0
    colour_temperature_k: ColourTemperature = None
    edges: tuple[str, ...] = ()  # names of the targets; empty: all

    @model_validator(mode="after")
    def _lamp_lit(self) -> Self:
        check_lamp(self.lamp_level, self.colour_temperature_k)
        return self

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls(frames=2 if quick else 4) if cls.possible(station) else None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station, LAMP_INSTRUMENTS if self.lamp_level else None)
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
    if sequence.lamp_level:
        stem = f"{stem}/{lamp_words(sequence.lamp_level, sequence.colour_temperature_k)}"
    if sequence.turn_deg:
        stem = f"{stem}/turned{sequence.turn_deg:g}"
        by_hand = (*by_hand, _turn_of(station, sequence.turn_deg))
    prefix = stem.partition("/")[2].replace("/", "-")
    usual = Setting(
        target=None,
        wavelength_nm=light_nm,
        slit_um=station.limits.slit_um if light_nm else None,
        by_hand=by_hand,
    )
    if sequence.lamp_level:
        channels = lamp_channels(station.lights, sequence.lamp_level, sequence.colour_temperature_k, light_nm)
        usual = Setting(target=None, by_hand=by_hand, lamp=channels)
    made: list[Step] = []
    for name in sequence.edges or there:
        edge = there[name]
        lit = usual.model_copy(update={"target": name})
        exposed = exposure_step(f"{stem}/{name}", f"slanted edge {name}", lit, sequence.level)
        light = spectrum_path(exposed.id)
        made.append(exposed)
        for frame in range(1, sequence.frames + 1):
            id = f"{stem}/{name}/{frame}"
            captures = []
            for side in station.sides:
                layout = edge.left if side == "left" else edge.right
                for region in _regions(layout, sequence.turn_deg, station, side):
                    geometry = {
                        "id": "-".join(filter(None, (prefix, name, str(frame), region.name, side))),
                        "kind": get_args(kind.model_fields["kind"].annotation)[0],
                        "region": region.region,
                        "angle_deg": region.angle_deg,
                        "light_radiance": light,
                        "field_mm": region.field_mm,
                        "colour_temperature_k": sequence.colour_temperature_k,
                    }
                    captures.append(kind.model_validate(planned_keys(id, side) | geometry | keys))
            made.append(
                Step(
                    id=id,
                    what=f"slanted edge {name} at {edge.angle_deg:g} deg, frame {frame} of {sequence.frames}",
                    setting=lit,
                    exposure=RelativeExposure(of=exposed.id),
                    captures=tuple(captures),
                )
            )
    if sequence.turn_deg:
        if not any(step.captures for step in made):
            raise InputError(
                f"edge.turn_deg: {sequence.turn_deg:g}: no edge stays whole in the frame after that turn; take a "
                "smaller one, or place an edge nearer to the middle"
            )
        made.append(back_step(stem, TurnTarget, station))
    return tuple(made)


def _regions(layout: EdgeLayouts | None, turn_deg: float, station: Equipment, side: Side) -> Iterator[EdgeLayout]:
    """Yield the edges in one camera's frame, after their turn."""
    for region in () if layout is None else layout.regions:
        turned = turn_layout(region, turn_deg, *station.frame_px(side)) if turn_deg else region
        if turned is not None:
            yield turned


def _turn_of(station: Equipment, turn_deg: float) -> str:
    """Return the name of the target that is the turn. Raises InputError where the station has none."""
    turns = {turn.angle_deg: name for name, turn in station.list_targets(TurnTarget).items()}
    if turn_deg in turns:
        return turns[turn_deg]
    have = ", ".join(f"{angle_deg:g}" for angle_deg in sorted(turns)) or "none"
    raise InputError(
        f"station: no target of kind 'turn' with angle_deg = {turn_deg:g}; it has {have}; add "
        f'[targets."turn {turn_deg:g}"] to the station file if the knife edges can be turned so'
    )


class EdgeCapture(Capture):
    """One straight edge in `region` (row0, col0, row1, col1, end excluded); None: the edges are searched for.

    `angle_deg`: from the vertical, nominal; positive turns the edge's top to the right.
    """

    shares_frame: ClassVar[bool] = True
    codes_are_fitted: ClassVar[bool] = False  # its levels are free

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
