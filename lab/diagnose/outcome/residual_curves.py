"""Measured values and predictions as curves, by measurement, condition and channel."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.formats.results import ResidualCurve
from sim.camera import Side
from sim.spectrum import FloatArray


def curves_of(
    model: MeasurementModel, side: Side, before: FloatArray, after: FloatArray, *, held_out_apart: bool
) -> Iterator[ResidualCurve]:
    """Yield the curves of every measurement.

    before : prediction by the stated baseline (n,); levels are limited to 0..white level
    after : prediction with effects (n,)
    held_out_apart : whether numbers of one condition and channel that a measurement holds out have a curve of their own
    """
    white_dn = float(model.camera.white_level_dn)
    for block, at in zip(model.blocks, model.slices, strict=True):
        measurement = block.measurement
        std = np.sqrt(np.diag(block.covariance))
        stated = np.clip(before[at], 0.0, white_dn) if measurement.is_level else before[at]
        lines: dict[tuple[str, str, bool], list[int]] = {}
        for i, label in enumerate(block.labels):
            condition = label.condition if measurement.conditions else ""
            lines.setdefault((condition, label.channel, held_out_apart and label.held_out), []).append(i)
        for (condition, channel, _), members in lines.items():
            order = sorted(members, key=lambda i: block.labels[i].x)
            yield ResidualCurve(
                side=side,
                measurement=measurement.name,
                label=condition or measurement.name,
                channel=channel,
                axis=measurement.places or f"{measurement.axis.replace('_', ' ')}, {measurement.unit}",
                quantity=measurement.quantity,
                names=tuple(block.labels[i].condition for i in order) if measurement.places else (),
                x=tuple(block.labels[i].x for i in order),
                measured=tuple(float(block.value[i]) for i in order),
                measured_std=tuple(float(std[i]) for i in order),
                before=tuple(float(stated[i]) for i in order),
                after=tuple(float(after[at][i]) for i in order),
                held_out=block.labels[order[0]].held_out,
            )
