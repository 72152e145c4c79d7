"""Blooming: charge of overfull pixels runs over along their column."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge


class Blooming(Effect):
    """Charge that overflows along the columns.

    A share of the charge above a pixel's full well runs over, half of it up and half of it down the column. It fills
    the next pixels to their full wells one after the other; the rest is drained. What runs off the frame is lost.
    """

    name: ClassVar[str] = "blooming"
    family: ClassVar[Family] = Family.CHARGE_BETWEEN_NEIGHBOURS
    reference: ClassVar[str] = "J. R. Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, blooming"
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "time"})
    sentence: ClassVar[str] = (
        "Pixels beyond their full well overflow: bright streaks stand above and below saturated places, along the "
        "columns alone."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of the charge beyond the full well that overflows",
            lower=0.0,
            upper=100.0,
            prior=(0.0, 10.0),
            absent=0.0,
        ),
    ] = 0.0

    def on_charge(self, charge: Charge) -> Charge:
        if self.share_percent == 0.0:
            return charge
        full_well_e = charge.camera.full_well_e

        def overflow(electrons: FloatArray) -> FloatArray:
            excess = 0.005 * self.share_percent * np.maximum(electrons - full_well_e, 0.0)
            if not np.any(excess):
                return electrons
            filled = electrons - 2.0 * excess
            for rows in (range(len(filled)), range(len(filled) - 1, -1, -1)):
                carried = np.zeros(filled.shape[1])
                for row in rows:
                    taken = np.minimum(carried, np.maximum(full_well_e - filled[row], 0.0))
                    filled[row] += taken
                    carried += excess[row] - taken
            return filled

        return charge.add_laws(overflow=overflow)
