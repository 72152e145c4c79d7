"""All blocks of one side together: one Gaussian model of everything that was measured, for any set of effects.

y ~ N(m(effects), C),  C = noise + floors + J P J' (free quantities, marginalised) + sum_k eps_k^2 (dm_k dm_k') o K

The last term is an effect's form tolerance: its law may be wrong by eps_k of its own change dm_k, smoothly along the axis.
What is held out of choice and fit is judged by its distribution given the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from lab.diagnose.summaries import Block, Effects, Prediction
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.spectrum import FloatArray

#: Share of every variance that keeps covariances positive against rounding.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Gaussian:
    """Mean and covariance of all numbers under one set of effects."""

    mean: FloatArray
    covariance: FloatArray


@dataclass
class Evidence:
    """The blocks of one side, in one vector. Predictions are kept, as most effects act on a few blocks only. `always`: effects that
    the baseline has; they act first, and their laws may be wrong like those of others."""

    blocks: tuple[Block, ...]
    camera: CameraModel
    always: tuple[Effect, ...] = ()
    _kept: dict[tuple[int, tuple[Effect, ...]], Prediction] = field(default_factory=dict)

    @cached_property
    def value(self) -> FloatArray:
        return np.concatenate([b.value for b in self.blocks])

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        ends = np.cumsum([len(b.value) for b in self.blocks])
        return tuple(slice(int(e) - len(b.value), int(e)) for b, e in zip(self.blocks, ends, strict=True))

    @cached_property
    def seen(self) -> np.ndarray:
        """Which numbers choice and fit may see."""
        return np.array([not label.held_out for b in self.blocks for label in b.labels])

    @cached_property
    def _noise(self) -> FloatArray:
        covariance = np.zeros((len(self.value), len(self.value)))
        for block, at in zip(self.blocks, self.slices, strict=True):
            covariance[at, at] = block.covariance
        return covariance

    def _prediction(self, index: int, acting: Effects) -> Prediction:
        block = self.blocks[index]
        key = index, tuple(e for e in acting if block.touched_by(type(e)))
        if key not in self._kept:
            if len(self._kept) > 20000:
                self._kept.clear()
            self._kept[key] = block.predict(key[1])
        return self._kept[key]

    def mean(self, effects: Effects = ()) -> FloatArray:
        """Prediction of everything, (n,)."""
        return self._mean_of((*self.always, *effects))

    def _mean_of(self, acting: Effects) -> FloatArray:
        return np.concatenate([self._prediction(i, acting).mean for i in range(len(self.blocks))])

    def _columns(self, effects: Effects) -> dict[str, FloatArray]:
        """Slopes by every free quantity, (n,) each, per prior standard deviation; one that several blocks share is one column."""
        columns: dict[str, FloatArray] = {}
        for index, at in enumerate(self.slices):
            for name, column in self._prediction(index, (*self.always, *effects)).slopes.items():
                columns.setdefault(name, np.zeros(len(self.value)))[at] = column
        return columns

    def _free(self, effects: Effects) -> FloatArray:
        """The same as a table, (n, k)."""
        columns = self._columns(effects)
        return np.column_stack(list(columns.values())) if columns else np.zeros((len(self.value), 0))

    @cached_property
    def _kinship(self) -> FloatArray:
        """How alike the error of a law is at two points: smooth along the axis, less so between channels and conditions."""
        kin = np.zeros((len(self.value), len(self.value)))
        for block, at in zip(self.blocks, self.slices, strict=True):
            x = block.position.reshape(len(block.value), -1)
            channel = np.array([label.channel for label in block.labels])
            condition = np.array([label.condition for label in block.labels])
            near = np.exp(-0.5 * np.square((x[:, None] - x) / block.reach).sum(-1))
            near = near * np.where(channel[:, None] == channel, 1.0, 0.7)
            if block.conditions and not block.places:
                near = near * np.where(condition[:, None] == condition, 1.0, 0.7)
            kin[at, at] = near
        return kin

    def gaussian(self, effects: Effects = ()) -> Gaussian:
        """Mean and covariance of everything under these effects."""
        return self._gaussian(effects, np.ones(len(self.value), bool))

    def seen_gaussian(self, effects: Effects = ()) -> Gaussian:
        """The same of the seen numbers only."""
        return self._gaussian(effects, self.seen)

    @property
    def seen_value(self) -> FloatArray:
        return self.value[self.seen]

    @cached_property
    def _parts(self) -> dict[bytes, tuple[FloatArray, FloatArray]]:
        return {}

    def _gaussian(self, effects: Effects, where: np.ndarray) -> Gaussian:
        key = where.tobytes()
        if key not in self._parts:
            only = np.ix_(where, where)
            self._parts[key] = self._noise[only], self._kinship[only]
        noise, kinship = self._parts[key]
        mean = self.mean(effects)
        free = self._free(effects)[where]
        covariance = noise.copy()
        freed = np.flatnonzero(np.any(free != 0.0, axis=1))  # edges, the most of all numbers, have no free quantity
        covariance[np.ix_(freed, freed)] += free[freed] @ free[freed].T
        ends = np.cumsum([int(where[at].sum()) for at in self.slices])
        acting = (*self.always, *effects)
        for i, effect in enumerate(acting):
            change = mean - self._mean_of((*acting[:i], *acting[i + 1 :]))
            for at, end in zip(self.slices, ends, strict=True):
                error = effect.form_tolerance * change[at][where[at]]
                if error.any():
                    here = slice(int(end) - len(error), int(end))
                    covariance[here, here] += error[:, None] * kinship[here, here] * error
        # strong slopes leave directions whose variance rounding could make negative
        covariance[np.diag_indices_from(covariance)] *= 1.0 + ROUNDING
        return Gaussian(mean[where], covariance)

    def shown(self, effect: Effect, others: Effects, index: int) -> float:
        """What an effect changes in one block beside others: sum of squares, in the numbers' own standard deviations."""
        at = self.slices[index]
        change = self.mean((*others, effect))[at] - self.mean(others)[at]
        return float(np.sum(np.square(change) / np.diag(self.blocks[index].covariance)))

    def pull(self, effects: Effects = (), process: FloatArray | None = None) -> FloatArray:
        """C^-1 (y - m) of the seen numbers, nil at the others, (n,): what any part J P J' of C, times this, has of the residual.
        `process` (n, n): a discrepancy's covariance, on top."""
        model = self.gaussian(effects)
        covariance = model.covariance if process is None else model.covariance + process
        inside = cho_factor(covariance[np.ix_(self.seen, self.seen)], lower=True)
        found = np.zeros(len(self.value))
        found[self.seen] = cho_solve(inside, (self.value - model.mean)[self.seen])
        return found

    def quantities(self, effects: Effects = (), process: FloatArray | None = None) -> dict[str, float]:
        """Where the seen numbers put the free quantities, by name, in prior standard deviations from their first guess."""
        found = self._free(effects).T @ self.pull(effects, process)
        return dict(zip(self._columns(effects), found.tolist(), strict=True))

    def levelled(self, effects: Effects = ()) -> FloatArray:
        """Prediction of everything with the free quantities there, (n,)."""
        found = np.array(list(self.quantities(effects).values()))
        return np.asarray(self.mean(effects) + self._free(effects) @ found)

    def touched(self, effect: type[Effect]) -> np.ndarray:
        """Numbers that an effect may change."""
        mask = np.zeros(len(self.value), bool)
        for block, at in zip(self.blocks, self.slices, strict=True):
            mask[at] = block.touched_by(effect)
        return mask

    def held_out(self, effects: Effects = (), where: np.ndarray | None = None) -> tuple[float, int]:
        """chi2 and number of the held-out numbers, given the seen ones, under these effects."""
        out = ~self.seen if where is None else ~self.seen & where
        if not out.any():
            return 0.0, 0
        model = self.gaussian(effects)
        residual = self.value - model.mean
        both = self.seen | out
        # p(held out | seen) = p(both) / p(seen)
        all_of = chi2(residual[both], model.covariance[np.ix_(both, both)])
        given = chi2(residual[self.seen], model.covariance[np.ix_(self.seen, self.seen)])
        return max(all_of - given, 0.0), int(out.sum())

    def captures(self, held_out: bool, where: np.ndarray | None = None) -> tuple[str, ...]:
        labels = [label for b in self.blocks for label in b.labels]
        names: dict[str, None] = {}
        for i, label in enumerate(labels):
            if label.held_out == held_out and (where is None or where[i]):
                names.update(dict.fromkeys(label.captures))
        return tuple(sorted(names))


def chi2(residual: FloatArray, covariance: FloatArray) -> float:
    """residual' covariance^-1 residual."""
    white = solve_triangular(cholesky(covariance, lower=True), residual, lower=True)
    return float(white @ white)


def log_likelihood(residual: FloatArray, covariance: FloatArray) -> float:
    """Of a normal distribution, without the constant."""
    lower = cholesky(covariance, lower=True)
    white = solve_triangular(lower, residual, lower=True)
    return float(-0.5 * white @ white - np.log(np.diag(lower)).sum())


def conditional(
    residual: FloatArray, covariance: FloatArray, of: np.ndarray, given: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Residual and covariance of some numbers, given others."""
    inside = cholesky(covariance[np.ix_(given, given)], lower=True), True
    gain = cho_solve(inside, covariance[np.ix_(given, of)])
    return residual[of] - gain.T @ residual[given], covariance[np.ix_(of, of)] - gain.T @ covariance[np.ix_(given, of)]
