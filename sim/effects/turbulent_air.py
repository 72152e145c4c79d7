"""Turbulent air: long exposures through it are blurred by Kolmogorov's spectrum of phases, as by seeing."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image

#: Full width at half maximum of the spread over the wavelength by Fried's length, and the exponent of the transfer.
WIDTH, STRUCTURE, POWER = 0.975863, 3.44, 5.0 / 3.0


class TurbulentAir(Effect):
    """Transfer factor exp(-3.44 (s f)^(5/3)) of a long exposure, s = w / 0.976, w the full width at half maximum of the
    point spread: warm air before the lens, or above a hot window.

    s is focal length times wavelength over Fried's length, which grows as wavelength^(6/5): the blur is as good as the
    same for all colours, by wavelength^(-1/5). Near its core the spread is a Moffat profile of exponent 4.8; its wings
    fall as r^(-11/3).
    """

    name: ClassVar[str] = "turbulent_air"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "D. L. Fried, J. Opt. Soc. Am. 56 (1966) 1372; I. Trujillo et al., MNRAS 328 (2001) 977"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    sentence: ClassVar[str] = (
        "Turbulent air blurs: contrast falls alike in all directions and colours, by the law of seeing, whatever the "
        "f-number."
    )

    width_um: Annotated[
        float,
        Quantity("um", "full width at half maximum of the point spread", lower=0.0, upper=40.0, prior=(0.0, 1.5),
                 absent=0.0, linear_power=POWER),
    ] = 0.0  # fmt: skip

    def log_prior(self) -> float:
        """Return -ln 10: few cameras look through turbulent air."""
        return -float(np.log(10.0)) if self.width_um else 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(width_um=0.3 * camera.pixel_pitch_um),),)

    def on_image(self, image: Image) -> Image:
        if self.width_um == 0.0:
            return image

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            f = np.hypot(fx_cy_per_um, fy_cy_per_um)
            return np.asarray(np.exp(-STRUCTURE * (self.width_um / WIDTH * f) ** POWER))

        return image.add_laws(transfer=transfer)
