"""Spherical aberration of the third order."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect, StatedFNumber
from sim.effects.families import Family
from sim.optics.pupil import seidel
from sim.parameters import Quantity
from sim.stages import Image


class SphericalAberration(Effect):
    """Path error W040 rho^4 over the pupil, in the paraxial focus.

    W040 is that at the rim of the pupil of `stated_f_number` N0: at f/N it is (N0 / N)^4 of it.
    """

    name: ClassVar[str] = "spherical_aberration"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "J. Goodman, Introduction to Fourier Optics, section 6.4"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time", "field"})
    sentence: ClassVar[str] = (
        "The lens has spherical aberration: a sharp core with a halo, alike in all directions, that stopping down "
        "removes."
    )

    w040_um: Annotated[
        float,
        Quantity(
            "um", "path error at the pupil's rim", lower=0.0, upper=5.0, prior=(0.0, 0.3), absent=0.0, linear_power=2
        ),
    ] = 0.0

    stated_f_number: StatedFNumber = None

    def on_image(self, image: Image) -> Image:
        if self.w040_um == 0.0:
            return image
        path = seidel(spherical_um=self.w040_um).stopped(self.pupil_share(image.camera.lens.f_number))
        return image.add_laws(pupil=lambda wavelength_nm: path)
