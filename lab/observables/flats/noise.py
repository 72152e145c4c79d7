"""The temporal variance of flats against their mean: the photon transfer curve."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.codes.rounding import variance_rounding_std
from lab.observables.dataset import Dataset
from lab.observables.noise.temporal import Repeats, flat_repeats
from lab.observables.observable import LEVEL_REACH, Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform, noise_values

VARIANCE_FLOOR = 0.002  # relative standard deviation of a variance beside chance: rounding, a few clipped pixels
GAIN_STD, READ_STD = 1.0, 0.3  # relative prior standard deviations of conversion gain and dark variance


def measure_noise(dataset: Dataset) -> Observable:
    """Temporal variance of flats by channel, DN^2, against their mean signal.

    Nuisance parameters: conversion gain, and read noise at each gain setting. Raises NotDetermined for fewer than four
    variances."""
    of_channel = channel_planes(dataset)
    points: list[tuple[Repeats, str, float, float, float]] = []
    for repeats in dataset.once(flat_repeats):
        for channel, names in of_channel.items():
            values = [repeats.variance[n] for n in names]
            known = [v for v in values if v is not None]
            if len(known) < len(values):
                continue
            std = float(np.mean([repeats.relative_std[n] for n in names])) / np.sqrt(len(names))
            level = float(np.mean([repeats.signal[n] for n in names]))
            points.append((repeats, channel, level, float(np.mean(known)), std))
    if len(points) < 4:
        raise NotDetermined(
            "noise", "fewer than two repeats of unclipped flat captures: temporal noise isn't determined"
        )
    signal = np.array([p[2] for p in points])
    value = np.array([p[3] for p in points])
    factor = np.array([p[0].gain for p in points])
    covariance = np.diag(np.square(value) * (np.square([p[4] for p in points]) + VARIANCE_FLOOR**2))
    noise = dataset.noise
    rounding = [
        variance_rounding_std(v, (noise.prnu * level) ** 2, noise.step_dn)
        for v, level in zip(value, signal, strict=True)
    ]
    covariance += np.diag(np.square(rounding))
    settings = sorted(set(factor.tolist()))

    def predict(effects: Effects) -> Prediction:
        shot_dn2 = shot_variance(dataset, signal, noise.gain * factor, effects)
        mean = shot_dn2 + np.square(noise.read_dn * factor)
        jacobian = {"gain": GAIN_STD * shot_dn2}
        for setting in settings:
            name = "read" if setting == 1.0 else f"read:{setting:.4g}"
            jacobian[name] = np.where(factor == setting, READ_STD * (noise.read_dn * setting) ** 2 + 0.05, 0.0)
        return Prediction(mean, jacobian)

    return Observable(
        measurement=NOISE, reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value, covariance=covariance,
        labels=tuple(Label(p[2], p[1], f"{p[0].exposure_s:.4g} s", p[0].captures, p[0].held_out) for p in points),
        reads=frozenset({"signal.response", "charge.variance_e2", "charge.excess", "codes.codes"}), predict=predict,
        scale=value,
    )  # fmt: skip


def shot_variance(dataset: Dataset, signal_dn: FloatArray, gain_dn_per_e: FloatArray, effects: Effects) -> FloatArray:
    """Variance (n,), DN^2, of uniform light without read noise, at mean signals above black (n,), DN, of captures with
    the given gains (n,)."""
    noise, model = dataset.noise, Uniform(dataset.camera, effects)
    light = dataset.field.light / dataset.field.light.mean()
    electrons, slope = behind(signal_dn / gain_dn_per_e, light, effects, dataset)
    setting_db = dataset.usual_gain_db + 20.0 * np.log10(gain_dn_per_e / noise.gain)
    noisy = [model.shot_e2(level, float(db)) for level, db in zip(electrons, setting_db, strict=True)]
    shot = np.maximum(np.array(noisy), 0.0) * np.square(slope)
    dn2 = gain_dn_per_e[:, None] ** 2 * shot
    if not model.has_even_codes:
        dn = noise.black + gain_dn_per_e[:, None] * electrons
        dn2 = coded_variance(dn, dn2 + noise.read_dn**2, effects, dataset) - np.square(noise.read_dn)
    return np.asarray(dn2.mean(1))


def channel_planes(dataset: Dataset) -> dict[str, list[str]]:
    """Channel -> names of its planes of the mosaic."""
    names = list(mosaic.planes(np.zeros((2, 2)), dataset.camera.cfa))
    return {channel: [n for n in names if n[0] == channel] for channel in dataset.channels}


def behind(
    signal_e: FloatArray, light: FloatArray, effects: Effects, dataset: Dataset
) -> tuple[FloatArray, FloatArray]:
    """Electrons (levels, points of the field) that give the measured mean signals (levels,), e, and the response's
    slope there.

    `light` (points,): relative illumination, of mean 1. A nonlinear response is inverted by three fixed-point steps.
    """
    model = Uniform(dataset.camera, effects)
    electrons = np.maximum(signal_e[:, None] * light, 1e-3)
    if model.is_linear:
        return electrons, np.ones_like(electrons)
    response = model.response
    wanted = np.maximum(signal_e, 1e-3)
    for _ in range(3):
        out = response(electrons).mean(1)
        electrons = np.maximum(electrons * (wanted / np.maximum(out, 1e-6))[:, None], 1e-3)
    step = 1e-3 * electrons
    return electrons, (response(electrons + step) - response(electrons - step)) / (2.0 * step)


def coded_variance(dn: FloatArray, dn2: FloatArray, effects: Effects, dataset: Dataset) -> FloatArray:
    """Variance (DN^2) of normal variables of means `dn` and variances `dn2`, in a converter's codes, by quadrature."""
    values = dn[..., None] + np.sqrt(dn2)[..., None] * noise_values(1)
    return np.asarray(Uniform(dataset.camera, effects).codes(values).var(axis=-1))


NOISE = Measurement(
    "noise",
    title="temporal noise against signal",
    order=220,
    axis="level",
    unit="DN",
    make=measure_noise,
    quantity="temporal variance, DN²",
    of_variances=True,
)
