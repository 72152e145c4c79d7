"""Evidence by Laplace's approximation and by the grid, against nested sampling (dynesty) on 30 problems."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.special import stdtr, stdtrit

from lab.inference.hypotheses import DEGREES, Coordinate, Hypothesis, SetPrior
from lab.inference.search import Search
from sim.spectrum import FloatArray
from tests.lab.inference.toys import Toy, linear, shaped

pytestmark = pytest.mark.slow
POINTS = 40
X = np.linspace(0.0, 1.0, POINTS)


def _at_share(c: Coordinate, share: float) -> float:
    """Return the quantile of a coordinate's prior."""
    if c.is_shape:
        return c.lower + share * (c.upper - c.lower)
    low, high = (float(stdtr(DEGREES, (b - c.centre) / c.scale)) for b in (c.lower, c.upper))
    return c.centre + c.scale * float(stdtrit(DEGREES, low + share * (high - low)))


@dataclass(frozen=True)
class Problem:
    """Hypotheses that are all active, and their true parameters."""

    kind: str
    hypotheses: dict[str, Hypothesis]
    changes: dict[str, Callable[[FloatArray], FloatArray]]
    true: dict[str, FloatArray]


def _wave(u: FloatArray) -> FloatArray:
    return np.asarray(u[0] * np.sin(7.0 * X))


def _near_wave(u: FloatArray) -> FloatArray:
    return np.asarray(u[0] * np.sin(7.0 * X + 0.3))


def _bent(u: FloatArray) -> FloatArray:
    return np.asarray(6.0 * np.expm1(-u[0] * X))


def _bump(u: FloatArray) -> FloatArray:
    return np.asarray(u[0] * np.exp(-0.5 * np.square((X - u[1]) / 0.1)))


def _mirrored(u: FloatArray) -> FloatArray:
    return np.asarray(u[0] * np.exp(-0.5 * np.square((X - abs(u[1] - 0.5)) / 0.1)))


def _problems(kind: str, size: float) -> Problem:
    if kind == "bound":
        return Problem(kind, {"wave": linear("wave", "f", 1.0)}, {"wave": _wave}, {"wave": np.array([size])})
    if kind == "bent":
        return Problem(kind, {"bent": linear("bent", "f", 0.5)}, {"bent": _bent}, {"bent": np.array([size / 3.0])})
    if kind == "two at their bounds":
        both = {"wave": linear("wave", "f", 1.0), "near": linear("near", "g", 1.0)}
        true = {"wave": np.array([size]), "near": np.array([0.0])}
        return Problem(kind, both, {"wave": _wave, "near": _near_wave}, true)
    bump = _bump if kind == "step" else _mirrored
    one = shaped("bump", "f", 2.0, 0.0, 1.0, 16)
    return Problem(kind, {"bump": one}, {"bump": bump}, {"bump": np.array([2.0 * size, 0.8])})


@pytest.mark.parametrize("size", [0.0, 0.0, 0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("kind", ["bound", "bent", "two at their bounds", "step", "two modes"])
def test_the_evidence_is_that_of_nested_sampling(kind: str, size: float, request: pytest.FixtureRequest) -> None:
    """Absent, weak and strong effects, one and two modes: within 0.3 nat. Nested sampling with 600 live points knows
    these to sqrt(H / 600) = 0.1 at an information H of 6 nats."""
    dynesty = pytest.importorskip("dynesty", reason="nested sampling: pip install dynesty")
    problem = _problems(kind, size)
    seed = [ord(c) for c in request.node.name]
    rng = np.random.default_rng(seed)
    clean = np.sum([problem.changes[n](u) for n, u in problem.true.items()], axis=0)
    nuisance = 3.0 * np.column_stack([np.ones(POINTS), X])
    toy = Toy(clean + rng.standard_normal(POINTS), problem.changes, nuisance)
    search = Search(toy, problem.hypotheses, SetPrior({n: h.family for n, h in problem.hypotheses.items()}))
    found = search.refit(frozenset(problem.hypotheses)).total - search.refit(frozenset()).total

    gaussian = toy.gaussian({}, 0.0)
    white = gaussian.whiten(toy.value)
    coords = [(n, c) for n, h in problem.hypotheses.items() for c in h.coordinates]

    def log_likelihood(u: FloatArray) -> float:
        mean, at = np.zeros(POINTS), 0
        for name, h in problem.hypotheses.items():
            mean = mean + problem.changes[name](u[at : at + len(h.coordinates)])
            at += len(h.coordinates)
        r = white - gaussian.whiten(mean)
        return float(0.5 * white @ white - 0.5 * r @ r)

    def from_prior(share: FloatArray) -> FloatArray:
        return np.array([_at_share(c, float(s)) for (_, c), s in zip(coords, share, strict=True)])

    sampler = dynesty.NestedSampler(
        log_likelihood, from_prior, len(coords), nlive=600, rstate=np.random.default_rng(seed)
    )
    sampler.run_nested(dlogz=0.02, print_progress=False)
    assert found == pytest.approx(float(sampler.results.logz[-1]), abs=0.3)
