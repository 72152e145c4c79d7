"""What may act: effects, metadata errors and laws of a toy, as hypotheses of one type, and the prior of their sets.

A hypothesis has parameters u. Each has one prior, in the coordinate in which it is fitted:

- a size is 0 where the hypothesis isn't there. Its prior is Student's t with `DEGREES` degrees of freedom about 0, cut to
  its bounds: heavy-tailed, as a camera at hand needn't be typical.
- a shape (a step's code, a cut-off, a frequency) means nothing without a size. Its prior is normal, or flat between
  bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.stats import t as student

from lab.inference.model import Point, State
from sim.spectrum import FloatArray

#: Degrees of freedom of a size's prior: the fewest with a finite variance.
DEGREES = 3.0
_CURVATURE = (DEGREES + 1.0) / DEGREES


@dataclass(frozen=True)
class Coordinate:
    """One parameter u: its bounds, and its prior of this centre and scale. A shape of infinite scale has a flat prior.
    `step`: of finite differences; `typical`: a usual change."""

    name: str
    scale: float
    lower: float = -np.inf
    upper: float = np.inf
    centre: float = 0.0
    is_shape: bool = False
    typical: float = 0.0
    step: float = 0.0

    @property
    def unit(self) -> float:
        """A usual change of u."""
        return self.typical or (self.scale if np.isfinite(self.scale) else 0.1 * (self.upper - self.lower))

    @cached_property
    def _log_norm(self) -> float:
        if not self.is_shape:
            low, high = ((b - self.centre) / self.scale for b in (self.lower, self.upper))
            return float(np.log(self.scale * (student.cdf(high, DEGREES) - student.cdf(low, DEGREES))))
        if not np.isfinite(self.scale):
            return float(np.log(self.upper - self.lower))
        from scipy.special import ndtr

        low, high = ((b - self.centre) / self.scale for b in (self.lower, self.upper))
        return float(np.log(self.scale * (ndtr(high) - ndtr(low))))

    def log_prior(self, u: FloatArray | float) -> FloatArray:
        """Log density at u, within the bounds."""
        if self.is_shape and not np.isfinite(self.scale):
            return np.zeros_like(np.asarray(u, float)) - self._log_norm
        t = (np.asarray(u, float) - self.centre) / self.scale
        if self.is_shape:
            return np.asarray(-0.5 * t * t - 0.5 * np.log(2.0 * np.pi) - self._log_norm)
        return np.asarray(student.logpdf(t, DEGREES) - self._log_norm)

    def residual(self, u: float) -> tuple[float, float]:
        """Return r with -r^2 / 2 the log prior up to a constant, and its derivative."""
        if not np.isfinite(self.scale):
            return 0.0, 0.0
        t = (u - self.centre) / self.scale
        if self.is_shape:
            return t, 1.0 / self.scale
        r = np.sign(t) * np.sqrt((DEGREES + 1.0) * np.log1p(t * t / DEGREES))
        slope = np.sqrt(_CURVATURE) if abs(t) < 1e-4 else _CURVATURE * t / (1.0 + t * t / DEGREES) / r
        return float(r), float(slope / self.scale)

    def slope_and_precision(self, u: float) -> tuple[float, float]:
        """First derivative of the log prior, and minus the second, 0 at least."""
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
    sign of one parameter, each has half of the prior."""

    points: tuple[Point, ...]
    scales: tuple[float, ...]


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
#: others each further cause is two and a half times rarer.
NUMBER = (0.5, 0.3, 0.12, 0.05, 0.02, 0.01)


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
        """Log of the sum over all sets of k members of the products of their shares: elementary symmetric
        polynomials."""
        total = np.zeros(len(self.number))
        total[0] = 1.0
        for w in self.weight.values():
            total[1:] += w * total[:-1]
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(total))

    def log(self, members: frozenset[str]) -> float:
        """Log prior probability of exactly this set; -inf of more members than `number` has."""
        k = len(members)
        if k >= len(self.number):
            return -np.inf
        return float(np.log(self.number[k]) + sum(np.log(self.weight[m]) for m in members) - self._log_totals[k])

    def draw(self, rng: np.random.Generator) -> frozenset[str]:
        """Draw a set."""
        k = int(rng.choice(len(self.number), p=np.array(self.number) / sum(self.number)))
        names = list(self.weight)
        k = min(k, len(names))
        sets = list(combinations(names, k))
        if len(sets) > 20000:
            raise ValueError(f"{len(sets)} sets of {k} hypotheses: draw from 20000 at most, of a toy's hypotheses")
        weight = np.array([np.prod([self.weight[m] for m in s]) for s in sets])
        return frozenset(sets[int(rng.choice(len(sets), p=weight / weight.sum()))])


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
