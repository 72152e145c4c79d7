"""The ratio of the two greens of a Bayer mosaic in uniform light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset
from lab.observables.flats.images import (
    FlatLevel,
    brightest_signal,
    dark_level_dn,
    flats,
    green_lines,
    green_planes,
    green_ratio,
)
from lab.observables.noise.figures import BLACK_FLOOR_DN
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import COLLECTED, LINE_GAINS, TRAILS, acting
from sim.effects.base import Effects
from sim.frame import collected_mosaic
from sim.sensor import mosaic
from sim.sensor.lines import Lines
from sim.spectrum import FloatArray
from sim.uniform import STRAYS, FieldPoints, Uniform, phase_means

GREEN_NOISE = 0.02  # ratios of a larger standard deviation aren't used
CELLS = (3, 4)  # of the frame: rows, columns
TILE_ROWS, TILE_COLS = mosaic.PERIOD_PX, 4  # size of the uniform frame by which effects are predicted


@dataclass(frozen=True)
class _Ratio:
    """One ratio of the greens."""

    value: float  # less 1
    std: float  # by noise
    x: float  # wavelength, nm; 0 of flats
    condition: str
    captures: tuple[str, ...]
    held_out: bool
    mean: dict[str, float]  # signal by channel, DN
    exposure_s: float
    elapsed_s: float


def measure_green_balance(dataset: Dataset) -> Observable:
    """Signal of the green pixels on red rows over that on blue rows, less 1.

    It is measured by level of flats, by wavelength of narrowband light, and by cell of the frame relative to the cells'
    mean. Raises NotDetermined for a camera without a mosaic, for frames too small, and without unclipped captures of
    uniform light."""
    if dataset.camera.cfa == "MONO":
        raise NotDetermined("green_balance", "the camera has no colour mosaic")
    if any(n < cells for n, cells in zip(_green_shape(dataset), CELLS, strict=True)):
        least = " x ".join(str(2 * (cells + 1)) for cells in CELLS)
        raise NotDetermined(
            "green_balance",
            f"frames of {dataset.camera.rows} x {dataset.camera.cols} px: {CELLS[0]} x {CELLS[1]} cells of greens need "
            f"{least} px",
        )
    levels, images = dataset.once(flats)
    rows_dn2 = _rows_dn2(dataset, levels)
    every = *_by_level(dataset, levels, rows_dn2), *_by_wavelength(dataset, rows_dn2)
    ratios = [r for r in every if r.std < GREEN_NOISE]
    if not ratios:
        raise NotDetermined("green_balance", "no unclipped flat or narrowband captures")
    common = dataset.noise.prnu**2 * _share(*_green_shape(dataset))
    value = np.array([r.value for r in ratios])
    covariance = np.diag([r.std**2 for r in ratios]) + common
    labels = [Label(r.x, "G", r.condition, r.captures, r.held_out) for r in ratios]
    number = CELLS[0] * CELLS[1]
    for held_out, (image, noise) in sorted(images.items()):  # seen frames first
        red_rows, blue_rows = green_planes(dataset, image)
        place = _cell_means(red_rows) / _cell_means(blue_rows)
        members = tuple(c.id for u in levels if u.held_out == held_out for c in u.captures)
        value = np.concatenate([value, (place / place.mean() - 1.0).ravel()])
        labels += [Label(0.0, "G", f"cell {k // CELLS[1]},{k % CELLS[1]}", members, held_out) for k in range(number)]
        size = len(covariance)
        centring = np.eye(number) - 1.0 / number
        shares = _cell_shares(red_rows.shape)
        # the cells are less their mean, which doesn't vary: it is given a cell's variance, for a matrix of full rank
        one = centring @ np.diag(shares) @ centring + np.mean(shares) / number
        bigger = np.zeros((size + number, size + number))
        bigger[:size, :size] = covariance
        bigger[size:, size:] = (dataset.noise.prnu**2 + noise) * one
        if held_out and False in images:
            # PRNU is the same in seen and held-out frames
            bigger[size:, size - number : size] = dataset.noise.prnu**2 * one
            bigger[size - number : size, size:] = dataset.noise.prnu**2 * one
        covariance = bigger
    cells = len(value) - len(ratios)

    def predict(effects: Effects) -> Prediction:
        greens = _Greens(dataset, acting(effects, GREENS))
        found, placed = greens.ratios(ratios), np.tile(greens.places() if cells else [], cells // number)
        model = Uniform(dataset.camera, effects)
        if model.strays:
            parted = np.array([_parted(r, dataset, model) for r in ratios])
            found = [ratio + float(own.mean()) for ratio, own in zip(found, parted, strict=True)]
            flat = [r.x == 0.0 for r in ratios]  # none where only narrowband light is there, or every flat is noisy
            of_flats = parted[flat if any(flat) else slice(None)].mean(0)
            placed = placed + np.tile(of_flats - of_flats.mean(), cells // number)
        return Prediction(np.concatenate([found, placed]), _line_gains(model, len(ratios), cells // number))

    return Observable(
        measurement=GREEN_BALANCE, reach=25.0, value=value, covariance=covariance, labels=tuple(labels),
        reads=GREENS | STRAYS, scattered_by=LINE_GAINS, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


def _rows_dn2(dataset: Dataset, levels: Sequence[FlatLevel]) -> float:
    """Variance of the greens' difference from frame to frame beyond shot and read noise, DN^2: row noise. It is reduced
    by about its uncertainty, so that chance isn't taken for row noise; at least 0."""
    excess, weights = 0.0, 0.0
    for u in levels:
        signal = u.mean["G2"]
        if len(u.ratios) > 1 and signal > 0:
            shot = _shot_dn2(dataset, signal)
            weight = (len(u.ratios) - 1) / shot**2
            excess += weight * (float(np.var(u.ratios, ddof=1)) * signal**2 - shot)
            weights += weight

    return max(excess / weights - weights**-0.5, 0.0) if weights > 0 else 0.0


