"""Nonlinearity of the read-out: the response bends with the signal."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Signal

#: Share of full well over which the toe fades.
TOE = 0.1


class Nonlinearity(Effect):
    """electrons (1 + a x + b x^2 + c exp(-x / 0.1)) with x = electrons / full well; a, b in percent at full well, c at
    none.
    """

    name: ClassVar[str] = "nonlinearity"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = "EMVA Standard 1288 release 4.0, linearity"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "orientation", "time"})
    sentence: ClassVar[str] = (
        "The response bends: the signal a photon leaves depends on the level, alike in all channels and exposures."
    )

    quadratic_percent: Annotated[
        float,
        Quantity(
            "%",
            "departure from a line that grows with the signal, at full well",
            lower=-50.0,
            upper=50.0,
            prior=(0.0, 3.0),
            absent=0.0,
        ),
    ] = 0.0
    cubic_percent: Annotated[
        float,
        Quantity(
            "%",
            "departure from a line that grows with its square, at full well",
            lower=-50.0,
            upper=50.0,
            prior=(0.0, 3.0),
            absent=0.0,
        ),
    ] = 0.0

    toe_percent: Annotated[
        float,
        Quantity(
            "%",
            "departure of small signals, below a tenth of full well",
            lower=-50.0,
            upper=50.0,
            prior=(0.0, 3.0),
            absent=0.0,
        ),
    ] = 0.0

    def on_signal(self, signal: Signal) -> Signal:
        if self.quadratic_percent == 0.0 and self.cubic_percent == 0.0 and self.toe_percent == 0.0:
            return signal

        def response(electrons: FloatArray) -> FloatArray:
            x = electrons / signal.camera.full_well_e
            bend = self.quadratic_percent * x + self.cubic_percent * x * x + self.toe_percent * np.exp(-np.abs(x) / TOE)
            return electrons * (1.0 + bend / 100.0)

        return signal.add_laws(response=response)
