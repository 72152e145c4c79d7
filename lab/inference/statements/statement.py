"""What a statement declares that may be wrong, and the list of all.

With a wrong statement the numbers y are as they were measured, and their prediction is an affine function of that by
the stated value: m' = A(u) m + b(u) of some of the numbers. It is the prediction by the value that would be right."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

import lab.inference.statements
from lab.capture_kinds.base import Capture
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.inference.hypotheses import Alternative, Coordinate, Hypothesis
from lab.inference.model import Point
from lab.observables.gaussian import ROUNDING, BlockCovariance, Gaussian
from lab.observables.observable import Label, Measurement
from sim.camera import Side
from sim.effects.families import Family
from sim.spectrum import FloatArray

#: The most alternatives of one statement that are kept: those that fit best by themselves. Two of 31 lights can be
#: exchanged in 465 ways.
MOST_ALTERNATIVES = 12


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers of a model, with the captures that they were measured from, and what is stated of the camera. `rate`:
    electrons a second by the baseline of a capture, a number's label and a channel."""

    model: MeasurementModel
    captures: Mapping[str, Capture]
    stated: DataSheet
    rate: Callable[[Capture, Label, str], float]

    def of(self, *measurements: Measurement) -> Iterator[tuple[int, Label, tuple[Capture, ...]]]:
        """Yield index, label and captures of every number of these measurements."""
        for block, at in zip(self.model.blocks, self.model.slices, strict=True):
            if block.measurement in measurements:
                for index, label in zip(range(at.start, at.stop), block.labels, strict=True):
                    yield index, label, tuple(self.captures[name] for name in label.captures)


@dataclass(frozen=True)
class AffineChange:
    """m' = A m + b of the numbers `rows` (r,), the others as they were. `matrix` (r, r): A; `offset` (r,): b; `spread`
    (r,): standard deviation of what the other value doesn't predict either (a channel that clips there); 0 elsewhere.
    """

    rows: NDArray[np.int64]
    matrix: FloatArray
    offset: FloatArray
    spread: FloatArray | None = None

    def on_mean(self, mean: FloatArray) -> FloatArray:
        """Return m' (n,)."""
        found = mean.copy()
        found[self.rows] = self.matrix @ mean[self.rows] + self.offset
        return found

    def on_columns(self, columns: FloatArray) -> FloatArray:
        """Return A times the columns (n, k) of a Jacobian."""
        found = columns.copy()
        found[self.rows] = self.matrix @ columns[self.rows]
        return found


#: Of some numbers: u (p,) -> change.
Changes = Callable[[FloatArray], AffineChange]


@dataclass(frozen=True, eq=False)
class Restatement:
    """A statement with one other value, or one value for each u.

    `on`: numbers -> their change by u. `starts`: values of u about which the change is nearly linear, one for each
    sign; of a restatement without a size, the empty tuple alone. `told`: what is stated and what fits, given u, its
    standard deviation, the recordings and the side."""

    on: Callable[[Numbers], Changes]
    told: Callable[[RecordingSet, Side, FloatArray, FloatArray], Told]
    starts: tuple[tuple[float, ...], ...] = ((),)
    measurement: Measurement | None = None
    form_tolerance: float = field(default=0.0, init=False)


@dataclass(frozen=True)
class Told:
    """A wrong statement in words, and the recordings with the value that fits, or without the captures.

    `where`, `shape`, `check`, `captures`, `correction`: as of `lab.formats.results.Unexplained`."""

    where: str
    shape: str
    check: str
    captures: tuple[str, ...]
    corrected: RecordingSet
    correction: str = "the value that fits is taken in its place"


@dataclass(frozen=True)
class Statement:
    """The declaration of a statement that may be wrong, in its module, where `statements` finds it.

    `coordinates`: of u, the departure from what is stated, with its prior; none of a statement with listed
    alternatives. `restatements`: numbers -> all other values that these can tell, equally probable."""

    name: str
    coordinates: tuple[Coordinate, ...]
    restatements: Callable[[Numbers], Sequence[Restatement]]

    def hypothesis(self, numbers: Numbers) -> Hypothesis | None:
        """Return the statement as a hypothesis; None where these numbers can't show that it is wrong.

        Of more than `MOST_ALTERNATIVES` alternatives those are kept that fit best about the empty set."""
        every = self.restatements(numbers)
        kept = _best(numbers, every) if len(every) > MOST_ALTERNATIVES else list(every)
        if not kept:
            return None
        log_share = float(np.log(len(kept) / len(every)))
        alternatives = []
        for one in kept:
            points = tuple(Point(np.array(u), one) for u in one.starts)
            scales = tuple(
                1.0 / max(float(np.linalg.norm([x / c.scale for x, c in zip(u, self.coordinates, strict=True)])), 1e-9)
                if u
                else 1.0
                for u in one.starts
            )
            alternatives.append(Alternative(points, scales, not self.coordinates, log_share))
        cost = float(np.log(len(every)))
        return Hypothesis(
            self.name, Family.METADATA.value, self.coordinates, tuple(alternatives), log_prior=lambda point: -cost
        )


