"""PWM rows against a lamp that is switched, summed in small steps of time."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.pwm_rows import PwmRows
from sim.stages import Light
from tests.sim.effects.test_sensor_effects import CAMERA

ONE = PwmRows(off_percent=40.0, frequency_hz=1000.0, line_time_us=30.0)
ROLLING = CAMERA.model_copy(update={"shutter": "rolling"})


@pytest.mark.parametrize("exposure_s", [0.0002, 0.0013, 0.0047])
def test_rows_hold_the_pulses_of_their_exposure(exposure_s: float) -> None:
    found = ONE.on_light(Light(ROLLING)).row_factors(48, exposure_s, 0.00037)
    assert found is not None
    steps = 20000
    time = 0.00037 + 30e-6 * np.arange(48)[:, None] + exposure_s * (np.arange(steps) + 0.5) / steps
    is_on = (1000.0 * time) % 1.0 < 0.6
    # the sum is off by two steps at most at each of the pulses' edges
    edges = 2.0 * (1000.0 * exposure_s + 1.0)
    np.testing.assert_allclose(found, is_on.mean(axis=1) / 0.6, atol=edges / steps / 0.6)


def test_whole_periods_are_even_and_a_global_shutter_sees_one_pulse() -> None:
    whole = ONE.on_light(Light(ROLLING)).row_factors(48, 0.003, 0.0001)
    np.testing.assert_allclose(whole, 1.0, rtol=1e-9)
    together = ONE.on_light(Light(CAMERA.model_copy(update={"shutter": "global"}))).row_factors(48, 0.0003, 0.0001)
    assert together is not None
    np.testing.assert_allclose(together, 1.0 / 0.6, rtol=1e-9)
