"""Lateral chromatic aberration: colours are imaged at different scales."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.illumination import from_axis_um
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image

#: The wavelength that lands where the camera's geometry has it.
REFERENCE_NM = 550.0


class LateralChromaticAberration(Effect):
    """Shift outwards by r / R (a t + b t^2), t = (wavelength - 550 nm) / 100 nm, r from the optical axis, R half the
    frame's diagonal.

    a is the primary spectrum, b what a corrected lens leaves. Within a channel's band the shift is a blur, along the
    radius. The term in r^3 that wide lenses add is left to the form tolerance.
    """

    name: ClassVar[str] = "lateral_chromatic_aberration"
    family: ClassVar[Family] = Family.COLOUR_BLUR
    reference: ClassVar[str] = "ISO 19084:2015"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "time"})
    sentence: ClassVar[str] = (
        "The lens images colours at different scales: towards the corners red and blue detail lies further out or in "
        "than green."
    )

    slope_um: Annotated[
        float,
        Quantity("um", "shift in the frame's corner at 650 nm, of the part that is linear in wavelength less 550 nm",
                 lower=-50.0,
                 upper=50.0, prior=(0.0, 2.0), absent=0.0),
    ] = 0.0  # fmt: skip
    curvature_um: Annotated[
        float,
        Quantity("um", "the same, of the part that is quadratic", lower=-50.0, upper=50.0, prior=(0.0, 2.0),
                 absent=0.0),
    ] = 0.0  # fmt: skip

    def on_image(self, image: Image) -> Image:
        if self.slope_um == 0.0 and self.curvature_um == 0.0:
            return image

        def shift(x_um: FloatArray, y_um: FloatArray, wavelength_nm: float) -> tuple[FloatArray, FloatArray]:
            t = (wavelength_nm - REFERENCE_NM) / 100.0
            corner_um = t * (self.slope_um + t * self.curvature_um)
            x, y, corner = from_axis_um(x_um, y_um, image.camera)
            return corner_um / corner * x, corner_um / corner * y

        return image.add_laws(shift=shift)
