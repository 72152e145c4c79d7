"""The display abstraction: a pattern on a screen, each cell a whole number of screen pixels, and the confirmation that
it is displayed."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.instrument import Instrument


@dataclass(frozen=True)
class Shown:
    """The screen's report once the pattern is displayed. Sizes are (rows, cols)."""

    device_pixel_ratio: float
    canvas_px: tuple[int, int]
    screen_px: tuple[int, int]
    cell_px: int


class Display(Instrument):
    """A screen in front of the cameras. `stop` and `close` leave it dark."""

    @abstractmethod
    def show(self, pattern: NDArray[np.uint8], cell_px: int = 1) -> Shown:
        """Show (rows, cols) cells of 0 (dark) and 1 (lit), `cell_px` screen pixels square, centred; the rest is dark.

        Returns when the pattern is displayed. Raises `InstrumentError` if it doesn't fit, if one canvas pixel isn't
        one screen pixel, or if no screen answers in time.
        """

    @abstractmethod
    def screen_px(self) -> tuple[int, int]:
        """Return the size (rows, cols) of the screen in its own pixels."""
