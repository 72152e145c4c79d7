"""Lateral colour of a pattern on a screen: displacement of its red and blue images from the green one."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.diagnose.measurements.pattern_fit import ACROSS, RADIAL, RADIAL3, Pattern, patterns
from lab.errors import NotDetermined
from lab.measure.reads import SHIFT
from lab.measure.study import Study
from sim.effects.base import Effects
from sim.point import displaced_um
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform

# standard deviation beside noise: where cells are whole pixels, errors of the drawn pattern don't average out
COLOUR_FLOOR_PX = 0.012


def colour_block(study: Study) -> Block:
    """Displacement (px) of a pattern's red and blue images from the green one: radial at two distances from the frame's
    middle, and tangential at one.

    Raises NotDetermined for a camera without a green channel, and where no pattern is fitted.
    """
    if "G" not in study.channels:
        raise NotDetermined("lateral_colour", "one channel: nothing to hold it against")
    points: list[tuple[Pattern, Pattern]] = []
    for group in patterns(study):
        for p in group:
            if p.channel != "G":
                green = next(q for q in group if q.channel == "G" and q.held_out == p.held_out)
                points.append((p, green))
    values, labels, places = [], [], []
    n = len(points)
    covariance = np.zeros((3 * n, 3 * n))
    for i, (p, green) in enumerate(points):
        near, far = 0.5 * p.reach, p.reach
        table = np.array([[near, near**3, 0.0], [far, far**3, 0.0], [0.0, 0.0, far]])
        at = np.array([len(p.bands) + k for k in (RADIAL, RADIAL3, ACROSS)])
        values.append(table @ (p.value[at] - green.value[at]))
        for j, (q, other) in enumerate(points):
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

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(places))
        if effects:
            for k, (p, distance, outwards) in enumerate(places):
                if outwards:
                    mean[k] = colour_shift_px(study, p.channel, distance, p.light, effects)
        return Prediction(mean, {})

    return Block(
        measurement=LATERAL_COLOUR, reach=0.5, value=np.concatenate(values),
        covariance=covariance + np.diag(np.full(3 * n, COLOUR_FLOOR_PX**2)), labels=tuple(labels),
        reads=SHIFT, predict=predict, scale=np.ones(3 * n),
    )  # fmt: skip


def colour_shift_px(
    study: Study, channel: str, distance: float, light: Spectrum | None, effects: Effects, kind: str = "bernoulli"
) -> float:
    """Predicted radial displacement of a channel's image from the green one, px, at `distance` (half diagonals) from
    the middle.

    It is the mean over four directions of the displacement by the effects, weighted over wavelengths by the photons
    that each channel detects. `light` None: a flat spectrum; `kind`: of the capture.
    """
    wavelength = np.arange(400.0, 721.0, 10.0)
    outwards = outward_shifts_px(study, distance, wavelength, effects)
    if not outwards.any():
        return 0.0
    radiance = np.ones_like(wavelength) if light is None else light.at(wavelength)
    model = Uniform(study.camera, effects)
    radiance = model.radiance(wavelength, radiance, kind) * model.transmittance(wavelength)
    seen = [radiance * wavelength * study.camera.quantum_efficiency[c].at(wavelength) for c in (channel, "G")]
    own, green = (float(s @ outwards / max(s.sum(), 1e-300)) for s in seen)
    return own - green


def outward_shifts_px(study: Study, distance: float, wavelength_nm: FloatArray, effects: Effects) -> FloatArray:
    """Predicted displacement outwards (n,), px, of light of n wavelengths at `distance` (half diagonals) from the
    middle: the mean over four directions."""
    camera = study.camera
    turn = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)
    x, y = (distance * camera.half_diagonal_um * way for way in (np.cos(turn), np.sin(turn)))
    outwards = np.zeros(len(wavelength_nm))
    for i, w in enumerate(wavelength_nm):
        shift = displaced_um(camera, x, y, float(w), effects)
        if shift is not None:
            outwards[i] = float(np.mean(shift[0] * np.cos(turn) + shift[1] * np.sin(turn)))
    return outwards / camera.pixel_pitch_um


LATERAL_COLOUR = Measurement(
    "lateral_colour",
    title="lateral colour of patterns",
    order=440,
    axis="field",
    unit="half diagonals",
    make=colour_block,
    quantity="displacement from green, px",
    conditions="direction",
)
