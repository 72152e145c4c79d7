"""Displacements of one colour's image from another's, as the chain of light predicts them for boards and patterns."""

from __future__ import annotations

import numpy as np

from lab.observables.dataset import Dataset
from sim.effects.base import Effects
from sim.point import displaced_um
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform

REFERENCE_NM = 550.0  # light in which effects displace corners: green


def colour_shift_px(
    dataset: Dataset, channel: str, distance: float, light: Spectrum | None, effects: Effects, kind: str = "bernoulli"
) -> float:
    """Predicted radial displacement of a channel's image from the green one, px, at `distance` (half diagonals) from
    the middle.

    It is the mean over four directions of the displacement by the effects, weighted over wavelengths by the photons
    that each channel detects. `light` None: a flat spectrum; `kind`: of the capture.
    """
    wavelength = np.arange(400.0, 721.0, 10.0)
    outwards = outward_shifts_px(dataset, distance, wavelength, effects)
    if not outwards.any():
        return 0.0
    radiance = np.ones_like(wavelength) if light is None else light.at(wavelength)
    model = Uniform(dataset.camera, effects)
    radiance = model.radiance(wavelength, radiance, kind) * model.transmittance(wavelength)
    seen = [radiance * wavelength * dataset.camera.quantum_efficiency[c].at(wavelength) for c in (channel, "G")]
    own, green = (float(s @ outwards / max(s.sum(), 1e-300)) for s in seen)
    return own - green


def outward_shifts_px(dataset: Dataset, distance: float, wavelength_nm: FloatArray, effects: Effects) -> FloatArray:
    """Predicted displacement outwards (n,), px, of light of n wavelengths at `distance` (half diagonals) from the
    middle: the mean over four directions."""
    camera = dataset.camera
    turn = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    x, y = (distance * camera.half_diagonal_um * way for way in (np.cos(turn), np.sin(turn)))
    outwards = np.zeros(len(wavelength_nm))
    for i, w in enumerate(wavelength_nm):
        shift = displaced_um(camera, x, y, float(w), effects)
        if shift is not None:
            outwards[i] = float(np.mean(shift[0] * np.cos(turn) + shift[1] * np.sin(turn)))
    return outwards / camera.pixel_pitch_um
