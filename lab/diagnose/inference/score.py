"""The score of every effect: how much of the residual its signature takes, nuisance parameters and known effects
projected out.

A signature is the change of the prediction by a small or typical instance of the effect (its prototypes), whitened by
the covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.optimize import nnls

from lab.diagnose.inference.closed_form import LinearProblem, LinearSet
from lab.diagnose.inference.measurement_model import MeasurementModel
from sim.camera import CameraModel
from sim.effects.base import Effect, Effects
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
class Signatures:
    """Whitened residual and signatures of all candidates, linearised about one set of effects.

    `columns`: of every candidate and each of its alternative sets of prototypes, the prototypes and their signatures
    (n, prototypes). `whitened_changes` gives the signatures of any effects as they stand, (n, effects).
    """

    camera: CameraModel
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
                best[effect.name] = value, _combined(effect, prototypes, share, self.camera)
            if len(prototypes) == 1:
                single.setdefault(effect.name, []).append((self._chi2_taken(table[:, 0]), prototypes[0]))
        found = [
            Score(type(scaled), value, partial(self._nearest, scaled, single.get(name, [])))
            for name, (value, scaled) in best.items()
        ]
        return sorted(found, key=lambda s: -s.value)

    def _nearest(self, scaled: Effect, prototypes: Sequence[tuple[float, Effect]]) -> Effect:
        """Return the prototype as it stands where that takes more of the residual than the linearly scaled one: of
        large changes, linear scaling may be far off."""
        taken, prototype = max(prototypes, key=lambda one: one[0], default=(0.0, scaled))
        is_nearer = taken > 0.0 and taken > self._chi2_taken(self.whitened_changes([scaled])[:, 0])
        return prototype if is_nearer else scaled

    def _chi2_taken(self, signature: FloatArray) -> float:
        """|r|^2 - |r - g|^2 of an effect as it stands; negative where it only adds."""
        return float(2.0 * signature @ self.white - signature @ signature)

    def problem(self, cost: Mapping[str, float]) -> LinearProblem:
        """Return the linear problem of all sets of candidates; `cost`: log odds that each has to earn, by name."""
        return LinearProblem.of(self.white, [t for _, _, t in self.columns], [e.name for e, _, _ in self.columns], cost)

    def starts(self, one: LinearSet) -> tuple[Effect, ...]:
        """Return where a refit of a set of this problem starts: its members scaled by their shares; a single one as
        `Score.start`."""
        found = []
        for member, share in zip(one.members, one.share, strict=True):
            effect, prototypes, _ = self.columns[member]
            found.append(_combined(effect, prototypes, share, self.camera))
        if len(found) == 1:
            name = found[0].name
            single = [(self._chi2_taken(t[:, 0]), p[0]) for e, p, t in self.columns if e.name == name and len(p) == 1]
            return (self._nearest(found[0], single),)
        return tuple(found)

    def threshold(self, rng: np.random.Generator, quantile: float, draws: int) -> float:
        """Return the quantile of the largest score over draws of white noise, projected on the span of the signatures.

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


#: Of every candidate and each of its alternative sets of prototypes: the prototypes, and their changes of the seen
#: numbers (n, prototypes).
Changes = Sequence[tuple[type[Effect], tuple[Effect, ...], FloatArray]]


def prototype_changes(
    model: MeasurementModel, camera: CameraModel, current: Effects, candidates: Iterable[type[Effect]]
) -> Changes:
    """Return what all prototypes of the candidates change beside a set of `current` effects. Candidates that change
    nothing that was measured are left out."""
    base = model.mean(current)
    return [
        (effect, prototypes, np.stack([model.mean((*current, e)) - base for e in prototypes], axis=1)[model.seen])
        for effect in candidates
        if model.affected(effect).any()
        for prototypes in effect.prototypes(camera)
    ]


def signatures(
    model: MeasurementModel,
    camera: CameraModel,
    current: Effects,
    candidates: Iterable[type[Effect]],
    jacobian: FloatArray | None = None,
) -> Signatures:
    """Residual and signatures about a set of `current` effects. `jacobian` (n, p) by the parameters of these is
    projected out."""
    return signatures_of(model, current, prototype_changes(model, camera, current, candidates), jacobian)


def signatures_of(
    model: MeasurementModel,
    current: Effects,
    changes: Changes,
    jacobian: FloatArray | None = None,
    tolerated: float = 1.0,
) -> Signatures:
    """Return the same of changes that are known, by the covariance that `current` effects give with a share of their
    form tolerances. Those beside a smaller set stand for those beside `current`: an effect's change depends little on
    what it stands beside."""
    gaussian = model.seen_gaussian(current, tolerated)
    white = gaussian.whiten(model.seen_value - gaussian.mean)
    out = np.zeros((len(white), 0))
    if jacobian is not None and jacobian.size:
        out = _span(gaussian.whiten(jacobian[model.seen]))
        white = white - out @ (out.T @ white)

    def whitened(raw: FloatArray) -> FloatArray:
        table = gaussian.whiten(raw)
        return np.asarray(table - out @ (out.T @ table))

    def whitened_changes(effects: Sequence[Effect]) -> FloatArray:
        base = model.mean(current)
        return whitened(np.stack([model.mean((*current, e)) - base for e in effects], axis=1)[model.seen])

    columns = []
    if changes:
        stacked = whitened(np.concatenate([raw for _, _, raw in changes], axis=1))
        tables = np.split(stacked, np.cumsum([raw.shape[1] for _, _, raw in changes])[:-1], axis=1)
        for (effect, prototypes, _), table in zip(changes, tables, strict=True):
            # smaller ones are rounding: scaled to unit length, they would count in the threshold as any other
            if np.linalg.norm(table, axis=0).max(initial=0.0) > LEAST_SIGNATURE:
                columns.append((effect, prototypes, table))
    return Signatures(model.camera, white, columns, whitened_changes)


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


def _combined(effect: type[Effect], prototypes: tuple[Effect, ...], share: FloatArray, camera: CameraModel) -> Effect:
    """Return the effect whose coordinates u are the sum of the prototypes', each times its share, within bounds."""
    likeliest = prototypes[int(np.argmax(share))]
    values: dict[str, float] = {}
    for name, quantity in effect.quantities_of(camera).items():
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
    return likeliest.replace_fields(**values)
