"""Lateral colour of a pattern on a screen: displacement of its red and blue images from the green one."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.colour_shift import colour_shift_px
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import SHIFT, SHOWN
from lab.observables.screens.bands import ACROSS, RADIAL, RADIAL3
from lab.observables.screens.changes import pattern_changes
from lab.observables.screens.patterns import Pattern, patterns, place_jacobian
from sim.effects.base import Effects
from sim.point import TRANSFER_AT
from sim.spectrum import FloatArray

#: Standard deviation of a displacement by its reading, outwards and around, over the displacement outwards. Before a
#: screen whose cells are a whole number of pixels and stand square, of 0.25 px and 0.53 px that another simulator draws
#: 0.239 px to 0.246 px and 0.527 px to 0.572 px are read: up to 5 %.
SHIFT_ERROR = 0.05


def measure_lateral_colour(dataset: Dataset) -> Observable:
    """Displacement (px) of a pattern's red and blue images from the green one: radial at two distances from the frame's
    middle, and tangential at one.

    A blur moves them, too, where the cells' aliases are coherent: it is predicted through the regression.

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
    tables: list[tuple[FloatArray, FloatArray]] = []
    n = len(points)
    covariance = np.zeros((3 * n, 3 * n))
    for i, (number, p, green) in enumerate(points):
        near, far = 0.5 * p.reach, p.reach
        table = np.array([[near, near**3, 0.0], [far, far**3, 0.0], [0.0, 0.0, far]])
        at = np.array([len(p.bands) + k for k in (RADIAL, RADIAL3, ACROSS)])
        tables.append((table, at))
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

    by_place, changes = place_jacobian(displaced), dataset.once(pattern_changes)

    def predict(effects: Effects) -> Prediction:
        mean = np.concatenate(expected)
        if effects:
            for i, ((number, p, _), (table, at)) in enumerate(zip(points, tables, strict=True)):
                change = changes[number].by(effects)
                mean[3 * i : 3 * i + 3] += np.nan_to_num(table @ (change[p.channel][at] - change["G"][at]))
        jacobian = dict(by_place)
        for k, (p, distance, outwards) in enumerate(places if effects else ()):
            if shift := colour_shift_px(dataset, p.channel, distance, p.light, effects):
                mean[k] += shift * outwards
                # seen and held-out repeats are displaced alike
                name = f"lateral_colour:{points[k // 3][0]}:{p.channel}:{k % 3}"
                jacobian.setdefault(name, np.zeros(3 * n))[k] = SHIFT_ERROR * shift
        return Prediction(mean, jacobian)

    return Observable(
        measurement=LATERAL_COLOUR, reach=0.5, value=np.concatenate(values),
        covariance=covariance, labels=tuple(labels), reads=SHIFT | SHOWN | TRANSFER_AT | {"image.transmittance"},
        predict=predict, scale=np.ones(3 * n),
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
