"""Flicker: light that changes while a rolling shutter exposes row after row, seen in the rows of single flat frames.
Noise of rows and a fixed pattern of rows show there, too; what dark frames have of both is predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.errors import NotDetermined
from lab.observables.darks.readout import DarkRowPower, dark_readout, row_profile
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.images import LEAST_SIGNAL, dark_level_dn
from lab.observables.flats.row_light import PHASES, ROW_LIGHT
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import ADDED, LEAK
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import FieldPoints, Uniform

MOST_FRAMES, MOST_LEVELS = 6, 8  # frames of a level; levels of a session
WIDEN = 1.25  # ratio of the lower ends of successive frequency bands
HIGHEST = 0.45  # cy/row
#: Relative prior standard deviation of a band's power, common to all levels: noise of pixels that isn't white. Five
#: times as much above
#: 0.15 cy/row.
COLOUR_STD = 0.1
#: Prior standard deviation of the relative amplitude by which the fixed pattern of rows changes from level to level.
PATTERN_STD = 3e-5
#: The same of its smooth part, at one cycle a frame, and the power of the frequency by which it falls: shading is
#: another at each level of a response that isn't quite linear. A real CMOS camera, linear to 0.5 % with shading of 2 %,
#: has 1e-3 at one cycle, 1e-4 at four and 5e-5 at ten.
SMOOTH_STD, SMOOTH_POWER = 1e-3, 1.5
#: Without repeated dark frames, the power of rows beyond that of pixels' noise is anything up to three times the
#: variance of the read noise: a camera whose rows are noisier than its pixels shows nothing but stripes.
MOST_ROW_NOISE = 3.0
LEAST_ROWS = 24  # of a plane of the mosaic
LEAST_POWER = 0.05  # of a band over that of the pixels' noise, as predicted
#: Times within a period at which a frame may begin, interpolated between `PHASES`; and how often they are found anew,
#: beside the mean of all frames that follows from them.
FINE_PHASES, REFINEMENTS = 240, 3


@dataclass(frozen=True)
class _Level:
    """The frames of one level."""

    captures: tuple[Any, ...]
    held_out: bool
    signal: float  # mean above the dark level, DN
    pixel_dn2: float  # variance of a pixel without that of whole rows
    variance: float  # relative variance of a row's mean by the noise of pixels, about the mean of all frames
    row_share: float  # relative variance of a row's mean, over `variance`, by noise of rows of 1 DN^2
    power: FloatArray  # (bands,): of the rows of single frames, over that of the noise
    freedom: FloatArray  # (bands,): degrees of freedom
    rows: FloatArray  # (frames, rows): of single frames, over the mean of all
    weight: FloatArray  # (frames,): in that mean


def measure_flat_rows(dataset: Dataset) -> Observable:
    """Power spectrum of the rows of single flat frames, relative to the mean of all, over that of the pixels' noise;
    cube roots.

    q(r) = row means of a frame / row means of all frames - 1. Power at k cycles a frame: |sum over r of q(r) exp(-2 pi
    i k r / rows)|^2 / (rows x variance of a row's mean). The cube root of its mean over a band is nearly normal (Wilson
    and Hilferty 1931): over the cube root of the true power, mean 1 - 2 / (9 v) and variance 2 / (9 v) for v degrees of
    freedom. The rows' offsets in dark frames are subtracted, and the spectrum of their noise is expected in light as
    well (`dark_readout`), with its standard deviation as a nuisance parameter of each band. Without repeated dark
    frames the spectrum is a free parameter of each band up to `MOST_ROW_NOISE`, so that only what grows with the light
    is seen. Other nuisance parameters: the spectrum of the pixels' noise, and the fixed pattern of rows. A frame begins
    at that time within a period of the light for which the predicted rows are most like its own. Raises NotDetermined
    without unclipped, repeated flats, and for too few rows.
    """
    groups = [
        g for g in dataset.flat_levels() if all(m is not None for c in g for m in dataset.levels(c).mean.values())
    ]
    groups = [g[:MOST_FRAMES] for g in groups if len(g) > 1 and _is_lit(dataset, g[0])]
    if len(groups) < 1:
        raise NotDetermined(
            "flicker", "no unclipped flat captures that are repeated: rows of single frames aren't comparable"
        )
    groups = [groups[i] for i in np.unique(np.linspace(0, len(groups) - 1, min(MOST_LEVELS, len(groups))).astype(int))]
    step = mosaic.step(dataset.camera.cfa)
    rows = dataset.camera.rows // step
    if rows < LEAST_ROWS:
        raise NotDetermined(
            "flicker", f"frames of {dataset.camera.rows} rows: too few to see bands in, which takes {LEAST_ROWS * step}"
        )
    bands = _bands(rows, HIGHEST * step)
    dark = dataset.once(dark_readout)
    levels = _measured(dataset, groups, bands, np.zeros(rows) if dark is None else row_profile(dark.offsets_dn, step))
    noise = _any_row_noise(dataset, levels) if dark is None else dark.noise(bands)
    frequency = np.array([np.sqrt(b[0] * b[-1]) for b in bands]) / (rows * step)
    freedom = np.concatenate([level.freedom for level in levels])
    value = np.cbrt(np.concatenate([level.power for level in levels]))

    def of_levels(share: Sequence[float], by_band: FloatArray | float) -> FloatArray:
        """(levels x bands,)"""
        return np.outer(share, by_band * np.ones(len(bands))).ravel()

    row_share = [level.row_share for level in levels]
    usual = 1.0 + of_levels(row_share, noise.power_dn2)
    pattern = PATTERN_STD**2 + (SMOOTH_STD / np.array([band[0] for band in bands]) ** SMOOTH_POWER) ** 2
    own = {
        "offset": of_levels(row_share, noise.std_dn2),
        "pattern": of_levels([rows / level.variance for level in levels], pattern),
    }
    if dark is not None:
        # what the subtracted offsets lack is a larger share of a low level than of the mean of all
        whole, left = sum(float(level.weight.sum()) / level.signal for level in levels), dark.offsets(bands, step)
        more = [(1.0 / level.signal - whole) ** 2 / level.variance for level in levels]
        usual = usual + of_levels(more, left.power_dn2)
        own["dark"] = of_levels(more, left.std_dn2)
    usual = np.maximum(usual, LEAST_POWER)
    colour = np.tile(COLOUR_STD * (1.0 + 4.0 * (frequency > 0.15)), len(levels))
    band = np.tile(np.arange(len(bands)), len(levels))

    def predict(effects: Effects) -> Prediction:
        model = Uniform(dataset.camera, effects)
        power = usual
        if model.varies_by_row:
            power = power + _added_power(model, dataset.camera.rows, levels, bands, step)
        if model.leaks or (dark is None and model.adds_signal):
            power = power + _pattern_power(dataset, levels, model, bands, step, added=dark is None)
        mean = np.cbrt(power) * (1.0 - 2.0 / (9.0 * freedom))
        slope = mean / (3.0 * power)
        jacobian = {}
        for k in range(len(bands)):
            for name, std in (*own.items(), ("colour", colour)):
                jacobian[f"rows:{name}:{k}"] = np.where(band == k, slope * std, 0.0)
        return Prediction(mean, jacobian)

    return Observable(
        measurement=FLAT_ROWS, reach=LOG_REACH, along=np.log(np.tile(frequency, len(levels))),
        value=value, covariance=np.diag(np.cbrt(np.square(usual)) * 2.0 / (9.0 * freedom)),
        labels=tuple(Label(float(f), "all", f"{level.captures[0].exposure_s:.4g} s",
        tuple(c.id for c in level.captures), level.held_out)
                     for level in levels for f in frequency),
        reads=ROW_LIGHT | LEAK if dark is not None else ROW_LIGHT | LEAK | ADDED, predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def _is_lit(dataset: Dataset, capture: Any) -> bool:
    """Return whether a flat's signal exceeds the noise by as much as one that is part of a mean image: rows are
    relative to it."""
    signal = float(np.mean(list(dataset.levels(capture).whole.values()))) - dark_level_dn(dataset, capture)
    return signal >= LEAST_SIGNAL * dataset.noise.read_dn


LOG_REACH = 1.0  # correlation length in ln(frequency)


def _bands(rows: int, highest_cy_per_row: float) -> list[range]:
    """Cycles a frame in each band, from 1 to `highest_cy_per_row` (at most `HIGHEST`). Each band begins at `WIDEN`
    times the last."""
    top = int(min(highest_cy_per_row, HIGHEST) * rows)
    bands, low = [], 1
    while low <= top:
        high = max(low + 1, int(np.ceil(low * WIDEN)))
        bands.append(range(low, min(high, top + 1)))
        low = high
    return bands


def _measured(
    dataset: Dataset, groups: Sequence[Sequence[Any]], bands: Sequence[range], offsets_dn: FloatArray
) -> list[_Level]:
    """Return the levels of groups of repeated flats, without the rows' fixed `offsets_dn` (rows,)."""
    step, cols = mosaic.step(dataset.camera.cfa), dataset.camera.cols
    out = dataset.once(held_out_flats)
    profiles, pixels, signals = [], [], []
    for group in groups:
        frames = [np.asarray(dataset.recordings.frame(c), np.float32) for c in group]
        mean = sum(frames[1:], frames[0]) / len(frames)
        # pixels' noise without that of whole rows
        left = [f - mean for f in frames]
        left = [d - d.mean(1, keepdims=True) for d in left]
        pixel = float(np.mean([np.mean(np.square(d, dtype=float)) for d in left])) / (1.0 - 1.0 / cols)
        own = np.array([row_profile(f, step) for f in frames]) - dark_level_dn(dataset, group[0]) - offsets_dn
        profiles.append(own / own.mean(1, keepdims=True))
        signals.append(float(own.mean()))
        pixels.append(pixel * len(frames) / (len(frames) - 1))
    # the reference: frames are weighted by signal and exposure, as flicker averages out in long ones
    weight = np.concatenate([np.full(len(g), s * g[0].exposure_s) for g, s in zip(groups, signals, strict=True)])
    weight /= weight.sum()
    every = np.concatenate(profiles)
    reference = weight @ every
    count = [len(group) for group in groups]
    of_pixels = np.array(pixels) / (step * cols) / np.square(signals)
    of_rows = 1.0 / np.square(signals)
    common_pixels, common_rows = (float(weight**2 @ np.repeat(of, count)) for of in (of_pixels, of_rows))
    found, first = [], 0
    for k, group in enumerate(groups):
        at = slice(first, first + len(group))
        first += len(group)
        # variance of q: the frame's own noise, less its covariance with the reference, and the reference's
        apart = 1.0 - 2.0 * float(weight[at].mean())
        variance = float(of_pixels[k]) * apart + common_pixels
        # frames share the noise of the reference: their mean has this variance over that of their differences
        together = max(1.0 + len(group) * (variance / float(of_pixels[k]) - 1.0), 0.0)
        free = (len(group) - 1.0 + together) ** 2 / (len(group) - 1.0 + together**2)
        found.append(
            _Level(
                captures=tuple(group),
                held_out=group[0].id in out,
                signal=signals[k],
                pixel_dn2=pixels[k],
                variance=variance,
                row_share=(float(of_rows[k]) * apart + common_rows) / variance,
                power=_power(every[at] / reference, bands) / variance,
                freedom=np.array([2.0 * free * len(band) for band in bands]),
                rows=every[at] / reference,
                weight=weight[at],
            )
        )
    return found


