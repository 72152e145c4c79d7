"""Taps: steps at a half and the quarters, of light in proportion and of the dark alike, about an unchanged mean."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.taps import Taps
from sim.frame import Exposure, moments
from sim.scene.scenes import Darkness, UniformField
from sim.stages import Signal
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

COLS = CAMERA.cols


def test_gains_step_at_the_borders() -> None:
    one = Taps(gain_percent=4.0, quarter_gain_percent=-2.0, last_gain_percent=1.0)
    gains = one.on_signal(Signal(CAMERA)).gain_map((CAMERA.rows, COLS))
    assert gains is not None
    # areas of 0, -2, 2 and 3 %, whose mean is 0.75 %
    np.testing.assert_allclose(
        gains[0, :: COLS // 4], 1.0 + 0.01 * (np.array([0.0, -2.0, 2.0, 3.0]) - 0.75), rtol=1e-12
    )
    assert np.flatnonzero(np.diff(gains[0])).tolist() == [COLS // 4 - 1, COLS // 2 - 1, 3 * COLS // 4 - 1]


def test_light_and_its_noise_grow_with_the_gain_and_the_dark_by_the_offset() -> None:
    one = Taps(gain_percent=4.0, offset_e=10.0, across="rows")
    upper, lower = slice(0, CAMERA.rows // 2), slice(CAMERA.rows // 2, None)
    gain = CAMERA.conversion_gain_dn_per_e
    dark, _ = moments(CAMERA, Exposure(Darkness(), 0.0), (one,))
    assert dark[lower].mean() - dark[upper].mean() == pytest.approx(10.0 * gain, abs=1e-3)  # of rounding
    plain, plain2 = moments(CAMERA, Exposure(UniformField(LIGHT), 0.01))
    lit, lit2 = moments(CAMERA, Exposure(UniformField(LIGHT), 0.01), (one,))
    for part, factor, offset in ((upper, 0.98, -5.0), (lower, 1.02, 5.0)):
        signal = plain[part] - CAMERA.black_level_dn
        expected = CAMERA.black_level_dn + factor * signal + gain * offset
        np.testing.assert_allclose(lit[part], expected, atol=2e-3)
        np.testing.assert_allclose(lit2[part] - 1.0 / 12.0, factor**2 * (plain2[part] - 1.0 / 12.0), rtol=1e-3)
