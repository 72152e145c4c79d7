"""Astigmatism: best focus of rows and columns in different planes."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.pupil import Wavefront
from sim.parameters import Quantity
from sim.stages import Image


class Astigmatism(Effect):
    """Path errors quadratic along x and y apart: W = (x_defocus x^2 - y_defocus y^2) / (8 N^2).

    The distances are the lens's, and stay as it is stopped down: the path errors go with the square of the pupil.
    """

    name: ClassVar[str] = "astigmatism"
    family: ClassVar[Family] = Family.DIRECTIONAL_CONTRAST
    reference: ClassVar[str] = "J. Goodman, Introduction to Fourier Optics, section 6.4"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    sentence: ClassVar[str] = (
        "The lens is astigmatic: horizontal and vertical detail come to focus in different planes, so that their "
        "contrasts differ."
    )

    defocus_x_um: Annotated[
        float,
        Quantity("um", "distance of the sensor from the focus of detail along columns", lower=0.0, upper=200.0,
                 prior=(0.0, 20.0),
                 absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
    defocus_y_um: Annotated[
        float,
        Quantity("um", "distance of the sensor from the focus of detail along rows, on the other side", lower=0.0,
                 upper=200.0,
                 prior=(0.0, 20.0), absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip

    def on_image(self, image: Image) -> Image:
        if self.defocus_x_um == 0.0 and self.defocus_y_um == 0.0:
            return image
        scale = 1.0 / (8.0 * image.camera.lens.f_number**2)
        path = Wavefront.of({(2, 0): self.defocus_x_um * scale, (0, 2): -self.defocus_y_um * scale})
        return image.add_laws(pupil=lambda wavelength_nm: path)
