"""The display abstraction: a pattern on a screen, one cell a whole number of screen pixels, and the word that it is on the glass."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.instrument import Instrument


@dataclass(frozen=True)
class Shown:
    """What the screen said once the pattern was on the glass. Sizes are (rows, cols)."""

    device_pixel_ratio: float
    canvas_px: tuple[int, int]
    screen_px: tuple[int, int]
    cell_px: int


class Display(Instrument):
    """A screen in front of the cameras. `stop` and `close` leave it dark."""

    @abstractmethod
    def show(self, pattern: NDArray[np.uint8], cell_px: int = 1) -> Shown:
        """Show (rows, cols) cells of 0 (dark) and 1 (lit), `cell_px` screen pixels square, centred; the rest is dark.

        Returns when the pattern is on the glass. Raises `InstrumentError` if it doesn't fit, if one canvas pixel isn't
        one screen pixel, or if no screen answers in time.
        """

    @abstractmethod
    def screen_px(self) -> tuple[int, int]:
        """Size (rows, cols) of the screen in its own pixels."""
