"""What the effects on the converter share: what they don't depend on, and where their laws come from."""

from __future__ import annotations

from typing import ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity


class ConverterLaw(Effect):
    """Levels -> codes, one law for all pixels."""

    family: ClassVar[Family] = Family.CONVERTER
    reference: ClassVar[str] = (
        "IEEE Std 1241-2010, differential and integral nonlinearity of analogue-to-digital converters"
    )
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "orientation", "time"}
    )


def bit_error(meaning: str, lower: float, upper: float, usual: float, *, dispensable: bool = False) -> Quantity:
    """Declare the error of a bit's weight, DN; `usual`: standard deviation of its prior."""
    return Quantity("DN", meaning, lower=lower, upper=upper, prior=(0.0, usual), absent=0.0, dispensable=dispensable)
