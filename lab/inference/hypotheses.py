"""What may act: effects, metadata errors and laws of a toy, as hypotheses of one type, and the prior of their sets.

A hypothesis has parameters u. Each has one prior, in the coordinate in which it is fitted:

- a size is 0 where the hypothesis isn't there. Its prior is Student's t with `DEGREES` degrees of freedom about 0, cut
  to its bounds: heavy-tailed, as a camera at hand needn't be typical. Of an effect, half of the prior has a tenth of
  the scale (`SMALLER`): effects are as usual, or corrected to what is left.
- a shape (a step's code, a cut-off, a frequency) means nothing without a size. Its prior is normal, or flat between
  bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.special import expit, ndtr, stdtr

from lab.inference.model import Point, State
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.parameters import Quantity
from sim.spectrum import FloatArray

#: Degrees of freedom of a size's prior: the fewest with a finite variance.
DEGREES = 3.0
_CURVATURE = (DEGREES + 1.0) / DEGREES
#: Student's t with 3 degrees of freedom at 0: 2 / (pi sqrt 3).
_LOG_AT_ZERO = float(np.log(2.0 / (np.pi * np.sqrt(3.0))))
#: An effect's smaller scale over the declared one, in its own unit. Row noise is declared with 5 e, and is 0.2 e in
#: good cameras; rows of phase detection with 5 %, and corrected ones lack 0.1 %.
SMALLER = 0.1


def log_size_prior(t: FloatArray, smaller: FloatArray) -> FloatArray:
    """Log density of sizes t, in the prior's scale, over the whole line: Student's t of scale 1, and of scale
    `smaller`, with equal shares."""
    narrow, wide = _log_student(t / smaller) - np.log(smaller), _log_student(t)
    return np.asarray(np.logaddexp(narrow, wide) - np.log(2.0))


def size_precision(t: FloatArray, smaller: FloatArray) -> FloatArray:
    """Return the precision of the normal prior about 0 that has the slope of `log_size_prior` at t."""
    narrow, wide = _log_student(t / smaller) - np.log(smaller), _log_student(t)
    share = expit(narrow - wide)
    of_narrow = (DEGREES + 1.0) / (DEGREES + np.square(t / smaller)) / np.square(smaller)
    return np.asarray(share * of_narrow + (1.0 - share) * (DEGREES + 1.0) / (DEGREES + np.square(t)))


def _log_student(t: FloatArray) -> FloatArray:
    return np.asarray(_LOG_AT_ZERO - 0.5 * (DEGREES + 1.0) * np.log1p(np.square(t) / DEGREES))


@dataclass(frozen=True)
class Coordinate:
    """One parameter u: its bounds, and its prior of this centre and scale. A shape of infinite scale has a flat prior.
    `step`: of finite differences; `typical`: a usual change; `to_value`: the parameter in its own unit, None for u;
    `smaller`: of a size, the scale of half of its prior over that of the other half."""

    name: str
    scale: float
    lower: float = -np.inf
    upper: float = np.inf
    centre: float = 0.0
    is_shape: bool = False
    typical: float = 0.0
    step: float = 0.0
    to_value: Callable[[float], float] | None = None
    smaller: float = 1.0

    @property
    def unit(self) -> float:
        """A usual change of u."""
        return self.typical or (self.scale if np.isfinite(self.scale) else 0.1 * (self.upper - self.lower))

    @cached_property
    def _log_norm(self) -> float:
        if not self.is_shape:
            low, high = ((b - self.centre) / self.scale for b in (self.lower, self.upper))
            inside = [stdtr(DEGREES, high / s) - stdtr(DEGREES, low / s) for s in (1.0, self.smaller)]
            return float(np.log(self.scale * np.mean(inside)))
        if not np.isfinite(self.scale):
            return float(np.log(self.upper - self.lower))
        low, high = ((b - self.centre) / self.scale for b in (self.lower, self.upper))
        return float(np.log(self.scale * (ndtr(high) - ndtr(low))))

    def log_prior(self, u: FloatArray | float) -> FloatArray:
        """Log density at u, within the bounds."""
        if self.is_shape and not np.isfinite(self.scale):
            return np.zeros_like(np.asarray(u, float)) - self._log_norm
        t = (np.asarray(u, float) - self.centre) / self.scale
        if self.is_shape:
            return np.asarray(-0.5 * t * t - 0.5 * np.log(2.0 * np.pi) - self._log_norm)
        return np.asarray(log_size_prior(t, np.asarray(self.smaller)) - self._log_norm)

    def draw(self, rng: np.random.Generator) -> float:
        """Draw u from its prior."""
        if self.is_shape and not np.isfinite(self.scale):
            return float(rng.uniform(self.lower, self.upper))
        while True:
            t = rng.standard_normal() if self.is_shape else rng.standard_t(DEGREES)
            scale = self.scale * (1.0 if self.is_shape or rng.random() < 0.5 else self.smaller)
            u = self.centre + scale * float(t)
            if self.lower <= u <= self.upper:
                return u

    def residual(self, u: float) -> tuple[float, float]:
        """Return r with -r^2 / 2 the log prior up to a constant, and its derivative."""
        if not np.isfinite(self.scale):
            return 0.0, 0.0
        t = (u - self.centre) / self.scale
        if self.is_shape:
            return t, 1.0 / self.scale
        smaller = np.asarray(self.smaller)
        precision = float(size_precision(np.asarray(t), smaller))
        if abs(t) < 1e-4 * self.smaller:
            return float(np.sqrt(precision) * t), float(np.sqrt(precision) / self.scale)
        r = np.sign(t) * np.sqrt(2.0 * (log_size_prior(np.zeros(()), smaller) - log_size_prior(np.asarray(t), smaller)))
        return float(r), float(precision * t / r / self.scale)

    def slope_and_precision(self, u: float) -> tuple[float, float]:
        """First derivative of the log prior, and minus the second, 0 at least; of a size, those of the wider half of
        its prior: an expansion that doesn't see beyond the narrow half would lose the other."""
        if not np.isfinite(self.scale):
            return 0.0, 0.0
        t = (u - self.centre) / self.scale
        if self.is_shape:
            return -t / self.scale, self.scale**-2
        spread = 1.0 + t * t / DEGREES
        second = _CURVATURE * (1.0 - t * t / DEGREES) / spread**2 / self.scale**2
        return -_CURVATURE * t / spread / self.scale, max(second, 0.0)


