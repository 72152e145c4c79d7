"""Uniform light: linearity of flat fields, narrowband signals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.diagnose.measurements.curves import CurveJacobian
from lab.diagnose.measurements.neighbours import held_out_flats
from lab.diagnose.measurements.summaries import (
    LAG,
    LEVEL_REACH,
    NARROWBAND_FLOOR,
    Block,
    Effects,
    Label,
    Prediction,
    Study,
    act_on,
    held_out_of,
    repeated_levels,
)
from lab.errors import NotDetermined
from lab.fit.rounding import rounding_std_dn
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import LEVEL, SPECTRAL, Uniform, electron_rate

LEVEL_FLOOR = 1.0e-4  # of a level, one for its repeats: non-linearity below what a linear camera may have, and rounding
READING_COLOUR_STD = 5e-4  # of a lamp's reading, by channel: the radiometer's noise by wavelength
RADIOMETER_STD = 0.002  # of a narrowband reading, common to the channels, where too few readings say less
READING_SAMPLE_STD = 1e-3  # of a narrowband reading, sample by sample, where no repeats tell
MOST_SAMPLE_STD = 4e-3
READING_STD = 1e-4  # what readings scatter at least
_READINGS = 8  # wavelengths from which on their own scatter tells


def linearity_block(study: Study) -> Block:
    """Mean of every flat frame by channel against the exposure; each channel's rate is free, the line's straightness isn't."""
    groups = study.flat_levels()
    if len({(g[0].exposure_s, g[0].photons_per_pixel) for g in groups}) < 3:
        raise NotDetermined("photon_transfer", "fewer than three levels of flat captures")
    if any(g[0].radiance is None for g in groups):
        raise NotDetermined("photon_transfer", "flat captures without a radiance file: their levels aren't comparable")
    points = _flat_points(study, groups)
    if len(points) < 4:
        raise NotDetermined("photon_transfer", "almost all flat captures are clipped: expose them shorter")
    exposures = np.array([c.exposure_s for c, *_ in points])
    value = np.array([mean for _, _, mean, _ in points])
    noise = study.noise
    signal = np.maximum(value - noise.black - noise.dark_dn_per_s * exposures, 1e-3)
    lights = list(dict.fromkeys(c.radiance for c, *_ in points))
    # one reading of a lamp against its first, by channel: what the radiometer says changed between passes
    first = {study.lamps[path]: path for path in reversed(lights)}
    read = {(path, c): electron_rate(study.camera, c, study.spectrum(path)) for path in lights for c in study.channels}
    relative = {(path, c): rate / max(read[first[study.lamps[path]], c], 1e-300) for (path, c), rate in read.items()}
    key = [(study.lamps[c.radiance], channel) for c, channel, *_ in points]
    scaled = exposures * np.array([relative[c.radiance, channel] for c, channel, *_ in points])
    rate = {}
    for pair in sorted(set(key)):
        mine = np.array([k == pair for k in key])
        low = mine & (signal < 0.6 * (study.saturation_dn - noise.black))
        use = low if low.sum() > 1 else mine
        rate[pair] = float(np.sum(signal[use]) / np.sum(scaled[use])) / noise.gain / float(study.field.light.mean())
    covariance = _level_covariance(study, groups, points, signal)

    def predict(effects: Effects) -> Prediction:
        changed = relative
        if any(act_on(effects, SPECTRAL)):
            changed = {}
            for (path, channel), share in relative.items():
                below = electron_rate(study.camera, channel, study.spectrum(path))
                above = electron_rate(study.camera, channel, study.spectrum(path), effects)
                changed[path, channel] = share * (above / below if below > 0 else 1.0)
        model = Uniform(study.camera, effects)
        field = model.field(study.field)
        mean, lit = np.empty(len(points)), np.empty(len(points))
        done: dict[str, dict[str, float]] = {}
        for i, (capture, channel, _, _) in enumerate(points):
            if capture.id not in done:
                lamp, elapsed = study.lamps[capture.radiance], study.elapsed_s(capture)
                rates = {c: rate[lamp, c] * changed[capture.radiance, c] for c in study.channels if (lamp, c) in rate}
                collected = model.electrons(rates, capture.exposure_s, field=field, elapsed_s=elapsed)
                done[capture.id] = model.mean_dn(collected)
            lit[i] = done[capture.id][channel] - noise.dark_dn_per_s * capture.exposure_s
            mean[i] = done[capture.id][channel] + _beside_light(study, capture, channel, effects)
        jacobian = study.free_offsets(exposures) | study.free_warmth([c for c, *_ in points])
        for lamp, channel in rate:
            jacobian[f"rate:{lamp}:{channel}"] = np.where([k == (lamp, channel) for k in key], 0.05 * lit, 0.0)
        if len(lights) > len(set(study.lamps.values())):
            for path in lights:
                read_there = np.array([c.radiance == path for c, *_ in points])
                jacobian[f"reading:{path}"] = np.where(read_there, RADIOMETER_STD * lit, 0.0)
                for channel in study.channels if len(study.channels) > 1 else ():
                    mine = read_there & np.array([c == channel for _, c, *_ in points])
                    jacobian[f"reading:{path}:{channel}"] = np.where(mine, READING_COLOUR_STD * lit, 0.0)
        return Prediction(mean, jacobian)

    return Block(
        measurement="photon_transfer", axis="level", unit="DN", reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value, covariance=covariance,
        labels=tuple(Label(float(v), channel, f"{c.exposure_s:.4g} s", (c.id,), out) for (c, channel, _, out), v in zip(points, value, strict=True)),
        reads=LEVEL | LAG, predict=predict, scale=signal,
    )  # fmt: skip


