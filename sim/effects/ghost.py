"""Ghost: light that goes back from the sensor and is reflected again by the lens lies over the image, turned about the
axis.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from scipy import ndimage

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image

BLUR_PX = 2.0  # a reflection is seldom in focus


class Ghost(Effect):
    """I'(r) = I(r) + q I(-r), r from the frame's middle, the copy blurred by 2 px: two reflections turn the image by
    half a turn.
    """

    name: ClassVar[str] = "ghost"
    family: ClassVar[Family] = Family.COPIES_AND_VEILS
    reference: ClassVar[str] = "E. Oleszko et al., Computer Graphics Forum 36, 165 (2017)"
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    sentence: ClassVar[str] = (
        "Light that the sensor sends back is reflected again by the lens: a weak copy of the scene lies over it, "
        "turned by half a turn about the axis."
    )

    share_percent: Annotated[
        float, Quantity("%", "the copy's light over the scene's", lower=0.0, upper=30.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    def on_image(self, image: Image) -> Image:
        if self.share_percent == 0.0:
            return image

        def reflect(irradiance: FloatArray) -> FloatArray:
            copy = ndimage.gaussian_filter(np.asarray(irradiance, float)[::-1, ::-1], BLUR_PX, mode="nearest")
            return np.asarray(irradiance + 0.01 * self.share_percent * copy)

        return image.add_laws(copies=reflect)
