"""Relative illumination: cos^4, a maker's curve, a measured flat field."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sim.camera import CameraModel, Geometry
from sim.frame import Exposure, expected_electrons
from sim.optics.fall_off import MeasuredIllumination, RadialIllumination
from sim.optics.illumination import irradiance_factor, optical_axis_px, relative_illumination, sin_theta
from sim.parameters import Frozen
from sim.scene.scenes import UniformField
from sim.spectrum import Spectrum


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


def test_a_makers_curve_stands_in_for_the_cosine(colour_camera: CameraModel) -> None:
    """Through its points, monotone between, about the principal point; held beyond its last radius."""
    curve = RadialIllumination(radius_mm=(0.0, 0.06, 0.12), relative_illumination=(1.0, 0.9, 0.5))
    camera = colour_camera.model_copy(
        update={"lens": colour_camera.lens.model_copy(update={"illumination": curve}),
                "geometry": Geometry(camera_matrix=((2667.0, 0.0, 50.0), (0.0, 2667.0, 30.0), (0.0, 0.0, 1.0)))}
    )  # fmt: skip
    np.testing.assert_allclose(
        relative_illumination(camera, 30.0, 50.0 + np.array([0.0, 20.0, -40.0])), [1.0, 0.9, 0.5]
    )
    line = relative_illumination(camera, 30.0, np.arange(50.0, 96.0))
    assert np.all(np.diff(line[:41]) < 0)
    np.testing.assert_allclose(line[41:], 0.5)


def test_a_flat_gives_its_own_fall_off_back(colour_camera: CameraModel) -> None:
    """cos^4 about a point off the centre with 1 % of noise: found to 3 sigma of 28 coefficients over 6912 pixels, 0.2
    %.
    """
    axis = Geometry(camera_matrix=((100.0, 0.0, 55.0), (0.0, 100.0, 30.0), (0.0, 0.0, 1.0)))
    wide = colour_camera.model_copy(
        update={"lens": colour_camera.lens.model_copy(update={"focal_length_mm": 0.35}), "geometry": axis}
    )
    row, col = np.arange(72.0)[:, None], np.arange(96.0)[None, :]
    truth = relative_illumination(wide, row, col)
    assert truth.min() < 0.6
    noise = 1 + 0.01 * np.random.default_rng(1).standard_normal(truth.shape)
    found = MeasuredIllumination.from_flat(5000.0 * truth * noise)
    camera = wide.model_copy(update={"lens": wide.lens.model_copy(update={"illumination": found})})
    away = relative_illumination(camera, row, col) / truth - 1
    # blocks of 2 px, coefficients' noise 0.01 sqrt(28 / 6912) = 6e-4, and what degree 6 leaves of the law
    assert np.sqrt(np.mean(away**2)) < 2e-3
    assert relative_illumination(camera, 30.0, 55.0) == pytest.approx(1.0)
    # scattered points and a grid are the same
    np.testing.assert_allclose(
        relative_illumination(camera, np.array([3.0, 60.0]), np.array([90.0, 7.0])),
        relative_illumination(camera, row, col)[[3, 60], [90, 7]],
    )


def test_a_measured_fall_off_shades_the_frame(colour_camera: CameraModel, lamp: Spectrum) -> None:
    half = MeasuredIllumination(values=((1.0, 0.5), (1.0, 0.5)))
    camera = colour_camera.model_copy(
        update={"lens": colour_camera.lens.model_copy(update={"illumination": half}), "cfa": "MONO",
                "quantum_efficiency": {"Y": lamp.scale(0.1 / max(lamp.value))}, "dark_current_e_per_s": 0.0}
    )  # fmt: skip
    electrons = expected_electrons(camera, Exposure(UniformField(lamp), 0.01))
    assert electrons[5, 0] / electrons[5, -1] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("law", "values", "message"),
    [
        (RadialIllumination, {"radius_mm": (0.0, 1.0), "relative_illumination": (1.0,)}, "as many"),
        (RadialIllumination, {"radius_mm": (0.5, 1.0), "relative_illumination": (1.0, 0.9)}, "ascend from 0"),
        (RadialIllumination, {"radius_mm": (0.0, 1.0), "relative_illumination": (0.9, 0.8)}, "on the axis"),
        (MeasuredIllumination, {"values": ((1.0, 0.0), (1.0, 1.0))}, "below the limit"),
        (MeasuredIllumination, {"values": ((1.0,), (1.0,))}, "two or more"),
    ],
)
def test_bad_fall_offs_are_refused(law: type[Frozen], values: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        law.model_validate(values)


def test_bad_flats_are_refused() -> None:
    with pytest.raises(ValueError, match="too few blocks"):
        MeasuredIllumination.from_flat(np.ones((6, 6)))
    with pytest.raises(ValueError, match="subtract the dark frame"):
        MeasuredIllumination.from_flat(-np.ones((96, 96)))


def test_without_a_focal_length_the_light_does_not_fall_off(colour_camera: CameraModel) -> None:
    lens = colour_camera.lens.model_copy(update={"focal_length_mm": None})
    camera = colour_camera.model_copy(update={"lens": lens})
    row, col = np.array([0.0, 3.0])[:, None], np.array([0.0, 5.0, 9.0])
    np.testing.assert_array_equal(relative_illumination(camera, row, col), np.ones((2, 3)))
    np.testing.assert_array_equal(sin_theta(camera, row, col), np.zeros((2, 3)))