@dataclass(frozen=True)
class Alternative:
    """Signatures of a hypothesis for one value of its shapes and choices: instances whose changes of the prediction
    may be combined with coefficients >= 0, and the prior scale of each coefficient. Where two instances are of opposite
    sign of one parameter, each has half of the prior.

    `is_whole`: one instance without a size, which acts as a whole or not at all: its coefficient is 1. `log_share`: log
    of the alternative's prior probability over that of one of equally probable alternatives."""

    points: tuple[Point, ...]
    scales: tuple[float, ...]
    is_whole: bool = False
    log_share: float = 0.0


@dataclass(frozen=True)
class Hypothesis:
    """One hypothesis: its family, its parameters, and where they may begin. `combine` returns the instance that has the
    coefficients c (k,) of an alternative's points; by default the sum of their u. `log_prior` of an instance: of its
    combination of parameters, over that of the single parameters' priors."""

    name: str
    family: str
    coordinates: tuple[Coordinate, ...]
    alternatives: tuple[Alternative, ...]
    combine: Callable[[Alternative, FloatArray], Point] | None = None
    log_prior: Callable[[Point], float] = field(default=lambda point: 0.0)

    def start(self, alternative: Alternative, coefficients: FloatArray) -> Point:
        """Return where a fit begins, given the coefficients of an alternative's points in the linear problem."""
        if self.combine is not None:
            return self.combine(alternative, coefficients)
        first = alternative.points[int(np.argmax(coefficients))]
        size = np.array([not c.is_shape for c in self.coordinates])
        total = np.sum([c * p.u for c, p in zip(coefficients, alternative.points, strict=True)], axis=0)
        low, high = (np.array([getattr(c, end) for c in self.coordinates]) for end in ("lower", "upper"))
        return first.at(np.clip(np.where(size, total, first.u), low, high))


# --- The prior of sets ------------------------------------------------------------------------------------------------

#: Probabilities of 0, 1, 2, ... active hypotheses on a side: half of the cameras do as their data sheet says; of the
#: others each further cause is two to three times rarer. A camera that is looked at closely shows more than five.
NUMBER = (0.5, 0.3, 0.12, 0.05, 0.02, 0.006, 0.0025, 0.001, 0.0005)


