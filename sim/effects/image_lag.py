"""Image lag: a share of the charge isn't read but stays in the pixel for the next frame."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Charge


class ImageLag(Effect):
    """Read: (1 - q) (x_t + l_t), left: l_(t+1) = q (x_t + l_t). In steady light nothing changes; after it q^k of it is
    still there in the k-th dark frame, and the first frame of a series lacks q.

    q is a constant, or grows with the charge x as (x / W)^p, W the full well: a barrier or a pocket behind the transfer
    gate that holds back full pixels' charge alone has a large p.
    """

    name: ClassVar[str] = "image_lag"
    family: ClassVar[Family] = Family.FRAME_MEMORY
    reference: ClassVar[str] = (
        "E. R. Fossum, Charge transfer noise and lag in CMOS active pixel sensors, IEEE Workshop on CCDs and AIS 2003"
    )
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "orientation"})
    shapes: ClassVar[frozenset[str]] = frozenset({"growth"})
    sentence: ClassVar[str] = (
        "Image lag: a share of a frame's charge is read with the next frame, so that a dark frame after a bright one "
        "shows a faint copy of it."
    )

    lag_percent: Annotated[
        float, Quantity("%", "share of the charge that stays", lower=0.0, upper=90.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    growth: Annotated[
        float,
        Quantity("1", "power of the charge, over a full well, with which the share grows", lower=0.0, upper=20.0,
                 prior=(0.0, 1.0), absent=0.0, dispensable=True),
    ] = 0.0  # fmt: skip

    def on_charge(self, charge: Charge) -> Charge:
        if self.lag_percent == 0.0:
            return charge
        share, full_well_e = 0.01 * self.lag_percent, charge.camera.full_well_e
        if self.growth == 0.0:
            return charge.add_laws(lag=lambda electrons: share * electrons)
        return charge.add_laws(
            lag=lambda electrons: share * electrons * np.clip(electrons / full_well_e, 0.0, 1.0) ** self.growth
        )
