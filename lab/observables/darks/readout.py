"""What read-out does in dark frames: noise that rows share anew in every frame, and fixed offsets of rows and columns.
Light frames have both as well, additively in DN."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from lab.errors import NotDetermined
from lab.observables.codes.rounding import rounding_std_dn
from lab.observables.darks.frames import (
    DarkCondition,
    DarkNoise,
    DarkPattern,
    DarkStatistics,
    by_part,
    captures_of,
    conditions,
    dark_frames,
    fine_conditions,
    rounding_waves_of_change_dn,
    spread_dn2,
)
from lab.observables.dataset import Dataset
from lab.observables.noise.line_spectra import LEVEL_BAND, Bands, log_mean_bias, log_mean_variance
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import ADDED, LINES, READ_SPECTRUM
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.sensor.lines import Lines
from sim.sensor.reading_order import ReadOutNoise
from sim.spectrum import FloatArray
from sim.uniform import Uniform

# --- dark lines ------------------------------------------------------------------------------------------------------
# Row and column noise of dark frames, fixed row and column patterns, and the correlation of noise along rows and
# columns.


BANDS = 6  # of a spectrum across lines
LEAST_FREQUENCIES = 2  # below the level band: `Bands` makes no band of fewer
LEAST_LINE_DN = 0.3  # of codes of a step of 1 DN: temporal noise of a pixel below which codes are too coarse


def measure_temporal_lines(lines: Lines, dataset: Dataset) -> Observable:
    """Temporal row (column) noise: ln of the power spectrum of the lines' means over that of white noise, by frequency
    band.

    0 where pixels are independent. Raises NotDetermined without repeats, and where codes are too coarse.
    """
    frames = dataset.once(dark_frames)
    name = "row_noise" if lines == "rows" else "column_noise"
    fine = fine_conditions(f"dark_{name}", frames, LEAST_LINE_DN * dataset.step_dn)
    parts = by_part(fine)
    frequency = next(iter(parts.values()))[0].lines[lines][0]
    # narrow bands at low frequencies tell a ripple of a few cycles a frame from correlated row noise
    bands = Bands.of(frequency, 8, 1.5)
    length = dataset.camera.cols if lines == "rows" else dataset.camera.rows
    value, variance, labels, inverse = [], [], [], []
    for out, part in parts.items():
        weight = np.array([min(c.contrasts, 6) for c in part], float)
        power = np.average([c.lines[lines][1] for c in part], axis=0, weights=weight)
        modes, level = bands.modes * weight.sum(), sum(c.lines[lines][2] for c in part)
        value.append(np.log(bands.mean(power)) - log_mean_bias(modes) - log_mean_bias(level))
        variance.append(log_mean_variance(modes) + 1.0 / level)
        inverse.append(np.full(len(modes), float(np.average([1.0 / c.white_dn2 for c in part], weights=weight))))
        ids = tuple(i for f in fine if out in f.changing for i in captures_of(f, out))
        labels += [Label(float(x), "all", "temporal", ids, out) for x in bands.middle]
    over = np.concatenate(inverse)
    sets, whites = len(parts), [1.0 / float(one[0]) for one in inverse]

    def predict(effects: Effects) -> Prediction:
        model, total = Uniform(dataset.camera, effects), np.zeros(len(frequency))
        for one in model.lines:
            if one.lines == lines:
                total += one.spectrum_e2(frequency, fixed=False)
        total += _ordered_power(dataset, model, lines, frequency) / length
        shared = over * np.tile(dataset.noise.gain**2 * length * bands.mean(total), sets)
        # the means of rows hold the read noise's power at frequency 0, those of columns its spectrum
        along = frequency if lines == "columns" else np.zeros(len(frequency))
        own = np.concatenate([bands.mean(_coloured_power(dataset, model, along, white)) for white in whites])
        return Prediction(np.log1p(shared + own), {})

    n = len(labels)
    return Observable(
        measurement=ROW_NOISE if lines == "rows" else COLUMN_NOISE, reach=0.1, value=np.concatenate(value),
        covariance=np.diag(np.concatenate(variance)), labels=tuple(labels), reads=LINES | READ_SPECTRUM,
        predict=predict, scale=np.ones(n),
    )  # fmt: skip


def _ordered_power(dataset: Dataset, model: Uniform, lines: Lines, frequency_cy_per_px: FloatArray) -> FloatArray:
    """Return the power of lines' means by noise in reading order, times the pixels of a line, less its power in
    `LEVEL_BAND`; e^2."""
    shape, zero = (dataset.camera.rows, dataset.camera.cols), np.zeros(len(frequency_cy_per_px))
    found = zero
    for one in model.reading_order:
        across, down = (zero, frequency_cy_per_px) if lines == "rows" else (frequency_cy_per_px, zero)
        found = found + one.plane_e2(shape, across, down) - _ordered_level(one)
    return found


def _alternating_e2(dataset: Dataset, one: ReadOutNoise, lines: Lines) -> float:
    """Power of noise in reading order that alternates from line to line; the difference of a frame's odd and even lines
    has 4 times that over its pixels, e^2."""
    across, down = (0.0, 0.5) if lines == "rows" else (0.5, 0.0)
    return float(one.plane_e2((dataset.camera.rows, dataset.camera.cols), np.array(across), np.array(down)))


def _ordered_level(one: ReadOutNoise) -> float:
    """Mean power of noise in reading order in `LEVEL_BAND`, e^2, where rows hardly depend on each other."""
    return float(np.mean(one.spectrum_e2(np.linspace(*LEVEL_BAND, 33))))


def _coloured_power(dataset: Dataset, model: Uniform, frequency_cy_per_px: FloatArray, white_dn2: float) -> FloatArray:
    """Return the power of a pixel's noise at frequencies along the row over `white_dn2`, the power in `LEVEL_BAND`,
    less 1. Read noise is a part of it, the rest is white."""
    read_dn2 = dataset.noise.read_dn**2
    level_dn2 = read_dn2 * float(np.mean(model.read_power(np.linspace(*LEVEL_BAND, 33))))
    found_dn2 = max(white_dn2 - level_dn2, 0.0) + read_dn2 * model.read_power(frequency_cy_per_px)
    return np.asarray(found_dn2 / max(white_dn2, level_dn2) - 1.0)


def measure_fixed_lines(lines: Lines, dataset: Dataset) -> Observable:
    """Fixed row (column) pattern in the mean frame of the shortest exposure.

    The numbers are ln of the power spectrum of the lines' means over that of white noise, by frequency band, and the
    mean of odd lines less that of even ones, DN. Raises NotDetermined where codes are too coarse.
    """
    frames = dataset.once(dark_frames)
    name = "row_pattern" if lines == "rows" else "column_pattern"
    first = next(f for f in frames if f.fixed)
    if min(part.white_dn2 for part in first.fixed.values()) < 1e-3:
        raise NotDetermined(
            f"dark_{name}", "dark frames have no noise and no pattern: codes are too coarse to show one"
        )
    frequency = next(iter(first.fixed.values())).lines[lines][0]
    bands = Bands.of(frequency, BANDS)
    length = dataset.camera.cols if lines == "rows" else dataset.camera.rows
    size = dataset.camera.rows * dataset.camera.cols
    value: list[FloatArray] = []
    labels: list[Label] = []
    factor: list[FloatArray] = []
    share = _fixed_share(first, lines, length)
    for out, part in first.fixed.items():
        _, power, level = part.lines[lines]
        value.append(np.log(bands.mean(power)) - log_mean_bias(bands.modes) - log_mean_bias(level))
        labels += [Label(float(x), "all", "fixed", part.captures, out) for x in bands.middle]
        factor.append(np.full(len(bands.middle), dataset.noise.gain**2 * length / part.white_dn2))
    pieces = len(first.fixed)
    one = np.diag(log_mean_variance(bands.modes))
    correlation = np.array([[1.0 if a == b else share[a] * share[b] for b in first.fixed] for a in first.fixed])
    covariance = np.kron(correlation, one)
    parity = np.array([part.parity_dn[lines] for part in first.fixed.values()])
    scatter = np.array([4.0 * _line_dn2(part, lines, length) * length / size for part in first.fixed.values()])
    rounding = float(rounding_std_dn(spread_dn2([first], dataset.step_dn), dataset.step_dn)[0])
    # powers are squares: lines themselves have the root of the powers' correlation
    parity_cov = np.sqrt(np.outer(scatter, scatter) * correlation)
    n = len(covariance)
    whole = np.zeros((n + pieces, n + pieces))
    whole[:n, :n], whole[n:, n:] = covariance, parity_cov
    labels += [Label(0.5, "all", "odd and even", part.captures, out) for out, part in first.fixed.items()]
    std = np.sqrt(np.diag(parity_cov))

    def predict(effects: Effects) -> Prediction:
        still, moving, odd = np.zeros(len(frequency)), np.zeros(len(frequency)), 0.0
        model = Uniform(dataset.camera, effects)
        if model.adds_signal:
            means = model.added_e.mean(axis=1 if lines == "rows" else 0)
            # the periodogram's frequencies above 0 and below 0.5 cy/px
            still += (np.abs(np.fft.rfft(means)) ** 2 / len(means))[1 : 1 + len(frequency)]
            odd += float(means[1::2].mean() - means[::2].mean())
        for one in model.lines:
            if one.lines == lines:
                still += one.spectrum_e2(frequency, fixed=True)
                moving += one.spectrum_e2(frequency, fixed=False)
                odd += one.odd_even_e
        moving += _ordered_power(dataset, model, lines, frequency) / length
        parts = zip(factor, first.fixed.values(), strict=True)
        power = np.concatenate([np.log1p(f * bands.mean(still + moving / part.frames)) for f, part in parts])
        odd_dn = np.full(pieces, dataset.noise.gain * odd)
        waves = [
            *_alternating_dn(dataset, model, lines, first),
            *rounding_waves_of_change_dn(odd_dn, rounding, dataset.step_dn),
        ]
        jacobian = {f"dark_{name}:odd:{k}": np.concatenate([np.zeros(n), wave]) for k, wave in enumerate(waves)}
        return Prediction(np.concatenate([power, odd_dn]), jacobian)

    return Observable(
        measurement=ROW_PATTERN if lines == "rows" else COLUMN_PATTERN, reach=0.1,
        value=np.concatenate([*value, parity]), covariance=whole, labels=tuple(labels),
        reads=LINES | ADDED, predict=predict,
        scale=np.concatenate([np.ones(n), 10.0 * std]),
    )  # fmt: skip


def _alternating_dn(dataset: Dataset, model: Uniform, lines: Lines, frames: DarkStatistics) -> list[FloatArray]:
    """Return the scatter (parts,) of mean frames' differences of odd and even lines by noise in reading order, one
    standard deviation each, DN."""
    size = dataset.camera.rows * dataset.camera.cols
    apart = 4.0 / size * sum((_alternating_e2(dataset, one, lines) for one in model.reading_order), 0.0)
    scatter = [dataset.noise.gain * float(np.sqrt(apart / part.frames)) for part in frames.fixed.values()]
    return list(np.diag(scatter)) if apart > 0.0 else []


def _line_dn2(part: DarkPattern | DarkNoise, lines: Lines, length: int) -> float:
    """Variance of the mean of a line of `length` pixels, DN^2: by pixels' and by lines' own noise."""
    return part.white_dn2 / length + part.line_dn2[lines]


def _fixed_share(frames: DarkStatistics, lines: Lines, length: int) -> dict[bool, float]:
    """Share of the variance of the mean frame's lines that is fixed, and so common to seen and held-out frames, by
    part. `length`: of a line, px."""
    changing = next((_line_dn2(c, lines, length) for c in frames.changing.values()), None)
    if changing is None:
        return dict.fromkeys(frames.fixed, 0.0)
    return {
        out: float(np.clip(1.0 - changing / part.frames / _line_dn2(part, lines, length), 0.0, 1.0))
        for out, part in frames.fixed.items()
    }


def measure_dark_correlation(dataset: Dataset) -> Observable:
    """Correlation of temporal noise along rows and columns: ln of its power at low frequencies over that of white
    noise.

    The means of the lines are excluded. 0 where pixels are independent. Raises NotDetermined where codes are too coarse
    or frames too small.
    """
    fine = fine_conditions("dark_correlation", dataset.once(dark_frames), LEAST_LINE_DN * dataset.step_dn)
    value, variance, labels = [], [], []
    # lines, bands, frequencies, DN^2 of white noise, contrasts
    along: list[tuple[str, Bands, FloatArray, float, float]] = []
    for out, part in by_part(fine).items():
        ids = tuple(i for f in fine if out in f.changing for i in captures_of(f, out))
        weight = np.array([min(c.contrasts, 6) for c in part], float)
        for lines in ("rows", "columns"):
            frequency = part[0].along[lines][0]
            if len(frequency) < LEAST_FREQUENCIES:
                continue
            power = np.average([c.along[lines][1] for c in part], axis=0, weights=weight)
            modes = np.sum([c.along[lines][2] for c in part], axis=0)
            level = sum(c.lines[lines][2] for c in part)
            bands = Bands.of(frequency, 3)
            total = np.array([modes[a:b].sum() for a, b in zip(bands.first, bands.last, strict=True)])
            value.append(np.log(bands.mean(power)) - log_mean_bias(total) - log_mean_bias(level))
            variance.append(1.0 / total + 1.0 / level)
            labels += [Label(float(x), "all", f"along {lines}", ids, out) for x in bands.middle]
            white_dn2 = 1.0 / float(np.average([1.0 / c.white_dn2 for c in part], weights=weight))
            along.append((lines, bands, frequency, white_dn2, float(weight.sum())))
    if not labels:
        raise NotDetermined(
            "dark_correlation",
            f"frames of {dataset.camera.rows} x {dataset.camera.cols} px: noise that neighbours share is measured from "
            f"{int(np.ceil(LEAST_FREQUENCIES / LEVEL_BAND[0]))} px along rows or columns on",
        )

    def predict(effects: Effects) -> Prediction:
        # row and column noise has no spectrum along its lines; that of read noise along columns is its mean over rows
        model, means = Uniform(dataset.camera, effects), []
        shape = dataset.camera.rows, dataset.camera.cols
        scatter = []
        for lines, bands, frequency, white_dn2, contrasts in along:
            if lines == "rows":
                power = bands.mean(_coloured_power(dataset, model, frequency, white_dn2))
            else:
                every = _coloured_power(dataset, model, np.linspace(0.0, 0.5, 257), white_dn2)
                power = np.full(len(bands.middle), every.mean())
            for one in model.reading_order:
                own = (one.along_rows_e2 if lines == "rows" else one.along_columns_e2)(shape, frequency)
                power = power + dataset.noise.gain**2 / white_dn2 * bands.mean(own - _ordered_level(one))
            means.append(np.log1p(power))
            waves = [one.plane_e2(shape, np.full(len(frequency), 0.5), frequency) for one in model.reading_order]
            few = bands.mean(np.square(sum(waves, np.zeros(len(frequency))))) / bands.modes / contrasts
            alone = 2.0 / shape[1] * dataset.noise.gain**2 / white_dn2 * np.sqrt(few)
            scatter.append(alone / (1.0 + power) if lines == "columns" else np.zeros(len(alone)))
        # of waves that alternate from column to column each band has few
        each = np.diag(np.concatenate(scatter))
        return Prediction(
            np.concatenate(means),
            {f"dark_correlation:few:{k}": column for k, column in enumerate(each) if column.any()},
        )

    return Observable(
        measurement=DARK_CORRELATION, reach=0.03, value=np.concatenate(value),
        covariance=np.diag(np.concatenate(variance)), labels=tuple(labels), reads=LINES | READ_SPECTRUM,
        predict=predict, scale=np.ones(len(labels)),
    )  # fmt: skip


DARK_CORRELATION = Measurement(
    "dark_correlation",
    title="correlation along the lines of dark frames",
    order=180,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_dark_correlation,
    quantity="power over white noise, ln",
    conditions="direction",
)
ROW_NOISE = Measurement(
    "dark_row_noise",
    title="row noise of dark frames",
    order=140,
    axis="spatial_frequency",
    unit="cy/px",
    make=partial(measure_temporal_lines, "rows"),
    quantity="power over single pixels', ln",
)
COLUMN_NOISE = Measurement(
    "dark_column_noise",
    title="column noise of dark frames",
    order=150,
    axis="spatial_frequency",
    unit="cy/px",
    make=partial(measure_temporal_lines, "columns"),
    quantity="power over single pixels', ln",
)
ROW_PATTERN = Measurement(
    "dark_row_pattern",
    title="fixed row pattern of dark frames",
    order=160,
    axis="spatial_frequency",
    unit="cy/px",
    make=partial(measure_fixed_lines, "rows"),
    quantity="power over single pixels', ln",
    conditions="pattern",
)
COLUMN_PATTERN = Measurement(
    "dark_column_pattern",
    title="fixed column pattern of dark frames",
    order=170,
    axis="spatial_frequency",
    unit="cy/px",
    make=partial(measure_fixed_lines, "columns"),
    quantity="power over single pixels', ln",
    conditions="pattern",
)


# --- dark readout ------------------------------------------------------------


MOST_FRAMES = 12  # of a condition
#: Prior relative standard deviation of the cube root of a band's power about its neighbours': a factor of 2.2 in power.
NEIGHBOUR_STD = 0.3
NEIGHBOURS = 2  # bands on either side
#: Relative standard deviation by which the power of rows in light departs from that in the dark: the chip is warmer or
#: cooler, and the read-out busier.
LIGHT_STD = 0.15
#: Share of the fixed offsets by which they may be others in light: a CMOS camera's even and odd rows differ by 0.09 DN
#: in the dark, and don't in light.
OFFSETS_STD = 0.5


@dataclass(frozen=True)
class DarkRowPower:
    """Power of the rows of single frames beyond that of pixels' noise, by band of frequency, DN^2, and its standard
    deviation."""

    power_dn2: FloatArray  # (bands,)
    std_dn2: FloatArray  # (bands,)


@dataclass(frozen=True)
class DarkReadOut:
    """Statistics of repeated dark frames. A row of a spectrum is the mean over as many neighbouring ones as the
    mosaic's period has."""

    contrasts: int  # independent differences of repeats
    power_dn2: FloatArray  # (rows / 2 + 1,): of the rows of single frames, by cycles a frame
    white_dn2: float  # of it, by the noise of pixels
    offsets_dn: NDArray[np.float32]  # (rows, cols): mean frame less its mean
    frames: int  # that it is the mean of

    def noise(self, bands: Sequence[range]) -> DarkRowPower:
        """Return the noise of rows in `bands`, each a range of cycles a frame.

        With a = `contrasts` x cycles of the band, its power P is gamma-distributed about the true one, tau, and P^(1/3)
        has the mean tau^(1/3) G(a + 1/3) / G(a) / a^(1/3), G the gamma function. Without other knowledge tau^(1/3) then
        has the variance (a P)^(2/3) (G(a - 2/3) / G(a) - (G(a - 1/3) / G(a))^2). It is weighed with the mean over the
        neighbouring bands by `NEIGHBOUR_STD`, as a power may be small by chance: two repeats have two degrees of
        freedom in the lowest band.
        """
        shape = self.contrasts * np.array([len(band) for band in bands], float)
        scale = np.cbrt(shape * [self.power_dn2[list(band)].mean() for band in bands])
        root = scale * np.exp(gammaln(shape) - gammaln(shape + 1.0 / 3.0))
        square, mean = (np.exp(gammaln(shape - n / 3.0) - gammaln(shape)) for n in (2.0, 1.0))
        own = scale**2 * (square - mean**2)
        near = [slice(max(k - NEIGHBOURS, 0), k + NEIGHBOURS + 1) for k in range(len(bands))]
        around = np.array([np.average(root[at], weights=shape[at]) for at in near])
        usual = around**2 * (NEIGHBOUR_STD**2 + np.array([1.0 / (9.0 * shape[at].sum()) for at in near]))
        weight = usual / (usual + own)
        likely = weight * root + (1.0 - weight) * around
        power = likely**3 - self.white_dn2
        std = 3.0 * likely**2 * np.sqrt(own * weight)
        return DarkRowPower(power, np.hypot(std, LIGHT_STD * np.maximum(power, 0.0)))

    def offsets(self, bands: Sequence[range], step: int) -> DarkRowPower:
        """Return the power of the rows of `offsets_dn` that isn't in those of light frames: their noise, and what may
        differ by `OFFSETS_STD`."""
        rows = row_profile(self.offsets_dn, step)
        fixed = np.abs(np.fft.rfft(rows)) ** 2 / len(rows)
        modes = np.array([len(band) for band in bands], float)
        noise, whole = (
            np.array([of[list(band)].mean() for band in bands]) for of in (self.power_dn2 / self.frames, fixed)
        )
        return DarkRowPower(noise, np.hypot(noise / np.sqrt(modes), OFFSETS_STD**2 * whole))


