"""All blocks of one side together: one Gaussian model of everything that was measured, for any set of effects.

y ~ N(m(effects), C),  C = noise + floors + J P J' (free quantities, marginalised) + sum_k eps_k^2 (dm_k dm_k') o K

The last term is an effect's form tolerance: its law may be wrong by eps_k of its own change dm_k, smoothly along the axis.
What is held out of choice and fit is judged by its distribution given the rest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, eigh, solve_triangular

from lab.diagnose.measurements.summaries import Block, Effects, Prediction
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.spectrum import FloatArray

#: Share of every variance that keeps covariances positive against rounding.
ROUNDING = 1e-9
#: Of a correlation matrix: what its directions' variance is at least where it isn't positive definite.
LEAST_SIZE = 1e-4
#: Covariances within blocks are kept up to so many numbers in all.
KEPT_NUMBERS = 2e7


@dataclass(frozen=True)
class Within:
    """Covariance of one block's numbers by itself: noise, floors, the errors of laws, and the free quantities that only it has."""

    covariance: FloatArray

    @cached_property
    def lower(self) -> FloatArray:
        """Cholesky's factor; of covariances estimated from frames, directions that came out negative are given a little."""
        try:
            return np.asarray(cholesky(self.covariance, lower=True, check_finite=False))
        except LinAlgError:
            scale = np.sqrt(np.diag(self.covariance))
            size, vectors = eigh(self.covariance / np.outer(scale, scale))
            mended = (vectors * np.maximum(size, LEAST_SIZE)) @ vectors.T
            return np.asarray(cholesky(mended * np.outer(scale, scale), lower=True, check_finite=False))


@dataclass(frozen=True)
class Gaussian:
    """Mean and covariance of numbers under one set of effects: C = D + F F', D block by block, F the slopes by free
    quantities that several blocks have, which alone tie them to each other. Inverted as such, C costs what its largest block does."""

    mean: FloatArray
    within: tuple[Within, ...]
    free: FloatArray  # (n, k)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        ends = np.cumsum([len(w.covariance) for w in self.within])
        return tuple(slice(int(e) - len(w.covariance), int(e)) for w, e in zip(self.within, ends, strict=True))

    @cached_property
    def covariance(self) -> FloatArray:
        """Of all numbers, (n, n)."""
        whole = self.free @ self.free.T
        for one, at in zip(self.within, self.slices, strict=True):
            whole[at, at] += one.covariance
        return np.asarray(whole)

    def of(self, index: int) -> FloatArray:
        """Covariance of one block's numbers."""
        free = self.free[self.slices[index]]
        return np.asarray(self.within[index].covariance + free @ free.T)

    def plus(self, index: int, kernel: FloatArray) -> Gaussian:
        """With a discrepancy of that covariance in one block."""
        more = Within(self.within[index].covariance + kernel)
        return replace(self, within=(*self.within[:index], more, *self.within[index + 1 :]))

    @cached_property
    def _ties(self) -> tuple[FloatArray, FloatArray]:
        """Left singular vectors and values of D^-1/2 F, from the few by few products of its columns: what is lost beside the largest
        value is far below 1, next to which only they count."""
        split = self._split(self.free)
        square, v = eigh(split.T @ split) if split.shape[1] else (np.zeros(0), np.zeros((0, 0)))
        counts = square > 1e-12 + 1e-15 * float(square.max(initial=0.0))
        s = np.sqrt(square[counts])
        return (split @ v[:, counts]) / s, s

    def _split(self, table: FloatArray) -> FloatArray:
        """D^-1/2 times vectors, block by block; blocks on which they are nil cost nothing."""
        out = np.zeros_like(table)
        for one, at in zip(self.within, self.slices, strict=True):
            if table[at].any():
                out[at] = solve_triangular(one.lower, table[at], lower=True, check_finite=False)
        return out

    def white(self, table: FloatArray) -> FloatArray:
        """Vectors, (n,) or (n, m), in coordinates in which the covariance is 1: (1 + B B')^-1/2 D^-1/2 of them, B = D^-1/2 F."""
        split = self._split(table)
        u, s = self._ties
        less = 1.0 / np.sqrt(1.0 + s * s) - 1.0
        return np.asarray(split + (u * less) @ (u.T @ split))

    def solved(self, table: FloatArray) -> FloatArray:
        """C^-1 times vectors."""
        split = self._split(table)
        u, s = self._ties
        split = split - (u * (s * s / (1.0 + s * s))) @ (u.T @ split)
        out = np.zeros_like(split)
        for one, at in zip(self.within, self.slices, strict=True):
            out[at] = solve_triangular(one.lower, split[at], lower=True, trans="T", check_finite=False)
        return out

    def chi2(self, value: FloatArray) -> float:
        """(y - m)' C^-1 (y - m)."""
        white = self.white(value - self.mean)
        return float(white @ white)

    def log_likelihood(self, value: FloatArray) -> float:
        """Of y, without the constant."""
        diagonals = sum(float(np.log(np.diag(one.lower)).sum()) for one in self.within)
        return -0.5 * self.chi2(value) - diagonals - 0.5 * float(np.log1p(np.square(self._ties[1])).sum())


