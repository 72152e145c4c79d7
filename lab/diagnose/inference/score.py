"""The score of every effect: how much of the residual its signature takes, nuisance parameters and known effects
projected out.

A signature is the change of the prediction by a small or typical instance of the effect (its prototypes), whitened by
the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.block import Effects
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.spectrum import FloatArray

#: Ridge on unit columns in non-negative least squares, a relative change of 1e-8: without it, the active set cycles
#: between columns that are all but equal.
RIDGE = 1e-4
#: A refit starts within this share of the way from `absent` to a bound.
INSIDE_BOUND = 0.9


#: Length of a whitened signature, in standard deviations of the noise, from which on an effect is looked for.
LEAST_SIGNATURE = 1e-6


@dataclass(frozen=True)
class Score:
    """S = |r|^2 - min over u >= 0 of |r - G u|^2, r the whitened residual, G the whitened signatures: the
    likelihood-ratio statistic of a small effect, twice the log-likelihood that it gains."""

    effect: type[Effect]
    value: float
    begin: Callable[[], Effect]

    @cached_property
    def start(self) -> Effect:
        """The instance from which a refit starts."""
        return self.begin()


@dataclass(frozen=True)
class Pair:
    """The same statistic of two effects together."""

    value: float
    starts: tuple[Effect, Effect]


@dataclass(frozen=True)
class Signatures:
    """Whitened residual and signatures of all candidates, linearised about one set of effects.

    `columns`: of every candidate and each of its alternative sets of prototypes, the prototypes and their signatures
    (n, prototypes). `whitened_changes` gives the signatures of any effects as they stand, (n, effects).
    """

    white: FloatArray
    columns: list[tuple[type[Effect], tuple[Effect, ...], FloatArray]]
    whitened_changes: Callable[[Sequence[Effect]], FloatArray]

    def scores(self) -> list[Score]:
        """Of every candidate, highest first; of alternative prototypes, the best."""
        best: dict[str, tuple[float, Effect]] = {}
        single: dict[str, list[tuple[float, Effect]]] = {}
        for effect, prototypes, table in self.columns:
            value, share = _cone_score(table, self.white)
            if effect.name not in best or value > best[effect.name][0]:
                best[effect.name] = value, _combined(effect, prototypes, share)
            if len(prototypes) == 1:
                single.setdefault(effect.name, []).append((self._chi2_taken(table[:, 0]), prototypes[0]))
        found = [
            Score(type(scaled), value, partial(self._nearest, scaled, single.get(name, [])))
            for name, (value, scaled) in best.items()
        ]
        return sorted(found, key=lambda s: -s.value)

    def _nearest(self, scaled: Effect, prototypes: Sequence[tuple[float, Effect]]) -> Effect:
        """The prototype as it stands where that takes more of the residual than the linearly scaled one: of large
        changes, linear scaling may be far off."""
        taken, prototype = max(prototypes, key=lambda one: one[0], default=(0.0, scaled))
        is_nearer = taken > 0.0 and taken > self._chi2_taken(self.whitened_changes([scaled])[:, 0])
        return prototype if is_nearer else scaled

    def _chi2_taken(self, signature: FloatArray) -> float:
        """|r|^2 - |r - g|^2 of an effect as it stands; negative where it only adds."""
        return float(2.0 * signature @ self.white - signature @ signature)

    def pairs(self, count: int) -> list[Pair]:
        """The best pairs of two effects by their common score, highest first. Of two effects that act on the same
        numbers, neither may be the best alone. Computed in the span of the signatures, which is of low dimension."""
        best: dict[str, tuple[float, tuple[Effect, ...], FloatArray]] = {}
        for effect, prototypes, table in self.columns:
            value, _ = _cone_score(table, self.white)
            if effect.name not in best or value > best[effect.name][0]:
                best[effect.name] = value, prototypes, table
        if len(best) < 2:
            return []
        basis = _span(np.concatenate([table for _, _, table in best.values()], axis=1))
        white = basis.T @ self.white
        members = [(prototypes, basis.T @ table) for _, prototypes, table in best.values()]
        found = []
        for (first, one), (second, two) in combinations(members, 2):
            value, share = _cone_score(np.concatenate([one, two], axis=1), white)
            found.append((value, first, share[: len(first)], second, share[len(first) :]))
        found.sort(key=lambda pair: -pair[0])
        return [
            Pair(value, (_combined(type(first[0]), first, mine), _combined(type(second[0]), second, other)))
            for value, first, mine, second, other in found[:count]
            if mine.any() and other.any()
        ]

    def threshold(self, rng: np.random.Generator, quantile: float, draws: int) -> float:
        """The quantile of the largest score over draws of white noise, projected on the span of the signatures.

        Of several prototypes, the norm of the projection on their span is an upper bound of the cone's score.
        """
        if not self.columns:
            return float("inf")
        stacked = np.concatenate([table for _, _, table in self.columns], axis=1)
        basis = _span(stacked)
        projected = [basis.T @ table for _, _, table in self.columns]
        top = np.zeros(draws)
        noise = rng.standard_normal((draws, basis.shape[1]))
        for table in projected:
            if table.shape[1] == 1:
                size = float(np.linalg.norm(table))
                if size > 0:
                    top = np.maximum(top, np.square(np.maximum(noise @ table[:, 0] / size, 0.0)))
            else:
                span = _span(table)
                top = np.maximum(top, np.square(noise @ span).sum(1))
        return float(np.quantile(top, quantile))


def signatures(
    model: MeasurementModel,
    camera: CameraModel,
    current: Effects,
    candidates: Iterable[type[Effect]],
    jacobian: FloatArray | None = None,
) -> Signatures:
    """Residual and signatures about a set of `current` effects. `jacobian` (n, p) by the parameters of these is
    projected out. Candidates that change nothing that was measured are left out."""
    seen = model.seen
    gaussian = model.seen_gaussian(current)
    base = model.mean(current)
    white = gaussian.whiten(model.seen_value - gaussian.mean)
    out = np.zeros((len(white), 0))
    if jacobian is not None and jacobian.size:
        out = _span(gaussian.whiten(jacobian[seen]))
        white = white - out @ (out.T @ white)

    def whitened_changes(effects: Sequence[Effect]) -> FloatArray:
        raw = np.stack([model.mean((*current, e)) - base for e in effects], axis=1)[seen]
        table = gaussian.whiten(raw)
        return np.asarray(table - out @ (out.T @ table))

    columns = []
    for effect in candidates:
        if not model.affected(effect).any():
            continue
        for prototypes in effect.prototypes(camera):
            table = whitened_changes(prototypes)
            # smaller ones are rounding: scaled to unit length, they would count in the threshold as any other
            if np.linalg.norm(table, axis=0).max(initial=0.0) > LEAST_SIGNATURE:
                columns.append((effect, prototypes, table))
    return Signatures(white, columns, whitened_changes)


def _span(table: FloatArray) -> FloatArray:
    """Orthonormal basis of the columns' span, relative singular values above 1e-6."""
    if table.shape[1] == 0:
        return table
    size = np.linalg.norm(table, axis=0)
    unit = table[:, size > 0] / size[size > 0]
    u, s, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * max(float(s.max(initial=0.0)), 1e-300)])


