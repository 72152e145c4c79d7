"""Places and measurements: chi2 before and after, on made-up edges."""

from __future__ import annotations

import pytest
from scipy import stats

from lab.diagnose.outcome.goodness_of_fit import measurement_fits, places
from lab.diagnose.policy import DecisionPolicy
from tests.lab.diagnose.outcome.filtered_edges import TRUTH, filtered_edges


def test_measurements_fit_with_the_truth_and_not_without() -> None:
    (fit,) = measurement_fits("left", filtered_edges((TRUTH,)))
    model = filtered_edges().model
    assert (fit.n, fit.held_out_n) == (36, 36)
    assert fit.held_out_before == pytest.approx(model.held_out()[0])
    assert fit.held_out_after == pytest.approx(model.held_out((TRUTH,))[0])
    assert fit.chi2_after < stats.chi2.ppf(0.999, 36) < fit.chi2_before


def test_every_place_is_told_before_and_after() -> None:
    found = list(places("left", filtered_edges((TRUTH,)), DecisionPolicy()))
    assert {p.axis for p in found} == {"spatial_frequency", "orientation"}
    assert max(p.sigma_before for p in found) > 5.0
    assert max(p.sigma_after for p in found) < 3.0
    assert all(p.chi2_after < p.chi2_before for p in found)
