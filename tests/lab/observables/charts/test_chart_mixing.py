"""Charge between a patch's colours, where one of them has no pixels in the patch's inner part."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lab.diagnose.reference_study import reference_camera
from lab.observables.charts.chart import _mixing
from sim.effects.crosstalk import Crosstalk
from sim.uniform import Uniform


def _points(channels: str) -> list[Any]:
    capture = SimpleNamespace(id="c0")
    return [SimpleNamespace(captures=(capture,), name="red", channel=c) for c in channels]


def test_neighbours_of_a_colour_without_pixels_count() -> None:
    """The factors of red and green are those with blue measured, to rounding, and crosstalk changes them."""
    model = Uniform(reference_camera(), (Crosstalk(share_percent=0.8),))
    whole = _mixing(_points("RGB"), np.array([900.0, 300.0, 150.0]), model, [{}])
    partly = _mixing(_points("RG"), np.array([900.0, 300.0]), model, [{"B": 150.0 / 900.0}])
    assert partly == pytest.approx(whole[:2], rel=1e-12)
    assert whole[1] > 1.01  # green takes more from red than it gives: 0.8 % of a signal three times its own, per side
