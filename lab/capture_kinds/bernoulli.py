"""Random cells on the screen: a spectrum without gaps, from which the point-spread function is estimated."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from lab.capture_kinds.base import Cells
from lab.capture_kinds.screen import CellGrid, PatternCapture


class BernoulliCapture(PatternCapture):
    """Independent cells on the screen, each lit with probability 1/2."""

    shows: ClassVar[str] = "random cells on the screen, nothing moved since the checkerboard of the same pose"

    kind: Literal["bernoulli"]

    @classmethod
    def cells(cls, grid: CellGrid, seed: int) -> Cells | None:
        return np.random.default_rng(seed).integers(0, 2, (grid.rows, grid.cols)).astype(np.uint8)


KIND = BernoulliCapture
