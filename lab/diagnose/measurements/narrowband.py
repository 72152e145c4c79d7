"""Signals in narrowband light against the maker's sensitivity curves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.diagnose.measurements.curves import CurveJacobian
from lab.diagnose.measurements.linearity import RADIOMETER_STD
from lab.diagnose.measurements.uniform_levels import UniformLevels
from lab.errors import NotDetermined
from lab.measure.reads import DARK_CURRENT, LAG, LINES, acting
from lab.measure.rounding import rounding_std_dn
from lab.measure.study import Study, held_out_of
from sim.effects.base import Effects
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import LEVEL, SPECTRAL

# Relative standard deviations.
NARROWBAND_FLOOR = 1e-4  # of a level, independent between channels, common to its repeats
READING_SAMPLE_STD = 1e-3  # of a sample of a radiometer's reading, where no wavelength was read twice
MOST_SAMPLE_STD = 4e-3  # the most that is measured of it
READING_STD = 1e-4  # the least of a reading, common to the channels
_READINGS = 8  # readings from which on their standard deviation is measured


def narrowband_block(study: Study) -> Block:
    """Mean of every unclipped narrowband frame by channel, DN, against the maker's sensitivity curves.

    Nuisance parameters: black level, dark current, and smooth errors of the curves (`curves`). Raises NotDetermined
    where the curves aren't stated, and for fewer than four means.
    """
    if not study.stated.quantum_efficiency:
        raise NotDetermined(
            "narrowband", "the maker's sensitivity curves aren't stated: nothing to hold the recordings against"
        )
    captures = study.recordings.captures(NarrowbandCapture, study.side)
    groups = study.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s, c.radiance))
    out = set().union(*(held_out_of(g, i, len(groups)) for i, g in enumerate(groups))) if groups else set()
    points = []
    for capture in captures:
        for channel in study.channels:
            mean = study.levels(capture).mean[channel]
            if mean is not None and channel in study.stated.quantum_efficiency:
                points.append((capture, channel, mean, capture.id in out))
    if len(points) < 4:
        raise NotDetermined("narrowband", "fewer than four unclipped narrowband signals")
    exposures = np.array([c.exposure_s for c, *_ in points])
    value = np.array([p[2] for p in points])
    noise = study.noise
    signal = np.maximum(value - noise.black - noise.dark_dn_per_s * exposures, 0.0)
    curves = CurveJacobian(
        study,
        [(c.radiance, channel, c.exposure_s, "narrowband", None) for c, channel, *_ in points],
        signal / noise.gain / exposures,
    )
    every = list(dict.fromkeys(c.radiance for c, *_ in points))
    known = [c for c in study.channels if c in study.camera.quantum_efficiency]
    whole = CurveJacobian(
        study, [(path, c, 1.0, "narrowband", None) for path in every for c in known], scale=curves.scale
    )
    covariance = _narrowband_covariance(study, points, signal, curves)

    levels = UniformLevels(study, [(c, channel) for c, channel, *_ in points])
    light_of = np.array([every.index(path) for path in {c.id: c.radiance for c, *_ in points}.values()])

    def jacobian_of(effects: Effects, share: FloatArray) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> derivative (n,), DN. `share` (n,): DN for an electron a second on axis."""
        jacobian = study.free_offsets(exposures) | study.free_warmth([c for c, *_ in points])
        jacobian |= levels.lines.jacobian(effects)
        return jacobian | {k: v * share for k, v in curves.jacobian(effects).items()}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        if not acting(effects, LEVEL | LAG | DARK_CURRENT):
            # effects on the spectrum alone: signals are proportional to the rates
            share = noise.gain * float(study.field.light.mean()) * exposures
            return Prediction(
                noise.black + noise.dark_dn_per_s * exposures + share * rates, jacobian_of(effects, share)
            )
        lit = whole.rates(effects).reshape(len(every), len(known))[light_of]
        light_dn = levels.of_light_dn(effects, dict(zip(known, lit.T, strict=True)))
        share = (light_dn - noise.dark_dn_per_s * exposures) / np.maximum(rates, 1e-30)
        return Prediction(light_dn + levels.beside_light_dn(effects), jacobian_of(effects, share))

    return Block(
        measurement=NARROWBAND, reach=25.0, value=value, covariance=covariance,
        labels=tuple(Label(c.wavelength_nm, channel, f"{c.wavelength_nm:g} nm", (c.id,), o) for c, channel, _,
        o in points),
        reads=LEVEL | LAG | DARK_CURRENT | SPECTRAL, scattered_by=LINES, predict=predict, scale=np.maximum(signal, 1.0),
    )  # fmt: skip


