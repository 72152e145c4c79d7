"""Phase-detection rows: which pixels lack how much, and that every colour keeps its mean."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.phase_detection_rows import PhaseDetectionRows
from sim.sensor.mosaic import PERIOD_PX
from sim.stages import Charge
from tests.sim.effects.test_effects import CAMERA


def _collected(one: PhaseDetectionRows) -> np.ndarray:
    return one.on_charge(Charge(CAMERA)).collect_light(np.full((PERIOD_PX, PERIOD_PX), 100.0))


def test_rows_of_a_period_lack_their_share() -> None:
    """RGGB, rows 3, 11, ...: green and blue. Two of eight green rows' halves and one of four blue rows are such."""
    after = _collected(PhaseDetectionRows(loss_percent=20.0, period=8, first_row=3))
    np.testing.assert_allclose(after[3::8, 0::2] / after[1::8, 0::2], 0.8, rtol=1e-12)
    np.testing.assert_allclose(after[3::8, 1::2] / after[1::8, 1::2], 0.8, rtol=1e-12)
    assert after[1, 0] == pytest.approx(100.0 / (1.0 - 0.2 / 8.0))
    assert after[1, 1] == pytest.approx(100.0 / (1.0 - 0.2 / 4.0))
    np.testing.assert_allclose(after[0::2, 0::2], 100.0, rtol=1e-12)  # red has no pixel in them


def test_the_other_colour_may_lack_more_than_green() -> None:
    after = _collected(PhaseDetectionRows(loss_percent=10.0, colour_percent=20.0, period=12, first_row=5))
    np.testing.assert_allclose(after[5::12, 0::2] / after[1::12, 0::2], 1.0, rtol=1e-12)
    np.testing.assert_allclose(after[5::12, 1::2] / after[1::12, 1::2], 0.8, rtol=1e-12)


def test_the_first_row_is_within_the_period() -> None:
    with pytest.raises(ValueError, match="first_row: 8 isn't below the period of 8 rows"):
        PhaseDetectionRows(loss_percent=5.0, period=8, first_row=8)
