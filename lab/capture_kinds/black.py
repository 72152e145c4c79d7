"""The screen all dark: the lower level of the patterns."""

from __future__ import annotations

from typing import ClassVar, Literal

from lab.capture_kinds.base import Cells
from lab.capture_kinds.screen import CellGrid, ScreenCapture


class BlackCapture(ScreenCapture):
    """The screen all dark."""

    shows: ClassVar[str] = "the screen all dark"
    fills_screen: ClassVar[bool] = True

    kind: Literal["black"]

    @classmethod
    def cells(cls, grid: CellGrid, seed: int) -> Cells | None:
        return None


KIND = BlackCapture
