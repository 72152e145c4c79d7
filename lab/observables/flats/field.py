"""Shading of flat fields: means over cells of the frame, relative to the frame's mean, against cos^4 (or the lens's)
fall-off."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.images import collect_rows
from lab.observables.flats.row_light import ROW_LIGHT, nuisances, row_light_scatter
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import ADDED, COLLECTED, GAINS, LEAK, LINE_GAINS, TRAILS, acting
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.point import even_share
from sim.sensor import mosaic
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import SHADING, STRAYS, FieldPoints, Uniform

#: Read-outs whose effect on the cells is kept: a refit varies one effect's parameters beside the others' as they stand.
CACHED_READ_OUTS = 64
ROWS, COLS = 6, 8  # cells of the frame
AXIS_STD, AXIS_STD_KNOWN = (
    0.01,
    0.004,
)  # of the optical axis without and with a fitted geometry, over the frame's diagonal
MOST_FRAMES, MOST_LEVELS = 6, 2  # brightest levels, of seen and of held-out flats each
BLOCK_PX = 4  # side of the blocks in a channel's plane at which its fixed pattern is measured
ALIKE = 1.5  # largest ratio of the fixed pattern's variance in blocks to that of independent pixels
#: Variance of rows between frames over that by noise from which on the light flickers. A healthy set exceeds it once in
#: thousands.
VARYING = 4.0


@dataclass(frozen=True)
class _ChannelCells:
    """One channel of the mean seen or held-out flat."""

    captures: tuple[Any, ...]
    channel: str
    held_out: bool
    cells: FloatArray  # (ROWS * COLS,): means over their mean
    level_e: float  # mean signal
    inverse_per_e: float  # mean of the frames' 1 / signal, which what read-out adds is multiplied by
    noise: float  # relative variance of a cell by shot and read noise
    pattern: float  # relative variance of a cell by the fixed pattern, which repeats share
    row_covariance: FloatArray  # (ROWS, ROWS): relative covariance of rows of cells by flicker of the light


def measure_flat_field(dataset: Dataset) -> Observable:
    """Means over 6 x 8 cells of the brightest unclipped flats, relative to the mean of the frame, by channel.

    Nuisance parameters: row and column of the optical axis. Raises NotDetermined where focal length or pixel pitch
    isn't stated, for frames too small, and without unclipped flats.
    """
    if dataset.stated.focal_length_mm is None or dataset.stated.pixel_pitch_um is None:
        raise NotDetermined(
            "flat_field", "the focal length or the pixel pitch isn't stated: the fall-off of the light isn't known"
        )
    least_px = max(ROWS, COLS, 2 * BLOCK_PX) * mosaic.step(dataset.camera.cfa)
    if min(dataset.camera.rows, dataset.camera.cols) < least_px:
        raise NotDetermined(
            "flat_field",
            f"frames of {dataset.camera.rows} x {dataset.camera.cols} px: {ROWS} x {COLS} cells need {least_px} px a "
            "side",
        )
    planes = _planes(dataset)
    if not planes:
        raise NotDetermined("flat_field", "no unclipped flat captures")
    camera = dataset.camera

    off_px = (AXIS_STD_KNOWN if camera.geometry is not None else AXIS_STD) * float(np.hypot(camera.rows, camera.cols))
    place = _cell_points(camera, 0.0, 0.0)
    lit = _channel_points(camera, 0.0, 0.0)
    moved = {"axis:row": _channel_points(camera, off_px, 0.0), "axis:col": _channel_points(camera, 0.0, off_px)}
    x_mm, y_mm = (_cell_means(v) * 1e-3 for v in (place.x_um, place.y_um))

    @lru_cache(maxsize=CACHED_READ_OUTS)
    def of_pixels(acting: Effects) -> _ReadOut:
        return _read_out(Uniform(camera, acting))

    def predict(effects: Effects) -> Prediction:
        # what pixels do stays where it is if the lens's axis moves
        own, model = _own_factors(planes, place, effects, dataset), Uniform(camera, effects)
        read_out = of_pixels(acting(effects, ADDED | GAINS))
        even = even_share(camera, effects)
        base = _shaded(planes, lit, model, even, read_out, own)

        def jacobian() -> dict[str, FloatArray]:
            axis = {name: _shaded(planes, off, model, even, read_out, own) - base for name, off in moved.items()}
            return axis | _row_light(planes, base, model, camera.rows) | _line_gains(planes, base, model, camera)

        return Prediction(base, jacobian)

    radius = np.hypot(x_mm, y_mm)
    return Observable(
        measurement=FLAT_FIELD, reach=0.2 * float(np.ptp(x_mm)),
        value=np.concatenate([p.cells for p in planes]), covariance=_covariance(planes),
        labels=tuple(Label(float(radius[k]), p.channel, f"cell {k // COLS},{k % COLS}", tuple(c.id for c in p.captures),
        p.held_out)
                     for p in planes for k in range(ROWS * COLS)),
        reads=SHADING | ADDED | COLLECTED | GAINS | LEAK | STRAYS | TRAILS | {"signal.response", "image.veils"},
        scattered_by=ROW_LIGHT | LINE_GAINS,
        predict=predict, scale=np.ones(len(planes) * ROWS * COLS),
        along=np.tile(np.column_stack([x_mm, y_mm]), (len(planes), 1)),
    )  # fmt: skip


def _planes(dataset: Dataset) -> list[_ChannelCells]:
    """Return the mean of the brightest levels' frames by channel, seen and held-out ones apart. Levels are ranked by
    rounded means, so that noise doesn't choose."""
    out = dataset.once(held_out_flats)
    groups = [
        g for g in dataset.flat_levels() if all(m is not None for c in g for m in dataset.levels(c).mean.values())
    ]
    groups.sort(key=lambda g: -float(np.round(np.mean(list(dataset.levels(g[0]).whole.values())), 0)))
    planes: list[_ChannelCells] = []
    for held in (False, True):
        parts = [[c for c in g if (c.id in out) == held] for g in groups]
        picked = [part for part in parts if part][:MOST_LEVELS]
        captures = tuple(c for part in picked for c in part)[:MOST_FRAMES]
        if captures:
            planes += _summed(dataset, captures, held)
    return planes


