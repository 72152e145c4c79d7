"""Vibration or motion during the exposure: the image moves along one direction."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from scipy.special import j0

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image


class VibrationBlur(Effect):
    """OTF factor J0(2 pi (ax fx + ay fy)) of a sinusoidal movement with amplitude (ax, ay), long against its period."""

    name: ClassVar[str] = "vibration_blur"
    family: ClassVar[Family] = Family.DIRECTIONAL_CONTRAST
    reference: ClassVar[str] = "J. Hadar, I. Dror, N. Kopeika, Opt. Eng. 33, 566 (1994)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level"})
    sentence: ClassVar[str] = (
        "The image moved during the exposure: contrast falls along one direction and is unchanged across it."
    )

    amplitude_x_um: Annotated[
        float,
        Quantity("um", "amplitude along columns", lower=0.0, upper=20.0, prior=(0.0, 1.5), absent=0.0, linear_power=2),
    ] = 0.0
    amplitude_y_um: Annotated[
        float,
        Quantity("um", "amplitude along rows", lower=-20.0, upper=20.0, prior=(0.0, 1.5), absent=0.0, linear_power=2),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        # one direction of movement each: two movements at once don't add
        return tuple(
            (cls(amplitude_x_um=0.5 * float(np.cos(a)), amplitude_y_um=0.5 * float(np.sin(a))),)
            for a in np.deg2rad([0, 30, 60, 90, -30, -60])
        )

    def on_image(self, image: Image) -> Image:
        if self.amplitude_x_um == 0.0 and self.amplitude_y_um == 0.0:
            return image

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            return np.asarray(
                j0(2.0 * np.pi * (self.amplitude_x_um * fx_cy_per_um + self.amplitude_y_um * fy_cy_per_um))
            )

        return image.add_laws(transfer=transfer)
