"""Radiometer nonlinearity: strong light is read low, or high, against weak light."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light

#: W sr^-1 m^-2 nm^-1 at which the reading is right: that of a lamp in a sphere. Any other level is a factor on
#: everything, which the scale of the sensitivity takes.
RIGHT_AT = 0.01


class RadiometerNonlinearity(Effect):
    """The true radiance of narrowband light that was read as L, of peak P, is L exp(a (p^q - 1) / q), p = P / 0.01: a
    power of the level, p^a, for q = 0, and for q = 1 an error in proportion to the level, as of a detector that begins
    to saturate.
    """

    name: ClassVar[str] = "radiometer_nonlinearity"
    family: ClassVar[Family] = Family.SOURCE_IN_WAVELENGTH
    reference: ClassVar[str] = "CIE 214:2014; S. Yang, I. Vayshenker, X. Li, T. R. Scott, NIST J. Res. 99, 1 (1994)"
    form_tolerance: ClassVar[float] = 0.04
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "field", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"growth"})
    sentence: ClassVar[str] = (
        "The radiometer isn't linear: the sensitivity that is measured follows the level of the light and not its "
        "wavelength, alike in all channels."
    )

    exponent_percent: Annotated[
        float,
        Quantity(
            "%",
            "exponent less 1 of the true light as a power of the reading, about a peak of 0.01 W sr^-1 m^-2 nm^-1",
            lower=-30.0,
            upper=30.0,
            prior=(0.0, 1.0),
            absent=0.0,
        ),
    ] = 0.0
    growth: Annotated[
        float,
        Quantity("1", "power of the level with which the error grows", lower=0.0, upper=1.5, prior=(0.0, 0.5),
                 absent=0.0, dispensable=True),
    ] = 0.0  # fmt: skip

    def on_light(self, light: Light) -> Light:
        if self.exponent_percent == 0.0:
            return light

        def spectrum(wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
            peak = float(np.max(radiance))
            if kind != "narrowband" or peak <= 0.0:
                return radiance
            level = float(np.log(peak / RIGHT_AT))
            grown = level if self.growth == 0.0 else float(np.expm1(self.growth * level)) / self.growth
            return np.asarray(radiance * np.exp(0.01 * self.exponent_percent * grown))

        return light.add_laws(spectrum=spectrum)
