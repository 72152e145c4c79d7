"""The closed form of evidences: amplitudes by quadrature, several columns by the joint integral, p(nothing) of a
table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import t as student_t

from lab.inference.closed_form import Signature, amplitude_log_odds, integrate_each, integrate_set, signature_log_odds
from lab.inference.hypotheses import Coordinate, SetPrior
from lab.inference.model import Group, Point, State
from lab.inference.posterior import read_table
from lab.inference.search import Search
from lab.observables.gaussian import BlockCovariance, Gaussian
from sim.spectrum import FloatArray
from tests.lab.inference.toys import Toy, linear

POINTS = 40
X = np.linspace(0.0, 1.0, POINTS)


@pytest.mark.parametrize("positive", [True, False])
@pytest.mark.parametrize("width", [0.01, 1.0, 1000.0])
@pytest.mark.parametrize("signal", [-5.0, 0.0, 4.0, 20.0])
@pytest.mark.parametrize("smaller", [1.0, 0.01])
def test_an_amplitude_is_integrated_as_by_quadrature(
    signal: float, width: float, positive: bool, smaller: float
) -> None:
    """log integral exp(signal x - x^2 / 2) p(x) dx, p Student's t of this width, half of it of a smaller one.
    Quadrature about a strong mode takes the prior's logarithm as smooth, which leaves 1 / signal^2 at most."""
    top = max(signal if positive else abs(signal), 0.0)
    edges = sorted({
        0.0, smaller * width, 10.0 * smaller * width, width, 10.0 * width, 0.5, max(top - 6.0, 0.0), top, top + 6.0,
        top + 12.0,
    })  # fmt: skip
    edges = [e for e in edges if e <= top + 12.0]

    def density(x: float, sign: float) -> float:
        prior = np.mean([student_t.pdf(x / (s * width), 3) / (s * width) for s in (1.0, smaller)])
        return float(np.exp(sign * signal * x - 0.5 * x * x - 0.5 * top**2) * prior)

    parts = [
        quad(density, a, b, args=(s,), limit=200)[0]
        for a, b in pairwise(edges)
        for s in ((1.0,) if positive else (1.0, -1.0))
    ]
    exact = np.log((2.0 if positive else 1.0) * sum(parts)) + 0.5 * top**2
    one = np.ones(1)
    found = amplitude_log_odds(signal * one, one, width * one, np.array([positive]), smaller * one)[0]
    assert found == pytest.approx(exact, abs=0.01)


def test_each_signature_is_integrated_as_a_set_of_its_own() -> None:
    """Of one column by quadrature, where a set has Laplace's integral with the prior's tails (0.02 nats), and with the
    same mode; of two as the set."""
    scale = (0.5, 1.0, 30.0, 1.0, 2.0)
    lower = (0.0, -np.inf, 0.0, 0.0, 0.0)
    coordinates = [Coordinate("a", w, lower=lo) for w, lo in zip(scale, lower, strict=True)]
    raw = np.zeros((1, 1))
    signatures = [Signature(f"s{k}", 0, raw, (coordinates[k],), (k,), ()) for k in range(3)]
    signatures.append(Signature("pair", 0, raw, tuple(coordinates[3:]), (3, 4), ()))
    gram = np.diag([4.0, 9.0, 1.0, 2.0, 3.0]) + 0.3
    z = np.array([1.5, -20.0, -0.7, 2.0, 4.0])
    for one, (value, mode) in zip(signatures, integrate_each(z, gram, signatures), strict=True):
        wanted, at = integrate_set(z, gram, [one])
        assert value == pytest.approx(wanted, abs=0.02)
        np.testing.assert_allclose(mode, at, atol=1e-3)


def test_two_weak_columns_are_integrated_as_by_quadrature() -> None:
    """One after the other, against a grid over both amplitudes, >= 0 with prior scale 1 and a correlation of 0.5.
    The first one's bound is left out of the second's: 0.4 nats at most, which only enters by how it depends on the
    groups' scales."""
    gram = 4.0 * np.array([[1.0, 0.5], [0.5, 1.0]])
    coordinate = Coordinate("a", 1.0, lower=0.0)
    one = Signature("pair", 0, np.zeros((1, 2)), (coordinate,) * 2, (0, 1), ())
    c = (np.arange(600) + 0.5) * 0.02
    prior = coordinate.log_prior(np.asarray(c, float)) + np.log(0.02)
    quadratic = -2.0 * np.square(c[:, None]) - 2.0 * np.square(c) - 2.0 * np.outer(c, c) + prior[:, None] + prior
    away = []
    for z in np.random.default_rng(1).multivariate_normal(np.zeros(2), gram, 20):
        if np.abs(z).max() < 6.0:  # three standard deviations
            exact = float(logsumexp(quadratic + z[0] * c[:, None] + z[1] * c))
            away.append(signature_log_odds(z, gram, [one])[0] - exact)
    assert len(away) > 15
    assert np.abs(away).max() < 0.4


