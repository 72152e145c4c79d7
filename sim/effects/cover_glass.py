"""Cover glass: a plate before the sensor that the lens wasn't computed with."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.filters import plate_wavefront
from sim.parameters import Quantity
from sim.stages import Image


class CoverGlass(Effect):
    """Spherical aberration W040 = t (n^2 - 1) / (128 n^3 N^4), in the new focus, or with t (1 - 1/n) of defocus in the
    old one.

    A component that a camera is known to have. What it does is spherical aberration, so that captures can't tell the
    two apart: a diagnosis doesn't look for it. A plate that stands in a lens's prescription is traced with it.
    """

    name: ClassVar[str] = "cover_glass"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    is_candidate: ClassVar[bool] = False
    reference: ClassVar[str] = "V. Mahajan, Optical Imaging and Aberrations, part I, section 5.8"
    form_tolerance: ClassVar[float] = 0.06
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time", "field"})
    sentence: ClassVar[str] = (
        "A glass plate stands before the sensor that the lens wasn't computed with: it adds spherical aberration, the "
        "more the wider the aperture."
    )

    thickness_mm: Annotated[
        float,
        Quantity("mm", "thickness of the plate", lower=0.0, upper=20.0, prior=(0.0, 5.0), absent=0.0, linear_power=2),
    ] = 0.0
    refractive_index: Annotated[float, Field(ge=1.0, le=3.0, description="refractive index of the plate")] = 1.52
    refocused: Annotated[bool, Field(description="whether the lens is focused anew behind the plate")] = True

    def on_image(self, image: Image) -> Image:
        if self.thickness_mm == 0.0:
            return image
        path = plate_wavefront(
            self.thickness_mm, self.refractive_index, image.camera.lens.f_number, refocused=self.refocused
        )
        return image.add_laws(pupil=lambda wavelength_nm: path)
