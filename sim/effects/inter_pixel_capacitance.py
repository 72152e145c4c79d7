"""Inter-pixel capacitance: neighbouring pixels share their voltages, after the noise was made."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sim.effects.crosstalk import Crosstalk
from sim.effects.families import Family
from sim.sensor.electrons import NEIGHBOURS
from sim.stages import Charge


class InterPixelCapacitance(Crosstalk):
    """The kernel of `Crosstalk` on what the pixels hold, noise and all, with unequal axes and a share across corners:
    the image and its colours mix as by charge that goes astray. Shot noise has the kernel's autocorrelation at all
    levels of light: 2 c / (1 - 4 c) of the next pixels to first order, and as much across corners as these couple.
    Read noise comes after.
    """

    name: ClassVar[str] = "inter_pixel_capacitance"
    title: ClassVar[str] = "inter-pixel capacitance"
    family: ClassVar[Family] = Family.CHARGE_BETWEEN_NEIGHBOURS
    reference: ClassVar[str] = "A. C. Moore, Z. Ninkov, W. J. Forrest, Optical Engineering 45, 076402 (2006)"
    sentence: ClassVar[str] = (
        "Neighbouring pixels share their voltages: contrast falls, colours mix, and shot noise is correlated between "
        "neighbours at all levels of light, but read noise isn't."
    )

    def log_prior(self) -> float:
        # of hybrid arrays, whose pixels are read through bumps; sensors in one piece of silicon hardly have it
        return 0.0 if self.share_percent == 0.0 else -2.0

    def on_charge(self, charge: Charge) -> Charge:
        if self.share_percent == 0.0:
            return charge
        kernel = self.kernel()
        squares = float(np.sum(np.square(kernel)))
        wide = np.pad(kernel, 2)
        shared = np.array(
            [np.sum(kernel * wide[2 + down : 5 + down, 2 + right : 5 + right]) for (down, right), *_ in NEIGHBOURS]
        )
        shared, lost = shared / squares, 1.0 - squares
        return charge.add_laws(
            kernels=kernel,
            correlation=lambda electrons: np.multiply.outer(shared, np.ones(np.shape(electrons))),
            variance_e2=lambda electrons, variance_e2: variance_e2 - electrons * lost,
        )
