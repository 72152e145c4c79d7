"""Persistence: charge that traps take from a bright frame comes out again over the frames that follow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Charge, Traps

#: Ratio by which time constants of real traps, of several energies, spread to either side.
SPREAD = 3.0


class Persistence(Effect):
    """Traps hold q x when a frame of x electrons has been read, and release it by exp(-t / tau): an exposure T that
    begins t later collects q x (exp(-t / tau) - exp(-(t + T) / tau)), a dark current that decays. Frames add up. What
    comes out between exposures is reset with the pixels, and what traps take is part of the quantum efficiency.

    Traps are full at the share `fullness` of what they would hold of a full well: at 3 they take a third of it at
    most. A second kind, of another time constant, takes `slow_percent`; it is as full.

    Image lag comes whole with the next frame, whenever that is taken.
    """

    name: ClassVar[str] = "persistence"
    family: ClassVar[Family] = Family.FRAME_MEMORY
    reference: ClassVar[str] = (
        "R. M. Smith et al., A theory for image persistence in HgCdTe photodiodes, Proc. SPIE 7021, 70210J (2008); the "
        "Pyxel detection framework, simple persistence"
    )
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "wavelength", "field", "orientation"})
    shapes: ClassVar[frozenset[str]] = frozenset({"release_s", "fullness", "slow_release_s"})
    forms: ClassVar[Mapping[str, object]] = {"release": "spread"}
    sentence: ClassVar[str] = (
        "Persistence: after bright frames dark ones have more signal, in proportion to their exposure, and it fades "
        "over the frames that follow."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%", "share of a frame's charge that traps hold afterwards", lower=0.0, upper=50.0, prior=(0.0, 1.0),
            absent=0.0,
        ),
    ] = 0.0  # fmt: skip
    release_s: Annotated[
        float,
        Quantity("s", "time constant with which traps release it", lower=0.1, upper=1e4, absent=30.0, logarithmic=True),
    ] = 30.0

    fullness: Annotated[
        float,
        Quantity(
            "1", "charge that traps would take of a full well without a limit, over what they hold when full",
            lower=0.0, upper=100.0, prior=(0.0, 2.0), absent=0.0, dispensable=True,
        ),
    ] = 0.0  # fmt: skip
    slow_percent: Annotated[
        float,
        Quantity(
            "%", "share of a frame's charge that a second kind of traps holds", lower=0.0, upper=50.0, prior=(0.0, 1.0),
            absent=0.0, dispensable=True,
        ),
    ] = 0.0  # fmt: skip
    slow_release_s: Annotated[
        float,
        Quantity("s", "time constant of the second kind", lower=0.1, upper=1e4, absent=300.0, logarithmic=True,
                 dispensable=True),
    ] = 300.0  # fmt: skip

    release: Annotated[
        Literal["exponential", "spread"],
        Field(description="release by each kind's time constant, or half each by a third and by three times of it"),
    ] = "exponential"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple((cls(share_percent=0.3, release_s=release_s),) for release_s in (30.0, 1.0, 5.0, 150.0, 1000.0))

    def on_charge(self, charge: Charge) -> Charge:
        kinds = [(self.share_percent, self.release_s), (self.slow_percent, self.slow_release_s)]
        if self.release == "spread":
            kinds = [
                (0.5 * percent, release_s * factor) for percent, release_s in kinds for factor in (1.0 / SPREAD, SPREAD)
            ]
        for percent, release_s in kinds:
            if percent != 0.0:
                full_e = 0.01 * percent * charge.camera.full_well_e
                capacity_e = full_e / self.fullness if self.fullness > 0.0 else np.inf
                charge = charge.add_laws(traps=Traps(0.01 * percent, release_s, capacity_e))
        return charge
