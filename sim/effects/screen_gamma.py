"""A screen's gamma: greys between dark and lit are shown darker, or lighter, than asked for."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class ScreenGamma(Effect):
    """light = share ** exponent of the lit state. A pattern of lit and dark cells has greys only at their rims, where the screen
    resamples it; how wide these are isn't stated, and drawings take a sample: the exponent is good to tens of per cent."""

    name: ClassVar[str] = "screen_gamma"
    stage: ClassVar[Stage] = Stage.RIG
    reference: ClassVar[str] = "R. S. Berns, Displays 16, 173 (1996)"
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "level", "orientation", "time"}
    )
    shown_by: ClassVar[frozenset[str]] = frozenset({"checkerboard", "bernoulli"})
    rivals: ClassVar[frozenset[str]] = frozenset({"nonlinearity"})
    sentence: ClassVar[str] = (
        "The screen's light isn't in proportion to what it is asked for: the greys at the rims of cells are off, and lit cells look "
        "smaller or larger than drawn."
    )

    exponent: Annotated[
        float, Quantity("1", "power of what is asked for", lower=0.2, upper=5.0, prior=(1.0, 1.0), absent=1.0)
    ] = 1.0

    def screen(self, share: FloatArray, x_um: FloatArray, y_um: FloatArray, camera: CameraModel) -> FloatArray:
        if self.exponent == 1.0:
            return share
        return np.asarray(np.clip(share, 0.0, 1.0) ** self.exponent)
