"""The evaluation: it measures what it says, and the product doesn't know it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.observables import Calibrated, _chi2, _whitening, calibrate, table


def _drawn(scale: float, sets: int = 400, n: int = 30) -> list[Calibrated]:
    """Sets whose residuals have `scale` times the standard deviation that their covariance says."""
    rng = np.random.default_rng(9)
    return [
        Calibrated("own chain", k, "dark", float(np.sum(np.square(scale * rng.standard_normal(n)))), n)
        for k in range(sets)
    ]


def test_a_true_covariance_is_not_marked_and_wrong_ones_are() -> None:
    """chi2 a number has the standard error sqrt(2 / (n sets)) = 1.3 %; 10 % of the standard deviation move it by
    21 %."""
    assert "| 1.0" in table(_drawn(1.0)) and "**" not in table(_drawn(1.0))
    assert "**0.8" in table(_drawn(0.9))
    assert "**1.2" in table(_drawn(1.1))
    assert "black_level" not in table([*_drawn(1.0), Calibrated("own chain", 1, "black_level", 0.0, 0)])


def test_nuisance_directions_are_projected_out_where_their_prior_is_wide() -> None:
    """Residuals with one wide nuisance parameter, which the truth doesn't have, and one narrow one, drawn from its
    prior: chi2 over n is 1 within three standard errors, sqrt(2 / (n draws))."""
    rng = np.random.default_rng(2)
    half = rng.standard_normal((12, 12))
    covariance = half @ half.T + np.eye(12)
    whiten = _whitening(covariance)
    nuisances = np.column_stack([30.0 * np.ones(12), 0.5 * np.arange(12.0)])
    lower = np.linalg.cholesky(covariance)
    found = []
    for _ in range(400):
        away = lower @ rng.standard_normal(12) + 0.5 * np.arange(12.0) * rng.standard_normal()
        found.append(_chi2(whiten @ away, whiten @ nuisances))
    chi2, n = np.array(found).T
    assert set(n) <= {10.0, 11.0}
    assert chi2.sum() / n.sum() == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / n.sum()))


def test_kept_sets_are_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[tuple[str, int]] = []

    def of_set(source: str, number: int) -> list[Calibrated]:
        measured.append((source, number))
        return [Calibrated(source, number, "dark", 3.0, 4)]

    monkeypatch.setattr("evaluation.observables._of_set", of_set)
    file = tmp_path / "found.jsonl"
    assert len(calibrate(file, 2, ["own chain"])) == 2
    found = calibrate(file, 3, ["own chain", "second simulator"])
    second = [("second simulator", n) for n in (1, 2, 3)]
    assert sorted(measured) == [("own chain", 1), ("own chain", 2), ("own chain", 3), *second]
    assert len(found) == 6
