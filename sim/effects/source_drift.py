"""Source drift: the lamp changes while the recordings are taken."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Light

#: Longer than any session: a drift in proportion to the time.
SETTLES_NEVER_MIN = 1e4


class SourceDrift(Effect):
    """Radiance factor 1 + a T (1 - exp(-t / T)): in proportion to the time at first, settled after a few T. 1 + a t for
    long T.
    """

    name: ClassVar[str] = "source_drift"
    family: ClassVar[Family] = Family.SOURCE_IN_TIME
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, irradiation"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level", "orientation"})
    shapes: ClassVar[frozenset[str]] = frozenset({"settling_min"})
    sentence: ClassVar[str] = "The source drifts: signals follow the time of the capture and not the level."

    drift_percent_per_min: Annotated[
        float,
        Quantity(
            "%/min",
            "change of the radiance with time",
            lower=-20.0,
            upper=20.0,
            prior=(0.0, 0.3),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0

    settling_min: Annotated[
        float,
        Quantity(
            "min",
            "time constant of an exponential warm-up; none: a linear drift",
            lower=0.5,
            upper=SETTLES_NEVER_MIN,
            absent=SETTLES_NEVER_MIN,
            dispensable=True,
        ),
    ] = SETTLES_NEVER_MIN

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            (cls(drift_percent_per_min=0.1, settling_min=t), cls(drift_percent_per_min=-0.1, settling_min=t))
            for t in (SETTLES_NEVER_MIN, 30.0, 8.0, 2.0)
        )

    def on_light(self, light: Light) -> Light:
        if self.drift_percent_per_min == 0.0:
            return light

        def level(elapsed_s: float) -> float:
            settled = self.settling_min * -np.expm1(-elapsed_s / 60.0 / self.settling_min)
            return float(1.0 + self.drift_percent_per_min / 100.0 * settled)

        return light.add_laws(level=level)