def _summed(dataset: Dataset, captures: Sequence[Any], held_out: bool) -> list[_ChannelCells]:
    """Return the mean of some captures above the dark level, by channel."""
    noise, step = dataset.noise, mosaic.step(dataset.camera.cfa)
    total: dict[str, FloatArray] = {}
    inverse_per_dn: dict[str, float] = {}
    bands: dict[str, list[FloatArray]] = {c: [] for c in dataset.channels}
    for capture in captures:
        frame = np.asarray(dataset.recordings.frame(capture), np.float32) - np.float32(
            noise.black + noise.dark_dn_per_s * capture.exposure_s
        )
        for channel in dataset.channels:
            phases = mosaic.phases(dataset.camera.cfa)[channel]
            plane = np.mean([frame[r::step, c::step] for r, c in phases], axis=0, dtype=float)
            inverse_per_dn[channel] = inverse_per_dn.get(channel, 0.0) + 1.0 / float(plane.mean()) / len(captures)
            # each frame over its own mean, as levels may differ
            plane = plane / plane.mean()
            total[channel] = total.get(channel, 0.0) + plane / len(captures)
            bands[channel].append(_cells(plane).mean(1))
    planes: list[_ChannelCells] = []
    rows_dn2 = np.zeros((ROWS, ROWS))
    for channel, plane in total.items():
        count = len(mosaic.phases(dataset.camera.cfa)[channel])
        means = np.array([dataset.levels(c).mean[channel] or 0.0 for c in captures])
        levels = means - noise.black - noise.dark_dn_per_s * np.array([c.exposure_s for c in captures])
        single = (noise.gain * levels + noise.read_dn**2) / levels**2 / count  # relative variance of a plane's pixel
        shot = float(single.mean()) / len(captures)
        pixels = plane.size / (ROWS * COLS)
        cells = _cells(plane)
        # flicker is the light's: the mean over channels
        rows_dn2 = rows_dn2 + _row_covariance(np.array(bands[channel]), float(single.mean()) / (pixels * COLS)) / len(
            total
        )
        planes.append(
            _ChannelCells(
                tuple(captures), channel, held_out, (cells / cells.mean()).ravel(), float(levels.mean()) / noise.gain,
                inverse_per_dn[channel] * noise.gain, shot / pixels,
                _pattern_variance(plane, shot) / pixels,
                rows_dn2,
            )
        )  # fmt: skip
    return [replace(plane, row_covariance=rows_dn2) for plane in planes]


