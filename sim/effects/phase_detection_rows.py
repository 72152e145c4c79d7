"""Phase-detection rows: every few rows hold pixels for autofocus, which collect another share of the light."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray
from sim.stages import Charge

#: Rows after which such a row comes again; even, so that all of them hold the same colours.
Period = Literal[4, 8, 12, 16, 24]
PERIODS: tuple[Period, ...] = (4, 8, 12, 16, 24)


class PhaseDetectionRows(Effect):
    """Light of a row's pixels x (1 - l), every `period` rows from `first_row`; in a mosaic (1 - l + c / 2) in the green
    ones and (1 - l - c / 2) in the others. Every colour's mean over a period stays: what it loses there, its other
    pixels have more, as the quantum efficiency is stated for all of them.

    Half of such pixels are masked on the left, half on the right. What the angle of the light changes is of opposite
    sign in both, and the mean of a row doesn't show it.
    """

    name: ClassVar[str] = "phase_detection_rows"
    title: ClassVar[str] = "phase-detection rows"
    family: ClassVar[Family] = Family.RESPONSE
    reference: ClassVar[str] = (
        "P. Sliwinski and P. Wachel, A simple model for on-sensor phase-detection autofocusing algorithm, Journal of "
        "Computer and Communications 1 (2013) 11"
    )
    form_tolerance: ClassVar[float] = 0.05
    invariances: ClassVar[frozenset[str]] = frozenset({"f_number", "exposure", "field", "level", "time"})
    sentence: ClassVar[str] = (
        "Every few rows the pixels see less of even light than their neighbours, in one ratio at all levels: rows of "
        "phase-detection pixels."
    )

    loss_percent: Annotated[
        float,
        Quantity("%", "light that a pixel of such a row lacks", lower=-90.0, upper=90.0, prior=(0.0, 5.0), absent=0.0),
    ] = 0.0
    colour_percent: Annotated[
        float,
        Quantity(
            "%",
            "by how much the row's other colour lacks more than green",
            lower=-90.0,
            upper=90.0,
            prior=(0.0, 5.0),
            absent=0.0,
            dispensable=True,
        ),
    ] = 0.0
    period: Annotated[Period, Field(description="rows after which such a row comes again")] = 8
    first_row: Annotated[int, Field(description="the first such row", ge=0, lt=24)] = 0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.first_row >= self.period:
            raise ValueError(
                f"first_row: {self.first_row} isn't below the period of {self.period} rows; give the first of them"
            )
        return self

    def log_prior(self) -> float:
        """Return -ln 10: few industrial sensors have such rows."""
        return -float(np.log(10.0)) if self.loss_percent or self.colour_percent else 0.0

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return tuple(
            tuple(cls(period=period, first_row=first, loss_percent=loss) for loss in (1.5, -1.5))
            for period in PERIODS
            for first in range(period)
        )

    def on_charge(self, charge: Charge) -> Charge:
        if self.loss_percent == 0.0 and self.colour_percent == 0.0:
            return charge
        cfa = charge.camera.cfa

        def collect(electrons: FloatArray) -> FloatArray:
            changed, mosaic = np.array(electrons), step(cfa)
            for colour, places in phases(cfa).items():
                more = 0.0 if cfa == "MONO" else 0.5 * self.colour_percent * (-1.0 if colour == "G" else 1.0)
                share = 0.01 * (self.loss_percent + more)
                inside = [(row, col) for row, col in places if (self.first_row - row) % mosaic == 0]
                # of a colour's pixels, these are in such rows
                part = mosaic * len(inside) / (self.period * len(places))
                for row, col in places:
                    changed[row::mosaic, col::mosaic] /= 1.0 - share * part
                for _, col in inside:
                    changed[self.first_row :: self.period, col::mosaic] *= 1.0 - share
            return changed

        return charge.add_laws(collected=collect)
