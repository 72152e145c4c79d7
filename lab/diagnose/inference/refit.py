"""Fit the parameters of a set of effects to the seen numbers, and weigh it against other sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np
from scipy.optimize import least_squares

from lab.diagnose.inference.evidence import Evidence, Gaussian
from lab.diagnose.measurements.summaries import Effects
from sim.effects.base import Effect
from sim.parameters import Quantity
from sim.spectrum import FloatArray

PASSES = 3  # the covariance depends on the parameters by the form tolerance: refined so often
#: Nats that a parameter has to earn: half the logarithm of the independent numbers it is fitted to, a few hundred.
PARAMETER_NATS = 2.5
#: Nats that a dispensable parameter has to earn besides, as what it refines is a law with a tolerance.
REFINED_FROM = 8.0


@dataclass(frozen=True)
class Coordinate:
    """One parameter of one effect, in the coordinate in which predictions have a slope at `absent`."""

    index: int  # of the effect
    name: str
    quantity: Quantity

    @property
    def absent(self) -> float:
        return self.quantity.absent or 0.0

    def to(self, value: float) -> float:
        away = value - self.absent
        return float(np.sign(away) * abs(away) ** self.quantity.slope_power)

    def back(self, u: float) -> float:
        value = self.absent + float(np.sign(u) * abs(u) ** (1.0 / self.quantity.slope_power))
        low = self.quantity.lower if self.quantity.lower is not None else -np.inf
        high = self.quantity.upper if self.quantity.upper is not None else np.inf
        return min(max(value, low), high)

    @property
    def bounds(self) -> tuple[float, float]:
        low, high = self.quantity.lower, self.quantity.upper
        return (-np.inf if low is None else self.to(low), np.inf if high is None else self.to(high))

    def scale(self, value: float) -> float:
        """A typical step in u."""
        spread = self.quantity.prior[1] if self.quantity.prior is not None else 5.0
        if self.quantity.slope_power == 1:
            return spread
        return max(abs(self.to(value)), 0.05 * spread**self.quantity.slope_power)


@dataclass(frozen=True)
class Fit:
    """A set of effects at their best parameters. `weight` is the log-likelihood less what the parameters cost."""

    effects: tuple[Effect, ...]
    std: tuple[dict[str, float | None], ...]
    log_likelihood: float
    weight: float
    tangents: FloatArray  # (n, parameters), slopes of the prediction by the coordinates that were fitted
    final: bool = True  # whether it was carried to convergence
    ahead: float = 0.0  # nats that one more step of all its coordinates promises

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.effects)

    def slopes(self, effects: Effects) -> dict[Coordinate, FloatArray]:
        """Those by the coordinates of the effects that stand in this set, too, as they are."""
        fitted = [(e, name) for e, std in zip(self.effects, self.std, strict=True) for name in std]
        at = dict(zip(fitted, self.tangents.T, strict=True))
        return {c: at[key] for c in coordinates(effects) if (key := (effects[c.index], c.name)) in at}


def coordinates(effects: Effects) -> list[Coordinate]:
    return [Coordinate(i, name, q) for i, e in enumerate(effects) for name, q in type(e).quantities().items()]


def moved(effects: Effects, coords: Sequence[Coordinate], u: FloatArray) -> tuple[Effect, ...]:
    """The same effects at other values of their coordinates."""
    values: list[dict[str, float]] = [{} for _ in effects]
    for c, at in zip(coords, u, strict=True):
        values[c.index][c.name] = c.back(float(at))
    return tuple(e.having(**v) for e, v in zip(effects, values, strict=True))


def likelihood(evidence: Evidence, effects: Effects) -> float:
    """Of the seen numbers under the effects as they stand."""
    return evidence.seen_gaussian(effects).log_likelihood(evidence.seen_value)


def refit(
    evidence: Evidence,
    start: Effects,
    *,
    passes: int = PASSES,
    evaluations: int = 12,
    final: bool = True,
    settled: Fit | None = None,
) -> Fit:
    """Maximum a posteriori of all parameters of `start`, by Gauss-Newton with bounds; the prior is three times as wide as
    the declared one, as a camera at hand needn't be typical. Standard uncertainties follow from the slopes and hold the form
    tolerance, as the covariance does. A final fit does without the dispensable parameters where that is worth nearly as much.
    The slopes of members that stand as they do in `settled` are taken from there: they move, but change little by what joins."""
    coords = coordinates(tuple(start))
    known = {} if settled is None else settled.slopes(start)
    found = _refit(evidence, tuple(start), coords, passes, evaluations, final, known)
    spare = [c for c in coords if c.quantity.dispensable]
    if final and spare:
        without = moved(found.effects, spare, np.zeros(len(spare)))
        less = _refit(evidence, without, [c for c in coords if c not in spare], passes, evaluations, final)
        found = less if less.weight >= found.weight - REFINED_FROM else found
    return found


def _refit(
    evidence: Evidence,
    effects: tuple[Effect, ...],
    coords: Sequence[Coordinate],
    passes: int,
    evaluations: int,
    final: bool,
    known: Mapping[Coordinate, FloatArray] = MappingProxyType({}),
) -> Fit:
    """Of the parameters `coords`, the others as they are. `known`: slopes that needn't be taken again."""
    seen = evidence.seen
    if not coords:
        value = likelihood(evidence, effects)
        return Fit(effects, (), value, value, np.zeros((len(evidence.value), 0)))
    u = np.array([c.to(float(getattr(effects[c.index], c.name))) for c in coords])
    low, high = (np.array(b) for b in zip(*(c.bounds for c in coords), strict=True))
    scale = np.array([c.scale(float(getattr(effects[c.index], c.name))) for c in coords])
    prior_centre = np.array(
        [c.to(c.quantity.prior[0]) if c.quantity.prior and c.quantity.slope_power == 1 else 0.0 for c in coords]
    )
    prior_std = np.array([3.0 * c.quantity.prior[1] if c.quantity.prior else np.inf for c in coords])
    prior_std = np.array([s**c.quantity.slope_power for s, c in zip(prior_std, coords, strict=True)])
    jacobian = np.zeros((int(seen.sum()), len(coords)))
    for turn in range(passes):
        model = evidence.seen_gaussian(moved(effects, coords, u))

        def residual(at: FloatArray, model: Gaussian = model) -> FloatArray:
            white = model.white((evidence.value - evidence.mean(moved(effects, coords, at)))[seen])
            return np.concatenate([white, (at - prior_centre) / prior_std])

        def slope(at: FloatArray, model: Gaussian = model) -> FloatArray:
            # steps of 2 % of a typical size, towards the inside of the bounds
            base = evidence.mean(moved(effects, coords, at))[seen]
            columns = []
            for k, c in enumerate(coords):
                if c in known:
                    columns.append(-known[c][seen])
                    continue
                step = 0.02 * max(scale[k], 0.02 * abs(at[k]))
                step = -step if at[k] + step > high[k] else step
                shifted = at.copy()
                shifted[k] += step
                columns.append((base - evidence.mean(moved(effects, coords, shifted))[seen]) / step)
            white = model.white(np.array(columns).T)
            return np.vstack([white, np.diag(1.0 / prior_std)])

        inside = np.clip(u, low + 1e-9 * scale, high - 1e-9 * scale)
        result = least_squares(
            residual,
            inside,
            jac=slope,
            bounds=(low, high),
            x_scale=scale,
            max_nfev=evaluations if turn == 0 else 5,
            xtol=1e-5,
            ftol=1e-5,
        )
        before, u = u, result.x
        jacobian = result.jac[: -len(coords)]
        if np.all(np.abs(u - before) < 1e-3 * scale):
            break
    best = moved(effects, coords, u)
    curvature = jacobian.T @ jacobian + np.diag(1.0 / prior_std**2)
    covariance = np.linalg.pinv(curvature)
    std: list[dict[str, float | None]] = [{} for _ in best]
    for k, c in enumerate(coords):
        su = float(np.sqrt(max(covariance[k, k], 0.0)))
        power = c.quantity.slope_power
        away = abs(c.back(float(u[k])) - c.absent)
        # at a power p the uncertainty of the value is su / (p |value|^(p - 1)), at 0 the p-th root of su bounds it
        std[c.index][c.name] = (
            su if power == 1 else min(su / max(power * away ** (power - 1), 1e-12), su ** (1.0 / power))
        )
    model = evidence.seen_gaussian(best)
    value = model.log_likelihood(evidence.seen_value)
    prior = -0.5 * float(np.sum(np.square((u - prior_centre) / prior_std)))
    prior += sum(_usual_nats(e, s) for e, s in zip(best, std, strict=True))
    tangents = _tangents(evidence, best, coords, u, scale, high)
    ahead = _ahead(model, evidence.seen_value, tangents[seen], (u - prior_centre) / prior_std, prior_std)
    return Fit(best, tuple(std), value, value + prior - PARAMETER_NATS * len(coords), tangents, final, ahead)


