"""Stray light: the monochromator lets a little light of all wavelengths through."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Light


class StrayLight(Effect):
    """Narrowband radiance plus a share of its integral, spread evenly over the wavelengths stated."""

    name: ClassVar[str] = "stray_light"
    family: ClassVar[Family] = Family.SOURCE_IN_WAVELENGTH
    reference: ClassVar[str] = "Y. Zong et al., Appl. Opt. 45, 1111 (2006)"
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "field", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The monochromator leaks light of all wavelengths: channels respond where they should be blind, in proportion "
        "to the lamp."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of the light that is spread over all wavelengths",
            lower=0.0,
            upper=50.0,
            prior=(0.0, 0.3),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    def on_light(self, light: Light) -> Light:
        share = self.share_percent / 100.0
        if share == 0.0:
            return light

        def spectrum(wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
            if kind != "narrowband":
                return radiance
            mean = np.trapezoid(radiance, wavelength_nm) / (wavelength_nm[-1] - wavelength_nm[0])
            return np.asarray((1.0 - share) * radiance + share * mean)

        return light.add_laws(spectrum=spectrum)
