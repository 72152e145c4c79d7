"""Flicker: light that changes while a rolling shutter exposes row after row, seen in the rows of single flat frames. A fixed pattern of rows
that doesn't grow with the light shows there, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.diagnose.measurements.block import Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.held_out import held_out_flats
from lab.diagnose.measurements.reads import ADDED, acting
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from sim.effects.base import Effect
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

MOST_FRAMES, MOST_LEVELS = 6, 8  # frames of a level; levels of a session
WIDEN = 1.6  # ratio of the lower ends of successive frequency bands
HIGHEST = 0.45  # cy/row
#: Relative prior standard deviation of a band's power, common to all levels: row noise that isn't white. Five times as much above
#: 0.15 cy/row.
COLOUR_STD = 0.1
#: Prior standard deviation of the relative amplitude by which the fixed pattern of rows changes from level to level.
PATTERN_STD = 3e-5
#: Standard deviation of the rows' offsets over the read noise, where there are no repeated dark frames.
ROW_SHARE = 0.15
#: Start times of exposures, s, at which flicker is evaluated: multiples of the golden ratio cover all phases of any period evenly.
INSTANTS = 0.6180339887 * np.arange(24) % 1.0
LEAST_ROWS = 24  # of a plane of the mosaic


@dataclass(frozen=True)
class _Level:
    """The frames of one level."""

    captures: tuple[Any, ...]
    signal: float  # mean above the dark level, DN
    variance: float  # relative variance of a row's mean by the noise of pixels
    power: FloatArray  # (bands,): of the rows of single frames, over that of the noise
    freedom: FloatArray  # (bands,): degrees of freedom


def flicker_block(study: Study) -> Block:
    """Power spectrum of the rows of single flat frames, relative to the mean of all, over that of the pixels' noise; cube roots.

    q(r) = row means of a frame / row means of all frames - 1. Power at k cycles a frame: |sum over r of q(r) exp(-2 pi i k r / rows)|^2
    / (rows x variance of a row's mean). The cube root of its mean over a band is nearly normal (Wilson and Hilferty 1931): mean
    1 - 2 / (9 v), variance 2 / (9 v) for v degrees of freedom. Row noise of the dark frames is expected in light as well. Nuisance
    parameters: its size, the noise's spectrum, the fixed pattern of rows, and the phases of the light. Raises NotDetermined without
    unclipped, repeated flats, and for too few rows.
    """
    groups = [g for g in study.flat_levels() if all(m is not None for c in g for m in study.levels(c).mean.values())]
    groups = [g[:MOST_FRAMES] for g in groups if len(g) > 1]
    if len(groups) < 1:
        raise NotDetermined(
            "flicker", "no unclipped flat captures that are repeated: rows of single frames aren't comparable"
        )
    groups = [groups[i] for i in np.unique(np.linspace(0, len(groups) - 1, min(MOST_LEVELS, len(groups))).astype(int))]
    step = mosaic.step(study.camera.cfa)
    rows = study.camera.rows // step
    if rows < LEAST_ROWS:
        raise NotDetermined(
            "flicker", f"frames of {study.camera.rows} rows: too few to see bands in, which takes {LEAST_ROWS * step}"
        )
    bands = _bands(rows, HIGHEST * step)
    levels = _measured(study, groups, bands)
    dark, dark_std = _dark_power(study, bands)
    out = study.once(held_out_flats)
    frequency = np.array([np.sqrt(b[0] * b[-1]) for b in bands]) / (rows * step)
    freedom = np.concatenate([level.freedom for level in levels])
    value = np.cbrt(np.concatenate([level.power for level in levels]))
    # row noise of dark frames, DN^2 -> share of the power of noise in light
    share = np.repeat([1.0 / (level.signal**2 * level.variance) for level in levels], len(bands))
    offsets, offsets_std = np.tile(dark, len(levels)) * share, np.tile(dark_std, len(levels)) * share
    pattern = np.repeat([PATTERN_STD**2 * rows / level.variance for level in levels], len(bands))
    band = np.tile(np.arange(len(bands)), len(levels))

    def predict(effects: Effects) -> Prediction:
        moving = acting(effects, FLICKER)
        power, spread = 1.0 + offsets, np.zeros(len(value))
        if moving:
            found = [_modulation(study, level, effects, bands, step) for level in levels]
            power = power + np.concatenate([mean for mean, _ in found])
            spread = np.concatenate(
                [std / np.sqrt(len(level.captures)) for (_, std), level in zip(found, levels, strict=True)]
            )
        if Uniform(study.camera, effects).adds_signal:
            power = power + _pattern_power(study, levels, effects, bands, step)
        mean = np.cbrt(power) * (1.0 - 2.0 / (9.0 * freedom))
        slope = mean / (3.0 * power)
        jacobian = {}
        for k in range(len(bands)):
            jacobian[f"rows:offset:{k}"] = np.where(band == k, slope * offsets_std, 0.0)
            jacobian[f"rows:colour:{k}"] = np.where(
                band == k, slope * COLOUR_STD * (1.0 + 4.0 * (frequency[k] > 0.15)), 0.0
            )
            jacobian[f"rows:pattern:{k}"] = np.where(band == k, slope * pattern, 0.0)
        # the few frames of a level have phases of their own: standard deviation of their mean power about that over all phases
        for i in np.flatnonzero(spread):
            jacobian[f"rows:phase:{i}"] = np.where(np.arange(len(value)) == i, slope[i] * spread[i], 0.0)
        return Prediction(mean, jacobian)

    return Block(
        measurement=FLAT_ROWS, reach=LOG_REACH, along=np.log(np.tile(frequency, len(levels))),
        value=value, covariance=np.diag(2.0 / (9.0 * freedom)),
        labels=tuple(Label(float(f), "all", f"{level.captures[0].exposure_s:.4g} s", tuple(c.id for c in level.captures), level.captures[0].id in out)
                     for level in levels for f in frequency),
        reads=FLICKER | ADDED, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


FLICKER = frozenset({"light.rows"})
LOG_REACH = 1.0  # correlation length in ln(frequency)


def _bands(rows: int, highest_cy_per_row: float) -> list[range]:
    """Cycles a frame in each band, from 1 to `highest_cy_per_row` (at most `HIGHEST`). Each band begins at `WIDEN` times the last."""
    top = int(min(highest_cy_per_row, HIGHEST) * rows)
    bands, low = [], 1
    while low <= top:
        high = max(low + 1, int(np.ceil(low * WIDEN)))
        bands.append(range(low, min(high, top + 1)))
        low = high
    return bands


def _profile(frame: NDArray[np.floating], step: int) -> FloatArray:
    """Means of the rows, over `step` neighbouring ones each, the period of the mosaic."""
    rows = frame.shape[0] // step
    return np.asarray(frame.mean(1)[: rows * step].reshape(rows, step).mean(1))


def _measured(study: Study, groups: Sequence[Sequence[Any]], bands: Sequence[range]) -> list[_Level]:
    """The levels of groups of repeated flats."""
    noise, step = study.noise, mosaic.step(study.camera.cfa)
    rows = study.camera.rows // step
    profiles, variances, signals = [], [], []
    for group in groups:
        frames = [np.asarray(study.recordings.frame(c), np.float32) for c in group]
        dark = noise.black + noise.dark_dn_per_s * group[0].exposure_s
        mean = sum(frames[1:], frames[0]) / len(frames)
        # pixels' noise without that of whole rows
        left = [f - mean for f in frames]
        left = [d - d.mean(1, keepdims=True) for d in left]
        pixel = float(np.mean([np.mean(np.square(d, dtype=float)) for d in left])) * len(frames) / (len(frames) - 1)
        own = np.array([_profile(f, step) for f in frames]) - dark
        profiles.append(own / own.mean(1, keepdims=True))
        signals.append(float(own.mean()))
        variances.append(pixel / (step * study.camera.cols) / signals[-1] ** 2)
    # the reference: frames are weighted by signal and exposure, as flicker averages out in long ones
    weight = np.concatenate([np.full(len(g), s * g[0].exposure_s) for g, s in zip(groups, signals, strict=True)])
    weight /= weight.sum()
    every = np.concatenate(profiles)
    reference = weight @ every
    variance = np.concatenate([np.full(len(g), v) for g, v in zip(groups, variances, strict=True)])
    found, first = [], 0
    for group, signal, level in zip(groups, signals, variances, strict=True):
        at = slice(first, first + len(group))
        first += len(group)
        # variance of q: the frame's own noise, less its covariance with the reference, and the reference's
        own = level * (1.0 - 2.0 * weight[at].mean()) + float(weight**2 @ variance)
        lines = np.abs(np.fft.rfft(every[at] / reference - 1.0, axis=1)) ** 2 / rows / own
        found.append(
            _Level(
                tuple(group),
                signal,
                own,
                np.array([lines[:, list(band)].mean() for band in bands]),
                np.array([2.0 * len(group) * len(band) for band in bands]),
            )
        )
    return found


def _dark_power(study: Study, bands: Sequence[range]) -> tuple[FloatArray, FloatArray]:
    """Power of the rows of dark frames beyond that of pixels' noise, by band, DN^2, and its standard deviation.

    Without repeated dark frames: 0, and that of the prior `ROW_SHARE`. What is within two standard deviations of 0 is taken as 0.
    """
    noise, step = study.noise, mosaic.step(study.camera.cfa)
    rows = study.camera.rows // step
    total, expected, freedom = np.zeros(len(bands)), 0.0, np.zeros(len(bands))
    for group in study.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db)):
        part = group[:MOST_FRAMES]
        if len(part) < 2:
            continue
        frames = [np.asarray(study.recordings.frame(c), np.float32) for c in part]
        mean = sum(frames[1:], frames[0]) / len(frames)
        count = len(frames) - 1
        left = [f - mean for f in frames]
        lines = (
            np.mean([np.abs(np.fft.rfft(_profile(d, step))) ** 2 for d in left], axis=0) * len(frames) / count / rows
        )
        total += count * np.array([lines[list(band)].mean() for band in bands])
        inner = np.mean([np.mean(np.square(d - d.mean(1, keepdims=True), dtype=float)) for d in left])
        expected += count * float(inner) * len(frames) / count / (step * study.camera.cols)
        freedom += count
    if not freedom.any():
        return np.zeros(len(bands)), np.full(len(bands), (ROW_SHARE * noise.read_dn) ** 2 / step)
    frames_seen = freedom[0]
    mean_power = total / frames_seen
    uncertain = mean_power * np.sqrt(2.0 / (2.0 * frames_seen * np.array([len(b) for b in bands])))
    excess = mean_power - expected / frames_seen

    return np.where(excess > 2.0 * uncertain, excess, 0.0), uncertain


def _modulation(
    study: Study, level: _Level, effects: Sequence[Effect], bands: Sequence[range], step: int
) -> tuple[FloatArray, FloatArray]:
    """Power (bands,) that a varying light adds to a level: mean over `INSTANTS`, and standard deviation of a single frame."""
    rows = study.camera.rows // step
    model = Uniform(study.camera, effects)
    exposure = level.captures[0].exposure_s
    profiles = []
    for instant in INSTANTS:
        own = _profile(model.row_factors(study.camera.rows, exposure, float(instant))[:, None], step)
        profiles.append(own / own.mean())
    relative = np.array(profiles)
    relative = relative / relative.mean(0) - 1.0
    lines = np.abs(np.fft.rfft(relative, axis=1)) ** 2 / rows / level.variance
    power = np.array([lines[:, list(band)].mean(1) for band in bands])
    return power.mean(1), power.std(1)


def _pattern_power(
    study: Study, levels: Sequence[_Level], effects: Effects, bands: Sequence[range], step: int
) -> FloatArray:
    """Power (levels x bands,) that a fixed pattern of rows adds: it is a larger share of a low level than of the mean of all."""
    rows = study.camera.rows // step
    model = Uniform(study.camera, effects)
    added = study.noise.gain * _profile(model.added_e - model.added_e.mean(), step)
    share = np.array([added / level.signal for level in levels])
    weight = np.array([len(level.captures) * level.signal * level.captures[0].exposure_s for level in levels])
    relative = (1.0 + share) / (1.0 + weight @ share / weight.sum()) - 1.0
    lines = np.abs(np.fft.rfft(relative, axis=1)) ** 2 / rows
    power = [lines[i, list(band)].mean() / level.variance for i, level in enumerate(levels) for band in bands]
    return np.array(power)


FLAT_ROWS = Measurement(
    "flat_rows",
    title="flicker in the rows of flat fields",
    order=210,
    axis="row_frequency",
    unit="cy/row",
    make=flicker_block,
    quantity="power over noise, cube root",
    conditions="exposure",
    conditions_words="flats of",
)
