"""Vignetting: the lens loses more light towards the corners than cos^4 says."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image

#: Powers of the radius that are tried first.
EXPONENTS = (1.0, 2.0, 4.0)


class Vignetting(Effect):
    """Light factor 1 - v (r / r_corner)^p: p = 2 where the exit pupil shrinks, about 1 where a stop in front or behind
    cuts it (two discs that part), 4 and more where a mount's rim only reaches the corners.
    """

    name: ClassVar[str] = "vignetting"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = "ISO 17957:2015"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "wavelength", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"exponent"})
    sentence: ClassVar[str] = (
        "The lens vignettes: flat fields fall towards the corners more than the cosine law says, alike in all channels."
    )

    corner_loss_percent: Annotated[
        float,
        Quantity(
            "%",
            "light lost in the corner beyond cos^4",
            lower=-50.0,
            upper=100.0,
            prior=(0.0, 3.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    exponent: Annotated[
        float,
        Quantity(
            "1", "power of the radius with which the light falls", lower=0.7, upper=8.0, prior=(2.0, 1.0), absent=2.0
        ),
    ] = 2.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(corner_loss_percent=1.0, exponent=p), cls(corner_loss_percent=-1.0, exponent=p)) for p in EXPONENTS
        )

    def on_image(self, image: Image) -> Image:
        if self.corner_loss_percent == 0.0:
            return image
        corner2 = image.camera.half_diagonal_um**2

        def shading(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            share = ((x_um**2 + y_um**2) / corner2) ** (0.5 * self.exponent)
            return np.asarray(1.0 - self.corner_loss_percent / 100.0 * share)

        return image.add_laws(shading=shading)
