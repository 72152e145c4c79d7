"""Gains of rows and columns: the fixed pattern of flats' lines beside that of their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import polygamma

from lab.errors import NotDetermined
from lab.observables.darks.readout import OFFSETS_STD, DarkReadOut, dark_readout
from lab.observables.dataset import Dataset
from lab.observables.flats.images import LEAST_SIGNAL, brightest_signal, dark_level_dn, even_lines, flats
from lab.observables.noise.line_spectra import BAND_PIXELS, log_mean_bias, middle
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import COLLECTED, GAINS, LINE_GAINS, TRAILS, acting
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import Uniform

#: Bands of frequency across the lines, cy/px: below, the light isn't even; at 0.5 lie the planes of a mosaic.
BAND_EDGES = 0.1, 0.2, 0.32, 0.48
#: Frequencies along the lines whose power stands for that of independent pixels: cycles a frame from 2 on, up to this
#: share of the pixels, of at least `FEWEST_ALONG` frequencies.
HIGHEST_ALONG, FEWEST_ALONG = 0.15, 4
LEAST_PX = 24  # least side: a band holds two frequencies
#: What repeats after these numbers of rows, or parts of them, is taken out of rows, as it may be rows of another kind
#: (`row_periods`): all periods of `mosaic.PERIOD_PX` take 32 degrees of freedom. Lower frames have no numbers of rows.
PERIODS, LEAST_ROWS = (16, 24), 64
#: Degrees in row and column of the surface that is taken out as the light's.
LIGHT_DEGREE = 3
#: Relative standard deviation of a band's power: a healthy pattern isn't exactly white.
POWER_FLOOR = 0.03
#: Standard deviations from which on noise that lines share from frame to frame counts as more than the pixels'.
SEEN = 3.0


@dataclass(frozen=True)
class _Lines:
    """Lines of one direction in the mean image of seen or held-out flats. Powers are by band, over the mean signal's
    square."""

    lines: Lines
    held_out: bool
    captures: tuple[str, ...]
    modes: FloatArray  # independent frequencies of each band
    pixel_modes: FloatArray  # the same of `white`
    power: FloatArray  # of the lines' means, times the pixels of a line: that of a pixel if these are independent
    white: FloatArray  # of pixels
    fixed_share: FloatArray  # of `white`: what isn't noise
    shared: FloatArray  # of `power`: noise that lines share anew in every frame
    shared_std: FloatArray
    offsets: FloatArray  # power of the dark frames' lines in the same unit
    light: float  # mean square of the light along the lines


def measure_line_gains(dataset: Dataset) -> Observable:
    """Power of the rows' and columns' means in the mean flat image over that of its pixels, ln, by band of frequency.

    0 where pixels are independent. Both powers are taken at the same frequency across the lines: that of lines at
    frequency 0 along them, that of pixels at the next ones, so that a filter of the chip or charge that neighbours
    share changes both alike. A polynomial surface is taken out as the light's. The offsets of dark frames are
    subtracted, and may differ in light by `OFFSETS_STD`. Noise that lines share from frame to frame is measured by the
    difference of two halves of the frames. Raises NotDetermined without unclipped, repeated flats, without repeated
    dark frames, and for frames that are too small.
    """
    _, images = dataset.once(flats)
    if not images:
        raise NotDetermined("line_gains", "no unclipped flat captures")
    side_px = min(dataset.camera.rows, dataset.camera.cols)
    if side_px < LEAST_PX:
        raise NotDetermined(
            "line_gains", f"frames of {side_px} px: lines are told from pixels from {LEAST_PX} px a side on"
        )
    dark = dataset.once(dark_readout)
    if dark is None:
        raise NotDetermined(
            "line_gains",
            "no repeated dark frames whose noise exceeds a code: gains of lines aren't told from their offsets",
        )
    halves = {held_out: _halves(dataset, dark, held_out) for held_out in sorted(images)}
    directions: tuple[Lines, ...] = ("columns", "rows") if dataset.camera.rows >= LEAST_ROWS else ("columns",)
    parts = [
        _read(dataset, dark, lines, held_out, half)
        for lines in directions
        for held_out, half in halves.items()
        if half is not None
    ]
    if not parts:
        raise NotDetermined("line_gains", "no repeated flat captures: noise isn't told from a fixed pattern")
    bias = np.concatenate([log_mean_bias(part.modes) - log_mean_bias(part.pixel_modes) for part in parts])
    power, white, shared, shared_std, offsets = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("power", "white", "shared", "shared_std", "offsets")
    )
    bands = len(BAND_EDGES) - 1
    read = brightest_signal(dataset)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(dataset.camera, effects)
        still = acting(effects, COLLECTED | GAINS | TRAILS)
        even = dict(zip(("columns", "rows"), even_lines(dataset.camera, still, read), strict=True)) if still else {}
        pattern = []
        for part in parts:
            variance = model.line_gain_std(part.lines) ** 2
            steps = _line_power(even[part.lines], part.lines) if even else np.zeros(bands)
            pattern.append(_pixels_of(dataset, part.lines) * (variance * part.light + steps))
        ratio = 1.0 + (np.concatenate(pattern) + shared) / white
        slope = 1.0 / white / ratio
        jacobian = {"line_gains:offsets in light": OFFSETS_STD**2 * offsets * slope}
        for k in np.flatnonzero(shared_std):
            jacobian[f"line_gains:noise:{k}"] = np.where(np.arange(len(slope)) == k, shared_std * slope, 0.0)
        return Prediction(np.log(ratio), jacobian)

    return Observable(
        measurement=LINE_GAIN_POWER, reach=0.1, value=np.log(power / white) - bias, covariance=_covariance(parts),
        labels=tuple(Label(f, "all", part.lines, part.captures, part.held_out) for part in parts for f in _middles()),
        reads=LINE_GAINS | COLLECTED | GAINS | TRAILS, predict=predict, scale=np.ones(len(bias)),
    )  # fmt: skip


def _covariance(parts: Sequence[_Lines]) -> FloatArray:
    """Covariance of ln(`power` / `white`) of all parts. Seen and held-out flats have the same pattern, and noise of
    their own: powers have the square of what the amplitudes have in common."""
    own = np.concatenate([polygamma(1, part.modes) + polygamma(1, part.pixel_modes) for part in parts])
    covariance = np.diag(own + POWER_FLOOR**2)
    bands = len(BAND_EDGES) - 1
    for a, one in enumerate(parts):
        for b, other in enumerate(parts[:a]):
            if one.lines == other.lines:
                at, there = a * bands + np.arange(bands), b * bands + np.arange(bands)
                both = one.fixed_share * other.fixed_share * own[at]
                covariance[at, there] = covariance[there, at] = both
    return covariance


def _middles() -> list[float]:
    return [0.5 * (low + high) for low, high in pairwise(BAND_EDGES)]


def _pixels_of(dataset: Dataset, lines: Lines) -> int:
    """Pixels of one line."""
    return dataset.camera.rows if lines == "columns" else dataset.camera.cols


def _bands(count: int) -> list[slice]:
    """Slices of the frequencies k / `count`, k = 0, 1, ..., in each band."""
    edges = [int(np.ceil(edge * count)) for edge in BAND_EDGES]
    return [slice(low, high) for low, high in pairwise(edges)]


def _along(count: int) -> range:
    """Cycles a frame along the lines that stand for independent pixels."""
    return range(2, min(max(int(HIGHEST_ALONG * count), 1 + FEWEST_ALONG), count // 2 - 1) + 1)


def _pixels_of_noise(pixels: int, count: int) -> slice:
    """Return the pixels of `count` lines of `pixels` whose noise stands for that of all: of a large image, the middle
    ones of each line."""
    return middle(pixels, BAND_PIXELS // count) if pixels * count > 2 * BAND_PIXELS else slice(0, pixels)


def _window(count: int) -> FloatArray:
    """Hann window of mean square 1."""
    w = 1.0 - np.cos(2.0 * np.pi * (np.arange(count) + 0.5) / count)
    return np.asarray(w / np.sqrt(np.mean(np.square(w))))


@cache
def _repeats(count: int) -> FloatArray:
    """Orthonormal base (count, n) of all rows that repeat after one of `PERIODS`."""
    marks = [np.arange(count)[:, None] % period == np.arange(period) for period in PERIODS]
    base, size, _ = np.linalg.svd(np.concatenate(marks, axis=1).astype(float), full_matrices=False)
    return np.asarray(base[:, size > 1e-6 * size[0]])


@cache
def _share_and_modes(lines: Lines, count: int) -> tuple[FloatArray, FloatArray]:
    """For each band: the share of the power of independent lines that is left where what repeats is taken out, and how
    many independent frequencies those of the band are worth.

    The amplitudes of a band are normal with the covariance G = V*V, V the waves in the window after the projection. The
    mean of their powers has the relative variance sum |G|^2 / (tr G)^2, that of n independent ones 1 / n."""
    left, modes = [], []
    window = _window(count)
    base = _repeats(count) if lines == "rows" else np.zeros((count, 0))
    of_window, of_base = np.fft.fft(np.square(window)), np.fft.fft(base * window[:, None], axis=0)
    for band in _bands(count):
        wave = np.arange(band.start, band.stop)
        # of waves in the window, by their distance, less what the projection takes of them
        common = of_window[wave[None, :] - wave[:, None]] - of_base[band].conj() @ of_base[band].T
        whole = float(np.real(np.trace(common)))
        left.append(whole / count / (band.stop - band.start))
        modes.append(whole**2 / float(np.sum(np.square(np.abs(common)))))
    return np.array(left), np.array(modes)


def _without_repeats(line: FloatArray, lines: Lines) -> FloatArray:
    """Take what repeats out of rows, (n,); columns stay."""
    if lines == "columns":
        return line
    base = _repeats(len(line))
    return np.asarray(line - base @ (base.T @ line))


def _line_power(line: FloatArray, lines: Lines) -> FloatArray:
    """Mean power of given lines in each band: their variance where they are independent."""
    count = len(line)
    x = np.linspace(-1.0, 1.0, count)
    rest = _without_repeats(line - np.polynomial.Polynomial.fit(x, line, LIGHT_DEGREE)(x), lines)
    power = np.square(np.abs(np.fft.rfft(rest * _window(count)))) / count
    return np.array([power[band].mean() for band in _bands(count)]) / _share_and_modes(lines, count)[0]


def _powers(image: FloatArray, lines: Lines) -> tuple[FloatArray, FloatArray]:
    """Power of lines, times their pixels, and of pixels (`_pixels_of_noise`), by band; of an image (pixels, lines) less
    a polynomial surface of light."""
    pixels, count = image.shape
    down, across = (np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), LIGHT_DEGREE) for n in image.shape)
    down, across = (np.linalg.qr(base)[0] for base in (down, across))
    light = down.T @ image @ across @ across.T
    window = _window(count)
    part = _pixels_of_noise(pixels, count)
    rest = np.asarray((image[part] - down[part] @ light) * window, np.float32)
    spectrum = np.fft.fft(np.fft.rfft(rest, axis=1), axis=0)
    along = np.array(_along(len(rest)))
    white = np.square(np.abs(np.concatenate([spectrum[along], spectrum[-along]])), dtype=float) / rest.size
    mean = image.mean(axis=0) - down.mean(axis=0) @ light
    line = np.square(np.abs(np.fft.rfft(_without_repeats(mean, lines) * window))) * pixels / count
    bands = _bands(count)
    of_lines, of_pixels = (np.array([power[..., band].mean() for band in bands]) for power in (line, white))
    return of_lines / _share_and_modes(lines, count)[0], of_pixels


def _halves(dataset: Dataset, dark: DarkReadOut, held_out: bool) -> tuple[FloatArray, FloatArray, float] | None:
    """Mean images (rows, cols) of every other frame of the flats of one part, each plane of the mosaic over its mean,
    and the mean inverse signal of their frames, 1/DN; None with a single frame."""
    total: list[Any] = [0.0, 0.0]
    weight = [0.0, 0.0]
    frames = 0
    for level in dataset.once(flats)[0]:
        if level.held_out != held_out:
            continue
        for capture in level.captures:
            frame = np.asarray(dataset.recordings.frame(capture), np.float32) - np.float32(
                dark_level_dn(dataset, capture)
            )
            frame -= dark.offsets_dn
            planes = mosaic.planes(frame, dataset.camera.cfa)
            own = {name: float(plane.mean(dtype=float)) for name, plane in planes.items()}
            signal = float(np.mean(list(own.values())))
            if signal < LEAST_SIGNAL * dataset.noise.read_dn:
                continue
            for name, plane in planes.items():
                np.multiply(plane, np.float32(signal / own[name]), out=plane)
            total[frames % 2] = total[frames % 2] + frame
            weight[frames % 2] += signal
            frames += 1
    if frames < 2:
        return None
    one, other = (np.asarray(image, np.float64) / w for image, w in zip(total, weight, strict=True))
    return one, other, frames / sum(weight)


def _read(
    dataset: Dataset, dark: DarkReadOut, lines: Lines, held_out: bool, halves: tuple[FloatArray, FloatArray, float]
) -> _Lines:
    """Return the powers of one direction's lines, of the two images of `halves`."""
    *images, inverse_per_dn = halves
    first, second, offsets = (
        image if lines == "columns" else image.T for image in (*images, dark.offsets_dn * inverse_per_dn)
    )
    power, white = _powers(0.5 * (first + second), lines)
    line_noise, noise = _powers(0.5 * (first - second), lines)
    of_dark, dark_white = _powers(np.asarray(offsets, np.float64), lines)
    pixels, count = first.shape
    modes = _share_and_modes(lines, count)[1]
    part = _pixels_of_noise(pixels, count)
    pixel_modes = _share_and_modes("columns", count)[1] * 2.0 * len(_along(part.stop - part.start))
    shared = np.where(line_noise - noise > SEEN * noise / np.sqrt(modes), line_noise - noise, 0.0)
    return _Lines(
        lines=lines,
        held_out=held_out,
        captures=tuple(c.id for u in dataset.once(flats)[0] if u.held_out == held_out for c in u.captures),
        modes=modes,
        pixel_modes=pixel_modes,
        power=power,
        white=white,
        fixed_share=np.clip(1.0 - noise / white, 0.0, 1.0),
        shared=shared,
        shared_std=np.where(shared > 0.0, line_noise * np.sqrt(1.0 / modes + 1.0 / pixel_modes), 0.0),
        offsets=np.maximum(of_dark - dark_white, 0.0),
        light=float(np.mean(np.square(_window(count) * first.mean(axis=0)))),
    )


LINE_GAIN_POWER = Measurement(
    "line_gains",
    title="gains of rows and columns in flat fields",
    order=265,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_line_gains,
    quantity="power over single pixels', ln",
    conditions="direction",
)
