"""A checkerboard on the screen: where each cell of the other patterns lies in the frame."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from lab.capture_kinds.base import Cells
from lab.capture_kinds.screen import SQUARE_CELLS, CellGrid, PatternCapture


class CheckerboardCapture(PatternCapture):
    """A checkerboard on the screen, its first square dark."""

    shows: ClassVar[str] = "a checkerboard on the screen"
    codes_are_fitted: ClassVar[bool] = False

    kind: Literal["checkerboard"]

    @classmethod
    def cells(cls, grid: CellGrid, seed: int) -> Cells | None:
        squares = np.add.outer(np.arange(grid.rows) // SQUARE_CELLS, np.arange(grid.cols) // SQUARE_CELLS) % 2
        return squares.astype(np.uint8)


KIND = CheckerboardCapture
