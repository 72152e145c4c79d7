"""Strengths of concealed effects and the oracle, in linear Gaussian problems with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from evaluation.noncentrality import (
    FALSE_ALARMS,
    Directions,
    beyond,
    oracle_share,
    separability,
    span,
    with_direction,
)

DRAWS = 2000
NAMES = [f"effect_{k}" for k in range(45)]


def tolerance(parameters: int, strength: float) -> float:
    """Tolerance of the oracle's share of right names: four standard deviations over DRAWS; the change of the power if
    the share of false alarms is off by 40 %, four times the price's error of 10 %; and the share of draws in which
    another effect exceeds its price."""
    low, power, high = (
        float(ncx2.sf(chi2.isf(FALSE_ALARMS * factor / len(NAMES), parameters), parameters, strength))
        for factor in (0.6, 1.0, 1.4)
    )
    return 4.0 * float(np.sqrt(power * (1.0 - power) / DRAWS)) + max(high - power, power - low) + FALSE_ALARMS


def orthogonal(parameters: int, size: int = 150) -> list[Directions]:
    """45 mutually orthogonal effects: the first with `parameters` parameters, the others with one."""
    axes = np.eye(size)
    first = Directions(NAMES[0], axes[:, 50 : 50 + parameters])
    return [first, *(Directions(name, axes[:, [k]]) for k, name in enumerate(NAMES) if k)]


@pytest.mark.parametrize("parameters", [1, 3])
@pytest.mark.parametrize("strength", [10.0, 15.0, 25.0, 30.0, 40.0])
def test_the_oracle_has_the_power_of_the_chi2_test(parameters: int, strength: float) -> None:
    """One effect among 45 that are orthogonal to it is named where its non-central chi2 exceeds the threshold; a false
    name comes first as rarely as false alarms do."""
    candidates = orthogonal(parameters)
    mean = candidates[0].basis @ np.full(parameters, np.sqrt(strength / parameters))
    found = oracle_share(mean, candidates, NAMES[:1], np.random.default_rng(1), DRAWS)
    power = ncx2.sf(chi2.isf(FALSE_ALARMS / len(NAMES), parameters), parameters, strength)
    assert abs(found - power) < tolerance(parameters, strength)


def test_the_table_of_the_specification() -> None:
    """The specification's table of power at 1 % false alarms over 45 effects, to its two decimals."""
    for parameters, shares in ((1, (0.30, 0.57, 0.90, 0.96, 1.00)), (3, (0.16, 0.39, 0.79, 0.90, 0.98))):
        power = ncx2.sf(chi2.isf(FALSE_ALARMS / 45, parameters), parameters, np.array([10.0, 15.0, 25.0, 30.0, 40.0]))
        np.testing.assert_allclose(power, shares, atol=0.0101)


def test_the_oracle_keeps_its_false_alarms() -> None:
    """Nothing concealed: all names together have a share of 1 %, within the 10 % of the price's own error; twenty
    copies of each effect change nothing."""
    candidates, rng = orthogonal(1), np.random.default_rng(2)
    few = [Directions(one.name, one.basis) for one in candidates[:3] for _ in range(20)]
    named = sum(oracle_share(np.zeros(150), few, [name], rng, 5000) for name in NAMES[:3])
    assert abs(named - FALSE_ALARMS) < 4.0 * np.hypot(0.1 * FALSE_ALARMS, np.sqrt(FALSE_ALARMS / (3 * 5000)))


def test_effects_with_one_direction_are_named_by_chance() -> None:
    """Two effects with the same direction: together they come first in at most all draws, and neither is told from the
    other."""
    axes = np.eye(20)
    twins = [Directions("one", axes[:, :1]), Directions("two", axes[:, :1]), Directions("other", axes[:, 1:2])]
    mean = 10.0 * axes[:, 0]
    assert separability(mean, mean, np.zeros((20, 0)), twins[1:]) == (0.0, "two")
    shares = [oracle_share(mean, twins, [name], np.random.default_rng(3), DRAWS) for name in ("one", "two")]
    assert sum(shares) <= 1.0


