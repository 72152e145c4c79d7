"""Small physics that no list has: groups of disturbances, each of a state of the chain of light, with everyday scales.

The disturbances of a state are Gaussian processes, each along one coordinate: linear between nodes, whose values have a
squared-exponential kernel of unit variance and a correlation length of two nodes (of the transmittance 15 nm). Their
columns H are the changes of the whole prediction, so that an unlisted blur moves edges and screens by one function.
Where no law of `sim` has the state (noise by line, defective pixels), a process acts on an observable of that state,
along its own axis, as a share of its scale.

What is everyday acts along all coordinates of a state, with one scale: of n of them each has s_g / sqrt(n), so that s_g
is the standard deviation of their sum. Steps in time are one coordinate, a random walk of so many steps. What is
unlisted acts along one of them: one large process doesn't make the others of its state probable."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from scipy.linalg import eigh

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.inference.model import Group, Process
from lab.observables.dataset import Dataset
from lab.observables.observable import Label, Measurement, Observable
from sim.effects.base import Effect
from sim.effects.empirical_law import PLACES, Along, EmpiricalLaw, Of, Stage
from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.effects.screen_gamma import ScreenGamma
from sim.sensor import mosaic
from sim.spectrum import FloatArray

#: Change of a node for the differences: small, so that they are derivatives; of factors 0.01 %. What acts by its square
#: (shading on the power of rows) has a slope of 0 where it is absent; by steps of 1 % it had a hundredth of that at 1,
#: which let flats' rows decide on the shading. And that of the borders of a screen's cells.
_STEP, _STEP_OF_BORDERS = 0.0001, 0.01
#: Correlation length of a process in nodes.
_NODES_CORRELATED = 2.0
#: Distance of the nodes of the transmittance, nm, and their correlation length in nodes: coatings ripple with periods
#: of some tens of nm.
_SPECTRAL_STEP_NM, _SPECTRAL_CORRELATED, _MOST_SPECTRAL = 10.0, 1.5, 48
#: Nodes of the transfer function, cycles a pixel: closer towards 0, where a halo of some pixels acts.
_TRANSFER_NODES = (0.0, 0.01, 0.03, 0.06, 0.12, 0.2, 0.32, 0.46, 0.64, 0.82, 1.0)
#: Nodes by radius: lines between them follow a parabola to 0.4 % of its height.
_RADII = 9
#: Nodes about the axis: what has two lobes, as a saddle, is followed to 5 % by lines.
_ANGLES = 16
#: The most nodes by time, at captures; of each channel's; and the most captures between which a step is tried.
_MOST_TIMES, _FEW_TIMES, _MOST_STEPS = 12, 7, 33
#: The most nodes by exposure.
_MOST_EXPOSURES = 16
#: Codes after which a table of their widths repeats: the longest period of the combs that are counted.
_CODES_PERIOD = 8
#: Widths of the borders of a screen's cells at which their exponent varies, px.
_RIMS_PX = (0.0, 0.3)
#: Correlation between two channels, and between two conditions, of one observable.
_BETWEEN = 0.7
#: Columns of a group that are kept, by what they may change at its largest scale: variances, in the numbers' noise.
MOST_COLUMNS, MOST_ON_OBSERVABLE, LEAST_VARIANCE = 24, 12, 1e-2
#: Largest everyday scale, in s_g, at which directions count.
_EVERYDAY_MOST = 3.0


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


TRANSFER, FIELD, SPECTRAL, LINES, RESPONSE, SOURCE, OFFSET, SHOT, ROWS, BORDERS = (
    GroupDeclaration(
        "transfer", 0.002, "1, of the transfer function",
        "healthy sets of a simulator with transfer functions in closed form: 0.1 % at most; twice that for real lenses",
    ),
    GroupDeclaration(
        "field", 0.0005, "1, of the irradiance by place, and of the shortest exposure",
        "healthy sets: 0.03 % at most beside the free tilt and bow", observables=("flat_field",),
    ),
    GroupDeclaration(
        "spectral", 0.002, "1, of the transmittance by wavelength",
        "healthy sets: 0.1 % at most; coated windows ripple by twice that",
    ),
    GroupDeclaration(
        "narrowband wavelength", 0.02, "nm, of the displacement of narrowband light by wavelength",
        "repeatability of grating monochromators: 0.02 to 0.1 nm; healthy sets: none", largest=10.0,
    ),
    GroupDeclaration(
        "response", 0.00015, "1, of the signal by level and exposure",
        "healthy sets: 0.015 % at most; what real converters bend by more is a listed effect",
    ),
    GroupDeclaration(
        "source in time", 0.0005, "1, of the radiance by time, of an hour",
        "stabilised lamps drift by less than 0.1 % in an hour, and in shorter sessions by less in proportion",
    ),
    GroupDeclaration(
        "offset", 0.01, "read noise, of the offset by time, exposure and place",
        "healthy sets: 0.007 at most", largest=10.0, observables=("dark_field",),
    ),
    GroupDeclaration(
        "shot noise", 0.005, "1, of the temporal variance by level",
        "healthy sets: 1 % is not excluded",
    ),
    GroupDeclaration(
        "rows that repeat", 0.00005, "1, of the sensitivity by row", "healthy sets of two simulators",
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
        observables=("green_balance", "flat_lines", "line_gains", "flat_pattern"),
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
    declared: list[tuple[GroupDeclaration, list[_Columns]]] = [
        (group, [*_on_state(model, base, curves(dataset)), *_on_observables(model, group.observables, used)])
        for group, curves in _ON_STATES.items()
    ]
    taken = {name for group in ON_OBSERVABLES for name in group.observables}
    read = {b.measurement.name for b in model.blocks if b.reads and b.measurement.name not in taken}
    on_boards = tuple(sorted(n for n in read if _is_of_boards(model, n)))
    for group in (*ON_OBSERVABLES, GEOMETRY):
        tables = _TABLES.get(group.name)
        on_state = [] if tables is None else list(_on_state(model, base, tables(dataset)))
        declared.append((group, [*on_state, *_on_observables(model, group.observables or on_boards, used)]))
    found = []
    for group, processes in declared:
        if processes:
            white = gaussian.whiten(np.column_stack([p.columns[where] for p in processes]))
            found += list(_groups_of_state(group, processes, white, where))
    return tuple(found)


def _groups_of_state(
    declared: GroupDeclaration, processes: Sequence[_Columns], white: FloatArray, used: np.ndarray
) -> Iterator[Group]:
    """Yield what is everyday on a state, of all processes together, and each process by itself, which is unlisted.
    `white`: their columns at the `used` numbers, whitened."""
    name, unit, source = declared.name, declared.unit, declared.source
    share = np.concatenate([np.full(p.columns.shape[1], p.everyday) for p in processes])
    vectors = _strongest(white * share, _EVERYDAY_MOST * declared.everyday, MOST_COLUMNS)
    if vectors.shape[1]:
        kept = np.column_stack([p.columns for p in processes]) @ (share[:, None] * vectors)
        yield Group(name, kept[used], declared.everyday, unit, source, 0.0, kept[~used])
    first = 0
    for p in processes:
        count = p.columns.shape[1]
        own = _strongest(white[:, first : first + count], declared.largest, p.most)
        first += count
        if own.shape[1]:
            kept = p.columns @ own
            process = Process(p.factor @ own, p.factor @ (np.eye(count) - own @ own.T) @ p.factor.T, p.curve)
            least = 3.0 * p.everyday * declared.everyday
            yield Group(name, kept[used], 0.0, unit, source, declared.largest, kept[~used], process, least)


def _is_of_boards(model: MeasurementModel, name: str) -> bool:
    return any(b.measurement.name == name and b.measurement.order >= 500 for b in model.blocks)


def _strongest(white: FloatArray, largest: float, most: int) -> FloatArray:
    """Return the principal directions (R, r), `most` at most, of columns (n, R) that may change the numbers beyond
    their noise at a scale `largest`."""
    size, vectors = eigh(white.T @ white)
    kept = np.flatnonzero(largest**2 * size > LEAST_VARIANCE)[-most:]
    return np.asarray(vectors[:, kept])


@dataclass(frozen=True)
class _Columns:
    """Columns (n, m) of one process: changes of the numbers by independent standard normal coefficients. `factor` (k,
    m): those coefficients -> the process at its nodes. `most`: directions that are kept. `everyday`: its everyday scale
    over that of the state."""

    columns: FloatArray
    factor: FloatArray
    curve: StateCurve | ObservableCurve
    most: int
    everyday: float = 1.0


# --- processes on states of the chain ---------------------------------------------------------------------------------

#: Axes of `ModelDiscrepancy`, which turn with the frequency's direction or go with the wavelength.
Directed = Literal["astigmatic frequency", "diagonal frequency", "chromatic frequency"]
#: Least factor: a Gaussian process doesn't know that a quantity is positive.
_LEAST_FACTOR = 0.02


@dataclass(frozen=True)
class StateCurve:
    """A process along one axis of a state: its nodes `at`, and `unit`, by which the state changes where its value is 1.
    A table that repeats after `period` indices has no nodes. Values of the first `fixed` nodes are none. `curves`: of
    so many channels, one after the other. `everyday`: the everyday scale of the values, over that of the state."""

    stage: Stage
    along: Along | Directed
    of: Of
    at: tuple[float, ...]
    unit: float = 1.0
    period: int = 0
    fixed: int = 0
    curves: int = 1
    correlated: float = _NODES_CORRELATED
    everyday: float = 1.0

    @property
    def step(self) -> float:
        """Change of a node by which the prediction is differenced."""
        return _STEP

    @property
    def nodes(self) -> int:
        """Number of values."""
        return self.period or self.curves * (len(self.at) - self.fixed - self.is_closed)

    @property
    def is_step(self) -> bool:
        """Whether it changes once, between two points."""
        return self.fixed == 1 and len(self.at) == 2

    @property
    def is_closed(self) -> bool:
        """Whether the last node is the first one again."""
        return self.along == "angle"

    @property
    def none(self) -> float:
        """The value of the state's law that changes nothing."""
        if self.along in _DIRECTED:
            return 1.0
        return PLACES[self.stage, self.along, self.of][1]  # type: ignore[index]

    @property
    def kernel(self) -> FloatArray:
        """Covariance of the values at a scale of 1: alike along the nodes; independent in a table."""
        if self.period:
            return np.eye(self.period)
        x = np.arange(self.nodes // self.curves)
        apart = np.abs(x[:, None] - x)
        if self.is_closed:  # the chord, so that the kernel is positive definite
            apart = len(x) / np.pi * np.sin(np.pi * apart / len(x))
        own = np.exp(-0.5 * np.square(apart / self.correlated)) + 1e-6 * np.eye(len(x))
        return np.kron(np.eye(self.curves), own)

    def change(self, values: FloatArray) -> FloatArray:
        """Return the departures from no change at all points of the law, given the values (nodes,)."""
        change = self.unit * values
        if self.is_closed:
            return np.append(change, change[0])
        return np.concatenate([np.zeros(self.fixed), change])

    def law(self, values: FloatArray) -> Effect:
        """Return the effect that acts on the state so. Factors stay positive; what is added to a variance is 0 at
        least."""
        change = self.change(values)
        if self.along in _DIRECTED:
            factor = np.maximum(1.0 + change, _LEAST_FACTOR)
            curve = {"at": self.at, "factor": tuple(factor.tolist()), "strength": 1.0}
            return ModelDiscrepancy.model_validate({"along": _DIRECTED[self.along]} | curve)
        table = np.maximum(1.0 + change, _LEAST_FACTOR) if self.none == 1.0 else change
        if self.of != "mean" and self.none == 0.0:
            table = table - min(float(table.min()), 0.0)
        if self.period and self.none == 1.0:
            table = table / table.mean()
        return EmpiricalLaw(
            stage=self.stage, along=self.along, of=self.of, period=self.period, at=self.at,  # type: ignore[arg-type]
            table=tuple(table.tolist()), strength=1.0,
        )  # fmt: skip


_DIRECTED: dict[str, str] = {
    "astigmatic frequency": "astigmatic_frequency_cy_per_um",
    "diagonal frequency": "diagonal_frequency_cy_per_um",
    "chromatic frequency": "chromatic_frequency_cy_per_um",
}


@dataclass(frozen=True)
class BordersCurve(StateCurve):
    """The exponent of a screen's light by its drive, at widths `at` of the borders of cells, px."""

    @property
    def step(self) -> float:
        """Of 1 %: with the exponent, a border's width begins to act, which the shortest step would hold for a slope."""
        return _STEP_OF_BORDERS

    @property
    def none(self) -> float:
        """The exponent that changes nothing."""
        return 1.0

    def law(self, values: FloatArray) -> Effect:
        """Return the screen of the width at which the exponent departs most."""
        k = int(np.argmax(np.abs(values)))
        return ScreenGamma(exponent=1.0 + float(values[k]), rim_px=self.at[k])


def _on_state(model: MeasurementModel, base: FloatArray, curves: Iterable[StateCurve]) -> Iterator[_Columns]:
    curves = list(curves)
    steps = [curve for curve in curves if curve.is_step]
    coordinates = len(curves) - len(steps) + bool(steps)
    for curve in curves:
        own = [(model.mean((curve.law(curve.step * one),)) - base) / curve.step for one in np.eye(curve.nodes)]
        table = np.column_stack(own)
        if table.any():
            factor = np.asarray(np.linalg.cholesky(curve.kernel), float)
            share = 1.0 / np.sqrt(coordinates * (len(steps) if curve.is_step else 1))
            most = max(MOST_COLUMNS, curve.period)
            yield _Columns(table @ factor, factor, curve, most, curve.everyday * float(share))


def _points(at: Sequence[float] | FloatArray) -> tuple[float, ...]:
    return tuple(float(x) for x in at)


def _corner_um(dataset: Dataset) -> float:
    camera = dataset.camera
    return 0.5 * camera.pixel_pitch_um * float(np.hypot(camera.rows, camera.cols))


def _transfer(dataset: Dataset) -> Iterator[StateCurve]:
    at = _points(np.array(_TRANSFER_NODES) / dataset.camera.pixel_pitch_um)
    yield StateCurve("image", "frequency", "mean", at, fixed=1)
    for along in get_args(Directed):
        yield StateCurve("image", along, "mean", at, fixed=1)


def _field(dataset: Dataset) -> Iterator[StateCurve]:
    corner_um = _corner_um(dataset)
    yield StateCurve("image", "radius", "mean", _points(np.linspace(0.0, corner_um, _RADII)))
    yield StateCurve("image", "angle", "mean", _points(np.linspace(0.0, 360.0, _ANGLES + 1)))
    exposures = _exposures_s(dataset, ("flat",))
    if exposures:
        at = _points(np.linspace(0.0, corner_um, _RADII))
        yield StateCurve("charge", "radius x exposure", "mean", at, unit=exposures[0])


def _spectral(dataset: Dataset) -> Iterator[StateCurve]:
    low, high = _range_nm(dataset)
    nodes = int(np.clip((high - low) / _SPECTRAL_STEP_NM, 4, _MOST_SPECTRAL)) + 1
    at = _points(np.linspace(low, high, nodes))
    yield StateCurve("image", "wavelength", "mean", at, correlated=_SPECTRAL_CORRELATED)


def _lines_nm(dataset: Dataset) -> Iterator[StateCurve]:
    low, high = _range_nm(dataset)
    nodes = int(np.clip((high - low) / _SPECTRAL_STEP_NM, 4, _MOST_SPECTRAL)) + 1
    at = _points(np.linspace(low, high, nodes))
    yield StateCurve("light", "wavelength", "mean", at, correlated=_SPECTRAL_CORRELATED)


def _range_nm(dataset: Dataset) -> tuple[float, float]:
    stated = [c.wavelength_nm for c in dataset.recordings.captures("narrowband", dataset.side)]
    return (min(stated), max(stated)) if stated else (400.0, 700.0)


def _levels_e(dataset: Dataset) -> tuple[float, ...]:
    return _points(np.geomspace(0.01, 1.0, 7) * dataset.camera.full_well_e)


def _exposures_s(dataset: Dataset, kinds: Sequence[str]) -> list[float]:
    """Return the exposures of captures of these kinds, ascending."""
    found = {float(c.exposure_s) for kind in kinds for c in dataset.recordings.captures(kind, dataset.side)}
    return sorted(e for e in found if e > 0.0)


def _response(dataset: Dataset) -> Iterator[StateCurve]:
    yield StateCurve("signal", "level", "mean", _levels_e(dataset))
    exposures = _exposures_s(dataset, ("flat",))
    if len(exposures) > 1:
        at = np.geomspace(max(exposures[0], 1e-6), exposures[-1], min(len(exposures), 6))
        yield StateCurve("charge", "exposure", "mean", _points(at))


def _times_s(dataset: Dataset, most: int, kinds: Sequence[str | None] = (None,)) -> tuple[float, ...]:
    """Return the times of captures of these kinds (None: all), so many of them at most."""
    captures = (c for kind in kinds for c in dataset.recordings.captures(kind, dataset.side))
    times = sorted({dataset.elapsed_s(c) for c in captures}) or [0.0]
    few = np.unique(np.linspace(0, len(times) - 1, most).round().astype(int))
    return _points(np.array(times)[few]) if len(few) > 1 else (0.0, max(times[-1], 1.0))


def _steps(stage: Stage, at: Sequence[float], unit: float = 1.0) -> Iterator[StateCurve]:
    """Yield a step in time between each two of some captures: a process of one value."""
    for before, after in pairwise(at):
        yield StateCurve(stage, "time", "mean", (before, after), unit, fixed=1)


def _source(dataset: Dataset) -> Iterator[StateCurve]:
    lit = ("flat", "narrowband")
    at = _times_s(dataset, _MOST_TIMES, lit)
    curves = [StateCurve("light", "time", "mean", at), *_steps("light", _times_s(dataset, _MOST_STEPS, lit))]
    if len(dataset.channels) > 1:
        few = _times_s(dataset, _FEW_TIMES, lit)
        curves.append(StateCurve("light", "plane x time", "mean", few, curves=len(dataset.channels)))
    hours = (at[-1] - at[0]) / 3600.0
    yield from (replace(curve, everyday=min(hours, 1.0)) for curve in curves)


def _offset(dataset: Dataset) -> Iterator[StateCurve]:
    unit, corner_um = dataset.camera.read_noise_e, _corner_um(dataset)
    yield StateCurve("signal", "time", "mean", _times_s(dataset, _MOST_TIMES), unit)
    yield from _steps("signal", _times_s(dataset, _MOST_STEPS), unit)
    yield StateCurve("signal", "radius", "mean", _points(np.linspace(0.0, corner_um, _RADII)), unit)
    yield StateCurve("signal", "row", "mean", _points(np.linspace(0.0, 1.0, 6)), unit)
    yield StateCurve("signal", "column", "mean", _points(np.linspace(0.0, 1.0, 6)), unit)
    exposures = _exposures_s(dataset, ("dark", "flat"))
    if len(exposures) > 2:
        few = np.unique(np.linspace(0, len(exposures) - 1, _MOST_EXPOSURES).round().astype(int))
        yield StateCurve("signal", "exposure", "mean", _points(np.array(exposures)[few]), unit)
        at = _points(np.linspace(0.0, corner_um, _RADII))
        yield StateCurve("charge", "radius", "mean", at, unit / exposures[-1])


def _shot(dataset: Dataset) -> Iterator[StateCurve]:
    yield StateCurve("charge", "level", "variance", _levels_e(dataset))


def _borders(_dataset: Dataset) -> Iterator[StateCurve]:
    yield BordersCurve("light", "level", "mean", _RIMS_PX)


def _rows_that_repeat(_dataset: Dataset) -> Iterator[StateCurve]:
    yield StateCurve("charge", "row", "mean", (), period=mosaic.PERIOD_PX)


def _codes_that_repeat(_dataset: Dataset) -> Iterator[StateCurve]:
    yield StateCurve("codes", "code", "mean", (), period=_CODES_PERIOD)


_ON_STATES: dict[GroupDeclaration, Callable[[Dataset], Iterator[StateCurve]]] = {
    TRANSFER: _transfer, FIELD: _field, SPECTRAL: _spectral, LINES: _lines_nm, RESPONSE: _response, SOURCE: _source,
    OFFSET: _offset, SHOT: _shot, ROWS: _rows_that_repeat, BORDERS: _borders,
}  # fmt: skip
#: Tables that repeat, on states of groups whose other processes act on observables, by name.
_TABLES: dict[str, Callable[[Dataset], Iterator[StateCurve]]] = {"codes": _codes_that_repeat}


# --- processes on observables -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ObservableCurve:
    """A process along the axis of one observable, as a share of its numbers' scale. Its nodes are the numbers: those
    that are used, `used` of them, and those that are held out. `scale` (k,)."""

    measurement: Measurement
    labels: tuple[Label, ...]
    scale: FloatArray
    used: int


def _on_observables(model: MeasurementModel, names: Sequence[str], used: int) -> Iterator[_Columns]:
    """Yield processes along the axes of these observables, each by itself; one process for the numbers that are used
    and those that are held out."""
    n = len(model.value)
    for name in names:
        at = [k for k, block in enumerate(model.blocks) if block.measurement.name == name]
        if not at:
            continue
        blocks = [model.blocks[k] for k in at]
        size, vectors = eigh(observable_kernel(*blocks))
        kept = np.flatnonzero(size > 1e-3 * size[-1])[-2 * MOST_COLUMNS :]
        factor = vectors[:, kept] * np.sqrt(size[kept])
        scale = np.concatenate([b.scale for b in blocks])
        where = np.concatenate([np.arange(n)[model.slices[k]] for k in at])
        own = np.zeros((n, len(kept)))
        own[where] = scale[:, None] * factor
        labels = tuple(label for b in blocks for label in b.labels)
        curve = ObservableCurve(blocks[0].measurement, labels, scale, int(np.sum(where < used)))
        yield _Columns(own, factor, curve, MOST_ON_OBSERVABLE)


def law_error(block: Observable, kernel: FloatArray, change: FloatArray, is_invariant: bool) -> FloatArray:
    """Return the covariance (n, n) of the error of a law that changes an observable's numbers by `change` (n,), at an
    error of all of it. It is smooth along the axis (`observable_kernel`) and in the logarithm of the change, of a law
    that doesn't depend on the axis in that of the change as a share of the scale."""
    size = np.abs(change) / block.scale if is_invariant else np.abs(change)
    size = np.log(np.maximum(size, 1e-9 * max(float(size.max()), 1e-300)))
    alike = kernel * np.exp(-0.5 * np.square(size[:, None] - size))
    return np.asarray(change[:, None] * alike * change)


def depends_not_on_axis(block: Observable, law: type[Effect]) -> bool:
    """Whether a law doesn't depend on the axis of an observable."""
    return block.measurement.axis in law.invariances


def observable_kernel(*blocks: Observable, is_invariant: bool = False) -> FloatArray:
    """Kernel over the numbers of blocks of one measurement: squared exponential along the axis, 1 of a law that doesn't
    depend on it (`is_invariant`), reduced between channels and between conditions."""
    first = blocks[0]
    x = np.concatenate([b.position.reshape(len(b.value), -1) for b in blocks])
    labels = [label for b in blocks for label in b.labels]
    reach = np.inf if is_invariant else first.reach
    kernel = np.exp(-0.5 * np.square((x[:, None] - x) / reach).sum(-1))
    channel = np.array([label.channel for label in labels])
    condition = np.array([label.condition for label in labels])
    kernel = kernel * np.where(channel[:, None] == channel, 1.0, _BETWEEN)
    if first.measurement.conditions:
        kernel = kernel * np.where(condition[:, None] == condition, 1.0, _BETWEEN)
    return np.asarray(kernel)