def _shot_dn2(dataset: Dataset, signal: float) -> float:
    """Variance of the difference of the greens' means in one frame by shot and read noise, DN^2."""
    return (dataset.noise.gain * signal + dataset.noise.read_dn**2) * _share(*_green_shape(dataset))


def _green_shape(dataset: Dataset) -> tuple[int, int]:
    """Rows and columns of the green pixels that `green_planes` compares."""
    return dataset.camera.rows // 2 - 1, dataset.camera.cols // 2 - 1


def _share(rows: FloatArray | int, cols: FloatArray | int) -> Any:
    """Variance of the difference of two means, for pixels of variance 1: of n = rows x cols green pixels, and of the
    means of their four neighbours.

    The first has 1 / n. The second is over (rows + 1) x (cols + 1) pixels, which count half at a border: along a side
    of m its sum of squared weights is (m - 1/2) / m^2.
    """
    count = rows * cols
    return 1.0 / count + (rows - 0.5) * (cols - 0.5) / count**2


def _cell_shares(shape: tuple[int, int]) -> FloatArray:
    """`_share` of each of the CELLS, (cells,)."""
    rows, cols = (np.diff(np.linspace(0, n, k + 1).astype(int)) for n, k in zip(shape, CELLS, strict=True))
    return np.asarray(_share(rows[:, None], cols[None, :])).ravel()


def _by_level(dataset: Dataset, levels: Sequence[FlatLevel], rows_dn2: float) -> list[_Ratio]:
    """Return the ratios of flats, one a level."""
    found = []
    for u in levels:
        signal = u.mean["G2"]
        if signal <= 0:
            continue
        dn2 = (_shot_dn2(dataset, signal) + rows_dn2) / len(u.ratios) + 2.0 * (BLACK_FLOOR_DN * dataset.step_dn) ** 2
        std = float(np.sqrt(dn2)) / signal
        c = u.captures[0]
        mean = {"R": u.mean["R"], "G": 0.5 * (u.mean["G1"] + signal), "B": u.mean["B"]}
        found.append(
            _Ratio(float(np.mean(u.ratios)), std, 0.0, f"{signal:.4g} DN", tuple(c.id for c in u.captures), u.held_out,
            mean, c.exposure_s, dataset.elapsed_s(c))
        )  # fmt: skip
    return found


def _by_wavelength(dataset: Dataset, rows_dn2: float) -> list[_Ratio]:
    """Return the ratios of unclipped narrowband captures, one a capture."""
    found = []
    groups = dataset.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s, c.radiance))
    for i, group in enumerate(groups):
        for capture in group:
            if dataset.levels(capture).mean["G"] is None:
                continue
            frame = np.asarray(dataset.recordings.frame(capture), np.float32) - np.float32(
                dark_level_dn(dataset, capture)
            )
            own = {n: float(p.mean(dtype=float)) for n, p in mosaic.planes(frame, dataset.camera.cfa).items()}
            signal = own["G2"]
            if signal < 5.0:
                continue
            dn2 = _shot_dn2(dataset, signal) + rows_dn2 + 2.0 * (BLACK_FLOOR_DN * dataset.step_dn) ** 2
            found.append(
                _Ratio(
                    green_ratio(dataset, frame), float(np.sqrt(dn2)) / signal, capture.wavelength_nm,
                    f"{capture.wavelength_nm:g} nm", (capture.id,), i % 3 == 1, {"R": own["R"],
                    "G": 0.5 * (own["G1"] + signal), "B": own["B"]},
                    capture.exposure_s, dataset.elapsed_s(capture),
                )
            )  # fmt: skip
    return found


#: Quantities of the stages by which neighbouring pixels differ in uniform light. A light that changes from row to row
#: isn't among them: a green is held against the mean of the rows above and below.
KERNELS = TRAILS | {"charge.kernels"}
GREENS = COLLECTED | KERNELS


