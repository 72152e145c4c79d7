"""The choice of the next capture: known information, cost, pairs; and the journal."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from lab.capture.plan import CapturePlan
from lab.capture_kinds.dark import DarkSequence
from lab.diagnose.outcome.expected_information import (
    Forecast,
    entropy,
    expected_information,
    settling_probability,
)
from lab.diagnose.outcome.next_capture import Doubt, OpenCapture
from lab.diagnose.policy import DecisionPolicy
from lab.errors import InputError
from lab.resolve import Choice, Option, ResolveLimits, choose
from sim.spectrum import FloatArray

PLAN = CapturePlan((DarkSequence(exposures_s=(0.001, 0.1), frames=2),))
POLICY = DecisionPolicy()
FAR = 40.0  # standard deviations: exp(-B) = exp(-FAR^2 / 8) is below 1e-80, so that a capture tells all it can


def forecast(*means: float, parameter: Sequence[float] = (), error: Sequence[float] = ()) -> Forecast:
    """One number that rivals predict at `means`; by its parameter it may move by `parameter` of each rival, by its
    law's error by `error`."""
    k = len(means)
    none = [np.zeros((1, 0))] * k
    moved = [np.array([[p]]) for p in parameter] or none
    return Forecast.of(np.array(means)[:, None], moved, [np.array([[e]]) for e in error] or none, np.eye(1))


def doubt(*odds: float) -> Doubt:
    return Doubt("left", tuple("abcd"[: len(odds)]), odds, ())


def option(words: str, told: Forecast, seconds: float = 10.0) -> Option:
    return Option(OpenCapture(words, told, PLAN, ""), seconds)


def chosen(found: Choice | None) -> tuple[str, str | None]:
    assert found is not None
    return found.first.capture.words, None if found.then is None else found.then.capture.words


# --- information ------------------------------------------------------------------------------------------------------


def test_a_capture_that_tells_all_has_the_doubts_entropy_and_one_that_tells_nothing_has_none() -> None:
    odds = (0.5, 0.3, 0.2)
    assert expected_information([forecast(0.0, FAR, 2 * FAR)], odds) == pytest.approx(entropy(odds), abs=1e-9)
    assert expected_information([forecast(1.0, 1.0, 1.0)], odds) == pytest.approx(0.0, abs=1e-12)
    # b from the others: the entropy of 0.3 against 0.7
    assert expected_information([forecast(0.0, FAR, 0.0)], odds) == pytest.approx(entropy((0.3, 0.7)), abs=1e-9)


def test_the_bound_lies_below_the_information_that_draws_show() -> None:
    """Two rivals d apart: I = ln 2 - E[h(p)], p the posterior of the true one; the mean of 2e5 draws is known to
    3 * 0.69 / sqrt(2e5) = 0.005."""
    rng = np.random.default_rng(3)
    for apart in (0.5, 1.0, 2.0, 4.0):
        y = rng.standard_normal(200_000)
        log_odds = 0.5 * ((y - apart) ** 2 - y**2)
        exact = math.log(2.0) + float(np.mean(-np.logaddexp(0.0, -log_odds)))
        bound = expected_information([forecast(0.0, apart)], (0.5, 0.5))
        assert 0.4 * exact < bound < exact + 0.005


def test_the_covariance_is_whitened() -> None:
    """Twice the standard deviation is half the distance."""
    none = [np.zeros((2, 0))] * 2
    covariance: FloatArray = np.diag([4.0, 1.0])
    wide = Forecast.of(np.array([[0.0, 3.0], [2.0, 3.0]]), none, none, covariance)
    assert wide.distances()[0, 1] == pytest.approx(0.5)
    told = expected_information([wide], (0.5, 0.5))
    assert told == pytest.approx(expected_information([forecast(0.0, 1.0)], (0.5, 0.5)))


def test_what_a_free_parameter_may_change_tells_nothing_alone() -> None:
    """A rival that may lie anywhere within 100 standard deviations isn't told by a distance of 5."""
    sure = expected_information([forecast(0.0, 5.0)], (0.5, 0.5))
    free = [forecast(0.0, 5.0, parameter=(100.0, 100.0)), forecast(0.0, 5.0, error=(100.0, 100.0))]
    assert sure > 0.6
    assert all(expected_information([one], (0.5, 0.5)) < 0.01 for one in free)