def _narrowband_covariance(
    study: Study, points: list[tuple[Any, str, float, bool]], signal: FloatArray, curves: CurveJacobian
) -> FloatArray:
    """Covariance (n, n) of narrowband means, DN^2: shot and read noise, floor and rounding (common to repeats), the
    radiometer's readings, and the lamp's repeatability (common to a frame's channels)."""
    noise = study.noise
    exposures = np.array([c.exposure_s for c, *_ in points])
    pixels = np.array([study.levels(c).pixels[channel] for c, channel, *_ in points])
    rounded = curves.rounding * exposures * float(study.field.light.mean()) * noise.gain
    shot = (noise.gain * signal + noise.read_dn**2) / pixels
    frame = np.array([c.id for c, *_ in points])
    setting = np.array([f"{c.wavelength_nm} {c.exposure_s} {channel}" for c, channel, *_ in points])
    reading = np.array([c.radiance for c, *_ in points])
    digits = rounding_std_dn(noise.spread_dn2(signal))
    own = np.sqrt((NARROWBAND_FLOOR * signal) ** 2 + rounded**2 + digits**2)
    expected = curves.rates(()) * exposures
    radiometer = signal * _reading_std(points, signal, shot, expected)
    covariance = np.diag(shot) + (setting[:, None] == setting) * np.outer(own, own)
    readings: dict[float, dict[str, Spectrum]] = {}
    for c, *_ in points:
        readings.setdefault(c.wavelength_nm, {})[c.radiance] = study.spectrum(c.radiance)
    sampled = curves.sample_shares * (_sample_std([*r.values()] for r in readings.values()) * signal)[:, None]
    covariance += (reading[:, None] == reading) * (np.outer(radiometer, radiometer) + sampled @ sampled.T)
    lamp = signal * noise.jitter_lamp
    covariance += (frame[:, None] == frame) * (np.outer(lamp, lamp) + noise.jitter_dn**2)
    return np.asarray(covariance)


def _reading_std(points: list[Any], signal: FloatArray, shot: FloatArray, expected: FloatArray) -> float:
    """Relative standard deviation s of a radiometer's readings, common to the channels, from second differences along
    wavelength.

    With u the ln of measured over expected signal at neighbouring wavelengths, u_2 - (u_1 + u_3) / 2 has the variance
    1.5 s^2 + that of the noise. The median of its magnitude isn't moved by a few outlying wavelengths. At most
    `RADIOMETER_STD`, so that structure of the light or of filters isn't taken for noise; that, too, for fewer than
    `_READINGS` readings."""
    deviation: dict[str, tuple[float, float, float]] = {}
    by_frame: dict[str, list[int]] = {}
    for i, (capture, *_) in enumerate(points):
        by_frame.setdefault(capture.id, []).append(i)
    strong = signal > 0.05 * signal.max()
    for frame, members in by_frame.items():
        use = [i for i in members if strong[i] and expected[i] > 0]
        if use:
            weight = np.square(signal[use]) / shot[use]
            ratio = np.log(signal[use] / expected[use])
            place = points[use[0]][0].wavelength_nm
            deviation[frame] = place, float(np.sum(weight * ratio) / weight.sum()), float(1.0 / weight.sum())
    found = sorted(deviation.values())
    if len(found) < _READINGS:
        return RADIOMETER_STD
    u, v = np.array([f[1] for f in found]), np.array([f[2] for f in found])
    bend = u[1:-1] - 0.5 * (u[:-2] + u[2:])
    noise = float(np.median(v[1:-1] + 0.25 * (v[:-2] + v[2:])))
    spread = float(np.median(np.abs(bend))) / 0.6745
    return float(np.sqrt(np.clip((spread**2 - noise) / 1.5, READING_STD**2, RADIOMETER_STD**2)))


def _sample_std(repeats: Iterable[Sequence[Spectrum]]) -> float:
    """Relative standard deviation of a sample of a radiometer's reading, independent of its neighbours. `repeats`: the
    readings of each wavelength.

    Of two readings: the standard deviation of their log ratio over sqrt 2, at samples above a tenth of the peak. The
    median over pairs is taken, at most `MOST_SAMPLE_STD`.
    """
    found = []
    for readings in repeats:
        for first, second in pairwise(readings):
            (w, a), (v, b) = first.arrays, second.arrays
            lit = (a > 0.1 * a.max()) & (b > 0.1 * b.max()) if np.array_equal(w, v) else np.zeros(len(w), bool)
            if lit.sum() > 2:
                found.append(float(np.std(np.log(a[lit] / b[lit]), ddof=1)) / np.sqrt(2.0))
    return min(float(np.median(found)), MOST_SAMPLE_STD) if found else READING_SAMPLE_STD


NARROWBAND = Measurement(
    "narrowband",
    title="signal in narrowband light",
    order=280,
    axis="wavelength",
    unit="nm",
    make=narrowband_block,
    quantity="mean level, DN",
    is_level=True,
)