class _Numbered(NamedTuple):
    number: int
    acts: tuple[bool, ...]  # on which blocks
    effect: Effect


@dataclass
class Evidence:
    """The blocks of one side, in one vector. Predictions are kept, as most effects act on a few blocks only. `always`: effects that
    the baseline has; they act first, and their laws may be wrong like those of others. `unstated`: slopes, (n,) per prior standard
    deviation, by what nobody states and no block leaves free by itself."""

    blocks: tuple[Block, ...]
    camera: CameraModel
    always: tuple[Effect, ...] = ()
    unstated: Mapping[str, FloatArray] = field(default_factory=dict)
    _kept: dict[tuple[int, ...], Prediction] = field(default_factory=dict)
    _laws: dict[tuple[bytes, tuple[int, ...]], Within] = field(default_factory=dict)
    _numbers: dict[Effect, int] = field(default_factory=dict)

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
    def _acting(self) -> dict[type[Effect], tuple[bool, ...]]:
        return {}

    def acts(self, effect: type[Effect]) -> tuple[bool, ...]:
        """On which blocks an effect may act."""
        if effect not in self._acting:
            self._acting[effect] = tuple(block.touched_by(effect) for block in self.blocks)
        return self._acting[effect]

    def acted_on(self, effect: Effect) -> list[int]:
        """The blocks that an effect acts on."""
        return [i for i, acting in enumerate(self.acts(type(effect))) if acting]

    def _numbered(self, acting: Effects) -> list[_Numbered]:
        """Effects with a number each, which keys can be made of at less cost than of all their values."""
        return [_Numbered(self._numbers.setdefault(e, len(self._numbers)), self.acts(type(e)), e) for e in acting]

    def _prediction(self, index: int, acting: list[_Numbered]) -> Prediction:
        here = [e for e in acting if e.acts[index]]
        key = index, *(e.number for e in here)
        if key not in self._kept:
            if len(self._kept) > 20000:
                self._kept.clear()
            self._kept[key] = self.blocks[index].predict(tuple(e.effect for e in here))
        return self._kept[key]

    def mean(self, effects: Effects = ()) -> FloatArray:
        """Prediction of everything, (n,)."""
        acting = self._numbered((*self.always, *effects))
        return np.concatenate([self._prediction(i, acting).mean for i in range(len(self.blocks))])

    def _columns(self, effects: Effects) -> dict[str, FloatArray]:
        """Slopes by every free quantity, (n,) each, per prior standard deviation; one that several blocks share is one column."""
        columns = dict(self.unstated)
        acting = self._numbered((*self.always, *effects))
        for index, at in enumerate(self.slices):
            for name, column in self._prediction(index, acting).slopes.items():
                columns.setdefault(name, np.zeros(len(self.value)))[at] = column
        return columns

    @cached_property
    def _lone(self) -> frozenset[str]:
        """Free quantities of one block only, which belong to the covariance within it."""
        count = Counter(name for i in range(len(self.blocks)) for name in self._prediction(i, []).slopes)
        return frozenset(name for name, blocks in count.items() if blocks == 1)

    def _free(self, effects: Effects) -> FloatArray:
        """The slopes by what several blocks share as a table, (n, k)."""
        columns = [c for name, c in self._columns(effects).items() if name not in self._lone]
        return np.column_stack(columns) if columns else np.zeros((len(self.value), 0))

    @cached_property
    def _kinship(self) -> tuple[FloatArray, ...]:
        """How alike the error of a law is at two points of a block: smooth along the axis, less so between channels and conditions."""
        found = []
        for block in self.blocks:
            x = block.position.reshape(len(block.value), -1)
            channel = np.array([label.channel for label in block.labels])
            condition = np.array([label.condition for label in block.labels])
            near = np.exp(-0.5 * np.square((x[:, None] - x) / block.reach).sum(-1))
            near = near * np.where(channel[:, None] == channel, 1.0, 0.7)
            if block.conditions and not block.places:
                near = near * np.where(condition[:, None] == condition, 1.0, 0.7)
            found.append(near)
        return tuple(found)

    def gaussian(self, effects: Effects = (), where: np.ndarray | None = None) -> Gaussian:
        """Mean and covariance under these effects, of everything or of the numbers that `where` (n,) marks."""
        where = np.ones(len(self.value), bool) if where is None else where
        acting = self._numbered((*self.always, *effects))
        within = tuple(self._within(index, acting, where) for index in range(len(self.blocks)))
        return Gaussian(self.mean(effects)[where], within, self._free(effects)[where])

    def seen_gaussian(self, effects: Effects = ()) -> Gaussian:
        """The same of the seen numbers only."""
        return self.gaussian(effects, self.seen)

    @property
    def seen_value(self) -> FloatArray:
        return self.value[self.seen]

    def _within(self, index: int, acting: list[_Numbered], where: np.ndarray) -> Within:
        only = where[self.slices[index]]
        here = [e for e in acting if e.acts[index]]
        key = only.tobytes(), (index, *(e.number for e in here))
        if key not in self._laws:
            if sum(w.covariance.size for w in self._laws.values()) > KEPT_NUMBERS:
                self._laws.clear()
            block, both = self.blocks[index], np.ix_(only, only)
            covariance = block.covariance[both].copy()
            model = self._prediction(index, here)
            lone = [slope[only] for name, slope in model.slopes.items() if name in self._lone]
            if lone:
                covariance += np.transpose(lone) @ np.array(lone)
            for i, one in enumerate(here):
                change = model.mean - self._prediction(index, [*here[:i], *here[i + 1 :]]).mean
                error = one.effect.form_tolerance * change[only]
                if error.any():
                    covariance += error[:, None] * self._kinship[index][both] * error
            # measurements of the same frames leave directions whose variance rounding could make negative
            covariance[np.diag_indices_from(covariance)] *= 1.0 + ROUNDING
            self._laws[key] = Within(covariance)
        return self._laws[key]

    def shown(self, effect: Effect, others: Effects, index: int) -> float:
        """What an effect changes in one block beside others: sum of squares, in the numbers' own standard deviations."""
        at = self.slices[index]
        change = self.mean((*others, effect))[at] - self.mean(others)[at]
        return float(np.sum(np.square(change) / np.diag(self.blocks[index].covariance)))

    def seat(self, effect: Effect, effects: Effects) -> int:
        """The block in which an effect shows most beside the others of a set."""
        others = tuple(e for e in effects if e.name != effect.name)
        return max(self.acted_on(effect), key=lambda i: self.shown(effect, others, i), default=0)

    def pull(self, effects: Effects = (), processes: Mapping[int, FloatArray] | None = None) -> FloatArray:
        """C^-1 (y - m) of the seen numbers, nil at the others, (n,): what any part J P J' of C, times this, has of the residual.
        `processes`: covariances of discrepancies by the block's index, on top."""
        model = self.seen_gaussian(effects)
        for index, kernel in (processes or {}).items():
            seen = self.seen[self.slices[index]]
            model = model.plus(index, kernel[np.ix_(seen, seen)])
        found = np.zeros(len(self.value))
        found[self.seen] = model.solved(self.seen_value - model.mean)
        return found

    def quantities(self, effects: Effects = (), processes: Mapping[int, FloatArray] | None = None) -> dict[str, float]:
        """Where the seen numbers put the free quantities, by name, in prior standard deviations from their first guess."""
        pull = self.pull(effects, processes)
        return {name: float(column @ pull) for name, column in self._columns(effects).items()}

    def levelled(self, effects: Effects = (), processes: Mapping[int, FloatArray] | None = None) -> FloatArray:
        """Prediction of everything with the free quantities there, and with the processes' means, (n,)."""
        found = self.quantities(effects, processes)
        moved = sum(found[name] * column for name, column in self._columns(effects).items())
        return np.asarray(self.mean(effects) + moved + self.discrepant(effects, processes or {}))

    def discrepant(self, effects: Effects, processes: Mapping[int, FloatArray]) -> FloatArray:
        """Mean of the processes given the seen numbers, at everything, (n,)."""
        mean = np.zeros(len(self.value))
        if processes:
            pull = self.pull(effects, processes)
            for index, kernel in processes.items():
                mean[self.slices[index]] = kernel @ pull[self.slices[index]]
        return mean

    def touched(self, effect: type[Effect]) -> np.ndarray:
        """Numbers that an effect may change."""
        mask = np.zeros(len(self.value), bool)
        for touched, at in zip(self.acts(effect), self.slices, strict=True):
            mask[at] = touched
        return mask

    def held_out(
        self, effects: Effects = (), where: np.ndarray | None = None, processes: Mapping[int, FloatArray] | None = None
    ) -> tuple[float, int]:
        """chi2 and number of the held-out numbers, given the seen ones, under these effects. `processes` predict by their means
        alone: they make nothing less sure."""
        out = ~self.seen if where is None else ~self.seen & where
        if not out.any():
            return 0.0, 0
        # p(held out | seen) = p(both) / p(seen)
        both = self.seen | out
        value = self.value - self.discrepant(effects, processes or {})
        all_of = self.gaussian(effects, both).chi2(value[both])
        given = self.seen_gaussian(effects).chi2(value[self.seen])
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


def conditional(
    residual: FloatArray, covariance: FloatArray, of: np.ndarray, given: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Residual and covariance of some numbers, given others."""
    inside = cholesky(covariance[np.ix_(given, given)], lower=True), True
    gain = cho_solve(inside, covariance[np.ix_(given, of)])
    return residual[of] - gain.T @ residual[given], covariance[np.ix_(of, of)] - gain.T @ covariance[np.ix_(given, of)]
