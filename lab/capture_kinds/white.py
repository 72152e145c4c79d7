"""The screen all lit: the upper level of the patterns."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from lab.capture_kinds.base import Cells
from lab.capture_kinds.screen import CellGrid, ScreenCapture


class WhiteCapture(ScreenCapture):
    """The screen all lit."""

    shows: ClassVar[str] = "the screen all lit"
    fills_screen: ClassVar[bool] = True

    kind: Literal["white"]

    @classmethod
    def cells(cls, grid: CellGrid, seed: int) -> Cells | None:
        return np.ones((grid.rows, grid.cols), np.uint8)


KIND = WhiteCapture
