"""Coma: light of the pupil's rim lands beside that of its middle."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect, StatedFNumber
from sim.effects.families import Family
from sim.optics.pupil import seidel
from sim.parameters import Quantity
from sim.stages import Image


class Coma(Effect):
    """Path error W131 rho^2 (x, y) over the pupil along a direction, alike all over the field, as a decentred element
    makes it.

    The spread is lopsided, so that the transfer function gets a phase. Its part in proportion to frequency only moves
    the image; the rest grows in proportion to W131, the loss of contrast as its square. W131 is
    that at the rim of the pupil of `stated_f_number` N0: at f/N it is (N0 / N)^3 of it.
    """

    name: ClassVar[str] = "coma"
    family: ClassVar[Family] = Family.DIRECTIONAL_CONTRAST
    reference: ClassVar[str] = "V. Mahajan, Optical Imaging and Aberrations, part II, section 4.4"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time"})
    sentence: ClassVar[str] = (
        "The lens has coma: points have a tail to one side, so that edges are lopsided along one direction and even "
        "across it."
    )

    w131_x_um: Annotated[
        float,
        Quantity("um", "path error at the pupil's rim along columns", lower=-5.0, upper=5.0, prior=(0.0, 0.3),
                 absent=0.0),
    ] = 0.0  # fmt: skip
    w131_y_um: Annotated[
        float,
        Quantity("um", "path error at the pupil's rim along rows", lower=-5.0, upper=5.0, prior=(0.0, 0.3), absent=0.0),
    ] = 0.0  # fmt: skip

    stated_f_number: StatedFNumber = None

    def on_image(self, image: Image) -> Image:
        if self.w131_x_um == 0.0 and self.w131_y_um == 0.0:
            return image
        share = self.pupil_share(image.camera.lens.f_number)
        path = seidel(coma_um=(self.w131_x_um, self.w131_y_um)).stopped(share)
        return image.add_laws(pupil=lambda wavelength_nm: path)
