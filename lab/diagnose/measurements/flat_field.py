"""Shading of flat fields: cells of the frame against cos^4, each channel relative to its mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lab.diagnose.measurements.block import Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.held_out import held_out_flats
from lab.diagnose.measurements.study import Study
from lab.errors import NotDetermined
from sim.camera import CameraModel
from sim.point import even_share
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import SHADING, FieldPoints, Uniform

ROWS, COLS = 6, 8
SHADING_FLOOR = 2e-4  # of a cell, alike in its repeats: cos^4 at a cell's points, response at a cell's mean
AXIS_STD, AXIS_STD_KNOWN = 0.01, 0.004  # of the frame's diagonal: the optical axis without and with a fitted geometry
MOST_FRAMES, MOST_LEVELS = 6, 2  # brightest levels, seen and held out each
BLOCK_PX = 4  # of a channel's plane: at this scale its fixed pattern is measured
ALIKE = 1.5  # times as much of it than of independent pixels' may be left in cells
#: Ratio to the noise's variance from which on rows are said to vary from frame to frame: one healthy set in some thousands has it.
VARYING = 4.0


@dataclass(frozen=True)
class _Plane:
    """One channel of the seen or of the held-out flats: cells relative to their mean."""

    captures: tuple[Any, ...]
    channel: str
    held_out: bool
    cells: FloatArray  # (ROWS * COLS,)
    level_e: float
    noise: float  # relative variance of a cell by shot and read noise
    pattern: float  # and by the fixed pattern, which repeats share
    row_covariance: FloatArray  # (ROWS, ROWS), relative covariance of what rows of cells share in one frame


def shading_block(study: Study) -> Block:
    """Means over 6 x 8 cells of the brightest unclipped flats, relative to their mean, by channel.

    The fixed pattern's variance is measured at a scale of a few pixels. Nuisance parameters: the place of the optical axis.
    """
    if study.stated.focal_length_mm is None or study.stated.pixel_pitch_um is None:
        raise NotDetermined(
            "flat_field", "the focal length or the pixel pitch isn't stated: the fall-off of the light isn't known"
        )
    least_px = max(ROWS, COLS, 2 * BLOCK_PX) * mosaic.step(study.camera.cfa)
    if min(study.camera.rows, study.camera.cols) < least_px:
        raise NotDetermined(
            "flat_field",
            f"frames of {study.camera.rows} x {study.camera.cols} px: {ROWS} x {COLS} cells need {least_px} px a side",
        )
    planes = _planes(study)
    if not planes:
        raise NotDetermined("flat_field", "no unclipped flat captures")
    camera = study.camera
    # where the optical axis meets the sensor is known to a share of the frame's diagonal: the fall-off may be centred there
    off_px = (AXIS_STD_KNOWN if camera.geometry is not None else AXIS_STD) * float(np.hypot(camera.rows, camera.cols))
    place = _cell_points(camera, 0.0, 0.0)
    moved = {"axis:row": _cell_points(camera, off_px, 0.0), "axis:col": _cell_points(camera, 0.0, off_px)}
    x_mm, y_mm = (_cell_means(v) * 1e-3 for v in (place.x_um, place.y_um))

    def predict(effects: Effects) -> Prediction:
        base = _shaded(planes, place, effects, study)
        return Prediction(base, {name: _shaded(planes, off, effects, study) - base for name, off in moved.items()})

    radius = np.hypot(x_mm, y_mm)
    return Block(
        measurement=FLAT_FIELD, reach=0.2 * float(np.ptp(x_mm)),
        value=np.concatenate([p.cells for p in planes]), covariance=_covariance(planes),
        labels=tuple(Label(float(radius[k]), p.channel, f"cell {k // COLS},{k % COLS}", tuple(c.id for c in p.captures), p.held_out)
                     for p in planes for k in range(ROWS * COLS)),
        reads=SHADING | {"signal.response", "image.veils"}, predict=predict, scale=np.ones(len(planes) * ROWS * COLS),
        along=np.tile(np.column_stack([x_mm, y_mm]), (len(planes), 1)),
    )  # fmt: skip


def _planes(study: Study) -> list[_Plane]:
    """The brightest levels' frames, what is seen and what is held out apart. Chosen by their settings, not by their noise."""
    out = study.once(held_out_flats)
    groups = [g for g in study.flat_levels() if all(m is not None for c in g for m in study.levels(c).mean.values())]
    groups.sort(key=lambda g: -float(np.round(np.mean(list(study.levels(g[0]).whole.values())), 0)))
    planes: list[_Plane] = []
    for held in (False, True):
        parts = [[c for c in g if (c.id in out) == held] for g in groups]
        picked = [part for part in parts if part][:MOST_LEVELS]
        captures = tuple(c for part in picked for c in part)[:MOST_FRAMES]
        if captures:
            planes += _summed(study, captures, held)
    return planes


