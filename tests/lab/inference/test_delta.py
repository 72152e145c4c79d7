"""The posterior of small physics, as curves: against dense normal distributions, its limits, and known truth."""

from __future__ import annotations

import numpy as np
import pytest

from lab.inference.delta import condition
from lab.inference.discrepancy import StateCurve
from lab.inference.hypotheses import SetPrior
from lab.inference.model import Group, Process, ScaleIntegral, with_columns
from lab.inference.posterior import read_table
from lab.inference.search import Search
from lab.observables.gaussian import BlockCovariance, Gaussian
from sim.effects.empirical_law import PLACES, EmpiricalLaw
from sim.effects.library import list_changes
from sim.spectrum import FloatArray
from tests.lab.inference.toys import Toy, linear

TAU, NODES, NUMBERS = 0.3, 6, 40


def _kernel() -> FloatArray:
    x = np.arange(NODES)
    return np.exp(-0.5 * np.square((x[:, None] - x) / 2.0)) + 1e-6 * np.eye(NODES)


def _group(kept: int = NODES) -> Group:
    """A process of six nodes that forty numbers follow by lines between them; `kept` directions of it."""
    rng = np.random.default_rng(5)
    factor = np.linalg.cholesky(_kernel())
    hats = np.maximum(1.0 - np.abs(rng.uniform(0.0, NODES - 1.0, NUMBERS)[:, None] - np.arange(NODES)), 0.0)
    columns = 30.0 * hats @ factor
    vectors = np.linalg.eigh(columns.T @ columns)[1][:, -kept:]
    process = Process(factor @ vectors, factor @ (np.eye(NODES) - vectors @ vectors.T) @ factor.T)
    return Group("curve", columns @ vectors, 0.01, process=process)


def _distribution(group: Group, tau: float = TAU) -> Gaussian:
    """Noise of standard deviation 1, and one nuisance parameter that all numbers share."""
    shared = np.ones((NUMBERS, 1))
    alone = Gaussian(np.zeros(NUMBERS), (BlockCovariance(np.eye(NUMBERS)),), shared)
    return with_columns(alone, tau * group.columns)


def test_it_is_the_conditional_of_the_joint_normal_distribution() -> None:
    group, value = _group(), np.random.default_rng(1).standard_normal(NUMBERS)
    found = condition(_distribution(group), value, group, TAU)
    whole = np.eye(NUMBERS) + 1.0 + TAU**2 * group.columns @ group.columns.T
    gain = TAU**2 * group.columns.T @ np.linalg.inv(whole)
    np.testing.assert_allclose(found.mean, gain @ value, atol=1e-9)
    np.testing.assert_allclose(found.covariance, TAU**2 * np.eye(NODES) - TAU**2 * gain @ group.columns, atol=1e-9)


@pytest.mark.parametrize("kept", [2, NODES])
def test_numbers_that_say_nothing_leave_the_prior(kept: int) -> None:
    """At its nodes the process has the kernel times tau^2, whatever directions of it are kept."""
    group = _group(kept)
    silent = Group("curve", 1e-9 * group.columns, 0.01, process=group.process)
    found = condition(_distribution(silent), np.ones(NUMBERS), silent, TAU)
    mean, covariance = found.at_nodes(group.process)
    np.testing.assert_allclose(mean, 0.0, atol=1e-6)
    np.testing.assert_allclose(covariance, TAU**2 * _kernel(), atol=1e-9)


def test_a_known_curve_is_recovered_within_what_it_says() -> None:
    """400 curves of the prior, each with its own noise: r' C^-1 r at the nodes has mean k and variance 2 k."""
    group, rng, draws = _group(), np.random.default_rng(2), 400
    process, distribution = group.process, _distribution(group)
    squares = []
    for _ in range(draws):
        d = TAU * rng.standard_normal(NODES)
        value = group.columns @ d + rng.standard_normal() + rng.standard_normal(NUMBERS)
        mean, covariance = condition(distribution, value, group, TAU).at_nodes(process)
        away = process.values @ d - mean
        squares.append(float(away @ np.linalg.solve(covariance, away)))
    assert np.mean(squares) == pytest.approx(NODES, abs=3.0 * np.sqrt(2.0 * NODES / draws))


def test_unlisted_physics_counts_beside_what_says_nothing() -> None:
    """Five hypotheses that change nothing that is seen: p(unlisted) is that of the group alone, near 1, and isn't
    lessened by the sets that were never refitted."""
    group = _group()
    rng = np.random.default_rng(3)
    value = group.columns @ (TAU * rng.standard_normal(NODES)) + rng.standard_normal(NUMBERS)
    names = [f"h{k}" for k in range(5)]
    signatures = {n: 0.05 * rng.standard_normal(NUMBERS) for n in names}
    changes = {n: (lambda u, own=signatures[n]: u[0] * own) for n in names}
    toy = Toy(value, changes, np.zeros((NUMBERS, 0)), (group,))
    hypotheses = {n: linear(n, n, 1.0) for n in names}
    search = Search(toy, hypotheses, SetPrior({n: n for n in names}))
    posterior = read_table(search.run(), hypotheses)
    alone = Search(toy, {}, SetPrior({}))
    expected = read_table(alone.run(), {}).probability("unlisted", "curve")
    assert expected > 0.999
    # the changes are a twentieth of the noise: their Bayes factors are 1 to a few hundredths
    assert posterior.probability("unlisted", "curve") == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("everyday", [True, False])
