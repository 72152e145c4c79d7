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
from lab.diagnose.measurements.reads import ADDED
from lab.diagnose.measurements.row_light import PHASES, ROW_LIGHT
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

MOST_FRAMES, MOST_LEVELS = 6, 8  # frames of a level; levels of a session
WIDEN = 1.25  # ratio of the lower ends of successive frequency bands
HIGHEST = 0.45  # cy/row
#: Relative prior standard deviation of a band's power, common to all levels: row noise that isn't white. Five times as much above
#: 0.15 cy/row.
COLOUR_STD = 0.1
#: Prior standard deviation of the relative amplitude by which the fixed pattern of rows changes from level to level.
PATTERN_STD = 3e-5
#: Standard deviation of the rows' offsets over the read noise, where there are no repeated dark frames.
ROW_SHARE = 0.15
LEAST_ROWS = 24  # of a plane of the mosaic
#: Times within a period at which a frame may begin, interpolated between `PHASES`; and how often they are found anew, beside the mean
#: of all frames that follows from them.
FINE_PHASES, REFINEMENTS = 240, 3


@dataclass(frozen=True)
class _Level:
    """The frames of one level."""

    captures: tuple[Any, ...]
    signal: float  # mean above the dark level, DN
    variance: float  # relative variance of a row's mean by the noise of pixels
    power: FloatArray  # (bands,): of the rows of single frames, over that of the noise
    freedom: FloatArray  # (bands,): degrees of freedom
    rows: FloatArray  # (frames, rows): of single frames, over the mean of all
    weight: FloatArray  # (frames,): in that mean


def flicker_block(study: Study) -> Block:
    """Power spectrum of the rows of single flat frames, relative to the mean of all, over that of the pixels' noise; cube roots.

    q(r) = row means of a frame / row means of all frames - 1. Power at k cycles a frame: |sum over r of q(r) exp(-2 pi i k r / rows)|^2
    / (rows x variance of a row's mean). The cube root of its mean over a band is nearly normal (Wilson and Hilferty 1931): mean
    1 - 2 / (9 v), variance 2 / (9 v) for v degrees of freedom. Row noise of the dark frames is expected in light as well. Nuisance
    parameters: its size, the noise's spectrum, and the fixed pattern of rows. A frame begins at that time within a period of the light
    for which the predicted rows are most like its own. Raises NotDetermined without
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
        model = Uniform(study.camera, effects)
        power = 1.0 + offsets
        if model.varies_by_row:
            power = power + _added_power(model, study.camera.rows, levels, bands, step)
        if model.adds_signal:
            power = power + _pattern_power(study, levels, model, bands, step)
        mean = np.cbrt(power) * (1.0 - 2.0 / (9.0 * freedom))
        slope = mean / (3.0 * power)
        jacobian = {}
        for k in range(len(bands)):
            jacobian[f"rows:offset:{k}"] = np.where(band == k, slope * offsets_std, 0.0)
            jacobian[f"rows:colour:{k}"] = np.where(
                band == k, slope * COLOUR_STD * (1.0 + 4.0 * (frequency[k] > 0.15)), 0.0
            )
            jacobian[f"rows:pattern:{k}"] = np.where(band == k, slope * pattern, 0.0)
        return Prediction(mean, jacobian)

    return Block(
        measurement=FLAT_ROWS, reach=LOG_REACH, along=np.log(np.tile(frequency, len(levels))),
        value=value, covariance=np.diag(2.0 / (9.0 * freedom)),
        labels=tuple(Label(float(f), "all", f"{level.captures[0].exposure_s:.4g} s", tuple(c.id for c in level.captures), level.captures[0].id in out)
                     for level in levels for f in frequency),
        reads=ROW_LIGHT | ADDED, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


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
        found.append(
            _Level(
                tuple(group),
                signal,
                own,
                _power(every[at] / reference, bands) / own,
                np.array([2.0 * len(group) * len(band) for band in bands]),
                every[at] / reference,
                weight[at],
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


def _power(rows: FloatArray, bands: Sequence[range]) -> FloatArray:
    """Power (bands,) of rows (frames, rows) about 1, mean over the frames."""
    lines = np.abs(np.fft.rfft(rows - 1.0, axis=1)) ** 2 / rows.shape[1]
    return np.array([lines[:, list(band)].mean() for band in bands])


def _added_power(
    model: Uniform, camera_rows: int, levels: Sequence[_Level], bands: Sequence[range], step: int
) -> FloatArray:
    """Power (levels x bands,) over that of the noise, of the rows in a light that varies while a frame is taken."""
    from scipy.signal import resample  # here: the library takes a while to load

    factors = []
    for level in levels:
        by_phase = model.row_factors_by_phase(camera_rows, level.captures[0].exposure_s, PHASES)
        profiles = by_phase[:, : camera_rows // step * step].reshape(PHASES, -1, step).mean(2)
        factors.append(resample(profiles / profiles.mean(1, keepdims=True), FINE_PHASES))
    mean, light = np.ones(factors[0].shape[1]), list[FloatArray]()
    for _ in range(REFINEMENTS):
        light = [_nearest(level.rows * mean, own) for level, own in zip(levels, factors, strict=True)]
        mean = sum((level.weight @ own for level, own in zip(levels, light, strict=True)), np.zeros(len(mean)))
    return np.concatenate(
        [_power(own / mean, bands) / level.variance for level, own in zip(levels, light, strict=True)]
    )


def _nearest(rows: FloatArray, by_phase: FloatArray) -> FloatArray:
    """The light (frames, rows) of least squares from rows (frames, rows), of `by_phase` (phases, rows), interpolated linearly between
    phases: it is continuous in the law's parameters."""
    phases = len(by_phase)
    mismatch = np.square(by_phase).sum(1) - 2.0 * rows @ by_phase.T
    frame, at = np.arange(len(rows)), np.argmin(mismatch, axis=1)
    below, above = mismatch[frame, at - 1], mismatch[frame, (at + 1) % phases]
    curvature = np.maximum(below + above - 2.0 * mismatch[frame, at], 1e-300)
    off = np.clip(0.5 * (below - above) / curvature, -0.5, 0.5)[:, None]
    beside = by_phase[(at + np.where(off[:, 0] < 0.0, -1, 1)) % phases]
    return np.asarray(by_phase[at] * (1.0 - np.abs(off)) + beside * np.abs(off))


def _pattern_power(
    study: Study, levels: Sequence[_Level], model: Uniform, bands: Sequence[range], step: int
) -> FloatArray:
    """Power (levels x bands,) that a fixed pattern of rows adds: it is a larger share of a low level than of the mean of all."""
    added = study.noise.gain * _profile(model.added_e - model.added_e.mean(), step)
    share = np.array([added / level.signal for level in levels])
    weight = np.array([float(level.weight.sum()) for level in levels])
    relative = (1.0 + share) / (1.0 + weight @ share)
    return np.concatenate(
        [_power(own[None], bands) / level.variance for level, own in zip(levels, relative, strict=True)]
    )


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
