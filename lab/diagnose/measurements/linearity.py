"""Linearity of flat fields: the mean level against the exposure, or against the number of photons."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.measurements.block import LEVEL_REACH, Block, Label, Measurement, Prediction
from lab.diagnose.measurements.flat_light import FlatLight, reading, relative_rates
from lab.diagnose.measurements.uniform_levels import UniformLevels
from lab.errors import NotDetermined
from lab.measure.noise_figures import level_std, weighted_median
from lab.measure.reads import DARK_CURRENT, LAG, LINES, acting
from lab.measure.rounding import rounding_std_dn
from lab.measure.study import Study, held_out_flats
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import LEVEL, SPECTRAL, electron_rate

# Relative standard deviations.
LEVEL_FLOOR = 1.0e-4  # of a level, common to its repeats: nonlinearity of a linear camera
READING_COLOUR_STD = 5e-4  # of a radiometer's reading in one channel: its noise by wavelength
RADIOMETER_STD = 0.002  # of a radiometer's reading, common to the channels; the most that narrowband readings may have


def linearity_block(study: Study) -> Block:
    """Mean of every unclipped flat frame by channel, DN, against the exposure, or the number of photons where that is
    stated.

    Nuisance parameters: black level, dark current, the electron rate of each channel in each lamp, and the radiometer's
    readings. What remains is nonlinearity. Raises NotDetermined for flats without stated light, for fewer than three
    levels, and where fewer than four means are unclipped.
    """
    groups = [g for g in study.flat_levels() if reading(study, g[0]) is not None and g[0].id not in study.misstated]
    if not groups and study.flat_levels():
        raise NotDetermined(
            "photon_transfer", "flat captures without a radiance file or photon numbers: their levels aren't comparable"
        )
    if len({(g[0].exposure_s, g[0].photons_per_pixel) for g in groups}) < 3:
        raise NotDetermined("photon_transfer", "fewer than three levels of flat captures")
    points = _flat_points(study, groups)
    if len(points) < 4:
        raise NotDetermined("photon_transfer", "almost all flat captures are clipped: expose them shorter")
    exposures = np.array([c.exposure_s for c, *_ in points])
    value = np.array([mean for _, _, mean, _ in points])
    noise = study.noise
    signal = np.maximum(value - noise.black - noise.dark_dn_per_s * exposures, 1e-3)
    of = {c.id: found for c, *_ in points if (found := reading(study, c)) is not None}
    readings = list({one.name: one for one in of.values()}.values())
    # readings of a lamp against its first one, by channel: the change of the lamp between passes
    relative = relative_rates(study, readings)
    key = [(of[c.id].lamp, channel) for c, channel, *_ in points]
    scaled = exposures * np.array([relative[of[c.id].name, channel] for c, channel, *_ in points])
    rate = {}
    for pair in dict.fromkeys(key):
        mine = np.array([k == pair for k in key])
        low = mine & (signal < 0.6 * (study.saturation_dn - noise.black))
        use = low if low.sum() > 1 else mine
        # the median isn't moved by a level that contradicts the others
        typical = weighted_median(signal[use] / scaled[use], scaled[use])
        rate[pair] = typical / noise.gain / float(study.field.light.mean())
    covariance = _level_covariance(study, study.flat_levels(), points, signal)

    levels = UniformLevels(study, [(c, channel) for c, channel, *_ in points])
    lights = [of[c.id] for c in levels.captures]
    baseline = {c: np.array([rate.get((one.lamp, c), 0.0) for one in lights]) for c in study.channels}
    of_lamp = {(lamp, channel): np.array([k == (lamp, channel) for k in key]) for lamp, channel in rate}
    of_reading = _of_readings(study, readings, [of[c.id] for c, *_ in points], [channel for _, channel, *_ in points])

    def predict(effects: Effects) -> Prediction:
        changed = _changed(study, readings, relative, effects)
        rates = {c: level * np.array([changed[one.name, c] for one in lights]) for c, level in baseline.items()}
        light_dn = levels.of_light_dn(effects, rates)
        lit = light_dn - noise.dark_dn_per_s * exposures
        jacobian = study.free_offsets(exposures) | study.free_warmth([c for c, *_ in points])
        jacobian |= levels.lines.jacobian(effects)
        jacobian |= {f"rate:{lamp}:{channel}": 0.05 * lit * mine for (lamp, channel), mine in of_lamp.items()}
        jacobian |= {name: std * lit * mine for name, (std, mine) in of_reading.items()}
        return Prediction(light_dn + levels.beside_light_dn(effects), jacobian)

    return Block(
        measurement=PHOTON_TRANSFER, reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value,
        covariance=covariance,
        labels=tuple(Label(float(v), channel, _setting(c), (c.id,), out) for (c, channel, _, out), v in zip(points,
        value, strict=True)),
        reads=LEVEL | LAG | DARK_CURRENT, scattered_by=LINES, predict=predict, scale=signal,
    )  # fmt: skip


def _changed(
    study: Study, readings: list[FlatLight], relative: Mapping[tuple[str, str], float], effects: Effects
) -> Mapping[tuple[str, str], float]:
    """`relative` rates, (reading, channel) -> rate over that by the lamp's first reading, as effects on the spectrum
    change them.

    Light stated in photons changes by the same factor at all levels, which is part of its free rate.
    """
    if not acting(effects, SPECTRAL):
        return relative
    changed = dict(relative)
    for one in readings:
        for channel in study.channels if one.path is not None else ():
            below = electron_rate(study.camera, channel, study.spectrum(one.path or ""))
            above = electron_rate(study.camera, channel, study.spectrum(one.path or ""), effects)
            changed[one.name, channel] *= above / below if below > 0 else 1.0
    return changed


def _of_readings(
    study: Study, readings: list[FlatLight], lights: list[FlatLight], channels: list[str]
) -> dict[str, tuple[float, np.ndarray]]:
    """Nuisance parameters of the radiometer's readings: name -> (relative prior standard deviation, mask (n,) of the
    means it changes).

    One for each reading, and one for each reading and channel. None where every lamp was read once, as its free rate
    covers that."""
    found: dict[str, tuple[float, np.ndarray]] = {}
    if len(readings) == len({one.lamp for one in readings}):
        return found
    for one in readings:
        read_there = np.array([light == one for light in lights])
        found[f"reading:{one.name}"] = RADIOMETER_STD, read_there
        for channel in study.channels if len(study.channels) > 1 and one.path is not None else ():
            mine = read_there & np.array([c == channel for c in channels])
            found[f"reading:{one.name}:{channel}"] = READING_COLOUR_STD, mine
    return found


def _level_covariance(study: Study, groups: list[list[Any]], points: list[Any], signal: FloatArray) -> FloatArray:
    """Covariance (n, n) of flat frames' means, DN^2: shot and read noise, the lamp's repeatability (common to a frame's
    channels), and floor and rounding (common to repeats)."""
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


def _setting(capture: FlatCapture) -> str:
    """Return the setting of a flat in words: exposure, and photons where they are stated."""
    if capture.photons_per_pixel is None:
        return f"{capture.exposure_s:.4g} s"
    return f"{capture.photons_per_pixel:.6g} photons, {capture.exposure_s:.4g} s"


def _flat_points(study: Study, groups: list[list[Any]]) -> list[tuple[Any, str, float, bool]]:
    """(capture, channel, mean in DN, held out) of all unclipped channels of flat frames."""
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
    "photon_transfer",
    title="linearity of flat fields",
    order=200,
    axis="level",
    unit="DN",
    make=linearity_block,
    quantity="mean level, DN",
    is_level=True,
)