@dataclass(frozen=True)
class SetPrior:
    """p(A): the number of members by `number`, and of the sets of that number each by the product of its members'
    shares. A family's share is 1 over the number of families, split equally among its members, unless `shares` states
    another. Sets with two members of an exclusive family (metadata: one of a statement) aren't excluded."""

    families: Mapping[str, str]  # name -> family
    number: tuple[float, ...] = NUMBER
    shares: Mapping[str, float] = field(default_factory=dict)  # family -> share; the others share the rest

    @cached_property
    def weight(self) -> dict[str, float]:
        """Share of every hypothesis."""
        names: dict[str, list[str]] = {}
        for name, family in self.families.items():
            names.setdefault(family, []).append(name)
        stated = {f: s for f, s in self.shares.items() if f in names}
        rest = (1.0 - sum(stated.values())) / max(len(names) - len(stated), 1)
        return {n: stated.get(f, rest) / len(members) for f, members in names.items() for n in members}

    @cached_property
    def _log_totals(self) -> FloatArray:
        """Log of the sum over all sets of k members of the products of their shares."""
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(symmetric(list(self.weight.values()), len(self.number) - 1)))

    @cached_property
    def _of_number(self) -> FloatArray:
        """Probabilities of so many members: no set has more than there are hypotheses."""
        known = np.array(self.number) * np.isfinite(self._log_totals)
        return np.asarray(known / known.sum())

    def scale(self, k: int) -> float:
        """Return the prior of a set of k members over the product of their shares; 0 where there is no such set."""
        total = float(self._log_totals[k])
        return float(self._of_number[k] * np.exp(-total)) if np.isfinite(total) else 0.0

    def log(self, members: frozenset[str]) -> float:
        """Log prior probability of exactly this set; -inf of more members than `number` has."""
        k = len(members)
        if k >= len(self.number):
            return -np.inf
        return float(np.log(self._of_number[k]) + sum(np.log(self.weight[m]) for m in members) - self._log_totals[k])

    def draw(self, rng: np.random.Generator) -> frozenset[str]:
        """Draw a set."""
        names = list(self.weight)
        k = int(rng.choice(len(self.number), p=self._of_number))
        sets = list(combinations(names, k))
        if len(sets) > 20000:
            raise ValueError(f"{len(sets)} sets of {k} hypotheses: draw from 20000 at most, of a toy's hypotheses")
        weight = np.array([np.prod([self.weight[m] for m in s]) for s in sets])
        return frozenset(sets[int(rng.choice(len(sets), p=weight / weight.sum()))])


def symmetric(weights: Sequence[float] | Sequence[FloatArray], most: int) -> FloatArray:
    """Return the elementary symmetric polynomials of degree 0 to `most`: sums over all sets of k of their products.
    Weights are numbers, or arrays of one shape, for each element by itself."""
    total = np.zeros((most + 1, *(np.shape(weights[0]) if len(weights) else ())))
    total[0] = 1.0
    for w in weights:
        total[1:] += w * total[:-1]
    return total


def coordinates_of(hypotheses: Mapping[str, Hypothesis], state: State) -> list[tuple[str, int, Coordinate]]:
    """All parameters of a state: the hypothesis, the index, and the coordinate."""
    return [(name, k, c) for name in state for k, c in enumerate(hypotheses[name].coordinates)]


def moved(state: State, u: FloatArray) -> dict[str, Point]:
    """Return the state with its parameters, one after the other, at `u`."""
    found, at = {}, 0
    for name, point in state.items():
        found[name] = point.at(u[at : at + len(point.u)])
        at += len(point.u)
    return found


def stacked(state: State) -> FloatArray:
    """All parameters of a state, one after the other."""
    return np.concatenate([p.u for p in state.values()]) if state else np.zeros(0)


# --- Effects as hypotheses --------------------------------------------------------------------------------------------

