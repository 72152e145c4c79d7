"""Pixel aperture: the share of the pixel that collects light isn't what the data sheet says."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge

NULL = 1e-6  # of a transfer


class PixelAperture(Effect):
    """Side of the square aperture changed by a few um: OTF factor sinc(w' fx) sinc(w' fy) / (sinc(w fx) sinc(w fy))."""

    name: ClassVar[str] = "pixel_aperture"
    family: ClassVar[Family] = Family.ISOTROPIC_CONTRAST
    reference: ClassVar[str] = (
        "G. Boreman, Modulation Transfer Function in Optical and Electro-Optical Systems, chapter 3"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    sentence: ClassVar[str] = (
        "The pixel's aperture differs from the stated one: contrast at high frequencies differs alike in all colours and at all f-numbers."
    )

    side_change_um: Annotated[
        float,
        Quantity(
            "um",
            "side of the aperture less the stated one",
            lower=-5.0,
            upper=5.0,
            prior=(0.0, 0.5),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    def on_charge(self, charge: Charge) -> Charge:
        if self.side_change_um == 0.0:
            return charge
        side = charge.camera.pixel_pitch_um * charge.camera.fill_factor**0.5
        new = max(side + self.side_change_um, 0.05 * side)

        def transfer(fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float) -> FloatArray:
            ratio = np.ones(np.broadcast_shapes(np.shape(fx_cy_per_um), np.shape(fy_cy_per_um)))
            for f in (fx_cy_per_um, fy_cy_per_um):
                below = np.sinc(side * f)
                # at the stated aperture's nulls the ratio has no value, beside them it is large: the pixel's own transfer makes up for it
                ratio = ratio * np.where(
                    np.abs(below) > NULL, np.sinc(new * f) / np.where(np.abs(below) > NULL, below, 1.0), 1.0
                )
            return ratio

        return charge.adding(transfer=transfer)
