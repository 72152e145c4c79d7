"""The dark signal by place in the frame: glow of the read-out, other dark current that isn't uniform, and what
read-out adds by itself."""

from __future__ import annotations

import numpy as np

from lab.errors import NotDetermined
from lab.observables.codes.rounding import rounding_std_dn
from lab.observables.darks.frames import CELLS, cell_means, dark_frames, rounding_waves_of_change_dn, spread_dn2
from lab.observables.darks.level import dark_current_map
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import ADDED, DARK_CURRENT, LINES
from sim.effects.base import Effects
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import Uniform

CELL_PX = 4  # the least side of a cell
SLOW_CYCLES = 6  # down a frame, of noise whose waves cells tell


def measure_dark_field(dataset: Dataset) -> Observable:
    """Means over 4 x 6 cells of the mean dark frame of each condition, less the frame's mean, DN.

    The level of each mean frame is a nuisance parameter. Raises NotDetermined where cells are narrower than `CELL_PX`.
    """
    frames = [f for f in dataset.once(dark_frames) if f.fixed]
    # frames all of whose codes are equal have no scatter: rounding hides it
    points = [(f, out, part) for f in frames for out, part in f.fixed.items() if np.ptp(part.cells) > 0]
    if not points:
        raise NotDetermined("dark_field", "every pixel of the dark frames has the same code: raise the gain")
    rows, cols = CELLS
    count = rows * cols
    if min(dataset.camera.rows // rows, dataset.camera.cols // cols) < CELL_PX:
        raise NotDetermined(
            "dark_field",
            f"frames of {dataset.camera.rows} x {dataset.camera.cols} px: too small to be split into cells, which need "
            f"{rows * CELL_PX} x {cols * CELL_PX} px",
        )
    value = np.concatenate([part.cells.ravel() - part.cells.mean() for *_, part in points])
    row, col = (g.ravel() for g in np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"))
    size = dataset.camera.rows * dataset.camera.cols / count
    changing: list[float] = []
    fixed: list[float] = []
    line_dn2: dict[Lines, float] = {"rows": 0.0, "columns": 0.0}
    for f, _, part in points:
        moving = next(iter(f.changing.values()), None)
        white = moving.white_dn2 if moving is not None else part.white_dn2
        cell = max(moving.cells_dn2, white / size) if moving is not None else white / size
        changing.append(cell / part.frames)
        fixed.append(max(part.white_dn2 - white / part.frames, 0.0) / size)
        for lines, most in line_dn2.items():
            noise = moving.line_dn2[lines] / part.frames if moving is not None else 0.0
            line_dn2[lines] = max(most, part.line_dn2[lines] - noise)
    pattern = np.eye(count) * float(np.max(fixed))
    pattern += (row[:, None] == row) * line_dn2["rows"] * rows / dataset.camera.rows
    pattern += (col[:, None] == col) * line_dn2["columns"] * cols / dataset.camera.cols
    covariance = np.kron(np.ones((len(points), len(points))), pattern) + np.diag(np.repeat(changing, count))
    exposures = np.array([f.condition.exposure_s for f, *_ in points])
    half = 0.5 * np.hypot(rows, cols)
    rounding = rounding_std_dn(spread_dn2([f for f, *_ in points], dataset.step_dn), dataset.step_dn)
    radius = np.hypot(row - (rows - 1) / 2, col - (cols - 1) / 2) / half

    def predict(effects: Effects) -> Prediction:
        mean = np.zeros(len(value))
        model = Uniform(dataset.camera, effects)
        if model.adds_signal:
            added = cell_means(model.added_e.astype(np.float32))
            mean += np.tile((dataset.noise.gain * (added - added.mean())).ravel(), len(points))
        if model.changes_dark_current:
            dark_at = dark_current_map(dataset, effects)
            for i, (f, *_) in enumerate(points):
                cells = cell_means(dark_at(f.condition.temperature_c).astype(np.float32))
                here = dataset.noise.gain * f.condition.exposure_s * (cells - cells.mean())
                mean[i * count : (i + 1) * count] += here.ravel()
        jacobian = {}
        for i, std_dn in enumerate(rounding):
            own = slice(i * count, (i + 1) * count)
            for number, wave in enumerate(
                (np.ones(count), *rounding_waves_of_change_dn(mean[own], std_dn, dataset.step_dn))
            ):
                column = np.zeros(len(value))
                column[own] = wave
                jacobian[f"dark_field:{i}:rounding {number}" if number else f"dark_field:{i}"] = column
        for number, shape in enumerate(_slow_rows(dataset, model)):
            for i, (*_, part) in enumerate(points):
                column = np.zeros(len(value))
                column[i * count : (i + 1) * count] = shape / np.sqrt(part.frames)
                jacobian[f"dark_field:slow:{number}:{i}"] = column
        return Prediction(mean, jacobian)

    longest = max(float(exposures.max()), 1e-9)
    return Observable(
        measurement=DARK_FIELD, reach=0.5, value=value, covariance=np.asarray(covariance, float),
        labels=tuple(Label(float(radius[k]), "all", f.condition.name, part.captures, out) for f, out,
        part in points for k in range(count)),
        reads=DARK_CURRENT | ADDED, scattered_by=LINES, predict=predict,
        scale=np.repeat(np.maximum(exposures / longest, 0.1), count),
    )  # fmt: skip


def _slow_rows(dataset: Dataset, model: Uniform) -> list[FloatArray]:
    """Vectors (cells,) by which single frames' cells scatter with waves of `SLOW_CYCLES` cycles down the rows that
    effects' noise has, DN: few of them, so that their scatter isn't that of independent cells."""
    if not (model.lines or model.reading_order):
        return []
    shape = dataset.camera.rows, dataset.camera.cols
    cycles = np.arange(1.0, SLOW_CYCLES + 1.0)
    frequency = cycles / shape[0]
    power_e2 = np.zeros(len(cycles))
    for line in model.lines:
        if line.lines == "rows":
            power_e2 += line.spectrum_e2(frequency, fixed=False)
    for ordered in model.reading_order:
        power_e2 += ordered.plane_e2(shape, np.zeros(len(cycles)), frequency) / shape[1]
    phase = 2.0 * np.pi * cycles[:, None] * np.arange(shape[0]) / shape[0]
    size_dn = dataset.noise.gain * np.sqrt(2.0 * power_e2 / shape[0])
    waves = np.concatenate([size_dn[:, None] * np.cos(phase), size_dn[:, None] * np.sin(phase)])
    return [cell_means(np.tile(wave[:, None], (1, shape[1]))).ravel() for wave in waves]


DARK_FIELD = Measurement(
    "dark_field",
    title="dark signal over the field",
    order=130,
    axis="field",
    unit="of half the diagonal",
    make=measure_dark_field,
    quantity="dark signal less the frame's mean, DN",
    conditions="exposure and temperature",
)