def _best(numbers: Numbers, every: Sequence[Restatement]) -> list[Restatement]:
    """Return the alternatives with the largest likelihood ratios log p(y | m') - log p(y | m) at one covariance: of one
    with a size, of whatever sign, at its likeliest size."""
    gaussian, base = numbers.model.gaussian((), None, 0.0), numbers.model.mean()
    changes = np.column_stack([one.on(numbers)(np.array(one.starts[0])).on_mean(base) - base for one in every])
    white = gaussian.whiten(np.column_stack([changes, numbers.model.value - base]))
    z, square = white[:, :-1].T @ white[:, -1], np.maximum(np.square(white[:, :-1]).sum(axis=0), 1e-300)
    has_size = np.array([bool(one.starts[0]) for one in every])
    gain = np.where(has_size, 0.5 * np.square(z) / square, z - 0.5 * square)
    return [every[int(k)] for k in np.argsort(-gain)[:MOST_ALTERNATIVES]]


def restated(
    model: MeasurementModel, gaussian: Gaussian, changes: Sequence[AffineChange], effects: Sequence[object]
) -> Gaussian:
    """Return the Gaussian of a model under some effects with the changes of wrong statements: of the mean, and of the
    Jacobian by nuisance parameters, which is part of the covariance."""
    mean, shared = gaussian.mean, gaussian.shared_jacobian
    own = _own_columns(model, effects)
    blocks = list(gaussian.blocks)
    for change in changes:
        mean, shared, own = change.on_mean(mean), change.on_columns(shared), change.on_columns(own)
        for k, at in enumerate(model.slices):
            inside = (change.rows >= at.start) & (change.rows < at.stop)
            if not inside.any():
                continue
            covariance = model.blocks[k].covariance + own[at] @ own[at].T
            if change.spread is not None:
                more = np.zeros(at.stop - at.start)
                more[change.rows[inside] - at.start] = change.spread[inside]
                covariance = covariance + np.diag(np.square(more))
            covariance[np.diag_indices_from(covariance)] *= 1.0 + ROUNDING
            blocks[k] = BlockCovariance(covariance)
    return Gaussian(mean, tuple(blocks), shared)


def _own_columns(model: MeasurementModel, effects: Sequence[object]) -> FloatArray:
    """Columns (n, k) of the Jacobian by nuisance parameters of one block alone."""
    every = model.nuisance_jacobian(tuple(effects))  # type: ignore[arg-type]
    columns = [every[name] for name in model.single_block_nuisances if name in every]
    return np.column_stack(columns) if columns else np.zeros((len(model.value), 0))


@cache
def statements() -> tuple[Statement, ...]:
    """Return all statements that may be wrong: every module of this package is searched for declarations."""
    found: dict[str, Statement] = {}
    package = lab.inference.statements
    for module in pkgutil.iter_modules(package.__path__):
        content = importlib.import_module(f"{package.__name__}.{module.name}")
        for item in vars(content).values():
            if isinstance(item, Statement):
                found[item.name] = item
    return tuple(sorted(found.values(), key=lambda one: one.name))


def hypotheses_of_statements(numbers: Numbers) -> dict[str, Hypothesis]:
    """Return every statement that these numbers can show to be wrong, as a hypothesis."""
    found = {one.name: one.hypothesis(numbers) for one in statements()}
    return {name: hypothesis for name, hypothesis in found.items() if hypothesis is not None}


def light_of(capture: Capture) -> Hashable:
    """Return what tells a capture's light from others: its wavelength, else its reading."""
    return getattr(capture, "wavelength_nm", None) or getattr(capture, "radiance", None)


def restated_camera(recordings: RecordingSet, side: Side, **values: object) -> RecordingSet:
    """Return the recordings with other values stated of the camera of `side`."""
    manifest = recordings.manifest
    camera = manifest.cameras[side].model_copy(update=values)
    return recordings.under(manifest.model_copy(update={"cameras": {**manifest.cameras, side: camera}}))