def row_profile(frame: NDArray[np.floating], step: int) -> FloatArray:
    """Means of the rows, over `step` neighbouring ones each, the period of the mosaic."""
    rows = frame.shape[0] // step
    return np.asarray(frame.mean(1, dtype=float)[: rows * step].reshape(rows, step).mean(1))


def dark_readout(dataset: Dataset) -> DarkReadOut | None:
    """Return what repeated dark frames show of the read-out; None where there are none, or their codes are too coarse
    to show it.

    Noise is measured by Helmert contrasts: frame k less the mean of those before it, times sqrt(k / (k + 1)). Fixed
    offsets are those of exposures up to the longest flat's, as a dark current that differs from pixel to pixel grows
    with the exposure."""
    every = conditions(dataset) if dataset.recordings.captures("dark", dataset.side) else []
    step, longest_s = (
        mosaic.step(dataset.camera.cfa),
        max((g[0].exposure_s for g in dataset.flat_levels()), default=0.0),
    )
    power, pixel_dn2, contrasts = np.zeros(0), 0.0, 0
    total, frames = np.zeros((dataset.camera.rows, dataset.camera.cols), np.float32), 0
    for condition in every:
        if len(condition.captures) < 2:
            continue
        lines, own, mean = _read(dataset, condition, step)
        if own <= (LEAST_LINE_DN * dataset.step_dn) ** 2:
            continue
        power = lines.sum(0) + (power if contrasts else 0.0)
        pixel_dn2, contrasts = pixel_dn2 + len(lines) * own, contrasts + len(lines)
        if not frames or condition.exposure_s <= longest_s:
            count = len(lines) + 1
            total, frames = total + np.float32(count) * (mean - mean.mean(dtype=float)), frames + count
    if not contrasts:
        return None
    return DarkReadOut(
        contrasts=contrasts,
        power_dn2=power / contrasts,
        white_dn2=pixel_dn2 / contrasts / (step * dataset.camera.cols),
        offsets_dn=np.asarray(total / np.float32(frames), np.float32),
        frames=frames,
    )


def _read(dataset: Dataset, condition: DarkCondition, step: int) -> tuple[FloatArray, float, NDArray[np.float32]]:
    """Of the repeats of one condition: power of the rows of each contrast (contrasts, rows / 2 + 1), DN^2; variance of
    a pixel without that of whole rows, DN^2; and the mean frame, DN."""
    lines, pixel = [], []
    mean = np.zeros((dataset.camera.rows, dataset.camera.cols), np.float32)
    for k, capture in enumerate(condition.captures[:MOST_FRAMES]):
        away = np.asarray(dataset.recordings.frame(capture), np.float32) - mean
        mean += away / np.float32(k + 1)
        if k == 0:
            continue
        away *= np.float32(np.sqrt(k / (k + 1.0)))
        profile = row_profile(away, step)
        lines.append(np.abs(np.fft.rfft(profile)) ** 2 / len(profile))
        away -= away.mean(1, keepdims=True)
        pixel.append(float(np.mean(np.square(away), dtype=float)) / (1.0 - 1.0 / dataset.camera.cols))
    return np.array(lines), float(np.mean(pixel)), mean
