"""Lines around the area of a sensor that sees light: masked pixels, and overscan, which is read without pixels."""

from __future__ import annotations

from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim.parameters import Frozen, Quantity
from sim.spectrum import FloatArray

N = TypeVar("N", bound=np.generic)

#: Lines of one margin, at most.
MOST_LINES = 4096


class Margins(Frozen):
    """How many lines a frame has around its active area: before the first and behind the last active one.

    Masked pixels (optically black) are next to the active area. They have dark current and no light. Overscan is
    outermost: lines that are read without pixels, before the first pixel or behind the last one. They hold the offset
    and the noise of the read-out, and charge that packets left behind on their way to the output.
    """

    masked_rows: Annotated[
        tuple[int, int], Quantity("px", "masked rows before and behind the active ones", lower=0, upper=MOST_LINES)
    ] = (0, 0)
    masked_cols: Annotated[
        tuple[int, int], Quantity("px", "masked columns before and behind the active ones", lower=0, upper=MOST_LINES)
    ] = (0, 0)
    overscan_rows: Annotated[
        tuple[int, int], Quantity("px", "rows of overscan before and behind all others", lower=0, upper=MOST_LINES)
    ] = (0, 0)
    overscan_cols: Annotated[
        tuple[int, int], Quantity("px", "columns of overscan before and behind all others", lower=0, upper=MOST_LINES)
    ] = (0, 0)

    @property
    def lines(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Lines before and behind the active area, of rows and of columns."""
        rows = self.masked_rows[0] + self.overscan_rows[0], self.masked_rows[1] + self.overscan_rows[1]
        cols = self.masked_cols[0] + self.overscan_cols[0], self.masked_cols[1] + self.overscan_cols[1]
        return rows, cols

    def frame_shape(self, rows: int, cols: int) -> tuple[int, int]:
        """Return the shape of a whole frame, given the rows and columns of its active area.

        >>> Margins(masked_rows=(4, 0), overscan_cols=(2, 16)).frame_shape(480, 640)
        (484, 658)
        """
        return rows + sum(self.lines[0]), cols + sum(self.lines[1])

    def active(self, frame: NDArray[N]) -> NDArray[N]:
        """Return the active area (rows, cols) of a whole frame, a view."""
        (top, bottom), (left, right) = self.lines
        return frame[top : frame.shape[0] - bottom, left : frame.shape[1] - right]

    def surround(self, active: NDArray[N], masked: float = 0.0, overscan: float = 0.0) -> NDArray[N]:
        """Return a whole frame around an active area (rows, cols), with one value in masked pixels and one in
        overscan."""
        held = np.pad(active, (self.masked_rows, self.masked_cols), constant_values=masked)
        return np.pad(held, (self.overscan_rows, self.overscan_cols), constant_values=overscan)

    def embed(self, pattern: FloatArray | float, rows: int, cols: int) -> FloatArray | float:
        """Return a pattern that broadcasts to a whole frame, of one that broadcasts to its active area of `rows` x
        `cols`: of rows (rows, 1), of columns (1, cols) or of pixels. Outside it is 0; a number stays one."""
        if np.ndim(pattern) < 2:
            return pattern
        sizes = zip(np.shape(pattern), (rows, cols), self.lines, strict=True)
        return np.pad(pattern, [lines if size == active else (0, 0) for size, active, lines in sizes])


#: Of a frame that is its active area alone.
NO_MARGINS = Margins()
