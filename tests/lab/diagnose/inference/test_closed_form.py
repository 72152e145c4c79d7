"""Linear problems of known truth: scores, the best sets, and how often the sets that hold 95 % hold the truth."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import nnls

from lab.diagnose.inference.closed_form import LinearProblem, LinearSet, posterior, smallest_set
from sim.spectrum import FloatArray

NAMES = tuple("abcdefghij")


def _columns(rng: np.random.Generator, n: int, p: int, common: float) -> FloatArray:
    """Unit columns whose cosines are about `common`^2."""
    table = rng.standard_normal((n, p)) / np.sqrt(n) + common * rng.standard_normal((n, 1)) / np.sqrt(n)
    return np.asarray(table / np.linalg.norm(table, axis=0))


def _problem(white: FloatArray, table: FloatArray, cost: float) -> LinearProblem:
    names = NAMES[: table.shape[1]]
    return LinearProblem.of(white, [table[:, [k]] for k in range(table.shape[1])], names, dict.fromkeys(names, cost))


def _names(problem: LinearProblem, one: LinearSet) -> set[str]:
    return {problem.owners[m] for m in one.members}


def test_scores_are_those_of_least_squares_with_signs() -> None:
    """S = |r|^2 - min |r - G u|^2, of one column, of both signs of one, and of an effect with three; to the ridge of
    1e-8."""
    rng = np.random.default_rng(1)
    table = _columns(rng, 40, 5, 0.8)
    tables = [table[:, [0]], np.column_stack([table[:, 1], -table[:, 1]]), 3.0 * table[:, 2:]]
    white = 4.0 * rng.standard_normal(40)
    problem = LinearProblem.of(white, tables, NAMES[:3], {"a": 1.0, "b": 2.0, "c": 4.0})
    for size in (1, 2, 3):
        for members in combinations(range(3), size):
            found = problem.scored(members)
            u, rest = nnls(np.concatenate([tables[m] for m in members], axis=1), white)
            assert found.score == pytest.approx(white @ white - rest**2, rel=1e-5)
            assert found.log_odds == pytest.approx(0.5 * found.score - sum((1.0, 2.0, 4.0)[m] for m in members))
            np.testing.assert_allclose(
                sum(tables[m] @ share for m, share in zip(members, found.share, strict=True)),
                np.concatenate([tables[m] for m in members], axis=1) @ u,
                atol=1e-4,
            )


def test_a_parameter_of_one_sign_takes_nothing_of_the_other() -> None:
    table = _columns(np.random.default_rng(2), 30, 2, 0.0)
    assert _problem(-5.0 * table[:, 0], table[:, :1], 0.0).scored((0,)).score == 0.0
    assert _problem(5.0 * table[:, 0], table[:, :1], 0.0).scored((0,)).score == pytest.approx(25.0, rel=1e-6)


def test_a_pair_that_one_rival_absorbs_is_the_best() -> None:
    """The rival has a cosine of 0.96 with what a and b do together, so that it alone scores 0.92 of the pair's 800, and
    each of these about half."""
    rng = np.random.default_rng(3)
    table = _columns(rng, 60, 6, 0.0)
    together = table[:, 0] + table[:, 1]
    table[:, 5] = together / np.linalg.norm(together) + 0.3 * table[:, 2]
    table[:, 5] /= np.linalg.norm(table[:, 5])
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(60)
        problem = _problem(20.0 * together + noise, table, 9.0)
        singles, pairs, triples = (problem.best(size) for size in (1, 2, 3))
        assert _names(problem, singles[0]) == {"f"}
        assert _names(problem, pairs[0]) == {"a", "b"}
        assert pairs[0].log_odds > max(singles[0].log_odds, *(t.log_odds for t in triples), 0.0)


def test_of_alternatives_a_pair_has_those_that_are_best_together() -> None:
    """Of 200, the first alternative of a takes 191 alone, the second one 100; beside b, which takes 99 of the rest, 192
    and 199."""
    e = np.eye(4)
    first, second = e[0] + e[1] + 0.3 * e[3], e[0]
    white = 10.0 * e[0] + 10.0 * e[1]
    tables = [first[:, None], second[:, None], e[1][:, None] + 0.1 * e[2][:, None]]
    problem = LinearProblem.of(white, tables, ("a", "a", "b"), {})
    assert problem.singles["a"].members == (0,)
    pairs = problem.best(2)
    assert pairs[0].members == (1, 2)


def test_the_best_triples_extend_the_best_pairs() -> None:
    """Of 120 triples of independent columns, the one of the three largest coefficients, as all are tried would give."""
    rng = np.random.default_rng(4)
    table = _columns(rng, 80, 10, 0.5)
    for seed in range(10):
        draw = np.random.default_rng(seed)
        truth = draw.choice(10, 3, replace=False)
        problem = _problem(table[:, truth] @ draw.uniform(12.0, 20.0, 3) + draw.standard_normal(80), table, 5.0)
        every = max((problem.scored(m) for m in combinations(range(10), 3)), key=lambda s: s.log_odds)
        assert set(problem.best(3)[0].members) == set(every.members)


def test_sets_that_hold_95_percent_hold_the_truth_as_often() -> None:
    """Ten effects of cosines about 0.8, each present with probability 0.15 (none, one or two are), of a size from a
    half normal of 20.

    Over an amplitude u >= 0 with that prior, the likelihood's integral is about exp(S / 2) x 2 / 20: a cost of ln 10
    beside the prior odds. Over 200 draws, 95 % may come out 3 sqrt(0.95 x 0.05 / 200) = 4.6 % lower; and the likeliest
    set's probability is how often it is right, to 3 sqrt(p (1 - p) / 200) <= 10.6 % and what Laplace's method leaves
    out (cosines: ln sqrt(1 - 0.8^2) = 0.5 in a pair's log odds, of which 3 % are allowed for).
    """
    rng = np.random.default_rng(5)
    present, width, draws = 0.15, 20.0, 200
    cost = float(np.log(width / 2.0) + np.log((1.0 - present) / present))
    held = right = 0
    likeliest, sizes = [], []
    for _ in range(draws):
        table = _columns(rng, 40, 10, 2.0)
        while np.count_nonzero(is_there := rng.random(10) < present) > 2:
            pass
        u = np.where(is_there, np.abs(width * rng.standard_normal(10)), 0.0)
        problem = _problem(table @ u + rng.standard_normal(40), table, cost)
        members = [(), *((k,) for k in range(10)), *combinations(range(10), 2)]
        probability = posterior([problem.scored(m).log_odds if m else 0.0 for m in members])
        kept = smallest_set(probability.tolist(), 0.95)
        truth = members.index(tuple(np.flatnonzero(is_there).tolist()))
        held += truth in kept
        right += truth == kept[0]
        likeliest.append(probability[kept[0]])
        sizes.append(len(kept))
    assert held / draws > 0.95 - 0.046
    assert right / draws == pytest.approx(float(np.mean(likeliest)), abs=0.106 + 0.03)
    assert np.mean(sizes) < 0.2 * 56  # and not because they hold nearly all sets


def test_the_smallest_set_is_the_smallest() -> None:
    assert smallest_set([0.5, 0.02, 0.3, 0.18], 0.95) == (0, 2, 3)
    assert smallest_set([0.96, 0.04], 0.95) == (0,)
    np.testing.assert_allclose(posterior([1000.0, 1000.0 - np.log(3.0)]), [0.75, 0.25])
