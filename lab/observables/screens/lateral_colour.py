"""Lateral colour of a pattern on a screen: displacement of its red and blue images from the green one."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.colour_shift import COLOUR_FLOOR_PX, colour_shift_px
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import SHIFT
from lab.observables.screens.bands import ACROSS, RADIAL, RADIAL3
from lab.observables.screens.patterns import Pattern, patterns, place_jacobian
from sim.effects.base import Effects
from sim.spectrum import FloatArray


def measure_lateral_colour(dataset: Dataset) -> Observable:
    """Displacement (px) of a pattern's red and blue images from the green one: radial at two distances from the frame's
    middle, and tangential at one.

    Raises NotDetermined for a camera without a green channel, and where no pattern is fitted.
    """
    if "G" not in dataset.channels:
        raise NotDetermined("lateral_colour", "one channel: nothing to hold it against")
    points: list[tuple[int, Pattern, Pattern]] = []
    for number, group in enumerate(patterns(dataset)):
        for p in group:
            if p.channel != "G":
                green = next(q for q in group if q.channel == "G" and q.held_out == p.held_out)
                points.append((number, p, green))
    values, labels, places, expected = [], [], [], []
    displaced: list[tuple[int, FloatArray]] = []
    n = len(points)
    covariance = np.zeros((3 * n, 3 * n))
    for i, (number, p, green) in enumerate(points):
        near, far = 0.5 * p.reach, p.reach
        table = np.array([[near, near**3, 0.0], [far, far**3, 0.0], [0.0, 0.0, far]])
        at = np.array([len(p.bands) + k for k in (RADIAL, RADIAL3, ACROSS)])
        values.append(table @ (p.value[at] - green.value[at]))
        displaced += [(number, row) for row in table @ (p.by_place[at] - green.by_place[at])]
        expected.append(table @ (p.baseline[at] - green.baseline[at]))
        for j, (_, q, other) in enumerate(points):
            if p.channel != q.channel or p.light is not q.light:
                continue
            # only these coefficients: channels may have different numbers of parts beyond the bands
            own = np.ix_(at, at)
            both = 0.5 * np.sum([one.common[own] for one in (p, q, green, other)], axis=0)
            if i == j:
                both = both + p.shown[own] + green.shown[own]
            covariance[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = table @ both @ table.T
        for k, (distance, way) in enumerate(((near, "outwards"), (far, "outwards"), (far, "around"))):
            labels.append(Label(distance, p.channel, way, p.captures, p.held_out))
            places.append((p, distance, k < 2))

    by_place = place_jacobian(displaced)

    def predict(effects: Effects) -> Prediction:
        mean = np.concatenate(expected)
        if effects:
            for k, (p, distance, outwards) in enumerate(places):
                if outwards:
                    mean[k] += colour_shift_px(dataset, p.channel, distance, p.light, effects)
        return Prediction(mean, by_place)

    return Observable(
        measurement=LATERAL_COLOUR, reach=0.5, value=np.concatenate(values),
        covariance=covariance + np.diag(np.full(3 * n, COLOUR_FLOOR_PX**2)), labels=tuple(labels),
        reads=SHIFT, predict=predict, scale=np.ones(3 * n),
    )  # fmt: skip


LATERAL_COLOUR = Measurement(
    "lateral_colour",
    title="lateral colour of patterns",
    order=440,
    axis="field",
    unit="half diagonals",
    make=measure_lateral_colour,
    quantity="displacement from green, px",
    conditions="direction",
)
