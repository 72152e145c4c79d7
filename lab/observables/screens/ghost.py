"""The ghost of a pattern: its image, rotated by 180 degrees about the frame's middle."""

from __future__ import annotations

import numpy as np

from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import REFLECTIONS, acting
from lab.observables.screens.bands import GHOST
from lab.observables.screens.patterns import drawing_covariance, joint_covariance, patterns, place_jacobian
from sim.effects.base import Effects

#: Standard deviation by the error of the drawing, which all numbers of a pattern have in common: 5e-5 to 7e-5 against
#: sums of exact transforms of square cells of 4 px, at f/2.8 and f/5.6.
GHOST_ERROR = 7e-5


def measure_ghost(dataset: Dataset) -> Observable:
    """Coefficient of the rotated image in the fit of the pattern: the ghost's share of the light."""
    points = [(g, p, len(p.bands) + GHOST) for g, group in enumerate(patterns(dataset)) for p in group]
    value = np.array([p.value[b] for _, p, b in points])
    expected = np.array([p.baseline[b] for _, p, b in points])

    by_place = place_jacobian([(g, p.by_place[b]) for g, p, b in points])

    def predict(effects: Effects) -> Prediction:
        reflecting = acting(effects, REFLECTIONS)
        more = np.array([p.ghost(effects) if reflecting else 0.0 for _, p, _ in points])
        return Prediction(expected + more, by_place)

    return Observable(
        measurement=PATTERN_GHOST, reach=1e9, value=value,
        covariance=joint_covariance(points) + drawing_covariance(points, GHOST_ERROR),
        labels=tuple(Label(float(i), p.channel, "ghost", p.captures, p.held_out) for i, (_, p, _) in enumerate(points)),
        reads=REFLECTIONS, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


PATTERN_GHOST = Measurement(
    "ghost",
    title="ghost of the pattern",
    order=430,
    axis="level",
    unit="1",
    make=measure_ghost,
    quantity="ghost's share of the light",
    places="ghosts",
)
