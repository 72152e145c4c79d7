"""Levels in narrowband light against the maker's sensitivity curves."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_of
from lab.observables.flats.linearity import UniformLevels
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES, acting
from lab.observables.spectra.curves import CurveJacobian
from lab.observables.spectra.light_readings import reading_std, sample_std
from sim.effects.base import Effects
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import LEVEL, SPECTRAL


def measure_narrowband(dataset: Dataset) -> Observable:
    """Mean of every unclipped narrowband frame by channel, DN, against the maker's sensitivity curves.

    Nuisance parameters: black level, dark current, and smooth errors of the curves (`curves`). Raises NotDetermined
    where the curves aren't stated, and for fewer than four means.
    """
    if not dataset.stated.quantum_efficiency:
        raise NotDetermined(
            "narrowband", "the maker's sensitivity curves aren't stated: nothing to hold the recordings against"
        )
    captures = dataset.recordings.captures(NarrowbandCapture, dataset.side)
    groups = dataset.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s, c.radiance))
    out = set().union(*(held_out_of(g, i, len(groups)) for i, g in enumerate(groups))) if groups else set()
    points = []
    for capture in captures:
        for channel in dataset.channels:
            mean = dataset.levels(capture).mean[channel]
            if mean is not None and channel in dataset.stated.quantum_efficiency:
                points.append((capture, channel, mean, capture.id in out))
    if len(points) < 4:
        raise NotDetermined("narrowband", "fewer than four unclipped narrowband signals")
    exposures = np.array([c.exposure_s for c, *_ in points])
    value = np.array([p[2] for p in points])
    noise = dataset.noise
    signal = np.maximum(value - noise.black - noise.dark_dn_per_s * exposures, 0.0)
    curves = CurveJacobian(
        dataset,
        [(c.radiance, channel, c.exposure_s, "narrowband", None) for c, channel, *_ in points],
        signal / noise.gain / exposures,
    )
    every = list(dict.fromkeys(c.radiance for c, *_ in points))
    known = [c for c in dataset.channels if c in dataset.camera.quantum_efficiency]
    whole = CurveJacobian(
        dataset, [(path, c, 1.0, "narrowband", None) for path in every for c in known], scale=curves.scale
    )
    covariance = _narrowband_covariance(dataset, points, signal, curves)

    levels = UniformLevels(dataset, [(c, channel) for c, channel, *_ in points])
    light_of = np.array([every.index(path) for path in {c.id: c.radiance for c, *_ in points}.values()])

    def jacobian_of(effects: Effects, share: FloatArray) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> derivative (n,), DN. `share` (n,): DN for an electron a second on axis."""
        jacobian = dataset.free_offsets(exposures) | dataset.free_warmth([c for c, *_ in points])
        jacobian |= levels.lines.jacobian(effects)
        return jacobian | {k: v * share for k, v in curves.jacobian(effects).items()}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        if not acting(effects, LEVEL | LAG | DARK_CURRENT):
            # effects on the spectrum alone: signals are proportional to the rates
            share = noise.gain * float(dataset.field.light.mean()) * exposures
            return Prediction(
                noise.black + noise.dark_dn_per_s * exposures + share * rates, partial(jacobian_of, effects, share)
            )
        lit = whole.rates(effects).reshape(len(every), len(known))[light_of]
        light_dn = levels.of_light_dn(effects, dict(zip(known, lit.T, strict=True)))
        share = (light_dn - noise.dark_dn_per_s * exposures) / np.maximum(rates, 1e-30)
        return Prediction(light_dn + levels.beside_light_dn(effects), partial(jacobian_of, effects, share))

    return Observable(
        measurement=NARROWBAND, reach=25.0, value=value, covariance=covariance,
        labels=tuple(Label(c.wavelength_nm, channel, f"{c.wavelength_nm:g} nm", (c.id,), o) for c, channel, _,
        o in points),
        reads=LEVEL | LAG | DARK_CURRENT | SPECTRAL, scattered_by=LINES, predict=predict, scale=np.maximum(signal, 1.0),
    )  # fmt: skip


def _narrowband_covariance(
    dataset: Dataset, points: list[tuple[Any, str, float, bool]], signal: FloatArray, curves: CurveJacobian
) -> FloatArray:
    """Covariance (n, n) of narrowband means, DN^2: shot and read noise, rounding (common to repeats), the
    radiometer's readings, and the lamp's repeatability (common to a frame's channels)."""
    noise = dataset.noise
    exposures = np.array([c.exposure_s for c, *_ in points])
    pixels = np.array([dataset.levels(c).pixels[channel] for c, channel, *_ in points])
    rounded = curves.rounding * exposures * float(dataset.field.light.mean()) * noise.gain
    shot = (noise.gain * signal + noise.read_dn**2) / pixels
    frame = np.array([c.id for c, *_ in points])
    setting = np.array([f"{c.wavelength_nm} {c.exposure_s} {channel}" for c, channel, *_ in points])
    reading = np.array([c.radiance for c, *_ in points])
    digits = noise.rounding_std_dn(signal)
    own = np.sqrt(rounded**2 + digits**2)
    expected = curves.rates(()) * exposures
    radiometer = signal * reading_std(points, signal, shot, expected)
    covariance = np.diag(shot) + (setting[:, None] == setting) * np.outer(own, own)
    readings: dict[float, dict[str, Spectrum]] = {}
    for c, *_ in points:
        readings.setdefault(c.wavelength_nm, {})[c.radiance] = dataset.spectrum(c.radiance)
    sampled = curves.sample_shares * (sample_std([*r.values()] for r in readings.values()) * signal)[:, None]
    covariance += (reading[:, None] == reading) * (np.outer(radiometer, radiometer) + sampled @ sampled.T)
    lamp = signal * noise.jitter_lamp
    covariance += (frame[:, None] == frame) * (np.outer(lamp, lamp) + noise.jitter_dn**2)
    return np.asarray(covariance)


NARROWBAND = Measurement(
    "narrowband",
    title="signal in narrowband light",
    order=280,
    axis="wavelength",
    unit="nm",
    make=measure_narrowband,
    quantity="mean level, DN",
    is_level=True,
)
