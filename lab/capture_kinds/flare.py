"""A black square on a white screen, and the screen dark: image flare (ISO 18844).

A full session doesn't take it: `calibench run --standards` does."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from lab.capture_kinds.base import (
    Capture,
    Cells,
    Equipment,
    Level,
    RelativeExposure,
    Sequence,
    Setting,
    Step,
    Target,
    TargetPath,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from lab.capture_kinds.screen import CellGrid, ScreenState, ScreenTarget, pattern_path
from lab.errors import InputError
from sim.parameters import Quantity

#: Area of the black square over that of what the cameras see of the screen: the standard allows 5 %.
BLACK_SHARE = 0.02
LEAST_CELLS = 36  # rows of the pattern, so that the square has about its size


class FlareSequence(Sequence):
    """`frames` of a white screen with a black square in its middle, and as many of the dark screen."""

    name: ClassVar[str] = "flare"
    purpose: ClassVar[str] = "image flare by ISO 18844"
    instruments: ClassVar[tuple[str, ...]] = ("display", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (ScreenTarget,)

    frames: Annotated[int, Quantity("1", "frames of the chart and of the dark screen", lower=1, upper=1000)] = 4
    level: Level = 0.75
    pose: str = "flare-1"

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return None

    def grid(self, station: Equipment) -> CellGrid:
        """Return the whole screen in square cells, `LEAST_CELLS` rows at least where whole pixels allow it."""
        screen = station.list_targets(ScreenTarget)[station.one(ScreenTarget)]
        common = math.gcd(screen.rows, screen.cols)
        sizes = [size for size in range(1, common + 1) if common % size == 0 and screen.rows // size >= LEAST_CELLS]
        cell_px = max(sizes, default=1)
        return CellGrid(rows=screen.rows // cell_px, cols=screen.cols // cell_px, cell_px=cell_px)

    def patterns(self, station: Equipment) -> dict[str, Cells]:
        screen = station.list_targets(ScreenTarget)[station.one(ScreenTarget)]
        layouts = [layout for side in station.sides if (layout := getattr(screen, side)) is not None]
        if not layouts:
            raise InputError(
                f"station: [targets.{station.one(ScreenTarget)}.left] is missing; give camera_px_per_screen_px and the "
                "visible rectangle"
            )
        grid = self.grid(station)
        visible_px2 = min((at.visible[2] - at.visible[0]) * (at.visible[3] - at.visible[1]) for at in layouts)
        half = max(1, round(0.5 * math.sqrt(BLACK_SHARE * visible_px2) / grid.cell_px))
        cells = np.ones((grid.rows, grid.cols), np.uint8)
        row, col = grid.rows // 2, grid.cols // 2
        cells[row - half : row + half, col - half : col + half] = 0
        return {pattern_path("flare"): cells}

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        name = station.one(ScreenTarget)
        screen = station.list_targets(ScreenTarget)[name]
        lit = Setting(target=name, pattern=pattern_path("flare"), cell_px=self.grid(station).cell_px)
        made = [exposure_step("flare", "flare chart", lit, self.level)]
        light = spectrum_path(made[0].id)
        for shown, setting in (("chart", lit), ("dark", Setting(target=name))):
            for frame in range(1, self.frames + 1):
                id = f"flare/{shown}/{frame}"
                captures = []
                for side in station.sides:
                    layout, (rows, cols) = getattr(screen, side), station.frame_px(side)
                    scale = None if layout is None else layout.camera_px_per_screen_px
                    over = None if scale is None else scale * min(screen.rows / rows, screen.cols / cols)
                    keys = planned_keys(id, side) | {
                        "kind": "flare",
                        "lit": shown == "chart",
                        "chart_over_field": over,
                        "screen": {"pose": self.pose, "cell_camera_px": None, "radiance": light},
                        "target": pattern_path("flare"),
                    }
                    captures.append(FlareCapture.model_validate(keys))
                made.append(
                    Step(
                        id=id,
                        what=f"flare: {shown}, frame {frame} of {self.frames}",
                        setting=setting,
                        exposure=RelativeExposure(of=made[0].id),
                        captures=tuple(captures),
                    )
                )
        return tuple(made)


class FlareCapture(Capture):
    """White with a black square in the middle of the field (`lit`), or the same screen dark.

    `chart_over_field`: nominal size of the white chart over that of the field, in its smaller direction."""

    shows: ClassVar[str] = "a black square on a white screen, or the dark screen"
    sequence: ClassVar[type[Sequence] | None] = FlareSequence

    kind: Literal["flare"]
    lit: bool
    screen: ScreenState
    target: TargetPath
    chart_over_field: float | None = Field(default=None, gt=0)


KIND = FlareCapture
