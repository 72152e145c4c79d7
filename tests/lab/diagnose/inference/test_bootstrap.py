"""Thresholds of drawn scores; that they hold on images is a slow test
(`tests/recovery/test_diagnosis_bootstrap.py`)."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.diagnose import examine
from lab.diagnose.inference.bootstrap import HealthyDraw, image_threshold
from lab.diagnose.side import diagnose_side


def test_a_threshold_of_few_draws_is_that_of_many() -> None:
    """Largest of 40 chi2 of one degree: 1 in 100 is above 13.3 (1 - (1 - p)^(1/40) of chi2's tail). Gumbel's law by its
    moments lies 5 % off, 200 draws scatter by 3 %."""
    rng = np.random.default_rng(8)
    tops = np.square(rng.standard_normal((200, 40))).max(axis=1)
    found = image_threshold([HealthyDraw(float(t), {}) for t in tops], 0.01)
    assert found == pytest.approx(13.3, rel=0.12)


def test_a_threshold_is_never_below_that_of_drawn_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    recordings = recordings_of(ConcealedCamera(9, cfa="MONO", rows=64, cols=96), Plan(kinds=("dark", "flat")))
    tops = [30.0 + t for t in range(10)]
    monkeypatch.setattr("lab.diagnose.side.healthy_draws", lambda *_: [HealthyDraw(top, {}) for top in tops])
    plain, drawn = (diagnose_side(recordings, "left", None, None, lambda _: None, bootstrap=n) for n in (0, 10))
    assert plain.threshold is not None
    assert drawn.threshold == pytest.approx(image_threshold([HealthyDraw(t, {}) for t in tops], 0.01))
    assert drawn.threshold > plain.threshold


def test_each_draw_is_told_and_moves_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hours on a cluster are seen to go on; a hundred draws aren't a hundred steps of the bar."""
    recordings = recordings_of(ConcealedCamera(9, cfa="MONO", rows=64, cols=96), Plan(kinds=("dark", "flat")))
    tops = iter(30.0 + t for t in range(10))
    monkeypatch.setattr("lab.diagnose.inference.bootstrap._healthy_draw", lambda *_: HealthyDraw(next(tops), {}))
    told: list[tuple[str, float]] = []
    examine(recordings, progress=lambda what, share: told.append((what, share)), at_once=False, bootstrap=10)
    drawing = [(what, share) for what, share in told if what.startswith("drawing")]
    assert [what for what, _ in drawing][1:] == [f"drawing 10 healthy cameras: {n} done (left)" for n in range(1, 11)]
    assert len({share for _, share in drawing}) == 1
