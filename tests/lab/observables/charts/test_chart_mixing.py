"""Charge between a patch's colours, where one of them has no pixels in the patch's inner part."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lab.diagnose.reference_study import reference_camera
from lab.observables.charts.chart import _mixing
from sim.effects.charge_transfer_inefficiency import ChargeTransferInefficiency
from sim.effects.crosstalk import Crosstalk
from sim.uniform import Uniform


def _points(channels: str, row: float = 40.0) -> list[Any]:
    capture = SimpleNamespace(id="c0")
    return [SimpleNamespace(captures=(capture,), name="red", channel=c, row=row, col=60.0) for c in channels]


def test_neighbours_of_a_colour_without_pixels_count() -> None:
    """The factors of red and green are those with blue measured, to rounding, and crosstalk changes them."""
    model = Uniform(reference_camera(), (Crosstalk(share_percent=0.8),))
    whole = _mixing(_points("RGB"), np.array([900.0, 300.0, 150.0]), model, [{}])
    partly = _mixing(_points("RG"), np.array([900.0, 300.0]), model, [{"B": 150.0 / 900.0}])
    assert partly == pytest.approx(whole[:2], rel=1e-12)
    assert whole[1] > 1.01  # green takes more from red than it gives: 0.8 % of a signal three times its own, per side


def test_patches_far_from_the_output_find_more_of_other_colours() -> None:
    """Of few losses, in proportion to the transfers of the patch's rows, to a row of 50 and what lies in the trail."""
    model = Uniform(reference_camera(), (ChargeTransferInefficiency(parallel_ppm=1.0, release_px=1.0),))
    levels = np.array([900.0, 300.0, 150.0])
    near, far = (_mixing(_points("RGB", row), levels, model, [{}]) - 1.0 for row in (50.0, 200.0))
    np.testing.assert_allclose(far / near, 200.0 / 50.0, rtol=0.05)
