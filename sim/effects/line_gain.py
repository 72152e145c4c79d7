"""What the gains of columns and of rows share: factors on lines, drawn once."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.lines import LineGains, Lines
from sim.stages import Signal


class LineGain(Effect):
    """Normal factors on what is read of the lines, the same in every frame, of mean 1: signal and noise grow with them,
    and dark frames don't show them.
    """

    family: ClassVar[Family] = Family.READ_OUT_AREAS
    reference: ClassVar[str] = (
        "EMVA Standard 1288 release 4.0, spatial variances of rows and columns of PRNU; A. El Gamal et al., Proc. SPIE "
        "3301 (1998) 168"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "level", "time"})
    lines: ClassVar[Lines]

    gain_percent: Annotated[
        float,
        Quantity("%", "standard deviation of the lines' gains", lower=0.0, upper=50.0, prior=(0.0, 1.0), absent=0.0),
    ] = 0.0
    pattern_seed: Annotated[int, Field(description="which of the patterns that the law can draw")] = 0

    def on_signal(self, signal: Signal) -> Signal:
        if self.gain_percent == 0.0:
            return signal
        return signal.add_laws(line_gains=LineGains(self.lines, 0.01 * self.gain_percent, self.pattern_seed))
