"""Shutter leakage: as much light at every exposure, more in rows that are read later; none of a rolling shutter."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.shutter_leakage import ShutterLeakage
from sim.frame import Exposure, expected_electrons
from sim.scene.scenes import UniformField
from sim.uniform import FieldPoints, Uniform, electron_rate
from tests.sim.effects.test_sensor_effects import CAMERA, LIGHT

LEAKY = ShutterLeakage(last_row_us=200.0)


@pytest.mark.parametrize("exposure_s", [0.001, 0.01])
def test_every_exposure_has_the_same_light_besides(exposure_s: float) -> None:
    plain, leaky = (expected_electrons(CAMERA, Exposure(UniformField(LIGHT), exposure_s), e) for e in ((), (LEAKY,)))
    dark = CAMERA.dark_current_e_per_s * exposure_s
    rate = (plain - dark) / exposure_s
    waits = np.linspace(0.0, 1.0, CAMERA.rows)[:, None]
    np.testing.assert_allclose(leaky - plain, rate * 200e-6 * waits, rtol=1e-9, atol=1e-9)


def test_levels_are_the_means_of_frames() -> None:
    field = Uniform(CAMERA).field(FieldPoints.of(CAMERA))
    frame = expected_electrons(CAMERA, Exposure(UniformField(LIGHT), 0.001), (LEAKY,))
    found = Uniform(CAMERA, (LEAKY,)).electrons(
        {"Y": np.array(electron_rate(CAMERA, "Y", LIGHT))}, np.array(0.001), field=field
    )
    assert found["Y"].mean() == pytest.approx(frame.mean(), rel=1e-5)  # of 8 x 10 points for the fall-off


def test_a_rolling_shutter_has_no_store() -> None:
    rolling = CAMERA.model_copy(update={"shutter": "rolling"})
    assert not Uniform(rolling, (LEAKY,)).leaks


def test_the_end_that_is_read_last_may_be_the_top() -> None:
    leaked = Uniform(CAMERA, (ShutterLeakage(last_row_us=200.0, read_last="top"),)).leaked_s(
        FieldPoints.at(CAMERA, np.array([0.0, CAMERA.rows - 1.0]), np.zeros(2))
    )
    np.testing.assert_allclose(leaked, [200e-6, 0.0], atol=1e-12)
