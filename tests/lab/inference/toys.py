"""Toy problems in summary space: linear and bent predictions whose evidence is known by other means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lab.inference.hypotheses import Alternative, Coordinate, Hypothesis
from lab.inference.model import Group, Point, State
from lab.observables.gaussian import BlockCovariance, Gaussian
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class Toy:
    """y = sum of the active hypotheses' changes + J theta + H delta + noise of standard deviation 1."""

    value: FloatArray
    changes: dict[str, Callable[[FloatArray], FloatArray]]
    nuisance: FloatArray
    groups: Sequence[Group] = field(default_factory=tuple)

    def mean(self, state: State) -> FloatArray:
        """Return the prediction."""
        return np.sum([self.changes[n](p.u) for n, p in state.items()], axis=0) + np.zeros(len(self.value))

    def gaussian(self, state: State, form_scale: float) -> Gaussian:
        """Return the distribution without delta."""
        return Gaussian(self.mean(state), (BlockCovariance(np.eye(len(self.value))),), self.nuisance)

    def has_form_error(self, state: State) -> bool:
        """No law of a toy is inexact."""
        return False


def linear(name: str, family: str, scale: float, *, positive: bool = True) -> Hypothesis:
    """Return a hypothesis of one size; its signature is that of one scale."""
    low = 0.0 if positive else -np.inf
    coordinate = Coordinate("size", scale, lower=low)
    points = [Point(np.array([scale]))] + ([] if positive else [Point(np.array([-scale]))])
    return Hypothesis(name, family, (coordinate,), (Alternative(tuple(points), (1.0,) * len(points)),))


def shaped(name: str, family: str, scale: float, low: float, high: float, places: int) -> Hypothesis:
    """Return a hypothesis of a size and a shape, flat between two bounds; an alternative for each of `places`."""
    coords = (
        Coordinate("size", scale, lower=0.0),
        Coordinate("shape", np.inf, low, high, is_shape=True, typical=0.05 * (high - low)),
    )
    at = low + (np.arange(places) + 0.5) / places * (high - low)
    return Hypothesis(name, family, coords, tuple(Alternative((Point(np.array([scale, a])),), (1.0,)) for a in at))
