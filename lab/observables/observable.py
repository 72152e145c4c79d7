"""What a measurement is: its declaration, its numbers with their covariance, and how a camera model predicts them; and
the list of all.

A prediction goes through the same estimator as the recording. Nuisance parameters (levels, gain, smooth errors of the
maker's sensitivity curves) enter by their Jacobian and a normal prior. The measurement model marginalises them."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np

import lab.observables
from sim.effects.base import Effect, Effects
from sim.effects.library import may_change
from sim.extensions import extensions, refuse
from sim.spectrum import FloatArray

if TYPE_CHECKING:
    from lab.observables.dataset import Dataset


#: `Observable.reach` of measurements by ln(level): a departure from linearity may change over a factor of exp(0.8) =
#: 2.2 in level.
LEVEL_REACH = 0.8


@dataclass(frozen=True)
class Measurement:
    """The declaration of a measurement in its module, where `lab.observables.observable` finds it.

    `make` takes the `Dataset` of a side and returns the measured numbers. It raises NotDetermined where the recordings
    don't determine them.
    """

    name: str  # identifier in results: lower case and underscores
    title: str  # in reports: a noun phrase in a laboratory's words
    # in reports, ascending: 100 dark frames, 200 uniform light, 300 charts and edges, 400 screens, 500 boards, 600
    # pairs
    order: int
    axis: str  # quantity of `Label.x`
    unit: str  # of the axis
    make: Callable[[Dataset], Observable]
    quantity: str  # what the numbers are, with their unit: the ordinate of the report's curves
    #: Whether the numbers are levels of frames, which lie between 0 and the white level.
    is_level: bool = False
    #: Whether the numbers are variances, or correlations, of noise.
    of_variances: bool = False
    #: The quantity of `Label.condition` ("orientation"). Mismatches are located, and curves drawn, by its values. "":
    #: it has none.
    conditions: str = ""
    #: Words before the conditions where the report lists them ("edges at"); "": `conditions`.
    conditions_words: str = ""
    #: What the points are ("patches") where x only numbers them and the condition names them; "": x is a quantity.
    places: str = ""


@dataclass(frozen=True)
class Prediction:
    """Predicted mean (n,), and its Jacobian: name of a nuisance parameter -> derivative (n,) per prior standard
    deviation.

    `columns` are the Jacobian, or compute it when it is first asked for: of most sets of effects that a search tries,
    only the mean is."""

    mean: FloatArray
    columns: dict[str, FloatArray] | Callable[[], dict[str, FloatArray]]

    @cached_property
    def jacobian(self) -> dict[str, FloatArray]:
        """The Jacobian, which is kept."""
        return self.columns() if callable(self.columns) else self.columns


@dataclass(frozen=True)
class Label:
    """What one measured number belongs to."""

    x: float  # in `Measurement.unit`
    channel: str
    condition: str  # value of `Measurement.conditions`, in words
    captures: tuple[str, ...]  # ids of the captures that it was measured from
    held_out: bool  # whether neither the choice nor the fit of effects may use it


@dataclass(frozen=True)
class Observable:
    """The n numbers of one measurement: values, covariance of their noise, labels, and the prediction for given
    effects."""

    measurement: Measurement
    reach: float  # correlation length of a model discrepancy and of a law's error, in the unit of `position`
    value: FloatArray  # (n,)
    covariance: FloatArray  # (n, n), without nuisance parameters
    labels: tuple[Label, ...]  # n
    reads: frozenset[str]  # quantities of the stages (`sim.stages`) that the predicted mean depends on
    predict: Callable[[Effects], Prediction]
    scale: FloatArray  # (n,): a model discrepancy is stated as a share of it
    along: FloatArray | None = None  # `position` where it isn't x: ln(level) (n,), place on the sensor (n, 2)
    scattered_by: frozenset[str] = (
        frozenset()
    )  # quantities of the stages that only the scatter of the numbers depends on

    @property
    def position(self) -> FloatArray:
        """Coordinate in which model discrepancies and errors of laws are smooth, (n,) or (n, d)."""
        return np.array([label.x for label in self.labels]) if self.along is None else self.along

    def touched_by(self, effect: type[Effect]) -> bool:
        """Return whether the effect may change the predicted mean."""
        return not self.reads.isdisjoint(may_change(effect))

    def scatters_by(self, effect: type[Effect]) -> bool:
        """Return whether the effect may add scatter to the numbers."""
        return not self.scattered_by.isdisjoint(may_change(effect))


# --- All measurements: every module of this package is searched for declarations (`Measurement`), and entry points ----


@cache
def measurements() -> tuple[Measurement, ...]:
    """All measurements in the order of the report. Raises ValueError where two have the same name."""
    found: dict[str, Measurement] = {}
    package = lab.observables
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        content = importlib.import_module(module.name)
        for item in vars(content).values():
            if isinstance(item, Measurement) and found.setdefault(item.name, item) is not item:
                raise ValueError(f"two measurements are named {item.name!r}: give one another name")
    for name, item in extensions("observables"):
        if not isinstance(item, Measurement):
            refuse("observables", name, f"{item!r} is no lab.observables.observable.Measurement")
        elif item.name in found:
            refuse("observables", name, f"there is a measurement {item.name!r} already")
        else:
            found[item.name] = item
    return tuple(sorted(found.values(), key=lambda one: (one.order, one.name)))


def measurement_title(name: str) -> str:
    """Return a measurement's title in reports; its name in words where it no longer exists, as in an older result."""
    return next((one.title for one in measurements() if one.name == name), name.replace("_", " "))
