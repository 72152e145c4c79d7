"""What is reported where two parameters can't be told apart: their combination, with its direction."""

from __future__ import annotations

import numpy as np
import pytest

from lab.diagnose.outcome.determined import determined_directions, is_determined
from lab.diagnose.outcome.named_in_words import sum_words


def test_two_parameters_with_one_signature_are_their_sum() -> None:
    """Analytic limit: of y = x (a + 2 b), with sum x^2 / s^2 = 100 and a wide prior of 50 for each, a + 2 b has the
    standard deviation 0.1, whatever a and b are."""
    precision = 100.0 * np.outer([1.0, 2.0], [1.0, 2.0]) + np.eye(2) / 50.0**2
    (one,) = determined_directions(np.array([1.0, 1.5]), np.linalg.inv(precision))
    # The prior turns the direction by 1 / (50^2 500), 1e-6; it is b + a / 2, as b is the greater part.
    assert one.members == (1, 0)
    np.testing.assert_allclose(one.weights, [1.0, 0.5], rtol=1e-3)
    assert (one.value, one.std) == (pytest.approx(2.0, rel=1e-3), pytest.approx(0.05, rel=1e-3))


def test_what_is_told_apart_and_what_is_determined_has_no_combination() -> None:
    apart = np.array([[1.0, 0.5], [0.5, 1.0]])
    assert determined_directions(np.array([1.0, 1.0]), apart) == []  # a correlation of 0.5: neither is determined
    alike = np.array([[1.0, 0.99], [0.99, 1.0]])
    assert determined_directions(np.array([9.0, 9.0]), alike) == []  # each is 9 sigma from absence
    assert determined_directions(np.array([0.05, 0.1]), alike) == []  # a difference of 0.05 is less than 3 x 0.1
    (one,) = determined_directions(np.array([0.5, -0.5]), alike)  # sqrt(2 x 0.01) = 0.14 of a - b, 1
    assert (one.value, one.std) == (pytest.approx(1.0), pytest.approx(np.sqrt(0.02)))
    np.testing.assert_allclose(one.weights, [1.0, -1.0])
    assert determined_directions(np.array([3.0]), np.eye(1)) == []


def test_a_third_parameter_of_its_own_stays_out() -> None:
    covariance = np.array([[1.0, -0.98, 0.1], [-0.98, 1.0, 0.0], [0.1, 0.0, 4.0]])
    (one,) = determined_directions(np.array([1.0, 1.2, 30.0]), covariance)
    assert sorted(one.members) == [0, 1]


@pytest.mark.parametrize("seed", range(3))
def test_intervals_of_combinations_cover(seed: int) -> None:
    """Known truth: a line by its offset and its slope far from the origin, and a quantity of its own. In 400 draws
    from truths of all sizes, the combination's interval of 95 % holds the truth in 95 %, to 3 sqrt(0.95 0.05 / n)."""
    rng = np.random.default_rng(seed)
    x = np.linspace(20.0, 22.0, 12)
    columns = np.column_stack([np.ones_like(x), x / 21.0, np.sin(9.0 * x)])
    noise, prior = 0.05, 1.0
    covariance = np.linalg.inv(columns.T @ columns / noise**2 + np.eye(3) / prior**2)
    held = []
    for _ in range(400):
        truth = prior * rng.standard_normal(3)
        y = columns @ truth + noise * rng.standard_normal(len(x))
        found = covariance @ columns.T @ y / noise**2
        for one in determined_directions(found, covariance):
            held.append(abs(one.value - one.weights @ truth[list(one.members)]) <= 1.96 * one.std)
    # Offset and slope have a standard deviation of 0.4 each and a sum of 0.014: nearly all draws have a combination.
    assert len(held) > 200
    assert np.mean(held) == pytest.approx(0.95, abs=3.0 * np.sqrt(0.95 * 0.05 / len(held)) + 1e-9)


def test_an_interval_that_holds_absence_does_not_determine_a_size() -> None:
    assert not is_determined(15.0, 0.0, 21.0, None)
    assert is_determined(15.0, 0.0, 7.6, None) and not is_determined(15.0, 0.0, 7.7, None)  # 15 / 1.96 = 7.65
    assert not is_determined(15.0, 0.0, None, (-1.0, 40.0)) and is_determined(15.0, 0.0, 21.0, (2.0, 40.0))
    assert is_determined(1.4, 1.0, 0.1, None) and not is_determined(1.1, 1.0, 0.1, None)
    assert is_determined(3.0, 0.0, None, None)  # no standard deviation is stated


def test_a_combination_reads_as_a_formula() -> None:
    assert sum_words(["slope", "curvature", "tilt"], [1.0, 0.524, -1.0]) == "slope + 0.52 curvature - tilt"
