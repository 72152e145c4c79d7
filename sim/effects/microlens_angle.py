"""Microlenses at another angle: the lens's chief rays come in steeper or flatter than the pixels' microlenses are made
for.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge, Image, Stray

#: Light that misses its diode is lost, and falls on the next one in at least this proportion.
USUAL_RATIO = 0.25


class MicrolensAngle(Effect):
    """As the angle's error grows with the radius: light x (1 - l r^2), r the radius over that of the corner, and
    of what is left c x^2 falls on the next pixels in the row and c y^2 on those in the column, r^2 = x^2 + y^2; (1 + e)
    times that of red light and (1 - e) of blue. Colours mix towards the corners, and none does on the axis. The two
    greens have other neighbours along the angle, and part.

    Without a mosaic nothing but vignetting is seen, and this is absent.
    """

    name: ClassVar[str] = "microlens_angle"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = (
        "G. Agranov, V. Berezin and R. H. Tsai, Crosstalk and microlens study in a color CMOS image sensor, IEEE "
        "Trans. Electron Devices 50 (2003) 4; ISO 17957:2015, colour shading"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"red_excess"})
    sentence: ClassVar[str] = (
        "The microlenses are made for other angles than the lens's: towards the corners light is lost, and colours "
        "mix, so that each channel falls off by itself."
    )

    crosstalk_percent: Annotated[
        float,
        Quantity("%", "share of the light in the corner that falls on the next pixels", lower=0.0, upper=50.0,
                 prior=(0.0, 3.0), absent=0.0),
    ] = 0.0  # fmt: skip
    loss_percent: Annotated[
        float,
        Quantity("%", "light lost in the corner beside that", lower=0.0, upper=90.0, prior=(0.0, 5.0), absent=0.0),
    ] = 0.0
    red_excess: Annotated[
        float,
        Quantity("1", "by which share more of red light than of green falls there, and less of blue", lower=-1.0,
                 upper=1.0, prior=(0.0, 0.3), absent=0.0, dispensable=True),
    ] = 0.0  # fmt: skip

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return (cls(crosstalk_percent=1.0), cls(crosstalk_percent=1.0, loss_percent=1.5)), (
            cls(crosstalk_percent=1.0, red_excess=0.5),
            cls(crosstalk_percent=1.0, red_excess=-0.5),
        )

    def log_prior(self) -> float:
        """Return -ln 30, as a lens that vignettes is far more usual; and less where light is lost and hardly any falls
        on the next pixels.
        """
        if self.crosstalk_percent == 0.0 and self.loss_percent == 0.0:
            return 0.0
        lacks = max(1.0 - self.crosstalk_percent / max(USUAL_RATIO * self.loss_percent, 1e-9), 0.0)
        return -float(np.log(30.0)) - 4.0 * lacks**2

    def on_image(self, image: Image) -> Image:
        if self.loss_percent == 0.0 or image.camera.cfa == "MONO":
            return image
        corner2 = image.camera.half_diagonal_um**2

        def shading(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            return np.asarray(1.0 - 0.01 * self.loss_percent * (x_um**2 + y_um**2) / corner2)

        return image.add_laws(shading=shading)

    def on_charge(self, charge: Charge) -> Charge:
        if self.crosstalk_percent == 0.0 or charge.camera.cfa == "MONO":
            return charge
        corner2 = charge.camera.half_diagonal_um**2
        excess = {"R": self.red_excess, "B": -self.red_excess}

        def shares(channel: str, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
            most = 0.01 * self.crosstalk_percent * (1.0 + excess.get(channel, 0.0)) / corner2
            return most * x_um**2, most * y_um**2

        return charge.add_laws(strays=Stray(shares))