def _ahead(
    model: Gaussian, seen_value: FloatArray, tangents: FloatArray, from_prior: FloatArray, prior_std: FloatArray
) -> float:
    """Half of Newton's decrement, g' (J'J + P)^-1 g / 2: what a step to the optimum would gain were the prediction linear and
    without bounds."""
    slopes = model.white(tangents)
    gradient = slopes.T @ model.white(seen_value - model.mean) - from_prior / prior_std
    return float(0.5 * gradient @ np.linalg.pinv(slopes.T @ slopes + np.diag(1.0 / prior_std**2)) @ gradient)


def _usual_nats(effect: Effect, std: dict[str, float | None]) -> float:
    """The most usual of what lies within a standard deviation of the values found: noise makes nothing unusual."""
    if type(effect).usual_nats is Effect.usual_nats:
        return 0.0
    quantities = type(effect).quantities()
    near = []
    for name, spread in std.items():
        value, low, high = float(getattr(effect, name)), quantities[name].lower, quantities[name].upper
        around = (value - (spread or 0.0), value, value + (spread or 0.0))
        near.append([min(max(v, -np.inf if low is None else low), np.inf if high is None else high) for v in around])
    return max(effect.having(**dict(zip(std, v, strict=True))).usual_nats() for v in product(*near))


def _tangents(
    evidence: Evidence,
    effects: Effects,
    coords: Sequence[Coordinate],
    u: FloatArray,
    scale: FloatArray,
    high: FloatArray,
) -> FloatArray:
    base = evidence.mean(effects)
    columns = []
    for k in range(len(u)):
        step = 0.02 * scale[k] * (-1 if u[k] + 0.02 * scale[k] > high[k] else 1)
        shifted = u.copy()
        shifted[k] += step
        columns.append((evidence.mean(moved(effects, coords, shifted)) - base) / step)
    return np.array(columns).T
