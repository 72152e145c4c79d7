"""The score of every effect: how much of the residual its signature takes, free quantities and known effects projected out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from lab.diagnose.inference.evidence import Evidence
from lab.diagnose.measurements.summaries import Effects
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.spectrum import FloatArray


@dataclass(frozen=True)
class Score:
    """S = |r|^2 - min over u >= 0 of |r - G u|^2, r and G whitened: the likelihood-ratio statistic of a small effect."""

    effect: type[Effect]
    value: float
    begin: Callable[[], Effect]

    @cached_property
    def start(self) -> Effect:
        """Where a refit begins."""
        return self.begin()


@dataclass(frozen=True)
class Pair:
    """The same statistic of two effects together."""

    value: float
    starts: tuple[Effect, Effect]


@dataclass(frozen=True)
class Signatures:
    """Whitened signatures of all candidates about one model."""

    white: FloatArray  # residual
    columns: list[tuple[type[Effect], tuple[Effect, ...], FloatArray]]
    table_of: Callable[[Sequence[Effect]], FloatArray]  # signatures of any effects as they stand, (n, effects)

    def scores(self) -> list[Score]:
        best: dict[str, tuple[float, Effect]] = {}
        plain: dict[str, list[tuple[float, Effect]]] = {}
        for effect, prototypes, table in self.columns:
            value, share = _cone(table, self.white)
            if effect.name not in best or value > best[effect.name][0]:
                best[effect.name] = value, _combined(effect, prototypes, share)
            if len(prototypes) == 1:
                plain.setdefault(effect.name, []).append((self._taken(table[:, 0]), prototypes[0]))
        found = [
            Score(type(scaled), value, partial(self._nearest, scaled, plain.get(name, [])))
            for name, (value, scaled) in best.items()
        ]
        return sorted(found, key=lambda s: -s.value)

    def _nearest(self, scaled: Effect, plain: Sequence[tuple[float, Effect]]) -> Effect:
        """Scaled by what a small change promises, a large one may be far off: a prototype itself may lie nearer."""
        taken, prototype = max(plain, key=lambda one: one[0], default=(0.0, scaled))
        is_nearer = taken > 0.0 and taken > self._taken(self.table_of([scaled])[:, 0])
        return prototype if is_nearer else scaled

    def _taken(self, signature: FloatArray) -> float:
        """Of the residual's square, by an effect as it stands; negative where it only adds."""
        return float(2.0 * signature @ self.white - signature @ signature)

    def pairs(self, count: int) -> list[Pair]:
        """The best pairs of two effects by what their signatures take together, highest first.

        Of two effects that act on the same numbers neither may be the best alone. Small tables: only the signatures' span matters.
        """
        best: dict[str, tuple[float, tuple[Effect, ...], FloatArray]] = {}
        for effect, prototypes, table in self.columns:
            value, _ = _cone(table, self.white)
            if effect.name not in best or value > best[effect.name][0]:
                best[effect.name] = value, prototypes, table
        if len(best) < 2:
            return []
        basis = _span(np.concatenate([table for _, _, table in best.values()], axis=1))
        white = basis.T @ self.white
        members = [(prototypes, basis.T @ table) for _, prototypes, table in best.values()]
        found = []
        for (first, one), (second, two) in combinations(members, 2):
            value, share = _cone(np.concatenate([one, two], axis=1), white)
            found.append((value, first, share[: len(first)], second, share[len(first) :]))
        found.sort(key=lambda pair: -pair[0])
        return [
            Pair(value, (_combined(type(first[0]), first, mine), _combined(type(second[0]), second, other)))
            for value, first, mine, second, other in found[:count]
            if mine.any() and other.any()
        ]

    def threshold(self, rng: np.random.Generator, quantile: float, draws: int = 400) -> float:
        """The quantile of the largest score over a bootstrap of the model: noise drawn as the covariance says.

        Only the span of the signatures matters, in which white noise stays white.
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
                # both signs of a parameter, or several: the norm of the projection bounds the cone's score from above
                span = _span(table)
                top = np.maximum(top, np.square(noise @ span).sum(1))
        return float(np.quantile(top, quantile))


def signatures(
    evidence: Evidence,
    camera: CameraModel,
    current: Effects,
    candidates: Iterable[type[Effect]],
    tangents: FloatArray | None = None,
) -> Signatures:
    """About a model with `current` effects; `tangents` (n, p): slopes by the parameters of these, projected out."""
    seen = evidence.seen
    model = evidence.seen_gaussian(current)
    base = evidence.mean(current)
    white = model.white(evidence.seen_value - model.mean)
    out = np.zeros((len(white), 0))
    if tangents is not None and tangents.size:
        out = _span(model.white(tangents[seen]))
        white = white - out @ (out.T @ white)

    def table_of(prototypes: Sequence[Effect]) -> FloatArray:
        raw = np.stack([evidence.mean((*current, p)) - base for p in prototypes], axis=1)[seen]
        table = model.white(raw)
        return np.asarray(table - out @ (out.T @ table))

    columns = []
    for effect in candidates:
        if not evidence.touched(effect).any():
            continue
        for prototypes in effect.prototypes(camera):
            table = table_of(prototypes)
            if np.any(table):
                columns.append((effect, prototypes, table))
    return Signatures(white, columns, table_of)


def _span(table: FloatArray) -> FloatArray:
    if table.shape[1] == 0:
        return table
    size = np.linalg.norm(table, axis=0)
    unit = table[:, size > 0] / size[size > 0]
    u, s, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * max(float(s.max(initial=0.0)), 1e-300)])


#: Weight of the columns' own sizes in their fit: 1e-8 of a score.
ALIKE = 1e-4


def _cone(table: FloatArray, white: FloatArray) -> tuple[float, FloatArray]:
    size = np.linalg.norm(table, axis=0)
    unit = table / np.where(size > 0, size, 1.0)
    # next to nothing holds columns apart that are all but the same, between which the active set would go round in circles
    held = np.vstack([unit, ALIKE * np.eye(unit.shape[1])])
    share, rest = nnls(held, np.concatenate([white, np.zeros(unit.shape[1])]))
    return max(float(white @ white - rest**2), 0.0), share / np.where(size > 0, size, 1.0)


def _combined(effect: type[Effect], prototypes: tuple[Effect, ...], share: FloatArray) -> Effect:
    """The prototypes scaled in their slope coordinates by the shares found, within bounds."""
    likest = prototypes[int(np.argmax(share))]
    values: dict[str, float] = {}
    for name, quantity in effect.quantities().items():
        if name in effect.shapes:
            continue
        absent = quantity.absent or 0.0
        total = 0.0
        for prototype, part in zip(prototypes, share, strict=True):
            away = float(getattr(prototype, name)) - absent
            total += float(part) * np.sign(away) * abs(away) ** quantity.slope_power
        step = np.sign(total) * abs(total) ** (1.0 / quantity.slope_power)
        values[name] = absent + float(step)
        if quantity.upper is not None:
            values[name] = min(values[name], absent + 0.9 * (quantity.upper - absent))
        if quantity.lower is not None:
            values[name] = max(
                values[name], absent + 0.9 * (quantity.lower - absent) if quantity.lower < absent else quantity.lower
            )
    return likest.having(**values)
