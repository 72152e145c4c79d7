"""Brighter-fatter: full pixels push charge to their neighbours."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.camera import CameraModel
from sim.effects.base import Effect, Stage
from sim.parameters import Quantity
from sim.spectrum import FloatArray


class BrighterFatter(Effect):
    """Temporal variance e (1 - a e) while the mean stays: charge already collected repels the next."""

    name: ClassVar[str] = "brighter_fatter"
    stage: ClassVar[Stage] = Stage.CHARGE
    reference: ClassVar[str] = "P. Astier et al., A&A 629, A36 (2019)"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "orientation", "time"}
    )
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat"})
    rivals: ClassVar[frozenset[str]] = frozenset({"nonlinearity"})
    sentence: ClassVar[str] = (
        "Full pixels repel charge: the noise of bright flats is lower than photon statistics say while their mean is on its line."
    )

    loss_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of the variance that is missing at full well",
            lower=0.0,
            upper=80.0,
            prior=(0.0, 5.0),
            absent=0.0,
            slope_power=1,
        ),
    ] = 0.0

    def noise_e2(self, electrons: FloatArray, noise_e2: FloatArray, camera: CameraModel) -> FloatArray:
        return noise_e2 - electrons * (self.loss_percent / 100.0) * electrons / camera.full_well_e