def _cone_score(table: FloatArray, white: FloatArray) -> tuple[float, FloatArray]:
    """|r|^2 - min over u >= 0 of |r - G u|^2, and u."""
    size = np.linalg.norm(table, axis=0)
    unit = table / np.where(size > 0, size, 1.0)
    held = np.vstack([unit, RIDGE * np.eye(unit.shape[1])])
    share, rest = nnls(held, np.concatenate([white, np.zeros(unit.shape[1])]))
    return max(float(white @ white - rest**2), 0.0), share / np.where(size > 0, size, 1.0)


def _combined(effect: type[Effect], prototypes: tuple[Effect, ...], share: FloatArray) -> Effect:
    """The effect whose coordinates u are the sum of the prototypes', each times its share, within bounds."""
    likeliest = prototypes[int(np.argmax(share))]
    values: dict[str, float] = {}
    for name, quantity in effect.quantities().items():
        if name in effect.shapes:
            continue
        absent = quantity.absent or 0.0
        total = 0.0
        for prototype, part in zip(prototypes, share, strict=True):
            away = float(getattr(prototype, name)) - absent
            total += float(part) * np.sign(away) * abs(away) ** quantity.linear_power
        step = np.sign(total) * abs(total) ** (1.0 / quantity.linear_power)
        values[name] = absent + float(step)
        if quantity.upper is not None:
            values[name] = min(values[name], absent + INSIDE_BOUND * (quantity.upper - absent))
        if quantity.lower is not None:
            lowest = absent + INSIDE_BOUND * (quantity.lower - absent) if quantity.lower < absent else quantity.lower
            values[name] = max(values[name], lowest)
    return likeliest.having(**values)
