"""Vignetting about a point beside the middle: the lens, its stop or its mount sits off the sensor's centre."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image


class VignettingDecentre(Effect):
    """Light factor 1 - v (rho^p - rho_0^p), rho the distance from (x0, y0) and rho_0 that of the sensor's centre from
    there, in half diagonals: 1 at the centre, as without it. All of a small offset is a slope, which uneven
    illumination has as well.
    """

    name: ClassVar[str] = "vignetting_decentre"
    family: ClassVar[Family] = Family.FIELD_OF_LIGHT
    reference: ClassVar[str] = "ISO 17957:2015; D. B. Goldman, IEEE Trans. Pattern Anal. Mach. Intell. 32, 2276 (2010)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "wavelength", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"centre_x", "centre_y", "exponent"})
    sentence: ClassVar[str] = (
        "The lens vignettes about a point beside the sensor's middle: flat fields fall off around another place than "
        "the centre, alike in all channels."
    )

    fall_off_percent: Annotated[
        float,
        Quantity(
            "%",
            "light lost half a diagonal away from the fall-off's centre, beyond cos^4",
            lower=0.0,
            upper=100.0,
            prior=(0.0, 5.0),
            absent=0.0,
        ),
    ] = 0.0
    centre_x: Annotated[
        float,
        Quantity(
            "1",
            "centre of the fall-off along columns, in half diagonals",
            lower=-1.5,
            upper=1.5,
            prior=(0.0, 0.2),
            absent=0.0,
        ),
    ] = 0.0
    centre_y: Annotated[
        float,
        Quantity(
            "1",
            "centre of the fall-off along rows, in half diagonals",
            lower=-1.5,
            upper=1.5,
            prior=(0.0, 0.2),
            absent=0.0,
        ),
    ] = 0.0
    exponent: Annotated[
        float,
        Quantity(
            "1", "power of the distance with which the light falls", lower=1.0, upper=6.0, prior=(2.0, 0.7), absent=2.0
        ),
    ] = 2.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        angles = np.arange(8) * np.pi / 4.0
        return tuple(
            (cls(fall_off_percent=1.0, centre_x=float(s * np.cos(a)), centre_y=float(s * np.sin(a)), exponent=p),)
            for p in (2.0, 3.0)
            for s in (0.12, 0.3, 0.6)
            for a in angles
        )

    def on_image(self, image: Image) -> Image:
        if self.fall_off_percent == 0.0:
            return image
        half_um = image.camera.half_diagonal_um

        def shading(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
            rho2 = (x_um / half_um - self.centre_x) ** 2 + (y_um / half_um - self.centre_y) ** 2
            away = rho2 ** (0.5 * self.exponent) - (self.centre_x**2 + self.centre_y**2) ** (0.5 * self.exponent)
            return np.asarray(1.0 - self.fall_off_percent / 100.0 * away)

        return image.add_laws(shading=shading)
