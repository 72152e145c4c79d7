"""A model discrepancy: a smooth departure of recordings from the model that no effect of the library accounts for."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.optics.illumination import from_axis_um
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge, Image, Signal

Along = Literal[
    "frequency_cy_per_um",
    "astigmatic_frequency_cy_per_um",
    "diagonal_frequency_cy_per_um",
    "chromatic_frequency_cy_per_um",
    "radius_um",
    "signal_e",
    "variance_signal_e",
]
#: Wavelength at which a chromatic transfer is the model's, and the distance from it at which it has the whole factor.
MIDDLE_NM, REACH_NM = 550.0, 150.0


class ModelDiscrepancy(Effect):
    """A factor 1 + strength (f(x) - 1) on one stage: f linear between `at`, held beyond.

    `along` says on what, and what x is: `frequency_cy_per_um`, on the transfer function, alike in all directions;
    `astigmatic_`, `diagonal_` and `chromatic_frequency_cy_per_um`, on the transfer function 1 + (f - 1) s with s =
    cos 2 phi (rows against columns), sin 2 phi, phi the frequency's direction, or (wavelength - 550 nm) / 150 nm;
    `radius_um`, on the light by the distance from the optical axis; `signal_e`, on the mean signal;
    `variance_signal_e`, on the temporal variance by the mean signal. It describes and predicts; it explains nothing, so
    that a diagnosis never looks for it.
    """

    name: ClassVar[str] = "model_discrepancy"
    family: ClassVar[Family] = Family.DISCREPANCY
    is_candidate: ClassVar[bool] = False
    reference: ClassVar[str] = "M. C. Kennedy and A. O'Hagan, J. R. Statist. Soc. B 63, 425 (2001)"
    form_tolerance: ClassVar[float] = 0.2
    sentence: ClassVar[str] = (
        "Recordings depart from the model here by more than their noise, and no effect of the library says why: a "
        "smooth factor describes it."
    )

    along: Annotated[Along, Field(description="stage and axis")] = "frequency_cy_per_um"
    at: Annotated[tuple[float, ...], Field(min_length=2, description="places on the axis, ascending, in its unit")] = (
        0.0,
        0.1,
    )
    factor: Annotated[tuple[float, ...], Field(description="factor at each of them, above 0")] = (1.0, 0.9)
    strength: Annotated[
        float, Quantity("1", "share of the discrepancy that acts", lower=0.0, upper=2.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.at) != len(self.factor):
            raise ValueError(f"{len(self.at)} places and {len(self.factor)} factors: give as many of both")
        if any(b <= a for a, b in zip(self.at, self.at[1:], strict=False)) or any(f <= 0 for f in self.factor):
            raise ValueError("places have to ascend and factors to be above 0: sort them, and leave out what is below")
        return self

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(along=along, strength=0.3),) for along in get_args(Along))

    def _factor(self, x: FloatArray) -> FloatArray:
        return 1.0 + self.strength * (np.interp(x, self.at, self.factor) - 1.0)

    def _transfer(self, fx: FloatArray, fy: FloatArray, wavelength_nm: float) -> FloatArray:
        """Return the factor on the transfer function, over that at frequency 0, as light isn't lost."""
        factor = self._factor(np.hypot(fx, fy)) / float(self._factor(np.zeros(1))[0])
        if self.along == "frequency_cy_per_um":
            return factor
        if self.along == "chromatic_frequency_cy_per_um":
            return np.asarray(1.0 + (factor - 1.0) * (wavelength_nm - MIDDLE_NM) / REACH_NM)
        square = np.maximum(fx**2 + fy**2, 1e-30)
        turned = (fx**2 - fy**2) / square if self.along.startswith("astigmatic") else 2.0 * fx * fy / square
        return np.asarray(1.0 + (factor - 1.0) * turned)

    def on_image(self, image: Image) -> Image:
        if self.strength == 0.0:
            return image
        if self.along.endswith("frequency_cy_per_um"):
            return image.add_laws(transfer=self._transfer)
        if self.along == "radius_um":

            def shading(x_um: FloatArray, y_um: FloatArray) -> FloatArray:
                x, y, _ = from_axis_um(x_um, y_um, image.camera)
                return self._factor(np.hypot(x, y))

            return image.add_laws(shading=shading)
        return image

    def on_charge(self, charge: Charge) -> Charge:
        if self.strength == 0.0 or self.along != "variance_signal_e":
            return charge
        return charge.add_laws(variance_e2=lambda electrons, variance_e2: variance_e2 * self._factor(electrons))

    def on_signal(self, signal: Signal) -> Signal:
        if self.strength == 0.0 or self.along != "signal_e":
            return signal
        return signal.add_laws(response=lambda electrons: electrons * self._factor(electrons))
