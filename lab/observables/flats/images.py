"""Flat frames by level, their mean image, and what lines and greens of it show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.observables.darks.readout import DarkReadOut
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.reads import COLLECTED, acting
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.frame import collected_mosaic
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

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


def brightest_signal(dataset: Dataset) -> dict[str, float]:
    """Return the mean signal of the brightest unclipped flats by channel, DN: the colour of the light."""
    mean = dataset.once(flats)[0][-1].mean
    return {c: float(np.mean([v for name, v in mean.items() if name[0] == c])) for c in dataset.channels}


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


def green_lines(camera: CameraModel, axis: int, lines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what `green_planes` makes of a frame that is the product of values by row and by column: of values
    (..., lines) along one axis, those of the greens on red rows, and of their neighbours, both (..., greens)."""
    first = mosaic.phases(camera.cfa)["G"][0][axis]
    first += 2 * (first == 0)
    red, other = lines[..., first:-1:2], lines[..., first - 1 :: 2]
    count = red.shape[-1]
    return red, 0.5 * (other[..., :count] + other[..., 1 : count + 1])


def green_ratio(dataset: Dataset, frame: Any) -> float:
    """Ratio of the two greens' means in a frame above the dark level, less 1, corrected for their difference in dark
    frames."""
    red_rows, blue_rows = green_planes(dataset, frame)
    below = max(float(blue_rows.mean(dtype=float)), 1e-3)
    return (float(red_rows.mean(dtype=float)) - dataset.once(_green_dark)) / below - 1.0


def even_lines(
    camera: CameraModel, effects: Effects, read: Mapping[str, float] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the means of the columns and of the rows of even light, each over its mean, as effects leave it, of a
    frame whose planes are each over their means. `read`: mean signals by channel, for what packets leave behind on
    their way to the output."""
    rows = collect_rows(camera, acting(effects, COLLECTED)).mean(axis=1)
    cols = np.ones(camera.cols)
    model = Uniform(camera, effects)
    if model.trails and read is not None:
        across, down = _trailed_lines(model, read)
        rows, cols = rows * down, cols * across
    gains = model.gain_map()
    if gains is None:
        return cols, rows
    return cols * gains.mean(axis=0) / gains.mean(), rows * gains.mean(axis=1) / gains.mean()


def _trailed_lines(model: Uniform, read: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return the means of the columns and of the rows of even light, read with these means by channel, each plane of
    the mosaic over its own."""
    down, across = model.read_combs()
    step, light = len(down), model.phases_of(model.light_of(read))
    plane = np.array(
        [
            [float(down[:, i::step].mean(1) @ light @ across[:, j::step].mean(1)) for j in range(step)]
            for i in range(step)
        ]
    )
    rows, cols = np.zeros(down.shape[1]), np.zeros(across.shape[1])
    for i in range(step):
        for j in range(step):
            rows[i::step] += down[:, i::step].T @ light @ across[:, j::step].mean(1) / plane[i, j] / step
            cols[j::step] += down[:, i::step].mean(1) @ light @ across[:, j::step] / plane[i, j] / step
    return cols, rows


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