def _any_row_noise(dataset: Dataset, levels: Sequence[_Level]) -> DarkRowPower:
    """Return the noise of rows where no dark frames tell it: what is most like the seen flats beside light that varies
    from row to row, and so wide a standard deviation that any other is as good.

    A prediction is linear in this power, and so it is taken about the likeliest: of the seen levels' power P = 1 + x
    `row_share` + y / `variance` by least squares with x, y >= 0, x up to `MOST_ROW_NOISE` times the read noise's
    variance."""
    from scipy.optimize import nnls  # here: the library takes a while to load

    stated_e = dataset.stated.read_noise_e
    read_dn2 = min(level.pixel_dn2 for level in levels)  # the darkest level's at most
    if stated_e is not None and dataset.noise.gain_is_known:
        read_dn2 = min(read_dn2, (dataset.noise.gain * stated_e) ** 2 + dataset.noise.quantisation_dn2)
    seen = [level for level in levels if not level.held_out]
    power = np.array([level.power for level in seen])  # (levels, bands)
    design = np.array([[level.row_share, 1.0 / level.variance] for level in seen])
    size = design.max(0)
    likely = []
    for k in range(power.shape[1]):
        std = np.array([max(level.power[k], 1.0) * np.sqrt(2.0 / level.freedom[k]) for level in seen])
        found, _ = nnls(design / size / std[:, None], (power[:, k] - 1.0) / std)
        likely.append(min(float(found[0]) / size[0], MOST_ROW_NOISE * read_dn2))
    return DarkRowPower(np.array(likely), np.array(likely) + read_dn2)


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
    """Return the light (frames, rows) of least squares from rows (frames, rows), of `by_phase` (phases, rows),
    interpolated linearly between
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
    dataset: Dataset, levels: Sequence[_Level], model: Uniform, bands: Sequence[range], step: int, *, added: bool
) -> FloatArray:
    """Power (levels x bands,) that fixed rows add, which are a larger share of a low level than of the mean of all:
    what read-out adds (`added`), and light beside the exposure."""
    rows = dataset.camera.rows
    leaked = model.leaked_s(FieldPoints.at(dataset.camera, np.arange(float(rows)), np.zeros(rows)))
    lit_s = np.array([level.captures[0].exposure_s for level in levels]) + leaked.mean()
    share = (leaked - leaked.mean()) / lit_s[:, None]
    share = share[:, : rows // step * step].reshape(len(levels), -1, step).mean(axis=2)
    if added:
        offsets = dataset.noise.gain * row_profile(model.added_e - model.added_e.mean(), step)
        share = share + np.array([offsets / level.signal for level in levels])
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
    make=measure_flat_rows,
    quantity="power over noise, cube root",
    conditions="exposure",
    conditions_words="flats of",
)
