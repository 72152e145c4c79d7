"""Response knee: above one level the read-out has another slope, as of companding or of two gains that are joined."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Signal

#: Shares of full well at which a knee is tried first.
PLACES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


class ResponseKnee(Effect):
    """electrons + s max(electrons - k full well, 0): the slope is 1 below the knee and 1 + s above it. The variance
    goes with the square of the slope. A knee that is rounded over the share r of full well has r ln(1 + exp(x / r)) in
    place of max(x, 0), x the level over full well less k.
    """

    name: ClassVar[str] = "response_knee"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = (
        "EMVA Standard 1288 release 4.0 General, piecewise linear response; O. Yadid-Pecht, Wide-dynamic-range "
        "sensors, "
        "Optical Engineering 38 (1999) 1650"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"knee_share"})
    forms: ClassVar[Mapping[str, object]] = {"rounding_share": 0.03}
    sentence: ClassVar[str] = (
        "The response has a knee: from one level on, the signal and the slope of its noise grow by another factor, and "
        "below that level everything is in proportion."
    )

    slope_percent: Annotated[
        float,
        Quantity(
            "%",
            "change of the slope above the knee",
            lower=-99.0,
            upper=100.0,
            prior=(0.0, 5.0),
            absent=0.0,
        ),
    ] = 0.0
    knee_share: Annotated[
        float, Quantity("1", "level of the knee over full well", lower=0.01, upper=0.99, absent=0.5)
    ] = 0.5
    rounding_share: Annotated[
        float, Field(description="share of full well over which the knee is rounded", ge=0.0, le=0.2)
    ] = 0.0

    def log_prior(self) -> float:
        """Return -ln 10: a response that isn't straight bends smoothly in all cameras but those with a mode for it."""
        return -float(np.log(10.0)) if self.slope_percent else 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(slope_percent=1.5, knee_share=knee), cls(slope_percent=-1.5, knee_share=knee)) for knee in PLACES
        )

    def on_signal(self, signal: Signal) -> Signal:
        if self.slope_percent == 0.0:
            return signal

        def response(electrons: FloatArray) -> FloatArray:
            full = signal.camera.full_well_e
            above = electrons / full - self.knee_share
            if self.rounding_share > 0.0:
                above = self.rounding_share * np.logaddexp(0.0, above / self.rounding_share)
            return np.asarray(electrons + 0.01 * self.slope_percent * full * np.maximum(above, 0.0))

        return signal.add_laws(response=response)
