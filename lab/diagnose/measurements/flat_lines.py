"""Lines in flat fields: steps where the areas of two read-outs meet, and the difference of even and odd rows and
columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.diagnose.measurements.block import Block, Label, Measurement, Prediction
from lab.diagnose.measurements.dark_readout import OFFSETS_STD, DarkReadOut, dark_readout
from lab.diagnose.measurements.even_flats import LEAST_SIGNAL, FlatLevel, flats
from lab.errors import NotDetermined
from lab.measure.reads import COLLECTED, GAINS, acting
from lab.measure.study import Study
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.frame import collected_mosaic
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import Uniform

LINE_FLOOR = 1e-4  # relative standard deviation of a step beside noise
#: Where the areas of two read-outs may meet, as shares of a side.
MEETING = (0.25, 0.5, 0.75)
LEAST_LINES = 8  # least side of a plane of the mosaic, lines: half of them determine the light's slope
LEAST_PLACES = 8  # places from which on the spread of steps is measured; with fewer it is that by noise and PRNU


def line_block(study: Study) -> Block:
    """Steps in the means of rows and columns at halves and quarters of a side, and the difference of even and odd lines
    of a plane of the mosaic, relative to the mean signal.

    What dark frames have of both is subtracted, and may be another in light by `OFFSETS_STD`. The standard deviation of
    a step is measured at all other places. Raises NotDetermined without unclipped flats, and for frames too small.
    """
    _, images = study.once(flats)
    if not images:
        raise NotDetermined("flat_lines", "no unclipped flat captures")
    period = mosaic.step(study.camera.cfa)
    side_px = min(study.camera.rows, study.camera.cols)
    if side_px < LEAST_LINES * period:
        raise NotDetermined(
            "flat_lines",
            f"frames of {side_px} px: lines are told from the light's slope from {LEAST_LINES * period} px on",
        )
    levels, dark = study.once(flats)[0], study.once(dark_readout)
    values: list[float] = []
    labels: list[Label] = []
    whole: list[tuple[float, float]] = []
    subtracted: list[float] = []
    for held_out, (whole_image, noise) in sorted(images.items()):
        part = [u for u in levels if u.held_out == held_out]
        members = tuple(c.id for u in part for c in u.captures)
        image, of_dark = (whole_image, 0.0) if dark is None else without_dark(study, dark, part, whole_image)
        for axis, name in ((0, "column"), (1, "row")):
            line, with_dark = (np.asarray(one.mean(axis=axis, dtype=float)) for one in (image, whole_image))
            shot = noise / image.shape[axis]
            least = float(np.sqrt((study.noise.prnu**2 + of_dark) / image.shape[axis] + shot))
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
        for line in _lines(study.camera, differing):
            found += [step for _, step, *_ in _steps(line, period, 0.0)] + [_stripes(line, period, 0.0)[0]]
        return Prediction(np.tile(found, len(images)), jacobian)

    return Block(
        measurement=FLAT_LINES, reach=1.0, value=np.array(values), covariance=covariance, labels=tuple(labels),
        reads=COLLECTED | GAINS, predict=predict,
        scale=np.ones(len(values)),
    )  # fmt: skip


def _lines(camera: CameraModel, effects: Effects) -> tuple[FloatArray, FloatArray]:
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
    study: Study, dark: DarkReadOut, levels: Sequence[FlatLevel], image: FloatArray
) -> tuple[FloatArray, float]:
    """Return the mean image of flat `levels` without the offsets of dark frames, (rows, cols), and the variance that
    their noise adds to a pixel."""
    signal = np.array([float(np.mean(list(u.mean.values()))) for u in levels])
    # each frame of the image counts by its signal, and is divided by that of the plane
    weight = np.where(signal >= LEAST_SIGNAL * study.noise.read_dn, signal * [len(u.captures) for u in levels], 0.0)
    if not weight.any():
        return image, 0.0
    offsets, size = np.array(dark.offsets_dn), []
    for name, plane in mosaic.planes(offsets, study.camera.cfa).items():
        size.append(float(np.average([1.0 / u.mean[name] for u in levels], weights=weight)))
        np.multiply(plane, np.float32(size[-1]), out=plane)
    return image - offsets, study.noise.read_dn**2 / dark.frames * float(np.mean(np.square(size)))


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
    make=line_block,
    quantity="step over the mean signal",
)
