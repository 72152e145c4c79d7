"""Photon transfer of flat fields: the mean level against the exposure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lab.capture_kinds.base import Capture
from lab.diagnose.measurements.block import LEVEL_REACH, Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.dark_level import added_dark_dn
from lab.diagnose.measurements.held_out import held_out_flats
from lab.diagnose.measurements.line_means import line_mean_jacobian
from lab.diagnose.measurements.reads import DARK_CURRENT, LAG, LINES, acting
from lab.diagnose.measurements.repeatability import level_std
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from lab.fit.rounding import rounding_std_dn
from sim.spectrum import FloatArray
from sim.uniform import LEVEL, SPECTRAL, Uniform, electron_rate

LEVEL_FLOOR = 1.0e-4  # of a level, one for its repeats: non-linearity below what a linear camera may have, and rounding
READING_COLOUR_STD = 5e-4  # of a lamp's reading, by channel: the radiometer's noise by wavelength
RADIOMETER_STD = 0.002  # of a narrowband reading, common to the channels, where too few readings say less


def linearity_block(study: Study) -> Block:
    """Mean of every flat frame by channel, DN, against the exposure.

    Nuisance parameters: black level, dark current, each channel's rate, the radiometer's readings. What remains is nonlinearity.
    """
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
        changed = _changed(study, relative, effects)
        model, beside = Uniform(study.camera, effects), beside_light_dn(study, effects)
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
            mean[i] = done[capture.id][channel] + beside(capture, channel)
        jacobian = study.free_offsets(exposures) | study.free_warmth([c for c, *_ in points])
        jacobian |= line_mean_jacobian(study, [(c, channel) for c, channel, *_ in points], effects)
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
        measurement=PHOTON_TRANSFER, reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value, covariance=covariance,
        labels=tuple(Label(float(v), channel, f"{c.exposure_s:.4g} s", (c.id,), out) for (c, channel, _, out), v in zip(points, value, strict=True)),
        reads=LEVEL | LAG | DARK_CURRENT, scattered_by=LINES, predict=predict, scale=signal,
    )  # fmt: skip


def _changed(study: Study, relative: dict[tuple[str, str], float], effects: Effects) -> dict[tuple[str, str], float]:
    """Rates of light in each channel, by (spectrum, channel), over those of the lamp's first reading, as effects change them."""
    if not acting(effects, SPECTRAL):
        return relative
    changed = {}
    for (path, channel), share in relative.items():
        below = electron_rate(study.camera, channel, study.spectrum(path))
        above = electron_rate(study.camera, channel, study.spectrum(path), effects)
        changed[path, channel] = share * (above / below if below > 0 else 1.0)
    return changed


def beside_light_dn(study: Study, effects: Effects) -> Callable[[Capture, str], float]:
    """DN of a capture's mean by channel that are neither of light nor of the camera's own dark current: black level, image lag,
    offsets, additional dark current."""
    more = added_dark_dn(study, effects)

    def beside(capture: Capture, channel: str) -> float:
        lag_dn = study.noise.gain * study.carried_e(capture, channel, effects)
        return study.noise.black + lag_dn + study.offset(capture, effects) + more(capture)

    return beside


def _level_covariance(study: Study, groups: list[list[Any]], points: list[Any], signal: FloatArray) -> FloatArray:
    """Of flat frames' levels: shot and read noise, the lamp's repeatability (common to a frame's channels), and what repeats share."""
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
    lamp = signal * level_std(study, groups)[group]
    covariance += same * (np.outer(lamp, lamp) + noise.jitter_dn**2)
    return np.asarray(covariance)


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


PHOTON_TRANSFER = Measurement(
    "photon_transfer", title="linearity of flat fields", order=200, axis="level", unit="DN", make=linearity_block
)
