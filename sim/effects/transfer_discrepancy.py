"""A departure of the transfer function by direction or by wavelength that no effect of the list has."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Image

Shape = Literal["astigmatic", "diagonal", "chromatic"]
#: Wavelength at which the chromatic shape changes nothing, and the distance from it at which it is 1, nm.
MIDDLE_NM, REACH_NM = 550.0, 150.0


class TransferDiscrepancy(Effect):
    """A factor 1 + strength c(f) s on the transfer function: c linear between `at`, held beyond, 0 at frequency 0.

    s is cos 2 phi (`astigmatic`: rows against columns), sin 2 phi (`diagonal`), phi the direction of the frequency, or
    (wavelength - 550 nm) / 150 nm (`chromatic`). It describes; it names no cause, so that a diagnosis never looks
    for it."""

    name: ClassVar[str] = "transfer_discrepancy"
    family: ClassVar[Family] = Family.DISCREPANCY
    is_candidate: ClassVar[bool] = False
    reference: ClassVar[str] = "M. C. Kennedy and A. O'Hagan, J. R. Statist. Soc. B 63, 425 (2001)"
    form_tolerance: ClassVar[float] = 0.02
    sentence: ClassVar[str] = (
        "The contrast of detail departs from the model by direction or by wavelength, and no effect of the library "
        "says why."
    )

    shape: Annotated[Shape, Field(description="how it differs by direction or wavelength")] = "astigmatic"
    at: Annotated[
        tuple[float, ...], Field(min_length=2, description="frequencies, ascending from 0, cycles per um")
    ] = (
        0.0,
        0.1,
    )
    change: Annotated[tuple[float, ...], Field(description="relative change at each of them")] = (0.0, 0.1)
    strength: Annotated[
        float, Quantity("1", "share of the change that acts", lower=0.0, upper=2.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.at) != len(self.change):
            raise ValueError(f"change: {len(self.change)} values for {len(self.at)} frequencies: give one each")
        if list(self.at) != sorted(set(self.at)) or self.at[0] != 0.0 or self.change[0] != 0.0:
            raise ValueError("at: begin with frequency 0, at which nothing changes, and ascend")
        return self

    def on_image(self, image: Image) -> Image:
        if self.strength == 0.0:
            return image

        def transfer(fx: FloatArray, fy: FloatArray, wavelength_nm: float) -> FloatArray:
            frequency = np.hypot(fx, fy)
            change = self.strength * np.interp(frequency, self.at, self.change)
            if self.shape == "chromatic":
                return np.asarray(1.0 + change * (wavelength_nm - MIDDLE_NM) / REACH_NM)
            square = np.maximum(frequency**2, 1e-30)
            turned = (fx**2 - fy**2) / square if self.shape == "astigmatic" else 2.0 * fx * fy / square
            return np.asarray(1.0 + change * turned)

        return image.add_laws(transfer=transfer)