def test_flips_of_processes_are_those_of_the_whole_likelihood(everyday: bool) -> None:
    """A state with something everyday and two processes: what a process gains by its scale is the change of the log
    marginal likelihood, to rounding. The prior of none is that of none on any state."""
    rng, one = np.random.default_rng(7), _group()
    processes = tuple(Group("curve", rng.standard_normal((NUMBERS, k)), 0.0, least=0.03, largest=2.0) for k in (1, 4))
    groups = (Group("curve", one.columns, 0.01, largest=0.0), *processes) if everyday else processes
    bare = Gaussian(np.zeros(NUMBERS), (BlockCovariance(np.eye(NUMBERS)),), np.ones((NUMBERS, 1)))
    value, none = 3.0 * rng.standard_normal(NUMBERS), np.zeros(0)
    scales = ScaleIntegral.of(bare, value, groups, np.zeros((NUMBERS, 0)), none, none, 0.05)
    tau = scales.everyday_mode
    found = dict(scales.profiles_of_processes(tau, scales.projected[:, None]))
    assert set(found) == {g for g, group in enumerate(groups) if group.may_be_unlisted}
    for g, gains in found.items():
        points = groups[g].scales(True)
        expected = scales.profile(g, tau, points) - scales.log_likelihood(tau)
        np.testing.assert_allclose(gains[:, 0], expected, atol=1e-8)
        alone = frozenset((g,))
        mode = scales.mode(alone)
        assert mode[g] in points
        for other in np.flatnonzero(mode):
            points = groups[other].scales(other in alone)
            expected = scales.profile(other, mode, points) - scales.log_likelihood(mode)
            np.testing.assert_allclose(scales.gains(other, mode, points), expected, atol=1e-8)
    assert scales.log_prior(frozenset()) == pytest.approx(np.log(0.95))
    assert np.exp(scales.prior_log[1]).sum() == pytest.approx(0.05)


@pytest.mark.parametrize(
    "curve",
    [
        StateCurve("image", "wavelength", "mean", (400.0, 500.0, 600.0)),
        StateCurve("image", "angle", "mean", (0.0, 120.0, 240.0, 360.0)),
        StateCurve("image", "frequency", "mean", (0.0, 0.1, 0.2), fixed=1),
        StateCurve("light", "plane x time", "mean", (0.0, 60.0), curves=3),
        StateCurve("signal", "exposure", "mean", (0.001, 0.01, 0.1), unit=2.5),
        StateCurve("light", "time", "mean", (60.0, 80.0), fixed=1),
        StateCurve("charge", "row", "mean", (), period=6),
        StateCurve("codes", "code", "mean", (), period=8),
    ],
    ids=lambda curve: f"{curve.along}{'-step' * curve.is_step}",
)
def test_a_law_has_the_values_of_its_process(curve: StateCurve) -> None:
    """Values of none change nothing; others stand at the law's points as departures in its unit. A table's mean is that
    of no change."""
    values = 0.01 * np.random.default_rng(4).standard_normal(curve.nodes)
    values -= values.mean() if curve.period else 0.0
    law, none = curve.law(values), curve.law(np.zeros(curve.nodes))
    assert isinstance(law, EmpiricalLaw)
    assert isinstance(none, EmpiricalLaw)
    assert PLACES[law.stage, law.along, law.of][1] == curve.none
    assert list_changes(law)
    np.testing.assert_allclose(none.table, curve.none)
    np.testing.assert_allclose(np.array(law.table) - curve.none, curve.change(values), atol=1e-12)
    assert curve.change(values)[curve.fixed :][: curve.nodes] == pytest.approx(curve.unit * values)
    lower = np.linalg.cholesky(curve.kernel)  # positive definite
    np.testing.assert_allclose(np.square(lower).sum(axis=1), np.diag(curve.kernel))


@pytest.mark.parametrize("along", ["astigmatic frequency", "diagonal frequency", "chromatic frequency"])
def test_a_directed_law_acts_on_the_transfer(along: str) -> None:
    curve = StateCurve("image", along, "mean", (0.0, 0.1, 0.2), fixed=1)  # type: ignore[arg-type]
    assert {name.partition(".")[0] for name in list_changes(curve.law(np.array([0.01, 0.02])))} == {"image"}
