"""What the effects that process raw data share: a 3 x 3 filter of each colour's plane, which colours the noise with the
image.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.parameters import Quantity
from sim.stages import Signal

#: Of the blur's weight, across corners.
CornerShare = Annotated[
    float,
    Quantity("1", "share of the blur's weight across corners", lower=0.0, upper=0.8, prior=(0.33, 0.2), absent=0.33),
]


class OnChipFilter(Effect):
    """plane + k (plane - blurred), the blur a 3 x 3 mean of the pixels of one colour: a share (1 - s) / 4 of each of
    the four next ones and s / 4 of each of the four across corners, against the pixel itself: s = 0 a cross, 1/3 a
    binomial, 1/2 a box.

    k > 0 sharpens, k < 0 smooths. Signal, fixed pattern and noise go through it alike: neighbours' noise is correlated
    in the same proportion at all levels and in the dark.
    """

    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"corner_share"})

    @abstractmethod
    def detail(self) -> tuple[float, float]:
        """k and s."""

    def on_signal(self, signal: Signal) -> Signal:
        share, corners = self.detail()
        if share == 0.0:
            return signal
        next_, across = -0.25 * share * (1.0 - corners), -0.25 * share * corners
        kernel = np.array([[across, next_, across], [next_, 1.0 + share, next_], [across, next_, across]])
        return signal.add_laws(filters=kernel)
