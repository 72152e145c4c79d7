"""Flats over the frame: shading, and steps between the areas and the lines of two read-outs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.errors import NotDetermined
from lab.observables.darks.readout import OFFSETS_STD, DarkReadOut, dark_readout
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.row_light import ROW_LIGHT, nuisances, row_light_scatter
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import ADDED, COLLECTED, GAINS, LEAK, LINE_GAINS, acting
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.frame import collected_mosaic
from sim.point import even_share
from sim.sensor import mosaic
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import SHADING, STRAYS, FieldPoints, Uniform

#: Read-outs whose effect on the cells is kept: a refit varies one effect's parameters beside the others' as they stand.
CACHED_READ_OUTS = 64
LEAST_SIGNAL = 10.0  # of a frame that is a part of the mean image, in standard deviations of the read noise


@dataclass(frozen=True)
class FlatLevel:
    """The flat frames of one setting."""

    captures: tuple[Any, ...]
    held_out: bool
    mean: dict[str, float]  # above the dark level, by plane of the mosaic, DN
    ratios: tuple[float, ...]  # of each frame: signal of green on red rows over green on blue rows, less 1


def _unclipped(dataset: Dataset, capture: Any) -> bool:
    """Return whether no channel of the capture clips."""
    return all(m is not None for m in dataset.levels(capture).mean.values())


def flats(dataset: Dataset) -> tuple[list[FlatLevel], dict[bool, tuple[FloatArray, float]]]:
    """Unclipped flats by level, darkest first; and for seen (False) and held-out (True) ones a mean image with its
    pixels' variance.

    The image (rows, cols) is the mean over frames above the dark level, each plane of the mosaic over its mean,
    weighted by signal. The variance is that of a pixel of the image by shot and read noise.
    """
    out = dataset.once(held_out_flats)
    levels: list[FlatLevel] = []
    total: dict[bool, Any] = {}
    weights: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    for group in dataset.flat_levels():
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            part = [c for c in part if _unclipped(dataset, c)]  # noqa: PLW2901
            if not part:
                continue
            held_out = part[0].id in out
            means, ratios = [], []
            for capture in part:
                frame = np.asarray(dataset.recordings.frame(capture), np.float32) - np.float32(
                    dark_level_dn(dataset, capture)
                )
                own = {n: float(p.mean(dtype=float)) for n, p in mosaic.planes(frame, dataset.camera.cfa).items()}
                means.append(own)
                if "G1" in own:
                    ratios.append(green_ratio(dataset, frame))
                weight = float(np.mean(list(own.values())))
                if weight < LEAST_SIGNAL * dataset.noise.read_dn:
                    continue
                for name, plane in mosaic.planes(frame, dataset.camera.cfa).items():
                    np.multiply(plane, np.float32(weight / own[name]), out=plane)
                total[held_out] = total[held_out] + frame if held_out in total else frame
                noise = sum((dataset.noise.gain * m + dataset.noise.read_dn**2) / m**2 for m in own.values()) / len(own)
                weights[held_out].append((weight, noise))
            mean = {n: float(np.mean([m[n] for m in means])) for n in means[0]}
            levels.append(FlatLevel(tuple(part), held_out, mean, tuple(ratios)))
    images = {}
    for held_out, image in total.items():
        w = np.array(weights[held_out])
        share = w[:, 0] / w[:, 0].sum()
        images[held_out] = image / np.float32(w[:, 0].sum()), float(np.sum(np.square(share) * w[:, 1]))
    return sorted(levels, key=lambda u: sum(u.mean.values())), images


def dark_level_dn(dataset: Dataset, capture: Any) -> float:
    """Mean of a capture without light: black level + dark current x exposure, DN."""
    return dataset.noise.black + dataset.noise.dark_dn_per_s * float(capture.exposure_s)


def _green_dark(dataset: Dataset) -> float:
    """Difference of the two greens in dark frames, DN, by fixed patterns of the read-out; 0 without dark captures.

    In longer exposures than a flat's, hot pixels make it another.
    """
    every = dataset.recordings.captures(DarkCapture, dataset.side)
    longest_s = max((g[0].exposure_s for g in dataset.flat_levels()), default=0.0)
    longest_s = max(longest_s, min((c.exposure_s for c in every), default=0.0))
    captures = [c for c in every if c.exposure_s <= longest_s][:16]
    pairs = [green_planes(dataset, np.asarray(dataset.recordings.frame(c), np.float32)) for c in captures]
    return float(np.mean([float(a.mean(dtype=float)) - float(b.mean(dtype=float)) for a, b in pairs])) if pairs else 0.0


def green_planes(dataset: Dataset, frame: Any) -> tuple[Any, Any]:
    """Return the green pixels on red rows, without those at the border, and for each the mean of its four diagonal
    neighbours, the greens on blue rows. A gradient of the light cancels in their ratio."""
    row, col = mosaic.phases(dataset.camera.cfa)["G"][0]
    red_rows = frame[row + 2 * (row == 0) : -1 : 2, col + 2 * (col == 0) : -1 : 2]
    first = row + 2 * (row == 0) - 1, col + 2 * (col == 0) - 1
    blue_rows = frame[first[0] :: 2, first[1] :: 2]
    rows, cols = red_rows.shape
    corners = [blue_rows[i : i + rows, j : j + cols] for i in (0, 1) for j in (0, 1)]
    return red_rows, 0.25 * (corners[0] + corners[1] + corners[2] + corners[3])


def green_ratio(dataset: Dataset, frame: Any) -> float:
    """Ratio of the two greens' means in a frame above the dark level, less 1, corrected for their difference in dark
    frames."""
    red_rows, blue_rows = green_planes(dataset, frame)
    below = max(float(blue_rows.mean(dtype=float)), 1e-3)
    return (float(red_rows.mean(dtype=float)) - dataset.once(_green_dark)) / below - 1.0


# ----------------------------------------------------------------------------------------------------------------------
# Lines in flat fields: steps where the areas of two read-outs meet, and the difference of even and odd rows and
# columns.


LINE_FLOOR = 1e-4  # relative standard deviation of a step beside noise
#: Where the areas of two read-outs may meet, as shares of a side.
MEETING = (0.25, 0.5, 0.75)
LEAST_LINES = 8  # least side of a plane of the mosaic, lines: half of them determine the light's slope
LEAST_PLACES = 8  # places from which on the spread of steps is measured; with fewer it is that by noise and PRNU


def measure_flat_lines(dataset: Dataset) -> Observable:
    """Steps in the means of rows and columns at halves and quarters of a side, and the difference of even and odd lines
    of a plane of the mosaic, relative to the mean signal.

    What dark frames have of both is subtracted, and may be another in light by `OFFSETS_STD`. The standard deviation of
    a step is measured at all other places. Raises NotDetermined without unclipped flats, and for frames too small.
    """
    _, images = dataset.once(flats)
    if not images:
        raise NotDetermined("flat_lines", "no unclipped flat captures")
    period = mosaic.step(dataset.camera.cfa)
    side_px = min(dataset.camera.rows, dataset.camera.cols)
    if side_px < LEAST_LINES * period:
        raise NotDetermined(
            "flat_lines",
            f"frames of {side_px} px: lines are told from the light's slope from {LEAST_LINES * period} px on",
        )
    levels, dark = dataset.once(flats)[0], dataset.once(dark_readout)
    values: list[float] = []
    labels: list[Label] = []
    whole: list[tuple[float, float]] = []
    subtracted: list[float] = []
    for held_out, (whole_image, noise) in sorted(images.items()):
        part = [u for u in levels if u.held_out == held_out]
        members = tuple(c.id for u in part for c in u.captures)
        image, of_dark = (whole_image, 0.0) if dark is None else without_dark(dataset, dark, part, whole_image)
        for axis, name in ((0, "column"), (1, "row")):
            line, with_dark = (np.asarray(one.mean(axis=axis, dtype=float)) for one in (image, whole_image))
            shot = noise / image.shape[axis]
            least = float(np.sqrt((dataset.noise.prnu**2 + of_dark) / image.shape[axis] + shot))
            for share, value, std, size in _steps(line, period, least):
                values.append(value)
                whole.append((std**2 + LINE_FLOOR**2, shot * size))
                labels.append(Label(share * len(line), name, f"{name} {share * len(line):.0f}", members, held_out))
            subtracted += [found[1] for found in _steps(with_dark - line, period, least)]
            value, std = _stripes(line, period, least)
            values.append(value)
            whole.append((std**2 + LINE_FLOOR**2, shot * 4.0 / len(line)))
            labels.append(Label(0.0, name, f"even and odd {name}s", members, held_out))
            subtracted.append(_stripes(with_dark - line, period, least)[0])
    covariance = np.diag([total for total, _ in whole])
    conditions = [label.condition for label in labels]
    for i, label in enumerate(labels):
        for j in range(i):
            if conditions[j] == label.condition:  # the same pixels, seen and held out: only the noise is another
                covariance[i, j] = covariance[j, i] = min(max(whole[k][0] - whole[k][1], 0.0) for k in (i, j))
    jacobian = {
        f"in light: {name}": OFFSETS_STD * np.where(np.array(conditions) == name, subtracted, 0.0)
        for name in (dict.fromkeys(conditions) if dark is not None else ())
    }

    def predict(effects: Effects) -> Prediction:
        differing = acting(effects, COLLECTED | GAINS)
        if not differing:
            return Prediction(np.zeros(len(values)), jacobian)
        found = []
        for line in even_lines(dataset.camera, differing):
            found += [step for _, step, *_ in _steps(line, period, 0.0)] + [_stripes(line, period, 0.0)[0]]
        return Prediction(np.tile(found, len(images)), jacobian)

    return Observable(
        measurement=FLAT_LINES, reach=1.0, value=np.array(values), covariance=covariance, labels=tuple(labels),
        reads=COLLECTED | GAINS, predict=predict,
        scale=np.ones(len(values)),
    )  # fmt: skip


def even_lines(camera: CameraModel, effects: Effects) -> tuple[FloatArray, FloatArray]:
    """Return the means of the columns and of the rows of even light, each over its mean, as effects leave it."""
    rows = collect_rows(camera, acting(effects, COLLECTED)).mean(axis=1)
    gains = Uniform(camera, effects).gain_map()
    if gains is None:
        return np.ones(camera.cols), rows
    return gains.mean(axis=0) / gains.mean(), rows * gains.mean(axis=1) / gains.mean()


def collect_rows(camera: CameraModel, effects: Effects) -> FloatArray:
    """Return what the rows collect of even light, (rows, period of the mosaic): means over the even and the odd pixels
    of a row, each colour's plane over its mean.
    """
    even = {c: np.ones((camera.rows, mosaic.PERIOD_PX)) for c in camera.channels}
    tile = collected_mosaic(camera, mosaic.assemble(even, camera.cfa), effects, exposure_s=1.0, elapsed_s=0.0)
    for plane in mosaic.planes(tile, camera.cfa).values():
        plane[...] = plane / plane.mean()
    step = mosaic.step(camera.cfa)
    return np.stack([tile[:, first::step].mean(axis=1) for first in range(step)], axis=1)


def without_dark(
    dataset: Dataset, dark: DarkReadOut, levels: Sequence[FlatLevel], image: FloatArray
) -> tuple[FloatArray, float]:
    """Return the mean image of flat `levels` without the offsets of dark frames, (rows, cols), and the variance that
    their noise adds to a pixel."""
    signal = np.array([float(np.mean(list(u.mean.values()))) for u in levels])
    # each frame of the image counts by its signal, and is divided by that of the plane
    weight = np.where(signal >= LEAST_SIGNAL * dataset.noise.read_dn, signal * [len(u.captures) for u in levels], 0.0)
    if not weight.any():
        return image, 0.0
    offsets, size = np.array(dark.offsets_dn), []
    for name, plane in mosaic.planes(offsets, dataset.camera.cfa).items():
        size.append(float(np.average([1.0 / u.mean[name] for u in levels], weights=weight)))
        np.multiply(plane, np.float32(size[-1]), out=plane)
    return image - offsets, dataset.noise.read_dn**2 / dark.frames * float(np.mean(np.square(size)))


def _steps(line: FloatArray, period: int, least: float) -> list[tuple[float, float, float, float]]:
    """(share of the side, step, its standard deviation, variance of the step for lines of variance 1) where read-outs
    may meet.

    Least squares fit a straight line with a step to the means of `width` lines on either side. `least`: standard
    deviation of a line by noise and PRNU; `period`: of the mosaic.
    """
    width = max(len(line) // 16 // (2 * period) * 2 * period, 4 * period)
    x = np.arange(-width, width) + 0.5
    design = np.stack([np.ones_like(x), x, x > 0], axis=1)
    weight = np.linalg.pinv(design)[2]
    every = np.convolve(line, weight[::-1], mode="valid")  # steps at the lines width, width + 1, ...
    size = float(np.sum(weight * weight))
    at = {share: round(share * len(line) / period) * period for share in MEETING}
    far = np.ones(len(every), bool)
    for b in at.values():
        far[max(b - 2 * width, 0) : max(b, 0) + 1] = False
    others = every[::period][far[::period]]
    spread = 1.4826 * float(np.median(np.abs(others - np.median(others)))) if len(others) >= LEAST_PLACES else 0.0
    std = max(spread, least * np.sqrt(size))
    return [(share, float(every[b - width]), std, size) for share, b in at.items() if 0 <= b - width < len(every)]


def _stripes(line: FloatArray, period: int, least: float) -> tuple[float, float]:
    """Mean of the even lines of a plane of the mosaic less that of the odd ones, and its standard deviation, from the
    second differences of lines four periods apart."""
    lag = 4 * period
    pairs = line[: len(line) // (2 * period) * 2 * period].reshape(-1, 2, period)
    value = float((pairs[:, 0] - pairs[:, 1]).mean())
    # the light's slope from a line to the next of the plane
    slope = float(np.mean(line[-lag:] - line[:lag])) / (len(line) - lag) * period
    bend = line[2 * lag :] - 2.0 * line[lag:-lag] + line[: -2 * lag]
    spread = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0) if len(bend) >= LEAST_PLACES else 0.0
    one = max(spread, least)
    return value + slope, one * 2.0 / np.sqrt(len(line))


FLAT_LINES = Measurement(
    "flat_lines",
    title="lines in flat fields",
    order=260,
    axis="field",
    unit="px",
    make=measure_flat_lines,
    quantity="step over the mean signal",
)


# ----------------------------------------------------------------------------------------------------------------------
# Shading of flat fields: means over cells of the frame, relative to the frame's mean, against cos^4 (or the lens's)
# fall-off.


ROWS, COLS = 6, 8  # cells of the frame
#: Relative standard deviation of a cell, common to repeats: numerical error of the prediction.
SHADING_FLOOR = 2e-4
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
    moved = {"axis:row": _cell_points(camera, off_px, 0.0), "axis:col": _cell_points(camera, 0.0, off_px)}
    x_mm, y_mm = (_cell_means(v) * 1e-3 for v in (place.x_um, place.y_um))

    @lru_cache(maxsize=CACHED_READ_OUTS)
    def of_pixels(acting: Effects) -> _ReadOut:
        return _read_out(Uniform(camera, acting))

    def predict(effects: Effects) -> Prediction:
        # what pixels do stays where it is if the lens's axis moves
        own, model = _own_factors(planes, place, effects, dataset), Uniform(camera, effects)
        read_out = of_pixels(acting(effects, ADDED | GAINS))
        even = even_share(camera, effects)
        base = _shaded(planes, place, model, even, read_out, own)
        axis = {name: _shaded(planes, off, model, even, read_out, own) - base for name, off in moved.items()}
        scatter = _row_light(planes, base, model, camera.rows) | _line_gains(planes, base, model, camera)
        return Prediction(base, axis | scatter)

    radius = np.hypot(x_mm, y_mm)
    return Observable(
        measurement=FLAT_FIELD, reach=0.2 * float(np.ptp(x_mm)),
        value=np.concatenate([p.cells for p in planes]), covariance=_covariance(planes),
        labels=tuple(Label(float(radius[k]), p.channel, f"cell {k // COLS},{k % COLS}", tuple(c.id for c in p.captures),
        p.held_out)
                     for p in planes for k in range(ROWS * COLS)),
        reads=SHADING | ADDED | COLLECTED | GAINS | LEAK | STRAYS | {"signal.response", "image.veils"},
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
                part += np.eye(cells) * (np.sqrt(a.pattern * b.pattern) + SHADING_FLOOR**2)
            if i == j:
                part += np.eye(cells) * a.noise
            if a.held_out == b.held_out:
                part += np.kron(a.row_covariance, np.ones((COLS, COLS))) * np.outer(a.cells, b.cells)
    return covariance


#: Gauss-Legendre nodes and weights in a cell: means over cells are exact for shading up to the fifth power of the
#: coordinates.
_POINTS, _SHARES = np.polynomial.legendre.leggauss(3)


def _cell_points(camera: CameraModel, off_row_px: float, off_col_px: float) -> FieldPoints:
    row = ((np.arange(ROWS)[:, None] + 0.5 + 0.5 * _POINTS) / ROWS).ravel() * camera.rows - 0.5 - off_row_px
    col = ((np.arange(COLS)[:, None] + 0.5 + 0.5 * _POINTS) / COLS).ravel() * camera.cols - 0.5 - off_col_px
    grid_row, grid_col = np.meshgrid(row, col, indexing="ij")
    return FieldPoints.at(camera, grid_row.ravel(), grid_col.ravel())


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
    place: FieldPoints,
    model: Uniform,
    even: float,
    read_out: _ReadOut,
    factors: Sequence[FloatArray | float],
) -> FloatArray:
    """Predicted cells of all planes, each relative to its mean, (planes x cells,). `even`: share of the light that a
    veil spreads; `factors` of `_own_factors`."""
    light = _cell_means(model.field(place).light)
    # a veil of scattered light reduces the contrast of the fall-off
    light = (1.0 - even) * light + even * light.mean()
    leaked_s = _cell_means(model.leaked_s(place))
    found = []
    for plane, factor in zip(planes, factors, strict=True):
        own = light * factor
        if model.leaks:
            own = own * (1.0 + leaked_s * float(np.mean([1.0 / c.exposure_s for c in plane.captures])))
        electrons = model.response(own / own.mean() * plane.level_e) * read_out.gain
        found.append(electrons / electrons.mean() + read_out.added_e * plane.inverse_per_e)
    return np.concatenate(found)


def _own_factors(
    planes: Sequence[_ChannelCells], place: FieldPoints, effects: Effects, dataset: Dataset
) -> list[FloatArray | float]:
    """Factor on the cells (cells,) of each plane by what tells its pixels from others."""
    model, collected = Uniform(dataset.camera, effects), _collected(dataset, effects)
    strayed = {out: _strayed([p for p in planes if p.held_out == out], place, model) for out in (False, True)}
    return [strayed[p.held_out].get(p.channel, 1.0) * collected.get(p.channel, 1.0) for p in planes]


def _strayed(planes: Sequence[_ChannelCells], place: FieldPoints, model: Uniform) -> dict[str, FloatArray]:
    """Factor on the cells (cells,) of each channel by light that falls on the next pixels, which are of other channels.
    `planes`: those of one set of frames."""
    if not model.strays:
        return {}
    after = model.stray_light({p.channel: p.level_e * np.ones(place.x_um.size) for p in planes}, place)
    return {p.channel: _cell_means(after[p.channel]) / p.level_e for p in planes}


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
    r = np.linspace(0, plane.shape[0], ROWS + 1).astype(int)
    c = np.linspace(0, plane.shape[1], COLS + 1).astype(int)
    return np.add.reduceat(np.add.reduceat(plane, r[:-1], 0), c[:-1], 1) / np.outer(np.diff(r), np.diff(c))


FLAT_FIELD = Measurement(
    "flat_field",
    title="shading of flat fields",
    order=270,
    axis="field",
    unit="mm",
    make=measure_flat_field,
    quantity="signal over the mean",
)
