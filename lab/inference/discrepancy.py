"""Small physics that no list has: groups of disturbances, each of a state of the chain of light, with everyday scales.

A group's disturbance is a Gaussian process along the coordinate of its state: linear between nodes, whose values have a
squared-exponential kernel of unit variance and a correlation length of two nodes (of the transmittance 15 nm). Its
columns H are the changes of the whole prediction by it, so that an unlisted blur moves edges and screens by one
function. Where no law of `sim` has the state (noise by line, defective pixels, codes), the process acts on the
observables of that state, along their own axis, as a share of their scale."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.inference.model import Group
from lab.observables.dataset import Dataset
from lab.observables.observable import Observable
from sim.effects.base import Effect
from sim.effects.empirical_law import PLACES, Along, EmpiricalLaw, Of, Stage
from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.effects.screen_gamma import ScreenGamma
from sim.spectrum import FloatArray

#: Change of a node for the differences: small, so that they are derivatives; of factors 1 %.
_STEP = 0.01
#: Correlation length of a process in nodes.
_NODES_CORRELATED = 2.0
#: Distance of the nodes of the transmittance, nm, and their correlation length in nodes: coatings ripple with periods
#: of some tens of nm.
_SPECTRAL_STEP_NM, _SPECTRAL_CORRELATED, _MOST_SPECTRAL = 10.0, 1.5, 48
#: Nodes of the transfer function, cycles a pixel: closer towards 0, where a halo of some pixels acts.
_TRANSFER_NODES = (0.0, 0.01, 0.03, 0.06, 0.12, 0.2, 0.32, 0.46, 0.64, 0.82, 1.0)
#: Widths of the borders of a screen's cells at which their exponent varies, px.
_RIMS_PX = (0.0, 0.3)
#: Correlation between two channels, and between two conditions, of one observable.
_BETWEEN = 0.7
#: Columns of a group that are kept, by what they may change at its largest scale: variances, in the numbers' noise.
MOST_COLUMNS, LEAST_VARIANCE = 24, 1e-2


@dataclass(frozen=True)
class GroupDeclaration:
    """A group: its everyday scale s_g in its unit, the largest that unlisted physics may have, and the source of s_g.

    `observables`: those on which it acts directly."""

    name: str
    everyday: float
    unit: str
    source: str
    largest: float = 1.0
    observables: tuple[str, ...] = ()


TRANSFER, FIELD, SPECTRAL, RESPONSE, SOURCE, OFFSET, SHOT, BORDERS = (
    GroupDeclaration(
        "transfer", 0.002, "1, of the transfer function",
        "healthy sets of a simulator with transfer functions in closed form: 0.1 % at most; twice that for real lenses",
    ),
    GroupDeclaration(
        "field", 0.0005, "1, of the irradiance by place", "healthy sets: 0.03 % at most beside the free tilt and bow",
    ),
    GroupDeclaration(
        "spectral", 0.002, "1, of the transmittance by wavelength",
        "healthy sets: 0.1 % at most; coated windows ripple by twice that",
    ),
    GroupDeclaration(
        "response", 0.0005, "1, of the signal by level and exposure", "healthy sets: 0.015 %",
    ),
    GroupDeclaration(
        "source in time", 0.0005, "1, of the radiance by time", "stabilised lamps drift by less than 0.1 % in an hour",
    ),
    GroupDeclaration(
        "offset", 0.01, "read noise, of the offset by time, exposure and place",
        "healthy sets: 0.007 at most", largest=10.0,
    ),
    GroupDeclaration(
        "shot noise", 0.005, "1, of the temporal variance by level",
        "healthy sets: 1 % is not excluded",
    ),
    GroupDeclaration(
        "borders of cells", 0.05, "1, of the exponent of a screen's light by its drive",
        "a picture's file doesn't state how wide a screen draws the borders of cells: drawn with samples of 1/3 px, "
        "they have an exponent of 0.86",
    ),
)  # fmt: skip
ON_OBSERVABLES = (
    GroupDeclaration(
        "noise by line and pixel", 0.0005, "1, of the observable's scale", "healthy sets of two simulators",
        observables=(
            "dark_noise", "dark_row_noise", "dark_column_noise", "dark_row_pattern", "dark_column_pattern",
            "dark_correlation", "noise_tones", "amplifier_correlation", "noise_neighbours", "noise_skewness",
            "flat_rows", "level_repeats",
        ),
    ),
    GroupDeclaration(
        "defective pixels", 0.01, "1, of the observable's scale", "healthy sets of two simulators",
        observables=("defective_pixels", "flickering_pixels", "dark_events"),
    ),
    GroupDeclaration(
        "codes", 0.00005, "1, of the observable's scale", "healthy sets of two simulators",
        observables=("code_density",),
    ),
    GroupDeclaration(
        "gain by line", 0.00005, "1, of the observable's scale", "healthy sets of two simulators",
        observables=("green_balance", "flat_lines", "row_periods", "line_gains", "flat_pattern"),
    ),
    GroupDeclaration(
        "screens", 0.001, "1, of the observable's scale", "screens drawn to 1/55 px; drawn to 1/25 px they leave 0.7 %",
        observables=("screen", "bernoulli", "cell_borders", "ghost", "lateral_colour", "screen_grid"),
    ),
    GroupDeclaration(
        "charts", 0.002, "1, of the observable's scale", "healthy sets: 0.2 % is not excluded",
        observables=("chart",),
    ),
)  # fmt: skip
#: Everything that no group above holds.
GEOMETRY = GroupDeclaration(
    "geometry and pairs", 0.01, "1, of the observable's scale", "boards: 0.1 px beside Brown's distortion"
)


def groups_of(model: MeasurementModel, dataset: Dataset, used: int) -> tuple[Group, ...]:
    """Return the groups that move any number of a side, each with its strongest columns (`MOST_COLUMNS`).

    `model`: of the captures that are used, whose numbers are the first `used`, and of those that are held out."""
    where = np.arange(len(model.value)) < used
    gaussian = model.gaussian((), where, 0.0)
    base = model.mean()
    declared: list[tuple[GroupDeclaration, FloatArray]] = [
        (group, np.column_stack([*_columns(model, base, processes(dataset))] or [np.zeros((len(base), 0))]))
        for group, processes in _ON_STATES.items()
    ]
    taken = {name for group in ON_OBSERVABLES for name in group.observables}
    read = {b.measurement.name for b in model.blocks if b.reads and b.measurement.name not in taken}
    on_boards = tuple(sorted(n for n in read if _is_of_boards(model, n)))
    for group in (*ON_OBSERVABLES, GEOMETRY):
        names = group.observables or on_boards
        declared.append((group, _on_observables(model, names)))
    found = []
    for group, columns in declared:
        kept = _strongest(gaussian.whiten(columns[where]), columns, group.largest)
        if kept.shape[1]:
            found.append(
                Group(
                    group.name, kept[where], group.everyday, group.unit, group.source, group.largest, kept[~where]
                )
            )  # fmt: skip
    return tuple(found)


def _is_of_boards(model: MeasurementModel, name: str) -> bool:
    return any(b.measurement.name == name and b.measurement.order >= 500 for b in model.blocks)


def _strongest(white: FloatArray, columns: FloatArray, largest: float) -> FloatArray:
    """Return the principal directions of a group that may change the numbers beyond their noise."""
    if not columns.shape[1]:
        return columns
    size, vectors = eigh(white.T @ white)
    kept = np.flatnonzero(largest**2 * size > LEAST_VARIANCE)[-MOST_COLUMNS:]
    return np.asarray(columns @ vectors[:, kept])


@dataclass(frozen=True)
class _SmoothChange:
    """One process: a law with the value `v` at node k and none at the others, its nodes, and the unit in which it
    varies by 1."""

    law: Callable[[int, float], Effect]
    nodes: int
    unit: float = 1.0
    first: int = 0  # nodes before it are fixed
    correlated: float = _NODES_CORRELATED


def _columns(model: MeasurementModel, base: FloatArray, processes: Iterator[_SmoothChange]) -> Iterator[FloatArray]:
    for process in processes:
        own = []
        for k in range(process.first, process.nodes):
            law = process.law(k, _STEP * process.unit)
            own.append((model.mean((law,)) - base) / _STEP)
        table = np.column_stack(own)
        if table.any():
            x = np.arange(table.shape[1])
            kernel = np.exp(-0.5 * np.square((x[:, None] - x) / process.correlated)) + 1e-6 * np.eye(len(x))
            yield table @ np.linalg.cholesky(kernel)


def _curve(
    stage: Stage, along: Along, of: Of, at: Sequence[float] | FloatArray, unit: float = 1.0, first: int = 0
) -> _SmoothChange:
    """Return the process of a curve of `EmpiricalLaw` with its points at `at`."""
    none = PLACES[stage, along, of][1]
    points = tuple(float(x) for x in at)

    def law(k: int, value: float) -> Effect:
        table = [none] * len(points)
        table[k] = none + value
        return EmpiricalLaw(stage=stage, along=along, of=of, at=points, table=tuple(table), strength=1.0)

    return _SmoothChange(law, len(points), unit, first)


def _directed(shape: str, at: Sequence[float]) -> _SmoothChange:
    def law(k: int, value: float) -> Effect:
        factor = [1.0] * len(at)
        factor[k] += value
        curve = {"at": tuple(at), "factor": tuple(factor), "strength": 1.0}
        return ModelDiscrepancy.model_validate({"along": f"{shape}_frequency_cy_per_um"} | curve)

    return _SmoothChange(law, len(at), first=1)


def _transfer(dataset: Dataset) -> Iterator[_SmoothChange]:
    at = (np.array(_TRANSFER_NODES) / dataset.camera.pixel_pitch_um).tolist()
    yield _curve("image", "frequency", "mean", at, first=1)
    for shape in ("astigmatic", "diagonal", "chromatic"):
        yield _directed(shape, at)


def _field(dataset: Dataset) -> Iterator[_SmoothChange]:
    camera = dataset.camera
    corner_um = 0.5 * camera.pixel_pitch_um * float(np.hypot(camera.rows, camera.cols))
    yield _curve("image", "radius", "mean", np.linspace(0.0, corner_um, 5))
    yield _curve("image", "angle", "mean", np.linspace(0.0, 360.0, 9))


def _spectral(dataset: Dataset) -> Iterator[_SmoothChange]:
    stated = [c.wavelength_nm for c in dataset.recordings.captures("narrowband", dataset.side)]
    low, high = (min(stated), max(stated)) if stated else (400.0, 700.0)
    nodes = int(np.clip((high - low) / _SPECTRAL_STEP_NM, 4, _MOST_SPECTRAL)) + 1
    curve = _curve("image", "wavelength", "mean", np.linspace(low, high, nodes))
    yield replace(curve, correlated=_SPECTRAL_CORRELATED)


def _levels_e(dataset: Dataset) -> FloatArray:
    return np.geomspace(0.01, 1.0, 7) * dataset.camera.full_well_e


def _response(dataset: Dataset) -> Iterator[_SmoothChange]:
    yield _curve("signal", "level", "mean", _levels_e(dataset).tolist())
    exposures = sorted({float(c.exposure_s) for c in dataset.recordings.captures("flat", dataset.side)})
    if len(exposures) > 1:
        at = np.geomspace(max(exposures[0], 1e-6), exposures[-1], min(len(exposures), 6))
        yield _curve("charge", "exposure", "mean", at.tolist())


def _times_s(dataset: Dataset) -> FloatArray:
    times = sorted({dataset.elapsed_s(c) for c in dataset.recordings.captures(side=dataset.side)})
    return np.linspace(0.0, max(times[-1], 1.0), 7)


def _source(dataset: Dataset) -> Iterator[_SmoothChange]:
    yield _curve("light", "time", "mean", _times_s(dataset))


def _offset(dataset: Dataset) -> Iterator[_SmoothChange]:
    camera = dataset.camera
    unit = camera.read_noise_e
    corner_um = 0.5 * camera.pixel_pitch_um * float(np.hypot(camera.rows, camera.cols))
    yield _curve("signal", "time", "mean", _times_s(dataset), unit)
    yield _curve("signal", "radius", "mean", np.linspace(0.0, corner_um, 4), unit)
    for line in ("row", "column"):
        yield _curve("signal", line, "mean", np.linspace(0.0, 1.0, 6), unit)


def _shot(dataset: Dataset) -> Iterator[_SmoothChange]:
    yield _curve("charge", "level", "variance", _levels_e(dataset).tolist())


def _borders(_dataset: Dataset) -> Iterator[_SmoothChange]:
    yield _SmoothChange(lambda k, value: ScreenGamma(exponent=1.0 + value, rim_px=_RIMS_PX[k]), len(_RIMS_PX))


_ON_STATES: dict[GroupDeclaration, Callable[[Dataset], Iterator[_SmoothChange]]] = {
    TRANSFER: _transfer, FIELD: _field, SPECTRAL: _spectral, RESPONSE: _response, SOURCE: _source, OFFSET: _offset,
    SHOT: _shot, BORDERS: _borders,
}  # fmt: skip


def _on_observables(model: MeasurementModel, names: Sequence[str]) -> FloatArray:
    """Columns of processes along the axes of these observables, each by itself; one process for the numbers that are
    used and those that are held out."""
    n = len(model.value)
    columns = []
    for name in names:
        at = [k for k, block in enumerate(model.blocks) if block.measurement.name == name]
        if at:
            blocks = [model.blocks[k] for k in at]
            size, vectors = eigh(observable_kernel(*blocks))
            kept = np.flatnonzero(size > 1e-3 * size[-1])[-2 * MOST_COLUMNS :]
            own = np.zeros((n, len(kept)))
            scale = np.concatenate([b.scale for b in blocks])
            where = np.concatenate([np.arange(n)[model.slices[k]] for k in at])
            own[where] = scale[:, None] * vectors[:, kept] * np.sqrt(size[kept])
            columns.append(own)
    return np.concatenate(columns, axis=1) if columns else np.zeros((n, 0))


def observable_kernel(*blocks: Observable) -> FloatArray:
    """Kernel over the numbers of blocks of one measurement: squared exponential along the axis, reduced between
    channels and between conditions."""
    first = blocks[0]
    x = np.concatenate([b.position.reshape(len(b.value), -1) for b in blocks])
    labels = [label for b in blocks for label in b.labels]
    kernel = np.exp(-0.5 * np.square((x[:, None] - x) / first.reach).sum(-1))
    channel = np.array([label.channel for label in labels])
    condition = np.array([label.condition for label in labels])
    kernel = kernel * np.where(channel[:, None] == channel, 1.0, _BETWEEN)
    if first.measurement.conditions:
        kernel = kernel * np.where(condition[:, None] == condition, 1.0, _BETWEEN)
    return np.asarray(kernel)
