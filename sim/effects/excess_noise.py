"""Excess noise: each electron is multiplied by a random number before read-out, in an EM register or an avalanche."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.electrons import Multiplication
from sim.stages import Charge


class ExcessNoise(Effect):
    """The variance of the shot noise is F^2 e in place of e, while the mean stays, as the conversion gain is that of a
    mean electron. McIntyre: a multiplication by M on average, of electrons alone, has F^2 = 2 - 1/M: 1 without, near 2
    from some tens on, as in EM registers. Where holes multiply, too, as in avalanche diodes, it is above 2.

    By the slope of variance over mean, F^2 and the conversion gain are one number. Three things tell them apart: levels
    of light of known radiance (the gain is by F^2 too high for them); the skewness of the noise, as a single electron's
    charge is distributed between a geometric and a gamma distribution; and flats at two settings of a register's gain,
    over which F^2 changes as the law says, but a conversion gain in proportion to the setting (`gain_setting`).
    """

    name: ClassVar[str] = "excess_noise"
    family: ClassVar[Family] = Family.PHOTON_NOISE
    reference: ClassVar[str] = (
        "R. J. McIntyre, IEEE Trans. Electron Devices 13 (1966) 164; M. S. Robbins and B. J. Hadwen, The noise "
        "performance of electron multiplying charge-coupled devices, IEEE Trans. Electron Devices 50 (2003) 1227"
    )
    form_tolerance: ClassVar[float] = 0.03
    forms: ClassVar[Mapping[str, object]] = {"distribution": "gamma"}
    invariances: ClassVar[frozenset[str]] = frozenset(
        {"f_number", "exposure", "wavelength", "field", "level", "orientation", "time"}
    )
    sentence: ClassVar[str] = (
        "Electrons are multiplied at random before read-out: flats have more noise than their electrons have, and its "
        "distribution is skewed."
    )

    excess_percent: Annotated[
        float,
        Quantity("%", "variance of the shot noise beyond that of single electrons, at a gain setting of 0 dB",
                 lower=0.0, upper=900.0, prior=(0.0, 100.0), absent=0.0),
    ] = 0.0  # fmt: skip
    distribution: Annotated[
        Literal["geometric", "gamma"], Field(description="distribution of a single electron's charge")
    ] = "geometric"
    gain_setting: Annotated[
        Literal["after the multiplication", "of the multiplication"],
        Field(description="what the camera's gain setting amplifies"),
    ] = "after the multiplication"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return (
            (cls(excess_percent=20.0),),
            (cls(excess_percent=20.0, gain_setting="of the multiplication"),),
        )

    def factor(self, gain_db: float) -> float:
        """Return F^2 at a gain setting: with M by 10^(dB / 20), 1 / M = 2 - F^2 becomes smaller by that factor."""
        squared = 1.0 + 0.01 * self.excess_percent
        if self.gain_setting == "after the multiplication" or squared >= 2.0:
            return squared
        return max(2.0 - (2.0 - squared) * 10.0 ** (-gain_db / 20.0), 1.0)

    def on_charge(self, charge: Charge) -> Charge:
        if self.excess_percent == 0.0:
            return charge
        return charge.add_laws(excess=lambda gain_db: Multiplication(self.factor(gain_db), self.distribution))
