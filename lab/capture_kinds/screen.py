"""Patterns on a screen: their base classes, and the sequence that shows them one after another.

A pattern is a kind of its own (`white`, `black`, `checkerboard`, `bernoulli`): a subclass of `ScreenCapture` that says
which cells are lit. `ScreenSequence` takes every pattern that is registered, in the order of registration.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from lab.capture_kinds.base import (
    CAPTURES,
    Capture,
    Cells,
    Equipment,
    Level,
    Open,
    PoseName,
    RelativeExposure,
    Sequence,
    Setting,
    SpectrumPath,
    Step,
    Target,
    TargetPath,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from lab.errors import InputError
from sim.parameters import Frozen, Quantity

#: Side of a square of the checkerboard that aligns the screen, in cells. The pattern has whole squares.
SQUARE_CELLS = 8


class ScreenLayout(Frozen):
    """Nominal view of the screen by one camera; `visible`: rectangle (row0, col0, row1, col1) in screen px that lies
    inside the frame."""

    camera_px_per_screen_px: float = Field(gt=0)
    visible: tuple[int, int, int, int]


class ScreenTarget(Target):
    """The screen that the display driver draws on."""

    kind: Literal["screen"]
    rows: int = Field(gt=0)
    cols: int = Field(gt=0)
    pixel_mm: float = Field(gt=0)
    left: ScreenLayout | None = None
    right: ScreenLayout | None = None

    @property
    def screen_px(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def instruction(self) -> str:
        return "put the screen before the cameras, and move nothing until all patterns are taken"


class CellGrid(Frozen):
    """Rows and columns of cells on the screen, each of `cell_px` x `cell_px` screen pixels."""

    rows: int
    cols: int
    cell_px: int


class ScreenSequence(Sequence):
    """`frames` of every pattern on the screen, with nothing moved in between.

    The side of a cell is a whole number of screen pixels, about `cell_camera_px` camera pixels. The pattern is centred
    on the screen and lies inside what all cameras see. `seed`: of random patterns.
    """

    name: ClassVar[str] = "screen"
    purpose: ClassVar[str] = "point-spread function, crosstalk"
    instruments: ClassVar[tuple[str, ...]] = ("display", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (ScreenTarget,)

    frames: Annotated[int, Quantity("1", "frames of each pattern", lower=1, upper=1000)] = 4
    cell_camera_px: Annotated[
        float, Quantity("px", "side of a cell of the patterns, on the sensor", lower=0.5, upper=200.0)
    ] = 4.0
    seed: Annotated[int, Quantity("1", "what random patterns are drawn from", lower=0, upper=2**31 - 1)] = 1
    level: Level = 0.75
    pose: str = "screen-1"

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls(frames=2 if quick else 4) if cls.possible(station) else None

    @staticmethod
    def kinds() -> dict[str, type[ScreenCapture]]:
        """Return the registered patterns by name."""
        return {name: kind for name, kind in CAPTURES.models.items() if issubclass(kind, ScreenCapture)}

    def grid(self, station: Equipment) -> CellGrid:
        """Return the largest grid of whole checkerboard squares that all cameras see. Raises InputError if that is less
        than 2 x 2 squares, and where no camera's view of the screen is given."""
        name = station.one(ScreenTarget)
        screen = station.list_targets(ScreenTarget)[name]
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
                f"station: only {max(0, rows)} x {max(0, cols)} cells of {cell_px} screen px fit what both cameras "
                f"see of {name!r}; "
                "give a larger visible rectangle or smaller cells"
            )
        return CellGrid(rows=rows, cols=cols, cell_px=cell_px)

    def patterns(self, station: Equipment) -> dict[str, Cells]:
        grid = self.grid(station)
        screen = station.list_targets(ScreenTarget)[station.one(ScreenTarget)]
        whole = whole_screen(screen)
        drawn = {
            name: kind.cells(whole if kind.fills_screen else grid, self.seed) for name, kind in self.kinds().items()
        }
        return {pattern_path(name): cells for name, cells in drawn.items() if cells is not None}

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        name = station.one(ScreenTarget)
        screen = station.list_targets(ScreenTarget)[name]
        grid, shown = self.grid(station), self.patterns(station)
        settings = {
            pattern: Setting(
                target=name,
                pattern=pattern_path(pattern),
                cell_px=whole_screen(screen).cell_px if kind.fills_screen else grid.cell_px,
            )
            if pattern_path(pattern) in shown
            else Setting(target=name)
            for pattern, kind in self.kinds().items()
        }
        made = [exposure_step("screen", "screen", settings["white"], self.level)]
        light = spectrum_path(made[0].id)
        for pattern, kind in self.kinds().items():
            for frame in range(1, self.frames + 1):
                id = f"screen/{pattern}/{frame}"
                captures = []
                for side in station.sides:
                    layout = getattr(screen, side)
                    cell_camera_px = None if layout is None else grid.cell_px * layout.camera_px_per_screen_px
                    keys = planned_keys(id, side) | {
                        "kind": pattern,
                        "screen": {"pose": self.pose, "cell_camera_px": cell_camera_px, "radiance": light},
                    }
                    if "target" in kind.model_fields:
                        keys["target"] = pattern_path(pattern)
                    captures.append(kind.model_validate(keys))
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


def pattern_path(kind: str) -> str:
    """Return the path in the session of a pattern's cells.

    >>> pattern_path("bernoulli")
    'targets/bernoulli.npy'
    """
    return f"targets/{kind}.npy"


def whole_screen(screen: ScreenTarget) -> CellGrid:
    """Return the whole screen in the largest square cells that fill it exactly."""
    cell_px = math.gcd(screen.rows, screen.cols)
    return CellGrid(rows=screen.rows // cell_px, cols=screen.cols // cell_px, cell_px=cell_px)


class ScreenState(Open):
    """The screen in one capture. Captures of the same `pose` were taken with nothing moved in between."""

    pose: PoseName
    cell_camera_px: float | None = Field(default=None, gt=0)  # nominal camera pixels for one cell
    radiance: SpectrumPath | None = None  # of the lit screen


class ScreenCapture(Capture):
    """A pattern on the screen. A subclass with a key `target` keeps its cells in the recording set."""

    sequence: ClassVar[type[Sequence] | None] = ScreenSequence
    fills_screen: ClassVar[bool] = False  # it covers the whole screen, beyond what the cameras see

    screen: ScreenState

    @classmethod
    def cells(cls, grid: CellGrid, seed: int) -> Cells | None:
        """Return the cells, 0 dark and 1 lit; None: the whole screen is dark."""
        raise NotImplementedError


class PatternCapture(ScreenCapture):
    """A pattern with structure, kept at the path `target`."""

    target: TargetPath
