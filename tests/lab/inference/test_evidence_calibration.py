"""Simulation-based calibration in summary space: draws from p(A) p(u) p(delta) p(theta), and what the table says."""

from __future__ import annotations

import numpy as np
import pytest

from lab.inference.hypotheses import SetPrior
from lab.inference.model import Group
from lab.inference.posterior import read_table
from lab.inference.search import ANY_UNLISTED, Search
from sim.spectrum import FloatArray
from tests.lab.inference.toys import Toy, linear, shaped

POINTS = 36
X = np.linspace(0.0, 1.0, POINTS)
BINS = ((0.05, 0.35), (0.35, 0.65), (0.65, 0.95), (0.95, 1.0 + 1e-9))


def _bump(u: FloatArray) -> FloatArray:
    return np.asarray(3.0 * u[0] * np.exp(-0.5 * np.square((X - u[1]) / 0.12)))


CHANGES = {
    "line": lambda u: 4.0 * u[0] * (X - 0.5),
    "bow": lambda u: 4.0 * u[0] * np.square(X - 0.4),
    "bend": lambda u: 4.0 * u[0] * np.abs(X - 0.45) ** 1.5,  # like the bow
    "wave": lambda u: 3.0 * u[0] * np.sin(11.0 * X),
    "bump": _bump,
}
HYPOTHESES = {
    "line": linear("line", "slopes", 1.0, positive=False),
    "bow": linear("bow", "bows", 1.0),
    "bend": linear("bend", "bows", 1.0),
    "wave": linear("wave", "waves", 1.0, positive=False),
    "bump": shaped("bump", "bumps", 1.0, 0.0, 1.0, 12),
}
_SMOOTH = np.exp(-0.5 * np.square((X[:, None] - np.linspace(0.0, 1.0, 6)) / 0.12))
_TURNED = np.exp(-0.5 * np.square((X[:, None] - np.linspace(0.0, 1.0, 9)) / 0.05)) * np.sign(np.sin(60.0 * X))[:, None]
GROUPS = (Group("smooth", 30.0 * _SMOOTH, 0.01), Group("rough", 30.0 * _TURNED, 0.01))
PRIOR = SetPrior({name: h.family for name, h in HYPOTHESES.items()})


def _draw(rng: np.random.Generator) -> tuple[Toy, frozenset[str], frozenset[str]]:
    """Return a toy, the active hypotheses and the unlisted groups."""
    active = PRIOR.draw(rng)
    nuisance = 2.0 * np.ones((POINTS, 1))
    value = rng.standard_normal(POINTS) + nuisance @ rng.standard_normal(1)
    for name in active:
        value = value + CHANGES[name](np.array([c.draw(rng) for c in HYPOTHESES[name].coordinates]))
    one = 1.0 - (1.0 - ANY_UNLISTED) ** (1.0 / len(GROUPS))
    unlisted = set()
    for group in GROUPS:
        tau = group.everyday * abs(rng.standard_normal())
        if rng.random() < one:
            unlisted.add(group.name)
            tau = float(np.exp(rng.uniform(np.log(3.0 * group.everyday), np.log(group.largest))))
        value = value + tau * group.columns @ rng.standard_normal(group.columns.shape[1])
    return Toy(value, CHANGES, nuisance, GROUPS), active, frozenset(unlisted)


def _reliability(draws: int, seed: int) -> dict[str, list[tuple[float, bool]]]:
    """Return the statements of probability 0.05 and more, by kind: the probability, and whether it is true."""
    rng = np.random.default_rng(seed)
    found: dict[str, list[tuple[float, bool]]] = {"effect": [], "family": [], "unlisted": []}
    for _ in range(draws):
        toy, active, unlisted = _draw(rng)
        posterior = read_table(Search(toy, HYPOTHESES, PRIOR).run(), HYPOTHESES)
        true = {"effect": active, "family": {HYPOTHESES[n].family for n in active}, "unlisted": unlisted}
        for f in posterior.findings:
            if f.probability >= 0.05:
                found[f.kind].append((f.probability, f.name in true[f.kind]))
    return found


def _assert_reliable(found: dict[str, list[tuple[float, bool]]]) -> None:
    for kind, statements in found.items():
        for low, high in BINS:
            inside = [(p, true) for p, true in statements if low <= p < high]
            expected = sum(p for p, _ in inside)
            # statements of one draw exclude or follow one another, which widens the binomial standard deviation: by
            # half at most here, where a draw has two of them on average
            std = 1.5 * np.sqrt(sum(p * (1.0 - p) for p, _ in inside)) + 1.0
            actual = sum(true for _, true in inside)
            assert abs(actual - expected) < 3.0 * std, (
                f"{kind} of {low} to {high}: {actual} of {len(inside)}, {expected:.1f}"
            )


def test_statements_are_as_often_true_as_they_say() -> None:
    """20 draws from the prior."""
    _assert_reliable(_reliability(20, 11))


def test_the_threshold_of_no_mismatch_is_that_of_whole_searches_of_healthy_draws() -> None:
    """The p(nothing) of 20 draws without effects and everyday delta: their median by single effects and flips, in
    closed form, agrees with that by whole searches, 40 other draws, to 0.1 (the medians' standard error is 1.25 times
    the spread of 0.15 over sqrt(20))."""
    rng = np.random.default_rng(4)
    whole = []
    for _ in range(20):
        value = rng.standard_normal(POINTS) + 2.0 * rng.standard_normal()
        for group in GROUPS:
            tau = group.everyday * abs(rng.standard_normal())
            value = value + tau * group.columns @ rng.standard_normal(group.columns.shape[1])
        search = Search(Toy(value, CHANGES, 2.0 * np.ones((POINTS, 1)), GROUPS), HYPOTHESES, PRIOR)
        whole.append(read_table(search.run(), HYPOTHESES).nothing)
    quick = search.healthy_draws(40, rng)
    print(np.sort(whole).round(2), np.sort(quick).round(2))
    assert np.median(quick) == pytest.approx(np.median(whole), abs=0.1)


@pytest.mark.slow
def test_statements_of_many_draws_are_as_often_true_as_they_say() -> None:
    """1,000 draws."""
    found = _reliability(1000, 12)
    for kind, statements in found.items():
        for low, high in BINS:
            inside = [(p, true) for p, true in statements if low <= p < high]
            print(kind, low, len(inside), sum(p for p, _ in inside), sum(t for _, t in inside))
    _assert_reliable(found)
