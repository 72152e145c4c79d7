"""Lamp ageing: white light is no longer of the spectrum that was stated for it."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light

#: Kinds of capture that the lamp lights in white; a screen has its own light.
LAMP_LIT = frozenset({"flat", "chart", "slanted_edge", "charuco"})
#: Wavelength (nm) about which the spectrum tilts.
PIVOT_NM = 550.0


class LampAgeing(Effect):
    """White light of the stated radiance L is s L exp(a (w - 550 nm) / 100 nm), w the wavelength; s keeps the integral
    of L, as an error of the level is the exposures' or the lamp's own.

    A bulb that blackens, an LED's phosphor or lens that yellows: short wavelengths lose most, a > 0. A certificate of
    another lamp does the same with either sign. Light of one wavelength is as it was measured.
    """

    name: ClassVar[str] = "lamp_ageing"
    family: ClassVar[Family] = Family.SOURCE_IN_WAVELENGTH
    reference: ClassVar[str] = "CIE 250:2022, spectral ageing of lamps; IES LM-80-20, chromaticity shift of LEDs"
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "field", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The lamp has aged since its spectrum was stated: in white light the channels' signals lie apart as a "
        "redder, or bluer, lamp would put them, and in light of one wavelength they don't."
    )

    reddening_percent: Annotated[
        float,
        Quantity(
            "%",
            "change of the white light's radiance for each 100 nm of wavelength",
            lower=-60.0,
            upper=60.0,
            prior=(0.0, 3.0),
            absent=0.0,
        ),
    ] = 0.0

    def on_light(self, light: Light) -> Light:
        if self.reddening_percent == 0.0:
            return light

        def spectrum(wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
            if kind not in LAMP_LIT:
                return radiance
            tilted = radiance * np.exp(0.01 * self.reddening_percent * (wavelength_nm - PIVOT_NM) / 100.0)
            total = float(np.trapezoid(tilted, wavelength_nm))
            if total <= 0.0:
                return radiance
            return np.asarray(tilted * (np.trapezoid(radiance, wavelength_nm) / total))

        return light.add_laws(spectrum=spectrum)
