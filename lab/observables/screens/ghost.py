"""The ghost of a pattern: its image, rotated by 180 degrees about the frame's middle."""

from __future__ import annotations

import numpy as np

from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import REFLECTIONS, acting
from lab.observables.screens.bands import GHOST
from lab.observables.screens.patterns import joint_covariance, patterns, place_jacobian
from sim.effects.base import Effects

GHOST_FLOOR = 1.5e-4  # standard deviation of a ghost's share beside noise


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
        covariance=joint_covariance(points) + np.diag(np.full(len(value), GHOST_FLOOR**2)),
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
