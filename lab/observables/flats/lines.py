"""Lines in flat fields: steps where the areas of two read-outs meet, and the difference of even and odd rows and
columns."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.darks.readout import OFFSETS_STD, dark_readout
from lab.observables.dataset import Dataset
from lab.observables.flats.images import even_lines, flats, without_dark
from lab.observables.noise.robust import median_std
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import COLLECTED, GAINS, acting
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray

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
                whole.append((std**2, shot * size))
                labels.append(Label(share * len(line), name, f"{name} {share * len(line):.0f}", members, held_out))
            subtracted += [found[1] for found in _steps(with_dark - line, period, least)]
            value, std = _stripes(line, period, least)
            values.append(value)
            whole.append((std**2, shot * 4.0 / len(line)))
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
    away = others - np.median(others) if len(others) >= LEAST_PLACES else np.zeros(0)
    std = median_std(away, least * float(np.sqrt(size)), period / (2.0 * width))
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
    one = median_std(bend / np.sqrt(6.0) if len(bend) >= LEAST_PLACES else np.zeros(0), least)
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
