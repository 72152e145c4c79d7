"""Evidence in closed form, by quadrature and by Laplace's approximation, on toys whose integrals are known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student_t

from lab.inference.hypotheses import Alternative, Coordinate, Hypothesis, SetPrior
from lab.inference.laplace import best_within_bounds, integrate, log_box
from lab.inference.model import Group, Point, ScaleIntegral
from lab.inference.search import ANY_UNLISTED, Search
from sim.spectrum import FloatArray
from tests.lab.inference.toys import Toy, linear, shaped


@pytest.mark.parametrize(
    ("precision", "slope"), [(4.0, 1.0), (4.0, -3.0), (100.0, 50.0), (25.0, -40.0), (400.0, 4000.0)]
)
@pytest.mark.parametrize("smaller", [1.0, 0.1, 0.01])
def test_one_amplitude_at_its_bound_is_integrated_as_by_quadrature(
    precision: float, slope: float, smaller: float
) -> None:
    """Of exp(slope u - precision u^2 / 2) p(u) over u >= 0, p a half Student t, half of it of a smaller scale. The
    tails are cut at 6 standard deviations, which leaves 1e-4 at most."""
    c = Coordinate("size", 1.0, lower=0.0, smaller=smaller)
    top = max(slope, 0.0) ** 2 / 2.0 / precision

    def density(u: float) -> float:
        return float(np.exp(slope * u - 0.5 * precision * u * u - top + float(c.log_prior(u))))

    middle = max(slope / precision, 0.0) + 3.0 / np.sqrt(precision)
    edges = sorted({0.0, smaller, 6.0 * smaller, middle})
    parts = [quad(density, a, b)[0] for a, b in pairwise([*edges, np.inf])]
    exact = np.log(sum(parts)) + top
    u = max(slope / precision, 0.0)
    away = integrate(np.array([[precision]]), np.array([slope - precision * u]), [c], np.array([u])).log_integral
    assert away + slope * u - 0.5 * precision * u * u == pytest.approx(exact, abs=2e-3)


def test_several_amplitudes_are_cut_to_their_bounds() -> None:
    """Three correlated ones, against the distribution function of the normal distribution, known to 1e-4 there; 512
    points of the separation of variables give 1e-3."""
    covariance = np.array([[1.0, 0.6, 0.2], [0.6, 2.0, 0.3], [0.2, 0.3, 1.5]])
    mean = np.array([-0.5, 1.0, 0.2])
    exact = np.log(multivariate_normal(-mean, covariance).cdf(np.zeros(3)))
    assert log_box(mean, covariance, np.zeros(3), np.full(3, np.inf)) == pytest.approx(exact, abs=3e-3)


def test_the_best_step_within_bounds_is_that_of_a_grid() -> None:
    """Of two correlated parameters, one of which may only grow: steps of 0.01 about the best cost 2 x 0.01^2 x 4."""
    coords = [Coordinate("size", 1.0, lower=0.0), Coordinate("other", 1.0)]
    a, b, u = np.array([[4.0, 3.0], [3.0, 4.0]]), np.array([-2.0, 1.0]), np.array([0.2, 0.1])
    slope, precision = np.array([c.slope_and_precision(float(x)) for c, x in zip(coords, u, strict=True)]).T
    grid = np.stack(np.meshgrid(np.arange(-0.2, 1.0, 0.01), np.arange(-1.0, 1.0, 0.01), indexing="ij"), -1)
    hessian = a + np.diag(precision)
    gain = grid @ (b + slope) - 0.5 * np.einsum("...i,ij,...j", grid, hessian, grid)
    step, most = best_within_bounds(a, b, coords, u)
    assert most == pytest.approx(gain.max(), abs=1e-3)
    assert step == pytest.approx(grid.reshape(-1, 2)[int(gain.argmax())], abs=0.02)
    assert step[0] == pytest.approx(-0.2, abs=1e-6)


def test_a_flat_shape_that_nothing_determines_costs_nothing() -> None:
    """Its prior integrates to one."""
    c = Coordinate("shape", np.inf, 2.0, 5.0, is_shape=True)
    assert integrate(np.zeros((1, 1)), np.zeros(1), [c], np.array([3.3])).log_integral == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("smaller", [1.0, 0.1, 0.01])
@pytest.mark.parametrize("lower", [0.0, -np.inf])
def test_a_size_that_nothing_determines_costs_nothing(smaller: float, lower: float) -> None:
    """A normal distribution cut at 6 standard deviations misses 1.4 % of Student's t."""
    c = Coordinate("size", 2.0, lower=lower, smaller=smaller)
    assert integrate(np.zeros((1, 1)), np.zeros(1), [c], np.array([0.1])).log_integral == pytest.approx(0.0, abs=0.02)


