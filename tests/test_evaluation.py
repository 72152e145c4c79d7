"""The evaluation: it measures what it says, and the product doesn't know it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.observables import Calibrated, calibrate, table


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
