"""Exposure offset: light is collected for a little longer or shorter than asked."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Charge


class ExposureOffset(Effect):
    """Exposure t + t0."""

    name: ClassVar[str] = "exposure_offset"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, linearity"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "wavelength", "field", "level", "orientation", "time"}
    )
    sentence: ClassVar[str] = (
        "The exposure is off by a constant time: the share of signal that is missing or too much grows as exposures "
        "get short."
    )

    offset_us: Annotated[
        float,
        Quantity(
            "us",
            "true exposure less the stated one",
            lower=-5000.0,
            upper=5000.0,
            prior=(0.0, 20.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    def on_charge(self, charge: Charge) -> Charge:
        if self.offset_us == 0.0:
            return charge
        return charge.add_laws(exposure_s=lambda exposure_s: max(exposure_s + self.offset_us * 1e-6, 0.0))