def _pattern_variance(plane: FloatArray, shot: float) -> float:
    """Relative variance of a pixel by the fixed pattern, such that a cell of n pixels has 1 / n of it.

    It is measured on differences of adjacent blocks of 4 x 4 pixels, so that a pattern that is correlated over a few
    pixels counts in full. It is limited to 1..ALIKE times the variance of adjacent pixels: a pattern correlated more
    strongly isn't one of pixels."""
    single = _adjacent(plane, 1) - shot
    return float(np.clip(_adjacent(plane, BLOCK_PX) - shot, max(single, 0.0), ALIKE * max(single, 0.0)))


def _adjacent(plane: FloatArray, size: int) -> float:
    """Half the mean square of differences between adjacent blocks' means, times the pixels of a block: the variance of
    a pixel, where pixels are independent. Blocks have `size` x `size` pixels."""
    rows, cols = (n // size for n in plane.shape)
    blocks = plane[: rows * size, : cols * size].reshape(rows, size, cols, size).mean((1, 3))
    steps = np.concatenate([np.square(np.diff(blocks, axis=axis)).ravel() for axis in (0, 1)])
    # the median of squares, 0.4549 of their mean, isn't moved by dust or by the border between two read-outs
    return float(np.median(steps)) / 0.4549 / 2.0 * size**2


def _row_covariance(bands: FloatArray, noise: float) -> FloatArray:
    """Relative covariance (ROWS, ROWS) of the rows of cells in the mean of all frames, by flicker of the light: 0 where
    the variance between frames is below `VARYING` times `noise`, that of a row of cells. `bands` (frames, ROWS)."""
    count = len(bands)
    if count < 2:
        return np.zeros((ROWS, ROWS))
    relative = bands / bands.mean(1, keepdims=True)
    away = relative - relative.mean(0)
    spread = away.T @ away / (count - 1)
    if np.trace(spread) < VARYING * ROWS * noise:
        return np.zeros((ROWS, ROWS))
    # few frames span few directions: the same variance is added in all
    return np.asarray((spread + np.trace(spread) / ROWS * np.eye(ROWS)) / count)


def _covariance(planes: Sequence[_ChannelCells]) -> FloatArray:
    cells = ROWS * COLS
    covariance = np.zeros((len(planes) * cells, len(planes) * cells))
    for i, a in enumerate(planes):
        for j, b in enumerate(planes):
            part = covariance[i * cells : (i + 1) * cells, j * cells : (j + 1) * cells]
            if a.channel == b.channel:
                part += np.eye(cells) * np.sqrt(a.pattern * b.pattern)
            if i == j:
                part += np.eye(cells) * a.noise
            if a.held_out == b.held_out:
                part += np.kron(a.row_covariance, np.ones((COLS, COLS))) * np.outer(a.cells, b.cells)
    return covariance


#: Gauss-Legendre nodes and weights in a cell: means over cells are exact for shading up to the fifth power of the
#: coordinates.
_POINTS, _SHARES = np.polynomial.legendre.leggauss(3)


def _cell_points(camera: CameraModel, off_row_px: float, off_col_px: float) -> FieldPoints:
    """Return the nodes of all cells, each as large as the pixels that `_cells` averages, with the optical axis moved by
    `off_row_px` and `off_col_px`."""
    step = mosaic.step(camera.cfa)
    row, col = (
        _nodes(size // step, count, step) - off
        for size, count, off in ((camera.rows, ROWS, off_row_px), (camera.cols, COLS, off_col_px))
    )
    grid_row, grid_col = np.meshgrid(row, col, indexing="ij")
    return FieldPoints.at(camera, grid_row.ravel(), grid_col.ravel())


def _channel_points(camera: CameraModel, off_row_px: float, off_col_px: float) -> dict[str, FieldPoints]:
    """Return the nodes of the cells by channel: its pixels stand up to half a pixel beside the mean of all."""
    middle = 0.5 * (mosaic.step(camera.cfa) - 1)
    found = {}
    for channel, phases in mosaic.phases(camera.cfa).items():
        row, col = np.mean(phases, axis=0) - middle
        found[channel] = _cell_points(camera, off_row_px - float(row), off_col_px - float(col))
    return found


def _nodes(size: int, count: int, step: int) -> FloatArray:
    """Return the nodes (3 count,), px of the frame, of `count` cells of a plane of `size` pixels, `step` px apart."""
    edges = step * _edges(size, count) - 0.5
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    return np.asarray((middle[:, None] + half[:, None] * _POINTS).ravel())


def _cell_means(value: FloatArray) -> FloatArray:
    """Means over cells (cells,) of values at `_cell_points`."""
    parts = value.reshape(ROWS, 3, COLS, 3)
    return np.asarray(np.einsum("iajb,a,b->ij", parts, 0.5 * _SHARES, 0.5 * _SHARES).ravel())


class _ReadOut(NamedTuple):
    """What read-out does to the pixels of a cell: signal beside the light's, less its mean (cells,), in electrons, and
    the factor on what is read (cells,)."""

    added_e: FloatArray | float
    gain: FloatArray | float


def _read_out(model: Uniform) -> _ReadOut:
    added_e = _cells(model.added_e - model.added_e.mean()).ravel() if model.adds_signal else 0.0
    gains = model.gain_map()
    return _ReadOut(added_e, 1.0 if gains is None else _cells(gains).ravel())


def _shaded(
    planes: Sequence[_ChannelCells],
    places: Mapping[str, FieldPoints],
    model: Uniform,
    even: float,
    read_out: _ReadOut,
    factors: Sequence[FloatArray | float],
) -> FloatArray:
    """Predicted cells of all planes, each relative to its mean, (planes x cells,). `even`: share of the light that a
    veil spreads; `factors` of `_own_factors`."""
    lights = {}
    for channel, place in places.items():
        light = _cell_means(model.field(place).light)
        # a veil of scattered light reduces the contrast of the fall-off
        lights[channel] = (1.0 - even) * light + even * light.mean()
    found = []
    for plane, factor in zip(planes, factors, strict=True):
        own = lights[plane.channel] * factor
        if model.leaks:
            leaked_s = _cell_means(model.leaked_s(places[plane.channel]))
            own = own * (1.0 + leaked_s * float(np.mean([1.0 / c.exposure_s for c in plane.captures])))
        electrons = model.response(own / own.mean() * plane.level_e) * read_out.gain
        found.append(electrons / electrons.mean() + read_out.added_e * plane.inverse_per_e)
    return np.concatenate(found)


def _own_factors(
    planes: Sequence[_ChannelCells], place: FieldPoints, effects: Effects, dataset: Dataset
) -> list[FloatArray | float]:
    """Factor on the cells (cells,) of each plane by what tells its pixels from others."""
    model, collected = Uniform(dataset.camera, effects), _collected(dataset, effects)
    of_frames = {out: [p for p in planes if p.held_out == out] for out in (False, True)}
    strayed = {out: _strayed(part, place, model) for out, part in of_frames.items()}
    trailed = {out: _trailed(part, model) for out, part in of_frames.items()}
    return [
        strayed[p.held_out].get(p.channel, 1.0)
        * trailed[p.held_out].get(p.channel, 1.0)
        * collected.get(p.channel, 1.0)
        for p in planes
    ]


def _strayed(planes: Sequence[_ChannelCells], place: FieldPoints, model: Uniform) -> dict[str, FloatArray]:
    """Factor on the cells (cells,) of each channel by light that falls on the next pixels, which are of other channels.
    `planes`: those of one set of frames."""
    if not model.strays:
        return {}
    after = model.stray_light({p.channel: p.level_e * np.ones(place.x_um.size) for p in planes}, place)
    return {p.channel: _cell_means(after[p.channel]) / p.level_e for p in planes}


def _trailed(planes: Sequence[_ChannelCells], model: Uniform) -> dict[str, FloatArray]:
    """Factor on the cells (cells,) of each channel by what packets leave behind on their way to the output: far from
    it, neighbours of other channels collect more. `planes`: those of one set of frames."""
    if not (model.trails and planes):
        return {}
    camera = model.camera
    light = model.phases_of(model.light_of({p.channel: p.level_e for p in planes}))
    step = mosaic.step(camera.cfa)
    down, across = (
        [_line_cells(comb[:, phase::step], count) for phase in range(step)]
        for comb, count in zip(model.read_combs(), (ROWS, COLS), strict=True)
    )
    return {
        channel: np.mean([down[r] @ light @ across[c].T for r, c in phases], axis=0).ravel()
        for channel, phases in mosaic.phases(camera.cfa).items()
    }


def _line_cells(lines: FloatArray, count: int) -> FloatArray:
    """Means (count, step) of values by line (step, lines) over a side's cells."""
    edges = _edges(lines.shape[1], count)
    return np.asarray(np.add.reduceat(lines, edges[:-1], axis=1) / np.diff(edges)).T


def _collected(dataset: Dataset, effects: Effects) -> dict[str, FloatArray]:
    """Factor on the cells (cells,) of each channel by pixels that collect light unlike others of their colour, as rows
    that repeat fall unevenly into cells."""
    collecting = acting(effects, COLLECTED)
    if not collecting:
        return {}
    step, rows = mosaic.step(dataset.camera.cfa), collect_rows(dataset.camera, collecting)
    found = {}
    for channel, phases in mosaic.phases(dataset.camera.cfa).items():
        own = np.mean([rows[r::step, c] for r, c in phases], axis=0)
        found[channel] = _cells(np.tile(own[:, None], COLS)).ravel()
    return found


def _row_light(planes: Sequence[_ChannelCells], base: FloatArray, model: Uniform, rows: int) -> dict[str, FloatArray]:
    """Jacobian of the cells `base` by a light that varies while a frame is taken, of the seen and of the held-out
    frames."""
    edges = np.linspace(0, rows, ROWS + 1).astype(int)

    def of(light: FloatArray) -> FloatArray:
        cells = np.add.reduceat(light, edges[:-1], axis=1) / np.diff(edges)
        return np.asarray(cells / cells.mean(1, keepdims=True))

    vectors = []
    for held_out in (False, True):
        own = np.array([float(plane.held_out == held_out) for plane in planes])
        captures = next((plane.captures for plane in planes if plane.held_out == held_out), ())
        for exposure_s, frames in Counter(c.exposure_s for c in captures).items():  # each frame in a phase of its own
            for one in row_light_scatter(model, rows, exposure_s, len(captures) ** 2 / frames, of):
                vectors.append(base * np.kron(own, np.repeat(one, COLS)))
    return nuisances("flat_field", vectors)


def _line_gains(
    planes: Sequence[_ChannelCells], base: FloatArray, model: Uniform, camera: CameraModel
) -> dict[str, FloatArray]:
    """Jacobian of the cells `base` by gains of rows and columns, the same in all frames: a mean over n lines of one
    parity, which a plane of the mosaic has alone or shares, scatters by 1 / sqrt(n) of a line's."""
    step, found = mosaic.step(camera.cfa), {}
    counts: dict[Lines, tuple[int, int]] = {"rows": (ROWS, camera.rows), "columns": (COLS, camera.cols)}
    for axis, (lines, (cells, count)) in enumerate(counts.items()):
        std = model.line_gain_std(lines) / np.sqrt(count / step / cells)
        if std == 0.0:
            continue
        for parity in range(step):
            own = [[phase[axis] % step == parity for phase in mosaic.phases(camera.cfa)[p.channel]] for p in planes]
            share = np.array([np.mean(phases) for phases in own])
            for k in range(cells):
                at = (np.arange(cells) == k) - 1.0 / cells
                frame = np.repeat(at, COLS) if lines == "rows" else np.tile(at, ROWS)
                found[f"flat_field:gains of {lines}:{parity}:{k}"] = std * base * np.kron(share, frame)
    return found


def _cells(plane: FloatArray) -> FloatArray:
    r, c = _edges(plane.shape[0], ROWS), _edges(plane.shape[1], COLS)
    return np.add.reduceat(np.add.reduceat(plane, r[:-1], 0), c[:-1], 1) / np.outer(np.diff(r), np.diff(c))


def _edges(size: int, count: int) -> NDArray[np.int64]:
    """Return the borders (count + 1,) of `count` cells of whole pixels."""
    return np.linspace(0, size, count + 1).astype(np.int64)


FLAT_FIELD = Measurement(
    "flat_field",
    title="shading of flat fields",
    order=270,
    axis="field",
    unit="mm",
    make=measure_flat_field,
    quantity="signal over the mean",
)
