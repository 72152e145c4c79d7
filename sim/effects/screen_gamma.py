"""A screen's gamma: grey levels between dark and lit are shown darker, or lighter, than they should be."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from scipy.ndimage import gaussian_filter

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light

#: Log prior odds against borders that are only wider, with an exponent of 1: that is a blurred screen, not a gamma.
BLURRED_LOG_ODDS = 20.0
SURE_POWER = 0.3  # |ln exponent| from which on these odds are 0


class ScreenGamma(Effect):
    """Light = (drive blurred by a Gaussian of `rim_px`) ** exponent, as a share of the lit state. A pattern of lit and
    dark cells has grey levels only at the borders of cells, where the screen resamples it: the larger the exponent and
    the wider the borders, the smaller are lit cells. The width of the borders isn't stated, and drawings assume one
    sample: the exponent is good to tens of per cent.
    """

    name: ClassVar[str] = "screen_gamma"
    family: ClassVar[Family] = Family.SCREEN
    reference: ClassVar[str] = "R. S. Berns, Displays 16, 173 (1996)"
    form_tolerance: ClassVar[float] = 0.3
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "level", "orientation", "time"}
    )
    shapes: ClassVar[frozenset[str]] = frozenset({"rim_px"})
    sentence: ClassVar[str] = (
        "The screen's light isn't in proportion to its drive: the grey levels at the borders of cells are wrong, and "
        "lit cells look smaller or larger than drawn."
    )

    exponent: Annotated[
        float,
        Quantity(
            "1", "exponent of the light as a power of the drive", lower=0.2, upper=5.0, prior=(1.0, 1.0), absent=1.0
        ),
    ] = 1.0
    rim_px: Annotated[
        float,
        Quantity(
            "px",
            "standard deviation of the blur at the borders of cells, as the screen resamples its picture, in the "
            "camera's pixels",
            lower=0.0,
            upper=1.5,
            prior=(0.0, 0.3),
            absent=0.0,
            linear_power=2,
            dispensable=True,
        ),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        wide = tuple((cls(exponent=e, rim_px=0.4),) for e in (0.5, 2.0))
        return ((cls(exponent=0.7), cls(exponent=1.3)), *wide)

    def log_prior(self) -> float:
        if self.rim_px == 0.0:
            return 0.0
        return -BLURRED_LOG_ODDS * max(1.0 - abs(float(np.log(self.exponent))) / SURE_POWER, 0.0)

    def on_light(self, light: Light) -> Light:
        if self.exponent == 1.0:
            return light

        def show(share: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            asked = share
            if self.rim_px > 0.0:
                steps = float(np.ptp(y_um)) / (share.shape[0] - 1), float(np.ptp(x_um)) / (share.shape[1] - 1)
                asked = gaussian_filter(
                    share, [self.rim_px * light.camera.pixel_pitch_um / step for step in steps], mode="nearest"
                )
            return np.asarray(np.clip(asked, 0.0, 1.0) ** self.exponent)

        return light.add_laws(screen=show)
