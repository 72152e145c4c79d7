"""Small made-up measurement models: a contrast in two directions, and a departure along wavelength."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.observables.observable import Label, Observable, Prediction
from sim.camera import CameraModel, Lens
from sim.effects.base import Effect
from sim.point import TRANSFER, Blur
from sim.spectrum import Spectrum
from tests.lab.diagnose.on_blocks import declared

FREQUENCY = np.linspace(0.02, 0.9, 23)
NOISE = 0.004


def _camera() -> CameraModel:
    grid = np.arange(380.0, 781.0, 10.0)
    return CameraModel(
        rows=64, cols=64, pixel_pitch_um=3.0, fill_factor=0.9, cfa="MONO", bit_depth=12, black_level_dn=64.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.4, full_well_e=10000.0, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=0.0,
        prnu_percent=0.0,
        quantum_efficiency={"Y": Spectrum.of(grid, np.full(grid.shape, 0.5))}, lens=Lens(f_number=4.0,
        focal_length_mm=8.0),
    )  # fmt: skip


CAMERA = _camera()


def _transfer(acting: Sequence[Effect], angle: float) -> np.ndarray:
    blur = Blur(CAMERA, acting)  # over any baseline
    factor = blur.beside_lens(550.0, FREQUENCY * np.cos(angle), FREQUENCY * np.sin(angle))
    return np.asarray(np.exp(-2.0 * FREQUENCY) * np.real(factor))


def contrast_model(
    rng: np.random.Generator, truth: Sequence[Effect] = (), extra: np.ndarray | float = 0.0
) -> MeasurementModel:
    """Two directions, seen and held out; white noise."""
    angles = [0.0, 0.0, 0.8, 0.8]
    labels = tuple(
        Label(float(f), "Y", f"{a:g}", (f"edge-{i}",), i % 2 == 1) for i, a in enumerate(angles) for f in FREQUENCY
    )
    n = len(labels)
    value = np.concatenate([_transfer(truth, a) + extra for a in angles]) + NOISE * rng.standard_normal(n)
    block = Observable(
        measurement=declared("slanted_edge", "spatial_frequency", "cy/px"), reach=0.2, value=value,
        covariance=NOISE**2 * np.eye(n),
        labels=labels, reads=TRANSFER, scale=np.ones(n),
        predict=lambda acting: Prediction(np.concatenate([_transfer(acting, a) for a in angles]), {}),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)


def spectral_model(rng: np.random.Generator, extra: Callable[[np.ndarray], np.ndarray]) -> MeasurementModel:
    """A capture a wavelength, every third held out; white noise about 0 and a departure."""
    x = np.arange(400.0, 700.0, 10.0)
    labels = tuple(Label(float(w), "Y", "", (f"narrow-{i}",), i % 3 == 1) for i, w in enumerate(x))
    n = len(x)
    block = Observable(
        measurement=declared("narrowband", "wavelength", "nm"), reach=40.0,
        value=extra(x) + NOISE * rng.standard_normal(n),
        covariance=NOISE**2 * np.eye(n), labels=labels, reads=frozenset({"image.transmittance"}),
        predict=lambda _: Prediction(np.zeros(n), {}),
        scale=np.ones(n),
    )  # fmt: skip
    return MeasurementModel((block,), CAMERA)