class _Greens:
    """The two greens in even light, as effects leave them."""

    def __init__(self, dataset: Dataset, effects: Effects) -> None:
        self._dataset, self._effects, self._model = dataset, effects, Uniform(dataset.camera, effects)
        both = [green_lines(dataset.camera, axis, comb) for axis, comb in enumerate(self._model.read_combs())]
        # of the greens on red rows, and of their neighbours: what each cell's lines read of those of a phase
        self._down, self._across = (
            [_line_cells(one, count) for one in pair] for pair, count in zip(both, CELLS, strict=True)
        )
        self._whole = [(down.mean(1), across.mean(1)) for down, across in zip(*both, strict=True)]

    def ratios(self, ratios: Sequence[_Ratio]) -> list[float]:
        """Return the greens' ratios less 1 over the frame, in light that is read with the ratios' mean signals."""
        if not self._effects:
            return [0.0] * len(ratios)
        if acting(self._effects, KERNELS):  # by how much depends on what the other colours hold
            return [self._ratio(one) for one in ratios]
        return [self._ratio(ratios[0])] * len(ratios)

    def _ratio(self, ratio: _Ratio) -> float:
        light, cfa = self._light(ratio.mean), self._dataset.camera.cfa
        if acting(self._effects, COLLECTED):
            tile = mosaic.assemble({c: np.full((TILE_ROWS, TILE_COLS), e) for c, e in light.items()}, cfa)
            tile = collected_mosaic(
                self._dataset.camera, tile, self._effects, exposure_s=ratio.exposure_s, elapsed_s=ratio.elapsed_s
            )
            phases = phase_means(tile, cfa)
        else:
            phases = self._model.phases_of(light)
        red, blue = (float(down @ phases @ across) for down, across in self._whole)
        return red / max(blue, 1e-9) - 1.0

    def places(self) -> FloatArray:
        """Return the ratios of the cells over their mean, less 1 (cells,), in the light of flats."""
        if not self._model.trails:
            return np.zeros(CELLS[0] * CELLS[1])
        phases = self._model.phases_of(self._light(brightest_signal(self._dataset)))
        red, blue = (down @ phases @ across.T for down, across in zip(self._down, self._across, strict=True))
        place = red / blue
        return np.asarray(place / place.mean() - 1.0).ravel()

    def _light(self, read: Mapping[str, float]) -> dict[str, float]:
        """Electrons of the light of which these mean signals are read, DN."""
        gain = self._dataset.noise.gain
        return self._model.light_of({c: max(m, 0.0) / gain for c, m in read.items()})


def _line_cells(lines: FloatArray, count: int) -> FloatArray:
    """Means (count, step) of values by line (step, greens) over a side's cells."""
    edges = np.linspace(0, lines.shape[1], count + 1).astype(int)
    return np.asarray(np.add.reduceat(lines, edges[:-1], axis=1) / np.diff(edges)).T


def _parted(ratio: _Ratio, dataset: Dataset, model: Uniform) -> FloatArray:
    """Return by how much the greens' ratio grows in each cell (cells,) by light that falls on the next pixels."""
    rows, cols = CELLS
    place = FieldPoints.of(dataset.camera, 4 * rows, 4 * cols)
    more = model.part_greens({c: np.array(m) for c, m in ratio.mean.items()}, place) / max(ratio.mean["G"], 1e-9)
    return np.asarray(more.reshape(rows, 4, cols, 4).mean((1, 3)).ravel())


def _line_gains(model: Uniform, ratios: int, parts: int) -> dict[str, FloatArray]:
    """Jacobian of all numbers by gains of rows and columns: greens lie on even and on odd ones of both, and the means
    of n lines differ by sqrt(4 / n) of a line's standard deviation. `ratios` are of whole frames; `parts` times the
    cells' follow, less their mean."""
    rows, cols = CELLS
    found = {}
    counts: dict[Lines, tuple[int, int]] = {"rows": (rows, model.camera.rows), "columns": (cols, model.camera.cols)}
    for lines, (cells, count) in counts.items():
        std = model.line_gain_std(lines)
        if std == 0.0:
            continue
        for k in range(cells):
            at = np.eye(cells)[k] - 1.0 / cells
            placed = np.tile(np.repeat(at, cols) if lines == "rows" else np.tile(at, rows), parts)
            whole = np.full(ratios, 1.0 / cells)
            one = 2.0 * std / np.sqrt(count / cells)
            found[f"green_balance:gains of {lines}:{k}"] = one * np.concatenate([whole, placed])
    return found


def _cell_means(plane: FloatArray) -> FloatArray:
    rows, cols = (np.linspace(0, n, k + 1).astype(int) for n, k in zip(plane.shape, CELLS, strict=True))
    sums = np.add.reduceat(np.add.reduceat(np.asarray(plane, float), rows[:-1], 0), cols[:-1], 1)
    return np.asarray(sums / np.outer(np.diff(rows), np.diff(cols)))


GREEN_BALANCE = Measurement(
    "green_balance",
    title="balance of the two greens",
    order=250,
    axis="wavelength",
    unit="nm",
    make=measure_green_balance,
    quantity="green over green, less 1",
)
