"""Source drift: the lamp changes while the recordings are taken."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect, Stage
from sim.parameters import Quantity


class SourceDrift(Effect):
    """Radiance factor 1 + a t."""

    name: ClassVar[str] = "source_drift"
    stage: ClassVar[Stage] = Stage.RIG
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, irradiation"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "level", "orientation"})
    shown_by: ClassVar[frozenset[str]] = frozenset({"flat", "narrowband"})
    rivals: ClassVar[frozenset[str]] = frozenset({"nonlinearity", "exposure_offset"})
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
            slope_power=1,
        ),
    ] = 0.0

    def drift(self, elapsed_s: float) -> float:
        return 1.0 + self.drift_percent_per_min / 100.0 * elapsed_s / 60.0
