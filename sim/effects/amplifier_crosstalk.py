"""Crosstalk of output amplifiers: areas of the frame that are read at the same time couple into each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.amplifiers import CoupledAmplifiers
from sim.spectrum import FloatArray
from sim.stages import PatternNoise, Signal

Layout = Literal["two columns", "four columns", "two rows", "quadrants"]
Order = Literal["alike", "turned"]
#: How areas lie: (rows of areas, columns of areas).
LAYOUTS: dict[Layout, tuple[int, int]] = {
    "two columns": (1, 2),
    "four columns": (1, 4),
    "two rows": (2, 1),
    "quadrants": (2, 2),
}
ORDERS: tuple[Order, ...] = ("alike", "turned")


class AmplifierCrosstalk(Effect):
    """Each amplifier takes over a share c + d of what the one before it reads at the same moment, and c - d of the one
    behind it, in the order of the areas; f times as much of areas that aren't adjacent: light, its noise, and the level
    p of dark pixels. The frame's mean stays. Temporal noise of light in pixels that are read together
    is correlated by about 2 c, areas' gains differ by d, and bright things have ghosts in the other areas. The
    amplifiers' own noise comes after; in another form of the law it is coupled, too.
    """

    name: ClassVar[str] = "amplifier_crosstalk"
    family: ClassVar[Family] = Family.READ_OUT_AREAS
    reference: ClassVar[str] = "Fast method of crosstalk characterization for HxRG detectors, arXiv:1808.00790 (2018)"
    form_tolerance: ClassVar[float] = 0.2
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "wavelength", "level", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"far_share", "pedestal_e"})
    forms: ClassVar[Mapping[str, object]] = {"noise": "coupled"}
    sentence: ClassVar[str] = (
        "Amplifiers that read parts of the frame at the same time couple into each other: their noise is correlated, "
        "and bright things have ghosts in the other parts."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%",
            "share that an amplifier takes over from each adjacent one, on average",
            lower=-20.0,
            upper=20.0,
            prior=(0.0, 1.0),
            absent=0.0,
        ),
    ] = 0.0
    excess_percent: Annotated[
        float,
        Quantity(
            "%",
            "by how much more it takes over from one before it than on average",
            lower=-20.0,
            upper=20.0,
            prior=(0.0, 0.5),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0
    far_share: Annotated[
        float,
        Quantity(
            "1",
            "shares from areas that aren't adjacent, over those from adjacent ones",
            lower=0.0,
            upper=2.0,
            prior=(0.5, 0.3),
            absent=0.5,
            dispensable=True,
        ),
    ] = 0.5
    pedestal_e: Annotated[
        float,
        Quantity(
            "e",
            "level above none at which dark pixels stand at the amplifiers",
            lower=-1e5,
            upper=1e5,
            prior=(0.0, 1000.0),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0
    layout: Annotated[Layout, Field(description="how the areas lie")] = "two columns"
    order: Annotated[
        Order, Field(description="whether adjacent areas are read in the same direction, or in opposite ones")
    ] = "alike"
    noise: Annotated[Literal["own", "coupled"], Field(description="whether read noise is coupled as light is")] = "own"

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        steps = ({"share_percent": 0.3}, {"share_percent": -0.3}, {"excess_percent": 0.3}, {"excess_percent": -0.3})
        return tuple(
            tuple(cls(layout=layout, order=order).replace_fields(**step) for step in steps)
            for layout in LAYOUTS
            for order in ORDERS
        )

    def log_prior(self) -> float:
        # What couples two amplifiers, a supply or two wires, couples both ways with one sign: d is c at most, to a
        # tenth and to 0.02 %. With d alone areas have other gains and share no noise: that is taps.
        over = max(abs(self.excess_percent) - abs(self.share_percent), 0.0)
        return -0.5 * (over / (0.1 * abs(self.share_percent) + 0.02)) ** 2

    def coupling(self) -> FloatArray:
        """Return the shares (areas, areas) that the first index takes over from the second."""
        down, across = LAYOUTS[self.layout]
        row, col = np.divmod(np.arange(down * across), across)
        apart = np.abs(np.subtract.outer(row, row)) + np.abs(np.subtract.outer(col, col))
        weight = np.where(apart == 1, 1.0, np.where(apart == 0, 0.0, self.far_share))
        before = np.sign(np.subtract.outer(np.arange(down * across), np.arange(down * across)))
        return np.asarray(0.01 * weight * (self.share_percent + self.excess_percent * before))

    def on_signal(self, signal: Signal) -> Signal:
        if self.share_percent == 0.0 and self.excess_percent == 0.0:
            return signal
        law = CoupledAmplifiers(self.coupling(), *LAYOUTS[self.layout], self.order == "turned", self.noise == "coupled")
        signal = signal.add_laws(amplifiers=law)
        if self.pedestal_e != 0.0:
            dark = np.full((signal.camera.rows, signal.camera.cols), self.pedestal_e)
            steps = law.couple(dark) - dark
            signal = signal.add_laws(disturbances=PatternNoise(steps - steps.mean(), np.zeros((1, 1))))
        return signal