def _summed(study: Study, captures: Sequence[Any], held_out: bool) -> list[_Plane]:
    noise, step = study.noise, mosaic.step(study.camera.cfa)
    total: dict[str, FloatArray] = {}
    bands: dict[str, list[FloatArray]] = {c: [] for c in study.channels}
    for capture in captures:
        frame = np.asarray(study.recordings.frame(capture), np.float32) - np.float32(
            noise.black + noise.dark_dn_per_s * capture.exposure_s
        )
        for channel in study.channels:
            phases = mosaic.phases(study.camera.cfa)[channel]
            plane = np.mean([frame[r::step, c::step] for r, c in phases], axis=0, dtype=float)
            # every frame by its own mean: levels may differ
            plane = plane / plane.mean()
            total[channel] = total.get(channel, 0.0) + plane / len(captures)
            bands[channel].append(_cells(plane).mean(1))
    planes: list[_Plane] = []
    rows_dn2 = np.zeros((ROWS, ROWS))
    for channel, plane in total.items():
        count = len(mosaic.phases(study.camera.cfa)[channel])
        means = np.array([study.levels(c).mean[channel] or 0.0 for c in captures])
        levels = means - noise.black - noise.dark_dn_per_s * np.array([c.exposure_s for c in captures])
        single = (noise.gain * levels + noise.read_dn**2) / levels**2 / count  # relative variance of a plane's pixel
        shot = float(single.mean()) / len(captures)
        pixels = plane.size / (ROWS * COLS)
        cells = _cells(plane)
        # of the light, and so one for all channels
        rows_dn2 = rows_dn2 + _row_covariance(np.array(bands[channel]), float(single.mean()) / (pixels * COLS)) / len(
            total
        )
        planes.append(
            _Plane(
                tuple(captures), channel, held_out, (cells / cells.mean()).ravel(), float(levels.mean()) / noise.gain, shot / pixels,
                _pattern_variance(plane, shot) / pixels,
                rows_dn2,
            )
        )  # fmt: skip
    return [replace(plane, row_covariance=rows_dn2) for plane in planes]


def _pattern_variance(plane: FloatArray, shot: float) -> float:
    """Variance of the fixed pattern, a pixel's worth where cells average it: from adjacent blocks of 4 x 4 pixels, which may be alike;
    at least that of adjacent pixels by themselves and at most ALIKE times that, as what is much more alike is no pixels' pattern."""
    single = _adjacent(plane, 1) - shot
    return float(np.clip(_adjacent(plane, BLOCK_PX) - shot, max(single, 0.0), ALIKE * max(single, 0.0)))