# --- the choice -------------------------------------------------------------------------------------------------------


def test_the_capture_that_separates_wins() -> None:
    options = [option("dull", forecast(0.0, 0.3)), option("sharp", forecast(0.0, FAR)), option("so-so", forecast(0, 3))]
    assert chosen(choose(doubt(0.6, 0.4), options, POLICY)) == ("sharp", None)


def test_cost_matters() -> None:
    """A capture that tells nearly as much in a tenth of the time."""
    options = [option("sharp", forecast(0.0, FAR), 100.0), option("quick", forecast(0.0, 4.0), 10.0)]
    assert chosen(choose(doubt(0.5, 0.5), options, POLICY)) == ("quick", None)
    options = [option("sharp", forecast(0.0, FAR), 12.0), option("quick", forecast(0.0, 2.0), 10.0)]
    assert chosen(choose(doubt(0.5, 0.5), options, POLICY)) == ("sharp", None)


def test_a_pair_is_found_that_single_captures_do_not_show() -> None:
    """Both rivals have a free size, which the first capture measures and the second needs: neither tells them apart
    alone."""
    pins = option("pins the size", forecast(0.0, 0.0, parameter=(50.0, 50.0)))
    needs = option("needs the size", forecast(0.0, 0.0, parameter=(50.0, -50.0)))
    dull = option("dull", forecast(0.0, 0.1, parameter=(0.0, 0.0)))
    alone = [choose(doubt(0.5, 0.5), [one], POLICY) for one in (pins, needs, dull)]
    assert alone == [None, None, None]
    found = choose(doubt(0.5, 0.5), [pins, needs, dull], POLICY)
    assert set(chosen(found)) == {"pins the size", "needs the size"}
    assert found is not None and found.information_nat > 0.5


def test_what_does_not_fit_into_the_budget_is_left_out() -> None:
    options = [option("sharp", forecast(0.0, FAR), 100.0), option("weak", forecast(0.0, 3.0), 50.0)]
    assert chosen(choose(doubt(0.5, 0.5), options, POLICY, left_s=60.0)) == ("weak", None)
    assert choose(doubt(0.5, 0.5), options, POLICY, left_s=40.0) is None


def test_a_capture_that_tells_too_little_is_not_taken() -> None:
    """Two rivals of equal odds `next_capture_distance` apart are told to more than `resolve_least_share`, at a tenth of
    it to less."""
    at = math.sqrt(2.0 * POLICY.next_capture_distance)
    assert choose(doubt(0.5, 0.5), [option("enough", forecast(0.0, at))], POLICY) is not None
    assert choose(doubt(0.5, 0.5), [option("too little", forecast(0.0, at / math.sqrt(10.0)))], POLICY) is None


@pytest.mark.parametrize(
    ("minutes", "rounds", "said"),
    [(-5.0, 3, "-5 isn't above 0"), (0.0, 3, "0 isn't above 0"), (math.nan, 3, "nan isn't"), (5.0, 0, "0 is below 1")],
)
def test_limits_that_cannot_be_kept_are_refused(minutes: float, rounds: int, said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        ResolveLimits(minutes, rounds)
    assert "\n" not in str(refused.value)


def test_a_choice_has_the_forecasts_of_its_captures() -> None:
    """Of one capture one, of a pair two; rivals `FAR` apart are settled for certain."""
    found = choose(doubt(0.6, 0.4), [option("sharp", forecast(0.0, FAR))], POLICY)
    assert found is not None
    assert len(found.forecasts) == 1
    assert settling_probability(found.forecasts, found.doubt.odds, 0.95) == pytest.approx(1.0)
    pins = option("pins the size", forecast(0.0, 0.0, parameter=(50.0, 50.0)))
    needs = option("needs the size", forecast(0.0, 0.0, parameter=(50.0, -50.0)))
    pair = choose(doubt(0.5, 0.5), [pins, needs], POLICY)
    assert pair is not None
    assert len(pair.forecasts) == 2
    alone = settling_probability(pair.forecasts[:1], pair.doubt.odds, 0.95)
    assert alone == 0.0  # both rivals allow the same numbers
    assert settling_probability(pair.forecasts, pair.doubt.odds, 0.95) > 0.5
