"""The knee: nothing below it, another slope above, and a rounding that is nothing far from it."""

from __future__ import annotations

import numpy as np

from sim.effects.response_knee import ResponseKnee
from sim.stages import Signal
from tests.sim.effects.test_sensor_effects import CAMERA

FULL = CAMERA.full_well_e


def test_a_knee_changes_the_slope_from_its_level_on() -> None:
    read = ResponseKnee(slope_percent=-20.0, knee_share=0.4).on_signal(Signal(CAMERA)).read
    np.testing.assert_array_equal(read(np.array([0.0, 0.2 * FULL, 0.4 * FULL])), [0.0, 0.2 * FULL, 0.4 * FULL])
    np.testing.assert_allclose(read(np.array([0.6 * FULL, FULL])), [0.56 * FULL, 0.88 * FULL], rtol=1e-12)


def test_a_rounded_knee_is_the_sharp_one_far_from_it() -> None:
    sharp, rounded = (
        ResponseKnee(slope_percent=-20.0, knee_share=0.5, rounding_share=r).on_signal(Signal(CAMERA)).read
        for r in (0.0, 0.02)
    )
    # ln(1 + exp(x / r)) less max(x / r, 0) is ln 2 at the knee and exp(-20) at 20 r
    far = np.array([0.1, 0.9]) * FULL
    np.testing.assert_allclose(rounded(far), sharp(far), atol=0.2 * 0.02 * FULL * np.exp(-20.0) * 1.1)
    at = np.array([0.5 * FULL])
    np.testing.assert_allclose(rounded(at) - sharp(at), -0.2 * 0.02 * FULL * np.log(2.0), rtol=1e-9)