def _beside_light(study: Study, capture: Any, channel: str, effects: Effects) -> float:
    """DN of a channel's mean that isn't light's: black level, image lag, offsets."""
    lag_dn = study.noise.gain * study.carried_e(capture, channel, effects)
    return study.noise.black + lag_dn + study.offset(capture, effects)


def _level_covariance(study: Study, groups: list[list[Any]], points: list[Any], signal: FloatArray) -> FloatArray:
    """Of flat frames' levels: shot and read noise, the lamp's scatter (one for a frame's channels), and what is one for repeats."""
    noise = study.noise
    pixels = np.array([study.levels(c).pixels[channel] for c, channel, *_ in points])
    group_of = {c.id: i for i, group in enumerate(groups) for c in group}
    group = np.array([group_of[c.id] for c, *_ in points])
    channel_of = np.array([channel for _, channel, *_ in points])
    repeats = (group[:, None] == group) & (channel_of[:, None] == channel_of)
    covariance = np.diag((noise.gain * signal + noise.read_dn**2) / pixels)
    covariance += repeats * np.outer(signal, signal) * LEVEL_FLOOR**2
    rounding = rounding_std_dn(noise.spread_dn2(signal))
    covariance += repeats * np.outer(rounding, rounding)
    same = np.array([[a[0].id == b[0].id for b in points] for a in points])
    scatter = signal * _scatter(study, groups)[group]
    covariance += same * (np.outer(scatter, scatter) + noise.jitter_dn**2)
    return np.asarray(covariance)


#: Repeats' worth of trust in the scatter of all flat frames beside that of one setting's.
_COMMON_REPEATS = 4


def _scatter(study: Study, groups: list[list[Any]]) -> FloatArray:
    """Relative scatter of a frame's level by group: all flat frames', or more where a setting's own repeats scatter more, as in a
    flickering light that short exposures don't average."""
    noise = study.noise
    found = np.full(len(groups), noise.jitter_lamp)
    place = {c.id: i for i, group in enumerate(groups) for c in group}
    for repeats in repeated_levels(study, noise.black, noise.gain, noise.read_dn):
        moved = float(repeats.elapsed_s @ repeats.elapsed_s)
        left, free = repeats.away, len(repeats.away) - 1
        if free > 1 and moved > 0:  # a trend with time is no scatter
            left, free = left - float(repeats.elapsed_s @ left) / moved * repeats.elapsed_s, free - 1
        elif moved > 0:
            continue
        own = max(float(np.sum(np.square(left))) / free - repeats.noise, 0.0)
        pooled = (_COMMON_REPEATS * noise.jitter_lamp**2 + free * own) / (_COMMON_REPEATS + free)
        found[place[repeats.captures[0].id]] = np.sqrt(max(pooled, noise.jitter_lamp**2))
    return found


