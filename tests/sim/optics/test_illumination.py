from __future__ import annotations

import numpy as np
import pytest

from sim.camera import CameraModel, Geometry
from sim.optics.illumination import irradiance_factor, optical_axis_px, relative_illumination, sin_theta


def test_irradiance_tends_to_pi_over_4_n_squared() -> None:
    assert irradiance_factor(1000.0) * 4 * 1000.0**2 == pytest.approx(np.pi, rel=1e-6)
    assert irradiance_factor(4.0, -1.0) == pytest.approx(np.pi / (1 + 4 * 16 * 4))


def test_fall_off_is_the_fourth_power_of_the_cosine(colour_camera: CameraModel) -> None:
    row, col = 0.0, np.arange(96.0)
    cosine = np.sqrt(1 - sin_theta(colour_camera, row, col) ** 2)
    np.testing.assert_allclose(relative_illumination(colour_camera, row, col), cosine**4, rtol=1e-12)
    assert relative_illumination(colour_camera, 35.5, 47.5) == 1.0
    # A point one focal length off the axis sees 45 degrees.
    assert sin_theta(colour_camera, 35.5 + 8.0 / 0.003, 47.5) == pytest.approx(np.sqrt(0.5))


def test_the_axis_is_the_principal_point_where_it_is_known(colour_camera: CameraModel) -> None:
    geometry = Geometry(camera_matrix=((2667.0, 0.0, 50.0), (0.0, 2667.0, 30.0), (0.0, 0.0, 1.0)))
    assert optical_axis_px(colour_camera) == (35.5, 47.5)
    assert optical_axis_px(colour_camera.model_copy(update={"geometry": geometry})) == (30.0, 50.0)
