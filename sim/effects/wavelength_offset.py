"""Wavelength offset: the radiometer's wavelengths are shifted."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Light


class WavelengthOffset(Effect):
    """A wavelength scale that is shifted: the radiance read at w lies at w + offset."""

    name: ClassVar[str] = "wavelength_offset"
    family: ClassVar[Family] = Family.SOURCE_IN_WAVELENGTH
    reference: ClassVar[str] = "CIE 214:2014"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "level", "field", "orientation"})
    sentence: ClassVar[str] = (
        "The wavelength scale is shifted: the measured sensitivities differ from the maker's curves, with opposite "
        "signs on rising and falling slopes."
    )

    offset_nm: Annotated[
        float,
        Quantity(
            "nm",
            "true wavelength less the stated one",
            lower=-15.0,
            upper=15.0,
            prior=(0.0, 2.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    def on_light(self, light: Light) -> Light:
        if self.offset_nm == 0.0:
            return light
        return light.add_laws(
            spectrum=lambda wavelength_nm, radiance, kind: np.interp(
                wavelength_nm - self.offset_nm, wavelength_nm, radiance
            )
        )