def _flat_points(study: Study, groups: list[list[Any]]) -> list[tuple[Any, str, float, bool]]:
    """(capture, channel, mean DN, held out) of every flat frame's unclipped channels."""
    points = []
    out = study.once(held_out_flats)
    for group in groups:
        for capture in group:
            for channel in study.channels:
                mean = study.levels(capture).mean[channel]
                if mean is not None:
                    points.append((capture, channel, mean, capture.id in out))
    return points


def narrowband_block(study: Study) -> Block:
    """Mean of every narrowband frame by channel against the maker's curves, of which a smooth few per cent are free."""
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

    def jacobian_of(effects: Effects, share: FloatArray) -> dict[str, FloatArray]:
        """By what is free; `share`: DN over electrons a second on axis."""
        jacobian = study.free_offsets(exposures) | study.free_warmth([c for c, *_ in points])
        return jacobian | {k: v * share for k, v in curves.jacobian(effects).items()}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        if not any(act_on(effects, LEVEL | LAG)):
            # what acts on the light's colours alone leaves signals in proportion to its rates
            share = noise.gain * float(study.field.light.mean()) * exposures
            return Prediction(
                noise.black + noise.dark_dn_per_s * exposures + share * rates, jacobian_of(effects, share)
            )
        lit = dict(zip(every, whole.rates(effects).reshape(len(every), len(known)), strict=True))
        model = Uniform(study.camera, effects)
        field = model.field(study.field)
        mean, share = np.empty(len(points)), np.empty(len(points))
        done: dict[str, dict[str, float]] = {}
        for i, (capture, channel, _, _) in enumerate(points):
            if capture.id not in done:
                by_channel = dict(zip(known, lit[capture.radiance].tolist(), strict=True))
                electrons = model.electrons(
                    by_channel, capture.exposure_s, field=field, elapsed_s=study.elapsed_s(capture)
                )
                done[capture.id] = model.mean_dn(electrons)
            mean[i] = done[capture.id][channel] + _beside_light(study, capture, channel, effects)
            share[i] = (done[capture.id][channel] - noise.dark_dn_per_s * capture.exposure_s) / max(rates[i], 1e-30)
        return Prediction(mean, jacobian_of(effects, share))

    return Block(
        measurement="narrowband", axis="wavelength", unit="nm", reach=25.0, value=value, covariance=covariance,
        labels=tuple(Label(c.wavelength_nm, channel, f"{c.wavelength_nm:g} nm", (c.id,), o) for c, channel, _, o in points),
        reads=LEVEL | LAG | SPECTRAL, predict=predict, scale=np.maximum(signal, 1.0),
    )  # fmt: skip


def _narrowband_covariance(
    study: Study, points: list[tuple[Any, str, float, bool]], signal: FloatArray, curves: CurveJacobian
) -> FloatArray:
    """Of narrowband signals: shot and read noise, what is one for repeats, the radiometer's reading, the lamp's scatter."""
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
    scatter = signal * noise.jitter_lamp
    covariance += (frame[:, None] == frame) * (np.outer(scatter, scatter) + noise.jitter_dn**2)
    return np.asarray(covariance)


def _reading_std(points: list[Any], signal: FloatArray, shot: FloatArray, expected: FloatArray) -> float:
    """Relative scatter of a radiometer's readings that all channels share, from the second differences between neighbouring
    wavelengths; at most RADIOMETER_STD, so that no structure of the light's or the filters' passes for scatter.

    Neighbours u_1, u_2, u_3 in relative deviation: u_2 - (u_1 + u_3) / 2 has variance 1.5 s^2 beside that of the noise; the median of
    the magnitudes keeps a few odd wavelengths out.
    """
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
    """Relative scatter of a radiometer's readings from sample to sample, from those of one wavelength each: of the log ratio of two
    readings about its mean, over sqrt 2, where the light exceeds a tenth of its peak; the median of all pairs."""
    found = []
    for readings in repeats:
        for first, second in pairwise(readings):
            (w, a), (v, b) = first.arrays, second.arrays
            lit = (a > 0.1 * a.max()) & (b > 0.1 * b.max()) if np.array_equal(w, v) else np.zeros(len(w), bool)
            if lit.sum() > 2:
                found.append(float(np.std(np.log(a[lit] / b[lit]), ddof=1)) / np.sqrt(2.0))
    return min(float(np.median(found)), MOST_SAMPLE_STD) if found else READING_SAMPLE_STD