def test_the_closed_form_of_nothing_is_that_of_the_table() -> None:
    """p(no effect, nothing unlisted) of healthy draws, as their threshold takes it, and as the whole search does: sets
    of which two members speak are left out, which healthy draws hardly have, so that they agree to 0.05."""
    smooth = np.exp(-0.5 * np.square((X[:, None] - np.linspace(0.0, 1.0, 6)) / 0.12))
    changes = {"line": lambda u: 4.0 * u[0] * (X - 0.5), "wave": lambda u: 3.0 * u[0] * np.sin(11.0 * X)}
    hypotheses = {name: linear(name, f"{name}s", 1.0, positive=False) for name in changes}
    prior = SetPrior({name: h.family for name, h in hypotheses.items()})
    rng = np.random.default_rng(8)
    for _ in range(4):
        toy = Toy(rng.standard_normal(POINTS), changes, np.ones((POINTS, 1)), (Group("smooth", 30.0 * smooth, 0.01),))
        search = Search(toy, hypotheses, prior)
        whole = read_table(search.run(), hypotheses).nothing
        empty = search.fits[frozenset()]
        assert search._nothing(empty.likeliest.scales, search._gram(empty)) == pytest.approx(whole, abs=0.05)


@dataclass(frozen=True)
class InexactToy(Toy):
    """A law `line` that may be wrong by a tenth of its change, smoothly along the axis."""

    def gaussian(self, state: State, form_scale: float) -> Gaussian:
        """Return the distribution with the law's form error."""
        error = 0.1 * form_scale * self.mean(state)
        alike = np.exp(-0.5 * np.square((X[:, None] - X) / 0.2))
        covariance = BlockCovariance(np.eye(len(self.value)) + error[:, None] * alike * error)
        return Gaussian(self.mean(state), (covariance,), self.nuisance)

    def has_form_error(self, state: Mapping[str, Point]) -> bool:
        """Whether `line` acts."""
        return bool(state)


@pytest.mark.parametrize(("bend", "inexact"), [(0.0, False), (0.5, True)])
def test_a_law_that_is_wrong_by_more_than_it_declares_is_inexact(bend: float, inexact: bool) -> None:
    """A line of 100 standard deviations, and one that bends by half of itself: 5 times its tolerance."""

    def line(u: FloatArray) -> FloatArray:
        return np.asarray(100.0 * u[0] * (X + 0.2))

    noise = np.random.default_rng(3).standard_normal(POINTS)
    value = line(np.array([1.0])) * (1.0 + bend * np.sin(9.0 * X)) + noise
    hypotheses = {"line": linear("line", "lines", 1.0)}
    toy = InexactToy(value, {"line": line}, np.zeros((POINTS, 0)))
    posterior = read_table(Search(toy, hypotheses, SetPrior({"line": "lines"})).run(), hypotheses)
    assert [f.name for f in posterior.named] == ["line"]
    assert (posterior.inexact["line"] > 0.5) == inexact


def test_two_others_are_found_in_the_place_of_an_inexact_member() -> None:
    """A line and a wave of 60 and 30 standard deviations, and `both`, a law that changes the numbers by the sum of
    equal ones: alone it is wrong by a third of its change, three times its tolerance. From it, the right pair is an
    exchange of one for two."""
    laws = {
        "line": lambda u: 60.0 * u[0] * (X + 0.2),
        "wave": lambda u: 60.0 * u[0] * np.sin(9.0 * X),
        "both": lambda u: 60.0 * u[0] * (X + 0.2 + np.sin(9.0 * X)),
    }
    noise = np.random.default_rng(3).standard_normal(POINTS)
    value = laws["line"](np.ones(1)) + laws["wave"](np.array([0.5])) + noise
    hypotheses = {name: linear(name, f"{name}s", 1.0) for name in laws}
    toy = InexactToy(value, laws, np.zeros((POINTS, 0)))
    search = Search(toy, hypotheses, SetPrior({name: h.family for name, h in hypotheses.items()}))
    search.fit({})
    assert search.fit({"both": Point(np.array([0.7]))}).inexact > 0.5
    assert search._exchange()
    assert search._log_posterior(search.fits[frozenset(("line", "wave"))]) == search._top()
    assert search.fits[frozenset(("line", "wave"))].inexact < 0.5
    assert not search._exchange()
