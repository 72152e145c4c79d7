"""Axial chromatic aberration: colours come to focus at different distances."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.pupil import Wavefront, seidel
from sim.parameters import Quantity
from sim.stages import Image

#: The wavelength that is in focus.
FOCUSED_NM = 550.0


class AxialChromaticAberration(Effect):
    """The sensor lies dz = a t + b t^2 from the focus of a wavelength, t = (wavelength - 550 nm) / 100 nm:
    W = dz / (8 N^2) rho^2.

    a is the primary spectrum, b what a corrected lens leaves. Alone, either acts by its square; with a defocus of the
    whole lens the sign counts: one end of the spectrum comes into focus.
    """

    name: ClassVar[str] = "axial_chromatic_aberration"
    family: ClassVar[Family] = Family.COLOUR_BLUR
    reference: ClassVar[str] = "W. J. Smith, Modern Optical Engineering, chapter on chromatic aberration"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time", "field"})
    sentence: ClassVar[str] = (
        "The lens doesn't focus all colours in one plane: some channels are sharper than others, and which ones they "
        "are changes with the focus."
    )

    slope_um: Annotated[
        float,
        Quantity("um", "distance of sensor and focus at 650 nm, of the part that is linear in wavelength less 550 nm",
                 lower=-100.0,
                 upper=100.0, prior=(0.0, 10.0), absent=0.0, linear_power=2),
    ] = 0.0  # fmt: skip
    curvature_um: Annotated[
        float,
        Quantity("um", "the same, of the part that is quadratic", lower=-100.0, upper=100.0, prior=(0.0, 10.0),
                 absent=0.0,
                 linear_power=2),
    ] = 0.0  # fmt: skip

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        # the two signs differ only beside a defocus, and then they are no small change of each other
        return tuple((cls(slope_um=sign * 4.0), cls(curvature_um=sign * 4.0)) for sign in (1.0, -1.0))

    def on_image(self, image: Image) -> Image:
        if self.slope_um == 0.0 and self.curvature_um == 0.0:
            return image

        def path(wavelength_nm: float) -> Wavefront:
            t = (wavelength_nm - FOCUSED_NM) / 100.0
            defocus_um = t * (self.slope_um + self.curvature_um * t)
            return seidel(defocus_um=defocus_um / (8.0 * image.camera.lens.f_number**2))

        return image.add_laws(pupil=path)
