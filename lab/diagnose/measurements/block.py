"""What a measurement is: its declaration, its numbers with their covariance, and how a camera model predicts them.

The prediction goes through the estimator that made the numbers. Nuisance parameters (levels, gain, a smooth few per cent of the
maker's curves) enter by the Jacobian and a normal prior; the measurement model marginalises them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sim.effects.base import Effect
from sim.effects.library import may_change
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.diagnose.measurements.study import Study

Effects = Sequence[Effect]
LEVEL_REACH = 0.8  # of a level's logarithm: over a factor of 2 a smooth departure from a line may change


@dataclass(frozen=True)
class Measurement:
    """What a module of this package declares of a measurement; `lab.diagnose.measurements.library` finds it there.

    `make` takes a side's `Study` and returns the numbers. It raises NotDetermined where the recordings don't allow them.
    """

    name: str  # identifier in results: lower case and underscores
    title: str  # in reports: a noun phrase in a lab's words
    order: int  # in reports, ascending: 100 dark frames, 200 uniform light, 300 charts and edges, 400 screens, 500 boards, 600 pairs
    axis: str  # quantity of `Label.x`
    unit: str  # of the axis
    make: Callable[[Study], Block]
    quantity: str  # what the numbers are, with their unit: the ordinate of the report's curves
    #: Whether the numbers are levels of frames, which lie between 0 and the white level.
    is_level: bool = False
    #: Quantity that conditions are values of ("orientation"): slices and curves are by condition, too. "": none.
    conditions: str = ""
    #: Words before the conditions where the report lists them ("edges at"); "": `conditions`.
    conditions_words: str = ""
    #: Name of the points where x only numbers them and conditions name them ("patches"); "": x is a quantity.
    places: str = ""


@dataclass(frozen=True)
class Prediction:
    """Mean (n,) and the Jacobian: its derivatives (n,) by every nuisance parameter, per prior standard deviation."""

    mean: FloatArray
    jacobian: dict[str, FloatArray]


@dataclass(frozen=True)
class Label:
    """Where a number stands: for slices, held-out captures and pictures."""

    x: float
    channel: str
    condition: str
    captures: tuple[str, ...]
    held_out: bool


@dataclass(frozen=True)
class Block:
    """The numbers of one measurement, (n,): their noise's covariance (n, n), labels, and the model's prediction with given effects."""

    measurement: Measurement
    reach: float  # along `position`, over which a smooth discrepancy may change
    value: FloatArray
    covariance: FloatArray
    labels: tuple[Label, ...]
    reads: frozenset[str]  # quantities of the stages (`sim.stages`) that the prediction depends on
    predict: Callable[[Effects], Prediction]
    scale: FloatArray  # size of a discrepancy of 1, (n,)
    along: FloatArray | None = (
        None  # where smoothness isn't along x: logarithms of levels (n,), places on the sensor (n, 2)
    )
    scattered_by: frozenset[str] = frozenset()  # quantities of the stages that only the covariance depends on

    @property
    def position(self) -> FloatArray:
        """Along which errors of laws and unknown discrepancies are smooth, (n,) or (n, d)."""
        return np.array([label.x for label in self.labels]) if self.along is None else self.along

    def touched_by(self, effect: type[Effect]) -> bool:
        """Whether the effect acts on anything that this measurement sees."""
        return not self.reads.isdisjoint(may_change(effect))

    def scatters_by(self, effect: type[Effect]) -> bool:
        """Whether the effect makes the numbers scatter."""
        return not self.scattered_by.isdisjoint(may_change(effect))
