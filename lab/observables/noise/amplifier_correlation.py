"""The correlation of the temporal noise of pixels that amplifiers of different areas read at the same time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.dataset import CLIPPED_SHARE, Dataset, held_out_flats
from lab.observables.noise.temporal import OUTLIER, level_out
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import AMPLIFIERS
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.sensor.amplifiers import CoupledAmplifiers
from sim.sensor.reading_order import ReadOutNoise
from sim.spectrum import FloatArray
from sim.uniform import Uniform

LEAST_PX = 32  # least side
LEAST_DN = 0.3  # of codes of a step of 1 DN: temporal noise of a pixel below which codes are too coarse
MOST_FRAMES, MOST_LEVELS = 16, 8  # frames of a setting; levels of a session
#: Pixels of a setting that are held at once; as many know a correlation to 2e-4, but two frames in any case.
MOST_PIXELS = 4e7
CORRELATION_FLOOR = 2e-4  # standard deviation of a correlation beside chance
PARTS = 8  # of a frame, from which the scatter of a correlation is measured


#: A frame of any numbers.
Frame = NDArray[Any]


def _halves(frame: Frame) -> list[Frame]:
    half = frame.shape[1] // 2
    return [frame[:, :half], frame[:, half : 2 * half]]


def _quarters(frame: Frame) -> list[Frame]:
    quarter = frame.shape[1] // 4
    return [frame[:, k * quarter : (k + 1) * quarter] for k in range(4)]


def _flipped(frame: Frame) -> Frame:
    return frame[:, ::-1]


def _beside(areas: Sequence[Frame], turned: bool) -> tuple[Frame, Frame]:
    """Areas, and those beside them."""
    first, second = np.concatenate(areas[:-1], axis=1), [_flipped(a) if turned else a for a in areas[1:]]
    return first, np.concatenate(second, axis=1)


def _across_corners(frame: Frame, turned: bool) -> tuple[Frame, Frame]:
    """The left half, and the right one with its upper and lower halves exchanged, or turned by half a turn."""
    left, right = _halves(frame)
    half = len(frame) // 2
    other = np.concatenate([right[half : 2 * half], right[:half]])
    return left[: 2 * half], right[: 2 * half][::-1, ::-1] if turned else other


#: Name in the report -> pixels and those that may be read with them, of a frame (rows, columns).
RELATIONS: dict[str, Callable[[Frame], tuple[Frame, Frame]]] = {
    "halves of columns, alike": lambda f: _beside(_halves(f), turned=False),
    "halves of columns, turned": lambda f: _beside(_halves(f), turned=True),
    "quarters of columns, alike": lambda f: _beside(_quarters(f), turned=False),
    "quarters of columns, turned": lambda f: _beside(_quarters(f), turned=True),
    "halves of rows, alike": lambda f: _beside(_halves(f.T), turned=False),
    "halves of rows, turned": lambda f: _beside(_halves(f.T), turned=True),
    "quadrants across corners, alike": lambda f: _across_corners(f, turned=False),
    "quadrants across corners, turned": lambda f: _across_corners(f, turned=True),
}
#: Side of the small frame on which correlations are predicted: they don't depend on the size.
TILE_PX = 16


@dataclass(frozen=True)
class _Correlations:
    """The correlations of some settings, by `RELATIONS`."""

    captures: tuple[str, ...]
    lit: bool
    held_out: bool
    pixel_dn2: float  # variance of a pixel
    value: FloatArray
    freedom: int
    scatter: float  # variance of parts over that of independent pixels


def measure_amplifier_correlation(dataset: Dataset) -> Observable:
    """Correlation of pixels' temporal noise with that of the pixels that other areas' amplifiers may read at the same
    time (`RELATIONS`), in the dark and in even light.

    It is 0 where amplifiers don't couple. Levels and the means of rows and columns are removed as in
    `temporal_noise`, whose expectation is subtracted. Raises NotDetermined without repeats whose noise exceeds a code,
    and for frames too small.
    """
    side_px = min(dataset.camera.rows, dataset.camera.cols)
    if side_px < LEAST_PX:
        raise NotDetermined(
            "amplifier_correlation", f"frames of {side_px} px: areas are compared from {LEAST_PX} px a side on"
        )
    every = [found for group in _settings(dataset) if (found := _read(dataset, *group)) is not None]
    if not every:
        raise NotDetermined(
            "amplifier_correlation", "no repeats of dark or unclipped flat captures whose noise exceeds a code"
        )
    scatter = max(float(np.average([c.scatter for c in every], weights=[c.freedom for c in every])), 1.0)
    kinds = [(lit, out) for lit in (False, True) for out in (False, True)]
    pooled = [part for part in ([c for c in every if (c.lit, c.held_out) == kind] for kind in kinds) if part]
    names = list(RELATIONS)
    pairs = _pairs(dataset)
    values, variances, labels, pixel_dn2 = [], [], [], []
    for part in pooled:
        freedom = np.array([c.freedom for c in part], float)
        values.append(np.average([c.value for c in part], axis=0, weights=freedom))
        variances.append(scatter / pairs / freedom.sum() + CORRELATION_FLOOR**2)
        ids = tuple(name for c in part for name in c.captures)
        labels += [Label(float(part[0].lit), name, "even light" if part[0].lit else "dark", ids, part[0].held_out)
                   for name in names]  # fmt: skip
        pixel_dn2.append(float(np.average([c.pixel_dn2 for c in part], weights=freedom)))
    shape, period = (dataset.camera.rows, dataset.camera.cols), mosaic.step(dataset.camera.cfa)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(dataset.camera, effects)
        of_light, of_noise = (
            _coupled([law for law in model.amplifiers if law.of_noise or every]) for every in (True, False)
        )
        ordered_e2 = sum((_ordered(one, shape, period) for one in model.reading_order), np.zeros(len(names)))
        means = []
        for dn2 in pixel_dn2:
            light = max(1.0 - dataset.noise.read_dn**2 / dn2, 0.0)
            coupled = light * of_light + (1.0 - light) * of_noise
            means.append(coupled + dataset.noise.gain**2 * ordered_e2 / dn2)
        return Prediction(np.concatenate(means), {})

    return Observable(
        measurement=AMPLIFIER_CORRELATION, reach=0.1, value=np.concatenate(values),
        covariance=np.diag(np.concatenate(variances)), labels=tuple(labels),
        reads=AMPLIFIERS | {"signal.reading_order"}, predict=predict, scale=np.ones(len(labels)),
    )  # fmt: skip


def _settings(dataset: Dataset) -> list[tuple[list[Any], bool, bool]]:
    """(captures, lit, held out) of repeated settings."""
    found: list[tuple[list[Any], bool, bool]] = []
    dark = [g for g in dataset.groups("dark", lambda c: (c.exposure_s, c.temperature_c, c.gain_db)) if len(g) > 1]
    found += [(list(g), False, len(dark) >= 3 and i % 3 == 1) for i, g in enumerate(dark[:MOST_LEVELS])]
    out = dataset.once(held_out_flats)
    for group in dataset.flat_levels():
        for held_out in (False, True):
            part = [c for c in group if (c.id in out) == held_out]
            if len(part) > 1:
                found.append((part, True, held_out))
    return found


def _pairs(dataset: Dataset) -> FloatArray:
    """Number of pairs of each relation, each counted once."""
    frame = np.broadcast_to(np.zeros(1, bool), (dataset.camera.rows, dataset.camera.cols))
    return np.array([float(one(frame)[0].size) for one in RELATIONS.values()])


def _read(dataset: Dataset, captures: Sequence[Any], lit: bool, held_out: bool) -> _Correlations | None:
    """Return the correlations of the repeats of one setting; None where they clip, or codes are too coarse."""
    cfa = dataset.camera.cfa
    captures = captures[: int(np.clip(MOST_PIXELS / (dataset.camera.rows * dataset.camera.cols), 2, MOST_FRAMES))]
    frames = [np.array(dataset.recordings.frame(c), np.float32) for c in captures]
    clipped = max(float(np.mean((f >= dataset.saturation_dn) | (f <= 0))) for f in frames)
    level = float(np.mean(frames[0])) - dataset.noise.black
    if lit and clipped > 0.1 * CLIPPED_SHARE:
        return None
    bright = level > 20.0 * max(abs(dataset.noise.dark_dn_per_s) * captures[0].exposure_s, 1.0)
    freedom = len(frames) - 1
    frames, alike = level_out(frames, cfa, dataset.noise.black if lit and bright else None)
    pixel_dn2 = alike * sum(float(np.mean(np.square(f), dtype=float)) for f in frames) / freedom
    if pixel_dn2 < (LEAST_DN * dataset.step_dn) ** 2:
        return None
    for name in mosaic.planes(frames[0], cfa):
        planes = [mosaic.planes(f, cfa)[name] for f in frames]
        std = np.sqrt(alike * sum(float(np.mean(np.square(p), dtype=float)) for p in planes) / freedom)
        for plane in planes:
            np.divide(plane, np.float32(max(std, 1e-6)), out=plane)
            plane[np.abs(plane) > OUTLIER] = 0.0
    sums, parts = [], []
    for one in RELATIONS.values():
        by_row = alike * sum(np.einsum("ij,ij->i", *one(frame), dtype=float) for frame in frames)
        size = one(frames[0])[0].size
        sums.append(by_row.sum() / freedom / size)
        split = [np.sum(rows) for rows in np.array_split(by_row, PARTS)]
        parts.append(np.var(split, ddof=1) * PARTS / size / freedom)
    value = np.array(sums) - _expected(dataset.camera.rows, dataset.camera.cols, mosaic.step(cfa))
    return _Correlations(tuple(c.id for c in captures), lit, held_out, pixel_dn2, value, freedom, float(np.mean(parts)))


@lru_cache(maxsize=4)
def _expected(rows: int, cols: int, period: int) -> FloatArray:
    """Correlation of independent pixels after the means of rows and columns were taken out of each plane: -1 / (n - 1)
    of two in one row, or one column, of n of a plane; 1 / (n - 1) (m - 1) of others of a plane.

    Rows and columns of two related pixels don't depend on each other: shares of pairs are products."""
    row = np.broadcast_to(np.arange(rows, dtype=np.int32)[:, None], (rows, cols))
    col = np.broadcast_to(np.arange(cols, dtype=np.int32), (rows, cols))
    n, m = cols / period - 1.0, rows / period - 1.0
    found = []
    for one in RELATIONS.values():
        (in_row, other_row), (in_column, other_column) = (_shares(*one(index), period) for index in (row, col))
        in_one_row = -in_row * (in_column + other_column) / n
        found.append(in_one_row - other_row * in_column / m + other_row * other_column / (n * m))
    return np.array(found)


