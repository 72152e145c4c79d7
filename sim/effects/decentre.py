"""Decentring: an element of the lens stands off the axis, so that distortion isn't radial."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.illumination import from_axis_um
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image


class Decentre(Effect):
    """Brown's tangential distortion: with x, y from the optical axis in units of half the frame's diagonal R, light
    lands off by a (3 x^2 + y^2) + 2 b x y along columns and b (x^2 + 3 y^2) + 2 a x y along rows.

    (a, b) = R^2 / f (p2, p1) of OpenCV's model. The coma that comes with it blurs, and isn't part of this effect.
    """

    name: ClassVar[str] = "decentre"
    family: ClassVar[Family] = Family.GEOMETRY
    reference: ClassVar[str] = "D. C. Brown, Photogramm. Eng. 32, 444 (1966)"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "level", "time"})
    sentence: ClassVar[str] = (
        "An element of the lens is off centre: corners lie off across the radius as well as along it, on one side of "
        "the frame more than on the other."
    )

    shift_x_um: Annotated[
        float,
        Quantity("um", "a: a third of the shift at half the diagonal along columns", lower=-100.0, upper=100.0,
                 prior=(0.0, 1.0), absent=0.0),
    ] = 0.0  # fmt: skip
    shift_y_um: Annotated[
        float,
        Quantity("um", "b: a third of the shift at half the diagonal along rows", lower=-100.0, upper=100.0,
                 prior=(0.0, 1.0), absent=0.0),
    ] = 0.0  # fmt: skip

    def on_image(self, image: Image) -> Image:
        if self.shift_x_um == 0.0 and self.shift_y_um == 0.0:
            return image

        def shift(x_um: FloatArray, y_um: FloatArray, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
            x, y, corner = from_axis_um(x_um, y_um, image.camera)
            x, y = x / corner, y / corner
            a, b = self.shift_x_um, self.shift_y_um
            return a * (3.0 * x * x + y * y) + 2.0 * b * x * y, b * (x * x + 3.0 * y * y) + 2.0 * a * x * y

        return image.add_laws(shift=shift)
