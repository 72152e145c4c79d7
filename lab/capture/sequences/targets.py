"""Targets before the cameras: the ColorChecker, slanted edges, and patterns on the screen."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lab.capture.sequences.steps import (
    FindExposure,
    RelativeExposure,
    Sequence,
    Setting,
    Step,
    common,
    needs,
    spectrum_path,
)
from lab.capture.station import KnifeEdge, ReflectanceChart, ScreenTarget, Station
from lab.errors import InputError
from lab.formats.recording_set import AnyCapture, Bernoulli, Black, Chart, Checkerboard, SlantedEdge, White
from sim.parameters import Frozen

Cells = NDArray[np.uint8]
#: Side of a square of the checkerboard that aligns the screen, in cells.
SQUARE_CELLS = 8


class ChartSequence(Sequence):
    """`frames` of the ColorChecker in white light, with the radiance of its white diffuser."""

    frames: int = Field(default=4, ge=1)
    level: float = 0.75

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        needs(station, "colorchecker", "monochromator", "spectroradiometer")
        name = station.one(ReflectanceChart)
        target = station.having(ReflectanceChart)[name]
        lit = Setting(target=name, wavelength_nm=0.0)
        light = spectrum_path("colorchecker/exposure")
        made = [
            Step(
                id="colorchecker/exposure",
                what="ColorChecker: finding the exposure, measuring the light",
                setting=lit,
                radiance=light,
                exposure=FindExposure(level=self.level),
            )
        ]
        for frame in range(1, self.frames + 1):
            id = f"colorchecker/{frame}"
            captures: list[AnyCapture] = []
            for side in station.sides:
                layout = getattr(target, side)
                if layout is None:
                    raise InputError(
                        f"station: target {name!r} has no [targets.{name}.{side}] corners; "
                        "add the four [row, col] of the patch grid as this camera sees it"
                    )
                keys = {"kind": "chart", "chart": target.chart, "corners": layout.corners, "radiance": light}
                captures.append(Chart.model_validate(common(id, side) | keys))
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


class EdgeSequence(Sequence):
    """`frames` of every knife edge at hand: each frame has an edge in several regions, one capture a region."""

    frames: int = Field(default=4, ge=1)
    level: float = 0.7

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        needs(station, "edge", "monochromator", "spectroradiometer")
        edges = station.having(KnifeEdge)
        if not edges:
            station.one(KnifeEdge)
        made: list[Step] = []
        for name, edge in edges.items():
            lit = Setting(target=name, wavelength_nm=0.0)
            find = f"edge/{name}/exposure"
            light = spectrum_path(find)
            made.append(
                Step(
                    id=find,
                    what=f"slanted edge {name}: finding the exposure, measuring the light",
                    setting=lit,
                    radiance=light,
                    exposure=FindExposure(level=self.level),
                )
            )
            for frame in range(1, self.frames + 1):
                id = f"edge/{name}/{frame}"
                captures: list[AnyCapture] = []
                for side in station.sides:
                    layout = getattr(edge, side)
                    for region in () if layout is None else layout.regions:
                        keys = common(id, side) | {
                            "id": f"{name}-{frame}-{region.name}-{side}",
                            "kind": "slanted_edge",
                            "region": region.region,
                            "angle_deg": region.angle_deg,
                            "light_radiance": light,
                            "field_mm": region.field_mm,
                        }
                        captures.append(SlantedEdge.model_validate(keys))
                made.append(
                    Step(
                        id=id,
                        what=f"slanted edge {name} at {edge.angle_deg:g} deg, frame {frame} of {self.frames}",
                        setting=lit,
                        exposure=RelativeExposure(of=find),
                        captures=tuple(captures),
                    )
                )
        return tuple(made)


class _Grid(Frozen):
    """Cells on the screen: so many rows and columns of cells of so many screen pixels."""

    rows: int
    cols: int
    cell_px: int


class ScreenSequence(Sequence):
    """White, black, checkerboard and Bernoulli on the screen, `frames` of each, nothing moved in between.

    A cell covers about `cell_camera_px` camera pixels, a whole number of screen pixels; the pattern is centred on the screen
    and lies inside what all cameras surely see. White and black light and darken the whole screen. The Bernoulli pattern is
    fair coin tosses from `seed`. White and black, which level the others, come first.
    """

    frames: int = Field(default=4, ge=1)
    cell_camera_px: float = Field(default=4.0, gt=0)
    seed: int = 1
    level: float = 0.75
    pose: str = "screen-1"

    patterns_shown: ClassVar[tuple[Literal["white", "black", "checkerboard", "bernoulli"], ...]] = (
        "white",
        "black",
        "checkerboard",
        "bernoulli",
    )

    def grid(self, station: Station) -> _Grid:
        """The cells that fit. Raises InputError if fewer than two squares of the checkerboard do."""
        name = station.one(ScreenTarget)
        screen = station.having(ScreenTarget)[name]
        layouts = [layout for side in station.sides if (layout := getattr(screen, side)) is not None]
        if not layouts:
            raise InputError(
                f"station: [targets.{name}.left] is missing; give camera_px_per_screen_px and the visible rectangle"
            )
        scale = float(np.mean([layout.camera_px_per_screen_px for layout in layouts]))
        cell_px = max(1, round(self.cell_camera_px / scale))
        half_rows = min(min(screen.rows / 2 - at.visible[0], at.visible[2] - screen.rows / 2) for at in layouts)
        half_cols = min(min(screen.cols / 2 - at.visible[1], at.visible[3] - screen.cols / 2) for at in layouts)
        # Whole squares, so that the checkerboard's outer corners are corners of squares.
        rows, cols = (int(2 * half / cell_px) // SQUARE_CELLS * SQUARE_CELLS for half in (half_rows, half_cols))
        if min(rows, cols) < 2 * SQUARE_CELLS:
            raise InputError(
                f"station: only {rows} x {cols} cells of {cell_px} screen px fit what both cameras see of {name!r}; "
                "give a larger visible rectangle or smaller cells"
            )
        return _Grid(rows=rows, cols=cols, cell_px=cell_px)

    def patterns(self, station: Station) -> dict[str, Cells]:
        """See `Sequence.patterns`."""
        grid = self.grid(station)
        screen = station.having(ScreenTarget)[station.one(ScreenTarget)]
        whole = math.gcd(screen.rows, screen.cols)
        squares = np.add.outer(np.arange(grid.rows) // SQUARE_CELLS, np.arange(grid.cols) // SQUARE_CELLS) % 2
        tosses = np.random.default_rng(self.seed).integers(0, 2, (grid.rows, grid.cols))
        return {
            "targets/white.npy": np.ones((screen.rows // whole, screen.cols // whole), np.uint8),
            "targets/checkerboard.npy": squares.astype(np.uint8),
            "targets/bernoulli.npy": tosses.astype(np.uint8),
        }

    def steps(self, station: Station) -> tuple[Step, ...]:
        """See `Sequence.steps`."""
        needs(station, "screen", "display", "spectroradiometer")
        name = station.one(ScreenTarget)
        screen = station.having(ScreenTarget)[name]
        grid = self.grid(station)
        light = spectrum_path("screen/exposure")
        settings = {
            "white": Setting(target=name, pattern="targets/white.npy", cell_px=math.gcd(screen.rows, screen.cols)),
            "black": Setting(target=name),
            "checkerboard": Setting(target=name, pattern="targets/checkerboard.npy", cell_px=grid.cell_px),
            "bernoulli": Setting(target=name, pattern="targets/bernoulli.npy", cell_px=grid.cell_px),
        }
        made = [
            Step(
                id="screen/exposure",
                what="screen: finding the exposure, measuring the light",
                setting=settings["white"],
                radiance=light,
                exposure=FindExposure(level=self.level),
            )
        ]
        kinds: dict[str, type[White | Black | Checkerboard | Bernoulli]] = {
            "white": White,
            "black": Black,
            "checkerboard": Checkerboard,
            "bernoulli": Bernoulli,
        }
        for pattern in self.patterns_shown:
            for frame in range(1, self.frames + 1):
                id = f"screen/{pattern}/{frame}"
                captures: list[AnyCapture] = []
                for side in station.sides:
                    layout = getattr(screen, side)
                    cell_camera_px = None if layout is None else grid.cell_px * layout.camera_px_per_screen_px
                    keys = common(id, side) | {
                        "kind": pattern,
                        "screen": {"pose": self.pose, "cell_camera_px": cell_camera_px, "radiance": light},
                    }
                    if pattern in ("checkerboard", "bernoulli"):
                        keys["target"] = settings[pattern].pattern
                    captures.append(kinds[pattern].model_validate(keys))
                made.append(
                    Step(
                        id=id,
                        what=f"screen: {pattern}, frame {frame} of {self.frames}",
                        setting=settings[pattern],
                        exposure=RelativeExposure(of=made[0].id),
                        captures=tuple(captures),
                    )
                )
        return tuple(made)
