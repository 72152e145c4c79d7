"""A view: the corners of one board in one frame.

Points are those of OpenCV: (x, y) px, x to the right along columns, (0, 0) the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.charuco import CharucoCapture

Array = NDArray[np.floating[Any]]


MIN_CORNERS = 8  # of a view: a pose has six parameters


@dataclass(frozen=True)
class BoardView:
    """Corners of a board in one frame.

    `board_mm` (n, 3), z = 0; `image_px` (n, 2), (x, y); `index` (n,) numbers the corners row by row; `std_px` (n,):
    standard deviation of a coordinate by the noise of the picture, where it is known; `bent`: whether edges were fitted
    with the curvature that their corners show.
    """

    capture: CharucoCapture
    index: NDArray[np.int64]
    board_mm: Array
    image_px: Array
    std_px: Array | None = None
    bent: bool = False

    @property
    def squares(self) -> Array:
        """Places (n, 2) of the corners on the board, in squares."""
        return np.asarray(self.board_mm[:, :2] / self.capture.square_mm, float)

    def only(self, kept: NDArray[np.bool_]) -> BoardView:
        """Return the view with the corners for which `kept` (n,) is true."""
        std = None if self.std_px is None else self.std_px[kept]
        return BoardView(self.capture, self.index[kept], self.board_mm[kept], self.image_px[kept], std, self.bent)


def grid_steps(index: NDArray[np.int64], cols: int) -> Array:
    """Return the places (x, y) of corners in squares, from the first inner corner."""
    return np.column_stack([index % cols, index // cols]).astype(float)


def board_points(capture: CharucoCapture, index: NDArray[np.int64]) -> Array:
    """Return the places (x, y, 0), mm, of the inner corners of these numbers; the first square begins at 0."""
    return np.column_stack(
        [(grid_steps(index, capture.squares[1] - 1) + 1.0) * capture.square_mm, np.zeros(len(index))]
    )


def board_key(view: BoardView) -> tuple[object, ...]:
    """Return the properties of a board. Captures that agree in them show the same board."""
    capture = view.capture
    return capture.dictionary, capture.squares, capture.square_mm, capture.marker_mm
