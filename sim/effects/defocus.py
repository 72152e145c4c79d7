"""Defocus: the sensor lies in front of or behind the image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from sim.effects.base import Effect, StatedFNumber
from sim.effects.families import Family
from sim.optics.pupil import seidel
from sim.parameters import Quantity
from sim.stages import Image

#: Share of a defocused lens's path error that may be spherical aberration, balanced at the rim.
SPHERICAL_SHARE = 0.1


class Defocus(Effect):
    """Path error W020 = dz / (8 N^2) at the pupil's rim: the OTF of a circular pupil with a quadratic path error
    (Hopkins).

    Away from its focus a lens has some spherical aberration, too: W = W020 (r^2 + s (r^4 - r^2)) at `stated_f_number`
    N0. At f/N the share of r^4 is s (N0 / N)^2.
    """

    name: ClassVar[str] = "defocus"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "H. H. Hopkins, Proc. R. Soc. A 231, 91 (1955)"
    form_tolerance: ClassVar[float] = 0.02
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "orientation", "time"})
    forms: ClassVar[Mapping[str, object]] = {"spherical_share": SPHERICAL_SHARE}
    sentence: ClassVar[str] = (
        "The sensor is not in the image plane: contrast falls alike in all directions, with the shape of a defocused "
        "pupil, and would come back on stopping down."
    )

    defocus_um: Annotated[
        float,
        Quantity(
            "um",
            "distance of sensor and image plane",
            lower=0.0,
            upper=200.0,
            prior=(0.0, 20.0),
            absent=0.0,
            linear_power=2,
        ),
    ] = 0.0

    spherical_share: Annotated[float, Field(description="share of spherical aberration in the path error")] = 0.0
    stated_f_number: StatedFNumber = None

    def on_image(self, image: Image) -> Image:
        if self.defocus_um == 0.0:
            return image
        f_number = image.camera.lens.f_number
        share = self.pupil_share(f_number)
        rim_um = self.defocus_um / (8.0 * (share * f_number) ** 2)  # of the stated pupil
        path = seidel(
            defocus_um=rim_um * (1.0 - self.spherical_share), spherical_um=rim_um * self.spherical_share
        ).stopped(share)
        return image.add_laws(pupil=lambda wavelength_nm: path)