def _shares(first: Frame, second: Frame, period: int) -> tuple[float, float]:
    """Return the shares of the pairs whose index along one axis is the same, and another of the same plane."""
    apart = first - second
    same = float(np.mean(apart == 0))
    return same, float(np.mean(apart % period == 0)) - same


def _coupled(laws: Sequence[CoupledAmplifiers]) -> FloatArray:
    """Correlation by `RELATIONS` of white noise after coupling: of a small frame, whose every pixel has noise of its
    own."""
    if not laws:
        return np.zeros(len(RELATIONS))
    size = TILE_PX * TILE_PX
    sources = np.eye(size).reshape(size, TILE_PX, TILE_PX)
    for law in laws:
        sources = np.array([law.couple(source) for source in sources])
    found = []
    std = np.sqrt(np.sum(np.square(sources), axis=0))
    for one in RELATIONS.values():
        (here, there), (std_a, std_b) = np.array([one(s / std) for s in sources]).swapaxes(0, 1), one(std)
        found.append(float(np.mean(np.sum(here * there, axis=0))) if std_a.size and std_b.size else 0.0)
    return np.array(found)


def _ordered(noise: ReadOutNoise, shape: tuple[int, int], period: int) -> FloatArray:
    """Covariance by `RELATIONS` of noise in reading order, e^2, of one amplifier for all: along a row. Rows far apart
    have none."""
    found = np.zeros(len(RELATIONS))
    for k, (parts, turned) in enumerate(((2, False), (2, True), (4, False), (4, True))):
        found[k] = noise.departures_apart_e2(shape, period, shape[1] // parts, turned)
    return found


AMPLIFIER_CORRELATION = Measurement(
    "amplifier_correlation",
    title="noise correlation of areas read together",
    order=235,
    axis="light",
    unit="1",
    make=measure_amplifier_correlation,
    quantity="correlation",
    of_variances=True,
    conditions="light",
)
