"""Excess of light at the borders between lit and dark cells of a random pattern, where grey levels are seen."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.diagnose.measurements.pattern_fit import BORDER, joint_covariance, patterns
from lab.measure.reads import SHOWN
from lab.measure.study import Study
from sim.effects.base import Effects
from sim.uniform import Uniform

BORDER_FLOOR = 0.0015


def cell_border_block(study: Study) -> Block:
    """Coefficient of P (1 - P) in the fit of the pattern P, which is 0 on dark and 1 on lit cells (`pattern_fit`).

    It is the excess of light where the blurred picture is grey: at borders of cells. A nonlinear response of the camera
    and the grey levels of the screen change it.
    """
    found = patterns(study)
    points = [(g, p, len(p.bands) + BORDER) for g, group in enumerate(found) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(points))
        model = Uniform(study.camera, effects)
        for k, (_, p, b) in enumerate(points):
            mean[k] = p.shown_by(effects)[b]
            if not model.is_linear:
                low, high = p.levels_e
                out = model.response(np.array([low, 0.5 * (low + high), high]))
                # a term a y (1 - y) of the response lifts its middle, y = 1/2, by a / 4
                mean[k] += 4.0 * float((out[1] - out[0]) / (out[2] - out[0]) - 0.5)
        return Prediction(mean, {})

    return Block(
        measurement=CELL_BORDERS, reach=1e9, value=value,
        covariance=joint_covariance(points, study) + np.diag(np.full(len(value), BORDER_FLOOR**2)),
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
    make=cell_border_block,
    quantity="excess light at borders, share",
    places="borders",
)