def test_conditional_and_separable_parts_of_oblique_directions() -> None:
    """Beyond one direction: |d|^2 (1 - cos^2). Beyond a plane: the residual of Gram-Schmidt orthogonalisation."""
    axes, angle = np.eye(5), np.radians(30.0)
    change = 6.0 * axes[:, 0]
    partner = np.cos(angle) * axes[:, [0]] + np.sin(angle) * axes[:, [1]]
    assert beyond(change, change, partner) == pytest.approx(36.0 * np.sin(angle) ** 2)
    rival = Directions("rival", np.cos(angle) * axes[:, [0]] + np.sin(angle) * axes[:, [2]])
    far = Directions("far", axes[:, [3]])
    # normal of both in the space of the first three axes: (1, -cot, -cot) / sqrt(1 + 2 cot^2)
    left, name = separability(change, change, partner, [far, rival])
    assert (left, name) == (pytest.approx(36.0 / (1.0 + 2.0 / np.tan(angle) ** 2)), "rival")
    assert separability(change, change, partner, []) == (pytest.approx(36.0 * np.sin(angle) ** 2), None)


def test_the_noise_of_a_measured_change_cancels() -> None:
    """With two draws of the noise, the mean of d1' P d2 is |P d|^2; the square of one draw would add the noise of n
    numbers."""
    rng, basis = np.random.default_rng(4), span(np.random.default_rng(5).normal(size=(50, 3)))
    change = rng.normal(size=50)
    true = beyond(change, change, basis)
    found = [
        float(a @ b - (a @ basis) @ (b @ basis))
        for a, b in (change + 0.3 * rng.standard_normal((2, 50)) for _ in range(4000))
    ]
    assert abs(np.mean(found) - true) < 4.0 * np.std(found) / np.sqrt(len(found))


@pytest.mark.parametrize("conditional", [15.0, 25.0, 50.0])
def test_a_pair_is_told_as_its_weaker_member_allows(conditional: float) -> None:
    """Its partner at 1000 and at an angle of 60 degrees to it: both are named as often as the part beyond the partner
    is above the threshold, but for the false third, which can't be named, and the few rivals that noise prefers."""
    candidates = orthogonal(1)
    axes, angle = np.eye(150), np.radians(60.0)
    oblique = np.cos(angle) * axes[:, 1] + np.sin(angle) * axes[:, 50]
    candidates[0] = Directions(NAMES[0], oblique[:, None])
    mean = np.sqrt(conditional) / np.sin(angle) * oblique + np.sqrt(1000.0) * axes[:, 1]
    found = oracle_share(mean, candidates, NAMES[:2], np.random.default_rng(6), DRAWS)
    power = ncx2.sf(chi2.isf(FALSE_ALARMS / len(NAMES), 1), 1, conditional)
    assert abs(found - power) < tolerance(1, conditional)


def test_a_known_law_takes_the_place_of_the_nearest_direction() -> None:
    """The basis keeps its size, holds the change, and keeps what is orthogonal to the direction that it replaced."""
    axes = np.eye(6)
    change = 3.0 * (axes[:, 0] + 0.2 * axes[:, 4])
    found = with_direction(axes[:, :2], change)
    assert found.shape == (6, 2)
    np.testing.assert_allclose(found.T @ found, np.eye(2), atol=1e-12)
    assert beyond(change, change, found) == pytest.approx(0.0, abs=1e-12)
    assert beyond(axes[:, 1], axes[:, 1], found) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("truth", [[], ["a", "b", "c"], ["nobody"]])
def test_the_oracle_refuses_impossible_questions(truth: list[str]) -> None:
    candidates = [Directions(name, np.eye(4)[:, [k]]) for k, name in enumerate("abc")]
    with pytest.raises(ValueError, match="one or two of its candidates"):
        oracle_share(np.zeros(4), candidates, truth, np.random.default_rng(0))
