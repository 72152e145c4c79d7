"""Black level drift: the black level changes with time or temperature."""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Signal


class BlackLevelDrift(Effect):
    """DN added: a t + b (T - 25 C), t from the first capture."""

    name: ClassVar[str] = "black_level_drift"
    title: ClassVar[str] = "black-level drift"
    family: ClassVar[Family] = Family.DARK_SIGNAL
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, dark signal"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation"}
    )
    sentence: ClassVar[str] = (
        "The black level drifts: all captures carry an additional offset that grows with time or temperature and not "
        "with light."
    )

    drift_dn_per_min: Annotated[
        float,
        Quantity("DN/min", "change with time", lower=-50.0, upper=50.0, prior=(0.0, 0.5), absent=0.0, linear_power=1),
    ] = 0.0
    drift_dn_per_c: Annotated[
        float,
        Quantity(
            "DN/C", "change with temperature", lower=-50.0, upper=50.0, prior=(0.0, 0.5), absent=0.0, linear_power=1
        ),
    ] = 0.0

    def on_signal(self, signal: Signal) -> Signal:
        if self.drift_dn_per_min == 0.0 and self.drift_dn_per_c == 0.0:
            return signal

        def offset(elapsed_s: float, temperature_c: float | None) -> float:
            warmer = 0.0 if temperature_c is None else temperature_c - 25.0
            return self.drift_dn_per_min * elapsed_s / 60.0 + self.drift_dn_per_c * warmer

        return signal.add_laws(offset_dn=offset)