#: Step of finite differences, in prior scales of a size that acts linearly, and of one that acts by its square.
_STEP, _STEP_SQUARE = 0.02, 0.001
#: Change of a logarithm that is usual, and its least argument.
_TYPICAL_LOG, _LEAST = 0.1, 1e-9


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect in the coordinate u in which predictions have a slope where it is absent: sign(p -
    absent) |p - absent|^linear_power of a size; ln p where it is declared logarithmic; else p itself of a shape."""

    name: str
    quantity: Quantity
    is_shape: bool

    def to_u(self, value: float) -> float:
        """u of a value."""
        if self.quantity.logarithmic:
            return float(np.log(max(value, _LEAST)))
        if self.is_shape and self.quantity.linear_power == 1:
            return value
        away = value - (self.quantity.absent or 0.0)
        return float(np.sign(away) * abs(away) ** self.quantity.linear_power)

    def to_value(self, u: float) -> float:
        """Return the value of u, within its bounds."""
        q = self.quantity
        if q.logarithmic:
            value = float(np.exp(u))
        elif self.is_shape and q.linear_power == 1:
            value = u
        else:
            value = (q.absent or 0.0) + float(np.sign(u) * abs(u) ** (1.0 / q.linear_power))
        return min(max(value, -np.inf if q.lower is None else q.lower), np.inf if q.upper is None else q.upper)

    @property
    def coordinate(self) -> Coordinate:
        """u with its bounds and its prior, whose scale is the declared standard deviation's."""
        return replace(self._coordinate, to_value=self.to_value)

    @property
    def _coordinate(self) -> Coordinate:
        q = self.quantity
        low = -np.inf if q.lower is None else self.to_u(q.lower)
        high = np.inf if q.upper is None else self.to_u(q.upper)
        if q.prior is None:
            step = max(0.002 * (high - low), q.smooth_over)
            typical = _TYPICAL_LOG if q.logarithmic else 0.05 * (high - low)
            return Coordinate(self.name, np.inf, low, high, is_shape=True, typical=typical, step=step)
        centre, std = q.prior
        if self.is_shape:
            scale = std / centre if q.logarithmic else std**q.linear_power
            return Coordinate(
                self.name, scale, low, high, self.to_u(centre), is_shape=True, step=max(_STEP * scale, q.smooth_over)
            )
        scale = std**q.linear_power
        step = (_STEP if q.linear_power == 1 else _STEP_SQUARE) * scale
        typical = scale if q.linear_power == 1 else 0.05 * scale
        smaller = SMALLER**q.linear_power
        return Coordinate(
            self.name, scale, low, high, typical=typical, step=max(step, q.smooth_over), smaller=smaller
        )  # fmt: skip


def parameters_of(kind: type[Effect], camera: CameraModel) -> tuple[EffectParameter, ...]:
    """Return an effect's parameters. Those that shape it, and those without a value that means absence, are shapes."""
    return tuple(
        EffectParameter(name, q, name in kind.shapes or q.absent is None or q.prior is None)
        for name, q in kind.quantities_of(camera).items()
    )


def point_of(effect: Effect, camera: CameraModel) -> Point:
    """Return an effect as a point of its hypothesis."""
    return Point(
        np.array([p.to_u(float(getattr(effect, p.name))) for p in parameters_of(type(effect), camera)]), effect
    )


def effect_at(point: Point, parameters: Sequence[EffectParameter]) -> Effect:
    """Return the effect of a point: its template with the parameters of u, itself at its own u. A value isn't bit for
    bit that of its u, and would be predicted anew."""
    template: Effect = point.template
    if all(p.to_u(float(getattr(template, p.name))) == u for p, u in zip(parameters, point.u, strict=True)):
        return template
    values = {p.name: p.to_value(float(u)) for p, u in zip(parameters, point.u, strict=True)}
    return template.replace_fields(**values)


def hypothesis_of(kind: type[Effect], camera: CameraModel) -> Hypothesis:
    """Return an effect as a hypothesis: its prototypes are the alternatives, its choices equally probable."""
    parameters = parameters_of(kind, camera)
    coords = tuple(p.coordinate for p in parameters)
    alternatives = []
    choices = set()
    for group in kind.prototypes(camera):
        points = tuple(point_of(effect, camera) for effect in group)
        choices |= {tuple(getattr(effect, n) for n in kind.choices()) for effect in group}
        scales = []
        for point in points:
            sizes = [u / c.scale for u, c in zip(point.u, coords, strict=True) if not c.is_shape]
            scales.append(1.0 / max(float(np.linalg.norm(sizes)), 1e-9) if any(sizes) else 1.0)
        alternatives.append(Alternative(points, tuple(scales)))
    cost = float(np.log(max(len(choices), 1)))
    return Hypothesis(
        kind.name, kind.family.value, coords, tuple(alternatives),
        log_prior=lambda point: effect_at(point, parameters).log_prior() - cost,
    )  # fmt: skip
