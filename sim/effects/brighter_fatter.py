"""Brighter-fatter: full pixels push charge to their neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field
from scipy.ndimage import convolve

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.spectrum import FloatArray
from sim.stages import Charge


class BrighterFatter(Effect):
    """Temporal variance e (1 - a x) while the mean stays, x = e / full well: charge already collected repels the next,
    which goes to the neighbours and so has them share noise: correlation (b / 4) x with each of the four next ones, on
    average. Barriers along columns and rows differ: it is (b / 4) (1 + r) x in the row and (b / 4) (1 - r) x in the
    column.

    A pixel in silicon reaches farther: its neighbours across corners have q (b / 4) x, the second ones in the row and
    the column s (b / 4) x. Simulated and measured sensors have q of 0.2 to 0.5 and s of 0.05 to 0.2. q and s are forms
    of the law, 0 here.

    Where all that a pixel loses goes to these four b is a (charge is conserved: the covariances of all pixels sum up to
    e). Part of it lands farther away, or in the depth of other pixels, so that both are free.

    Means move between unequal neighbours, such as the colours of a mosaic in even light: the border between pixels of e
    and f electrons moves in proportion to e - f and takes the light that falls there, (e + f) / 2, along, so that the
    fuller one loses c / (4 W) (e^2 - f^2), W the full well, and 1 + r or 1 - r times as much. If borders are all there
    is, a and b are 4 c. Walls of charge between colours make c smaller.
    """

    name: ClassVar[str] = "brighter_fatter"
    title: ClassVar[str] = "brighter-fatter effect"
    family: ClassVar[Family] = Family.CHARGE_BETWEEN_NEIGHBOURS
    reference: ClassVar[str] = "P. Astier et al., A&A 629, A36 (2019)"
    form_tolerance: ClassVar[float] = 0.15
    shapes: ClassVar[frozenset[str]] = frozenset({"row_excess"})
    forms: ClassVar[Mapping[str, object]] = {"corner_share": 0.4, "second_share": 0.15}
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "field", "time"})
    sentence: ClassVar[str] = (
        "Full pixels repel charge: the noise of bright flats is lower than photon statistics say while their mean is "
        "on its line, and the missing variance appears as covariance of neighbours."
    )

    loss_percent: Annotated[
        float,
        Quantity(
            "%",
            "share of the variance that is missing at full well",
            lower=0.0,
            upper=80.0,
            prior=(0.0, 5.0),
            absent=0.0,
            linear_power=1,
        ),
    ] = 0.0
    shared_percent: Annotated[
        float,
        Quantity(
            "%",
            "sum of the covariances with the four neighbours at full well, over the shot noise's variance",
            lower=0.0,
            upper=80.0,
            prior=(0.0, 5.0),
            absent=0.0,
        ),
    ] = 0.0
    row_excess: Annotated[
        float,
        Quantity(
            "1",
            "covariance with each neighbour in the row over the mean of both kinds, less 1: -1 is none in the row",
            lower=-1.0,
            upper=1.0,
            prior=(0.0, 0.3),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0
    exchanged_percent: Annotated[
        float,
        Quantity(
            "%",
            "mean charge that a full pixel loses to its four neighbours if these are empty",
            lower=0.0,
            upper=40.0,
            prior=(0.0, 2.5),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0

    corner_share: Annotated[
        float,
        Field(ge=0.0, le=1.0, description="covariance with each pixel across corners, over the next ones'"),
    ] = 0.0
    second_share: Annotated[
        float, Field(ge=0.0, le=1.0, description="covariance with each second pixel, over the next ones'")
    ] = 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return (
            (
                cls(loss_percent=1.5),
                cls(loss_percent=1.5, shared_percent=1.5),
                cls(loss_percent=1.5, shared_percent=1.5, exchanged_percent=0.375),
            ),
        )

    def _shape(self) -> FloatArray:
        """Covariance with each neighbour over the mean of the four next ones, by kind (`NEIGHBOURS`)."""
        along, down = 1.0 + self.row_excess, 1.0 - self.row_excess
        return np.array([along, down, self.corner_share, self.second_share * along, self.second_share * down])

    def on_charge(self, charge: Charge) -> Charge:
        full_well_e = charge.camera.full_well_e
        if self.loss_percent != 0.0:
            charge = charge.add_laws(
                variance_e2=lambda electrons, variance_e2: (
                    variance_e2 - electrons * (self.loss_percent / 100.0) * electrons / full_well_e
                )
            )
        if self.shared_percent != 0.0:
            charge = charge.add_laws(
                correlation=lambda electrons: np.multiply.outer(
                    0.25 * (self.shared_percent / 100.0) * self._shape(),
                    np.clip(electrons / full_well_e, 0.0, 1.0),
                )
            )
        if self.exchanged_percent != 0.0:
            along, down = 1.0 + self.row_excess, 1.0 - self.row_excess
            next_less_own = np.array([[0.0, down, 0.0], [along, -4.0, along], [0.0, down, 0.0]])
            pair = 0.01 * self.exchanged_percent / (4.0 * full_well_e)
            charge = charge.add_laws(
                exchange=lambda electrons: (
                    electrons + pair * convolve(np.square(electrons), next_less_own, mode="mirror")
                )
            )
        return charge
