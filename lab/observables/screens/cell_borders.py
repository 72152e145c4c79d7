"""Excess of light at the borders between lit and dark cells of a random pattern, where grey levels are seen."""

from __future__ import annotations

import numpy as np

from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import SHOWN
from lab.observables.screens.bands import BORDER
from lab.observables.screens.patterns import drawing_covariance, joint_covariance, patterns, place_jacobian
from sim.effects.base import Effects
from sim.uniform import Uniform

#: Standard deviation by the error of the drawing, which all numbers of a pattern have in common: 1 to 2e-4 against sums
#: of exact transforms of square cells of 4 px, at f/2.8 and f/5.6.
BORDER_ERROR = 2e-4


def measure_cell_borders(dataset: Dataset) -> Observable:
    """Coefficient of P (1 - P) in the fit of the pattern P, which is 0 on dark and 1 on lit cells (`bands`).

    It is the excess of light where the blurred picture is grey: at borders of cells. A nonlinear response of the camera
    and the grey levels of the screen change it.
    """
    found = patterns(dataset)
    points = [(g, p, len(p.bands) + BORDER) for g, group in enumerate(found) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    by_place = place_jacobian([(g, p.by_place[b]) for g, p, b in points])

    def predict(effects: Effects) -> Prediction:
        mean = np.array([p.baseline[b] for _, p, b in points])
        model = Uniform(dataset.camera, effects)
        for k, (_, p, b) in enumerate(points):
            mean[k] = p.shown_by(effects)[b]
            if not model.is_linear:
                low, high = p.levels_e
                out = model.response(np.array([low, 0.5 * (low + high), high]))
                # a term a y (1 - y) of the response lifts its middle, y = 1/2, by a / 4
                mean[k] += 4.0 * float((out[1] - out[0]) / (out[2] - out[0]) - 0.5)
        return Prediction(mean, by_place)

    return Observable(
        measurement=CELL_BORDERS, reach=1e9, value=value,
        covariance=joint_covariance(points) + drawing_covariance(points, BORDER_ERROR),
        labels=tuple(Label(float(i), p.channel, "borders of cells", p.captures, p.held_out) for i, (_, p,
        _) in enumerate(points)),
        reads=SHOWN | {"signal.response"}, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


CELL_BORDERS = Measurement(
    "cell_borders",
    title="borders of pattern cells",
    order=420,
    axis="level",
    unit="1",
    make=measure_cell_borders,
    quantity="excess light at borders, share",
    places="borders",
)
