"""The ghost of a pattern: its image, rotated by 180 degrees about the frame's middle."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.diagnose.measurements.pattern_fit import GHOST, joint_covariance, patterns
from lab.measure.reads import REFLECTIONS, acting
from lab.measure.study import Study
from sim.effects.base import Effects

GHOST_FLOOR = 1.5e-4


def ghost_block(study: Study) -> Block:
    """Coefficient of the rotated image in the fit of the pattern: the ghost's share of the light."""
    points = [(g, p, len(p.bands) + GHOST) for g, group in enumerate(patterns(study)) for p in group]
    value = np.array([p.value[b] for _, p, b in points])

    def predict(effects: Effects) -> Prediction:
        reflecting = acting(effects, REFLECTIONS)
        return Prediction(np.array([p.ghost(effects) if reflecting else 0.0 for _, p, _ in points]), {})

    return Block(
        measurement=PATTERN_GHOST, reach=1e9, value=value,
        covariance=joint_covariance(points, study) + np.diag(np.full(len(value), GHOST_FLOOR**2)),
        labels=tuple(Label(float(i), p.channel, "ghost", p.captures, p.held_out) for i, (_, p, _) in enumerate(points)),
        reads=REFLECTIONS, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


PATTERN_GHOST = Measurement(
    "ghost",
    title="ghost of the pattern",
    order=430,
    axis="level",
    unit="1",
    make=ghost_block,
    quantity="ghost's share of the light",
    places="ghosts",
)
