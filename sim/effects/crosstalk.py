"""Crosstalk: a share of each pixel's charge ends up in its neighbours."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge


class Crosstalk(Effect):
    """A share c (1 + r) of each pixel's charge goes to each neighbour in its row, c (1 - r) to each in its column, c k
    to each across a corner: colours mix in uniform light, and the OTF factor is the kernel's cosine sum. Each electron
    goes its own way: the noise stays white.
    """

    name: ClassVar[str] = "crosstalk"
    family: ClassVar[Family] = Family.CHARGE_BETWEEN_NEIGHBOURS
    reference: ClassVar[str] = "K. Hirakawa, Cross-talk explained, ICIP 2008"
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "level", "time", "field"})
    shapes: ClassVar[frozenset[str]] = frozenset({"row_excess", "corner_share"})
    sentence: ClassVar[str] = (
        "Charge or light leaks into neighbouring pixels: each colour responds where only its neighbours should, and "
        "contrast falls."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of the charge that goes to each of the four next neighbours, their mean",
            lower=0.0,
            upper=20.0,
            prior=(0.0, 1.5),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0
    row_excess: Annotated[
        float,
        Quantity(
            "1",
            "share of each neighbour in the row over the mean of both kinds, less 1: 1 is none to those in the column",
            lower=-1.0,
            upper=1.0,
            prior=(0.0, 0.2),
            absent=0.0,
        ),
    ] = 0.0
    corner_share: Annotated[
        float,
        Quantity(
            "1",
            "share of each of the four neighbours across corners, over that mean",
            lower=0.0,
            upper=1.0,
            prior=(0.0, 0.2),
            absent=0.0,
        ),
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(share_percent=0.3),),)

    def kernel(self) -> FloatArray:
        """Return where the charge of a pixel ends up, (3, 3) of sum 1."""
        c = self.share_percent / 100.0
        along, down, across = c * (1.0 + self.row_excess), c * (1.0 - self.row_excess), c * self.corner_share
        centre = 1.0 - 2.0 * along - 2.0 * down - 4.0 * across
        return np.array([[across, down, across], [along, centre, along], [across, down, across]])

    def on_charge(self, charge: Charge) -> Charge:
        return charge if self.share_percent == 0.0 else charge.add_laws(kernels=self.kernel())