def _linear_toy(rng: np.random.Generator, groups: int = 2) -> tuple[Toy, FloatArray]:
    x = np.linspace(0.0, 1.0, 30)
    nuisance = 5.0 * np.column_stack([np.ones(30), x])
    shapes = [
        np.exp(-0.5 * ((x[:, None] - np.linspace(0, 1, 5)) / 0.15) ** 2) * (1.0 if g else -1.0) for g in range(groups)
    ]
    found = tuple(Group(f"g{g}", 4.0 * s if g else 4.0 * np.sin(9 * s), 0.05) for g, s in enumerate(shapes))
    return Toy(rng.standard_normal(30), {}, nuisance, found), x


def test_the_marginal_likelihood_of_the_scales_is_that_of_the_dense_normal_distribution() -> None:
    """log N(y; 0, 1 + J J' + sum tau^2 H H'), exactly: differences between scales agree to rounding."""
    toy, _ = _linear_toy(np.random.default_rng(3))
    gaussian = toy.gaussian({}, 0.0)
    none = np.zeros(0)
    scales = ScaleIntegral.of(gaussian, toy.value, toy.groups, np.zeros((30, 0)), none, none, 0.05)

    def dense(tau: FloatArray) -> float:
        covariance = gaussian.covariance + sum(
            t**2 * g.columns @ g.columns.T for g, t in zip(toy.groups, tau, strict=True)
        )
        return float(multivariate_normal(np.zeros(30), covariance).logpdf(toy.value))

    first, second = np.array([0.01, 0.02]), np.array([0.5, 0.3])
    assert scales.log_likelihood(second) - scales.log_likelihood(first) == pytest.approx(
        dense(second) - dense(first), abs=1e-8
    )


def test_the_evidence_of_a_linear_set_is_that_of_quadrature() -> None:
    """One amplitude, theta and everyday delta: the refitted set over the empty one, against the dense normal
    distribution integrated over the amplitude by quadrature. 0.02 is the quadrature over 7 scales' own error."""
    toy, x = _linear_toy(np.random.default_rng(5), groups=0)
    change = 6.0 * np.sin(7.0 * x)
    toy = Toy(toy.value + 0.4 * change, {"wave": lambda u: u[0] * change}, toy.nuisance)
    one = linear("wave", "waves", 0.3)
    search = Search(toy, {"wave": one}, SetPrior({"wave": "waves"}))
    table = search.run()
    with_it, without = table.fits[frozenset({"wave"})], table.fits[frozenset()]
    covariance = np.eye(30) + toy.nuisance @ toy.nuisance.T
    normal = multivariate_normal(np.zeros(30), covariance)
    none = float(normal.logpdf(toy.value))
    c = one.coordinates[0]
    exact = np.log(
        quad(
            lambda u: np.exp(normal.logpdf(toy.value - u * change) - none + float(c.log_prior(u))),
            0.0,
            2.0,
            points=[0.4],
        )[0]
    )
    assert with_it.total - without.total == pytest.approx(exact, abs=0.02)
    assert search.singles[frozenset()]["wave"] == pytest.approx(exact, abs=0.02)


def test_two_places_of_one_step_are_both_summed() -> None:
    """A bump at one of two places that a symmetric prediction doesn't tell apart: the evidence is twice that of one
    mode, by the grid of two-dimensional quadrature within 0.1."""
    x = np.linspace(0.0, 1.0, 40)

    def bump(u: FloatArray) -> FloatArray:
        at = abs(u[1] - 0.5)  # a place and its mirror image give the same change
        return np.asarray(u[0] * np.exp(-0.5 * ((x - at) / 0.1) ** 2))

    rng = np.random.default_rng(2)
    value = 6.0 * bump(np.array([1.0, 0.8])) + rng.standard_normal(40)
    toy = Toy(value, {"bump": bump}, np.zeros((40, 0)))
    one = shaped("bump", "bumps", 4.0, 0.0, 1.0, 10)
    table = Search(toy, {"bump": one}, SetPrior({"bump": "bumps"})).run()
    sizes, places = np.linspace(0.0, 20.0, 801), np.linspace(0.0, 1.0, 801)
    grid = np.array([[-0.5 * np.sum((value - bump(np.array([s, p]))) ** 2) for p in places] for s in sizes[::4]])
    prior = np.array([float(one.coordinates[0].log_prior(s)) for s in sizes[::4]])
    exact = np.log(np.sum(np.exp(grid - grid.max() + prior[:, None])) * (sizes[4] - sizes[0]) * (places[1] - places[0]))
    exact += grid.max() + 0.5 * float(value @ value)
    found = table.fits[frozenset({"bump"})].total - table.fits[frozenset()].total
    assert found == pytest.approx(exact, abs=0.1)
    assert len(table.fits[frozenset({"bump"})].others) == 1


