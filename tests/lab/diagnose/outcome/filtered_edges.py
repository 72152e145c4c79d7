"""A verdict on made-up edges behind an optical low-pass filter, in two directions, seen and held out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.weigh import Candidate
from lab.formats.camera_file import default_camera
from lab.observables.observable import Label, Observable, Prediction
from sim.effects.base import Effect
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.point import TRANSFER, Blur
from tests.lab.diagnose.on_blocks import declared

CAMERA = default_camera().camera
FREQUENCY = np.linspace(0.05, 0.9, 18)
NOISE = 0.004
TRUTH = OpticalLowPassFilter(displacement_x_um=1.5, displacement_y_um=1.5)


def filtered_edges(named: tuple[Effect, ...] = ()) -> Verdict:
    angles = [0.0, 0.0, 0.8, 0.8]

    def predict(acting: Sequence[Effect]) -> Prediction:
        parts, blur = [], Blur(CAMERA, acting)
        for angle in angles:
            factor = blur.beside_lens(550.0, FREQUENCY * np.cos(angle), FREQUENCY * np.sin(angle))
            parts.append(np.exp(-2.0 * FREQUENCY) * np.real(factor))
        return Prediction(np.concatenate(parts), {})

    labels = tuple(
        Label(float(f), "G", f"{a:g}", (f"edge-{i}",), i % 2 == 1) for i, a in enumerate(angles) for f in FREQUENCY
    )
    value = predict((TRUTH,)).mean + NOISE * np.random.default_rng(8).standard_normal(len(labels))
    block = Observable(
        measurement=declared("slanted_edge", "spatial_frequency", "cy/px", conditions="orientation"), reach=0.2,
        value=value,
        covariance=NOISE**2 * np.eye(len(labels)), labels=labels, reads=TRANSFER, predict=predict,
        scale=np.ones(len(labels)),
    )  # fmt: skip
    candidates = tuple(Candidate(e, {}, 1.0, (), 100.0) for e in named)
    return Verdict(MeasurementModel((block,), CAMERA), 12.0, 60.0, (), candidates, (), (), ())
