"""Charge diffusion: electrons drift sideways before they are collected."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge


class ChargeDiffusion(Effect):
    """OTF factor exp(-2 pi^2 s^2 f^2) with s = length (wavelength / 550 nm)^wavelength_power.

    Red light is absorbed deeper, where the field is weak: s grows with the absorption length. A power of the wavelength
    stands for absorption profile and field-free depth, which a data sheet doesn't give (Seib 1974, Stevens 1992 have
    laws with both); the form tolerance covers the rest.
    """

    name: ClassVar[str] = "charge_diffusion"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = "D. Seib, IEEE Trans. Electron Devices 21, 210 (1974)"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "field", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"wavelength_power"})
    sentence: ClassVar[str] = (
        "Charge diffuses to neighbouring pixels before it is collected: contrast falls as a Gaussian of spatial "
        "frequency, alike in all directions, at all f-numbers, and never less in red than in blue."
    )

    length_um: Annotated[
        float,
        Quantity("um", "standard deviation of the sideways drift at 550 nm", lower=0.0, upper=10.0, prior=(0.0, 0.7),
                 absent=0.0,
                 linear_power=2),
    ] = 0.0  # fmt: skip
    wavelength_power: Annotated[
        float,
        Quantity(
            "1",
            "power of the wavelength with which the drift grows",
            lower=0.0,
            upper=4.0,
            prior=(1.0, 1.0),
            absent=0.0,
        ),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(length_um=0.2, wavelength_power=power),) for power in (0.0, 1.0, 3.0))

    def on_charge(self, charge: Charge) -> Charge:
        if self.length_um == 0.0:
            return charge

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            length = self.length_um * (wavelength_nm / 550.0) ** self.wavelength_power
            return np.asarray(np.exp(-2.0 * np.pi**2 * length**2 * (fx_cy_per_um**2 + fy_cy_per_um**2)))

        return charge.add_laws(transfer=transfer)
