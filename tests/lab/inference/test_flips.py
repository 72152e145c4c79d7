"""Sets beside unlisted physics: the mode of a set moves where a process takes over what it explained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.special import logsumexp

from lab.inference.hypotheses import Alternative, Coordinate, Hypothesis, SetPrior
from lab.inference.model import Group, Point, ScaleIntegral
from lab.inference.search import Search
from sim.spectrum import FloatArray
from tests.lab.inference.toys import Toy

N = 60
X = np.linspace(0.0, 1.0, N)


def _process(name: str, columns: FloatArray) -> Group:
    """A process that is there only where it is unlisted, from 0.1 to 30."""
    return Group(name, columns, 0.0, largest=30.0, least=0.1)


def _waves(turns: Sequence[int]) -> FloatArray:
    return np.column_stack([f(2.0 * np.pi * k * X) for k in turns for f in (np.sin, np.cos)])


def _bend(u: FloatArray) -> FloatArray:
    """A law that saturates in its two parameters: about a large one, its Jacobian isn't its change."""
    return np.asarray(20.0 * u[0] * np.exp(-u[1]) * (1.0 - np.exp(-np.exp(u[1]) * X)))


_BEND = Hypothesis(
    "bend", "one",
    (Coordinate("size", 1.0, lower=0.0), Coordinate("shape", 1.0, -4.0, 4.0, is_shape=True)),
    (Alternative((Point(np.array([1.0, 0.0])),), (1.0,)),),
)  # fmt: skip


def _by_quadrature(value: FloatArray, group: Group) -> float:
    """Return log p(y | A, u = 1) but for powers of 2 pi: over the seven scales, and over the parameters on a grid."""
    size = np.concatenate([np.geomspace(1e-4, 0.1, 40), np.linspace(0.12, 6.0, 90)])
    edges = np.concatenate([[0.0], 0.5 * (size[1:] + size[:-1]), [6.06]])
    shape = np.linspace(-3.95, 3.95, 80)
    first, second = _BEND.coordinates
    log_prior = (
        (first.log_prior(size) + np.log(np.diff(edges)))[:, None]
        + second.log_prior(shape) + np.log(shape[1] - shape[0])
    )  # fmt: skip
    residual = np.array([[value - _bend(np.array([a, b])) for b in shape] for a in size])
    found = []
    for tau in group.scales(True):
        covariance = np.eye(N) + tau**2 * group.columns @ group.columns.T
        white = residual @ np.linalg.cholesky(np.linalg.inv(covariance))
        log_det = float(np.linalg.slogdet(covariance)[1])
        found.append(logsumexp(log_prior - 0.5 * np.square(white).sum(-1)) - 0.5 * log_det)
    return float(logsumexp(found) - np.log(len(found)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_evidence_beside_an_unlisted_process_is_that_of_quadrature(sign: float) -> None:
    """A process of 6 in two waves, and a bend that takes a part of it where there is no process. Quadrature is right to
    0.2; about the mode without the process, the evidence with it was wrong by 2 nats and more."""
    rng = np.random.default_rng(5)
    group = _process("waves", _waves((1, 2)))
    y = group.columns @ (sign * np.array([6.0, -6.0, 3.0, -3.0])) + rng.standard_normal(N)
    search = Search(Toy(y, {"bend": _bend}, np.zeros((N, 0)), (group,)), {"bend": _BEND}, SetPrior({"bend": "one"}))
    fit, flip = search.refit(frozenset({"bend"})), frozenset((0,))
    found = fit.by_groups[flip] - fit.likeliest.scales.log_prior(flip)
    assert found == pytest.approx(_by_quadrature(search.model.value, group), abs=0.3)
    assert fit.given(flip) is not fit
    assert fit.given(frozenset()) is fit


def test_groups_that_are_small_beside_the_best_are_tried_about_it() -> None:
    """Two processes of 300 and of 6 standard deviations: about none, the second is some 40,000 nats below the first,
    and about the first it gains more than its prior odds of 1 in 40."""
    rng = np.random.default_rng(6)
    strong, weak, silent = (_process(name, _waves(turns)) for name, turns in (("a", (1, 2)), ("b", (5,)), ("c", (9,))))
    y = strong.columns @ np.full(4, 25.0) + weak.columns @ np.full(2, 1.5) + rng.standard_normal(N)
    scales = ScaleIntegral.of(
        Toy(y, {}, np.zeros((N, 0))).gaussian({}, 0.0), y, (strong, weak, silent), np.zeros((N, 0)), np.zeros(0),
        np.zeros(0), 0.05,
    )  # fmt: skip
    weights = scales.weights()
    assert max(weights, key=lambda u: weights[u]) == {0, 1}
    # no process of no size: 1 in 60 by its prior, and as much again by its scales
    assert frozenset((0, 1, 2)) not in weights or weights[frozenset((0, 1, 2))] < weights[frozenset((0, 1))] - 3.0