def _adjacent(plane: FloatArray, size: int) -> float:
    """Half the mean square of differences between adjacent blocks' means, times the pixels of a block."""
    rows, cols = (n // size for n in plane.shape)
    blocks = plane[: rows * size, : cols * size].reshape(rows, size, cols, size).mean((1, 3))
    steps = np.concatenate([np.square(np.diff(blocks, axis=axis)).ravel() for axis in (0, 1)])
    # the median of squares, 0.4549 of their mean: a speck of dust or the border of a tap is no pattern of the pixels
    return float(np.median(steps)) / 0.4549 / 2.0 * size**2


def _row_covariance(bands: FloatArray, noise: float) -> FloatArray:
    """Covariance of the rows of cells of the mean of all frames beside noise, (ROWS, ROWS): 0 unless the light flickers."""
    count = len(bands)
    if count < 2:
        return np.zeros((ROWS, ROWS))
    relative = bands / bands.mean(1, keepdims=True)
    away = relative - relative.mean(0)
    spread = away.T @ away / (count - 1)
    if np.trace(spread) < VARYING * ROWS * noise:
        return np.zeros((ROWS, ROWS))
    # few frames tell of few directions: as much again in all of them
    return np.asarray((spread + np.trace(spread) / ROWS * np.eye(ROWS)) / count)


def _covariance(planes: Sequence[_Plane]) -> FloatArray:
    cells = ROWS * COLS
    covariance = np.zeros((len(planes) * cells, len(planes) * cells))
    for i, a in enumerate(planes):
        for j, b in enumerate(planes):
            part = covariance[i * cells : (i + 1) * cells, j * cells : (j + 1) * cells]
            if a.channel == b.channel:
                part += np.eye(cells) * (np.sqrt(a.pattern * b.pattern) + SHADING_FLOOR**2)
            if i == j:
                part += np.eye(cells) * a.noise
            if a.held_out == b.held_out:
                part += np.kron(a.row_covariance, np.ones((COLS, COLS)))
    return covariance


#: Gauss's three points in a cell and their shares: means over cells exact for shadings up to the fifth power of the place.
_POINTS, _SHARES = np.polynomial.legendre.leggauss(3)


def _cell_points(camera: CameraModel, off_row_px: float, off_col_px: float) -> FieldPoints:
    row = ((np.arange(ROWS)[:, None] + 0.5 + 0.5 * _POINTS) / ROWS).ravel() * camera.rows - 0.5 - off_row_px
    col = ((np.arange(COLS)[:, None] + 0.5 + 0.5 * _POINTS) / COLS).ravel() * camera.cols - 0.5 - off_col_px
    grid_row, grid_col = np.meshgrid(row, col, indexing="ij")
    return FieldPoints.at(camera, grid_row.ravel(), grid_col.ravel())


def _cell_means(value: FloatArray) -> FloatArray:
    """Of values at `_cell_points`, (cells,)."""
    parts = value.reshape(ROWS, 3, COLS, 3)
    return np.asarray(np.einsum("iajb,a,b->ij", parts, 0.5 * _SHARES, 0.5 * _SHARES).ravel())


def _shaded(planes: Sequence[_Plane], place: FieldPoints, effects: Effects, study: Study) -> FloatArray:
    """Cells of every plane relative to their mean, (planes x cells,)."""
    model = Uniform(study.camera, effects)
    light = _cell_means(model.field(place).light)
    # a veil evens out what the lens's fall-off leaves
    even = even_share(study.camera, effects)
    light = (1.0 - even) * light + even * light.mean()
    found = []
    for plane in planes:
        electrons = model.response(light / light.mean() * plane.level_e)
        found.append(electrons / electrons.mean())
    return np.concatenate(found)


def _cells(plane: FloatArray) -> FloatArray:
    r = np.linspace(0, plane.shape[0], ROWS + 1).astype(int)
    c = np.linspace(0, plane.shape[1], COLS + 1).astype(int)
    return np.add.reduceat(np.add.reduceat(plane, r[:-1], 0), c[:-1], 1) / np.outer(np.diff(r), np.diff(c))


FLAT_FIELD = Measurement(
    "flat_field",
    title="shading of flat fields",
    order=270,
    axis="field",
    unit="mm",
    make=shading_block,
    quantity="signal over the mean",
)