def test_the_prior_of_sets_sums_to_one() -> None:
    """Over all sets of five hypotheses in three families, with at most five members."""
    from itertools import combinations

    families = {"a": "f", "b": "f", "c": "g", "d": "h", "e": "h"}
    prior = SetPrior(families)
    sets = [frozenset(s) for k in range(6) for s in combinations(families, k)]
    assert sum(np.exp(prior.log(s)) for s in sets) == pytest.approx(1.0, abs=1e-12)
    assert prior.weight["c"] == pytest.approx(2.0 * prior.weight["a"])


def test_probabilities_of_an_effect_that_is_hardly_seen_are_those_of_quadrature() -> None:
    """Draws with and without one effect beside an everyday discrepancy that looks like it: the log odds by sums over
    400 points of the scale and 1,201 of the size. Seven points of the scale leave 0.1 at most, where the groups' scales
    at their likeliest values would leave up to 1.8."""
    points = 36
    x = np.linspace(0.0, 1.0, points)
    change, offset = 4.0 * (x - 0.5), 2.0 * np.ones((points, 1))
    smooth = Group("smooth", 30.0 * np.exp(-0.5 * np.square((x[:, None] - np.linspace(0.0, 1.0, 6)) / 0.12)), 0.01)
    hypotheses = {"line": linear("line", "slopes", 1.0, positive=False)}
    prior = SetPrior({"line": "slopes"})
    share = (np.arange(400) + 0.5) / 400
    scales = {
        False: smooth.everyday * norm.ppf(0.5 + 0.5 * share),
        True: np.exp(np.log(3.0 * smooth.everyday) + share * np.log(smooth.largest / (3.0 * smooth.everyday))),
    }
    size = np.linspace(-12.0, 12.0, 1201)
    log_size = student_t.logpdf(size, 3) + np.log(size[1] - size[0])
    rng = np.random.default_rng(21)
    away = []
    for _ in range(16):
        tau = smooth.everyday * abs(rng.standard_normal())
        y = rng.standard_normal(points) + offset @ rng.standard_normal(1) + change * rng.normal(0.0, 0.25)
        y = y + tau * smooth.columns @ rng.standard_normal(6)
        log: dict[str, list[float]] = {"": [], "line": []}
        for unlisted, values in scales.items():
            own = np.log(ANY_UNLISTED if unlisted else 1.0 - ANY_UNLISTED) - np.log(len(values))
            for value in values:
                covariance = np.eye(points) + offset @ offset.T + value**2 * smooth.columns @ smooth.columns.T
                lower = np.linalg.cholesky(covariance)
                white, w = np.linalg.solve(lower, y), np.linalg.solve(lower, change)
                base = own - float(np.log(np.diag(lower)).sum()) - 0.5 * float(white @ white)
                log[""].append(base)
                log["line"].append(base + float(logsumexp(size * (w @ white) - 0.5 * size**2 * (w @ w) + log_size)))
        odds = logsumexp(log["line"]) - logsumexp(log[""])
        exact = odds + prior.log(frozenset({"line"})) - prior.log(frozenset())
        table = Search(Toy(y, {"line": lambda u: change * u[0]}, offset, (smooth,)), hypotheses, prior).run()
        p = sum(row.probability for row in table.rows if "line" in row.members)
        if 0.02 < p < 0.98:
            away.append(float(np.log(p / (1.0 - p)) - exact))
    assert len(away) > 8
    assert np.abs(away).max() < 0.1


def test_a_rival_that_bends_is_refitted_before_it_is_ruled_out() -> None:
    """Two changes that are the same but for the bend of one by its size: the closed form about nothing, which scales
    its signature, gives it a seventh of the other's probability."""
    along, bend = np.zeros(40), np.zeros(40)
    along[0], bend[1] = 10.0, 2.3

    def straight(u: np.ndarray) -> np.ndarray:
        return u[0] * along

    def bent(u: np.ndarray) -> np.ndarray:
        return u[0] * along + (u[0] ** 2 - u[0]) * bend

    value = straight(np.array([1.0]))
    hypotheses = {
        "straight": Hypothesis("straight", "a", (Coordinate("size", 1.0, lower=0.0),), _prototype(1.0)),
        "bent": Hypothesis("bent", "a", (Coordinate("size", 1.0, lower=0.0),), _prototype(3.0)),
    }
    toy = Toy(value, {"straight": straight, "bent": bent}, np.zeros((40, 0)))
    search = Search(toy, hypotheses, SetPrior(dict.fromkeys(hypotheses, "a")))
    table = search.run()
    either = {name: sum(r.probability for r in table.rows if name in r.members) for name in hypotheses}
    # at size 1 both predict the same; the integrals over the size differ by its bend, a few per cent
    assert either["bent"] / either["straight"] == pytest.approx(1.0, abs=0.2)


def _prototype(size: float) -> tuple[Alternative, ...]:
    return (Alternative((Point(np.array([size])),), (1.0 / size,)),)
