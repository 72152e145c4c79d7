"""Projections against OpenCV's; the uncertainty and the difference of projections, and the motion that
is taken out of them.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lab.observables.boards.calibration import calibrate_robustly
from lab.observables.boards.projection import (
    CameraGeometry,
    cross_matrices,
    difference,
    error_operator,
    grid,
    grid_points,
    implied_motion,
    points_at,
    projection_std,
)
from sim.scene.projection import COUNT, EQUIDISTANT, PINHOLE, Projection
from tests.lab.fit.projected import SHAPE, TRUTH, poses, seen

MATRIX = np.array([[420.0, 0, 203.0], [0, 421.0, 147.0], [0, 0, 1]])
BROWN = np.array([-0.12, 0.06, 5e-4, -3e-4, 0.02])
RATIONAL = np.array([-0.12, 0.06, 5e-4, -3e-4, 0.02, 0.03, -0.01, 0.004])

CAMERA = CameraGeometry.of(TRUTH.left, TRUTH.distortion_left)
FISHEYE = np.array([0.03, -0.012, 0.004, -0.001])
SPLINE = np.array([0.01, -0.01, 1e-3, -5e-4, -0.03, -0.05, -0.07, -0.09])


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.normal(0, 0.3, (60, 2)), rng.uniform(0.8, 2, 60)])


@pytest.mark.parametrize("distortion", [np.zeros(5), BROWN, RATIONAL])
def test_projection_and_slopes_are_opencvs(points, distortion):
    camera = CameraGeometry.of(MATRIX, distortion)
    seen, by_point, by_camera = camera.project_with_jacobian(points)
    all_eight = np.pad(distortion, (0, 8 - len(distortion)))
    theirs, slopes = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, all_eight)
    np.testing.assert_allclose(seen, theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(camera.project(points), theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(by_point, slopes[:, 3:6].reshape(-1, 2, 3), atol=1e-8)
    np.testing.assert_allclose(by_camera, slopes[:, 6:18].reshape(-1, 2, 12), atol=1e-8)


def test_rays_are_the_inverse(points):
    camera = CameraGeometry.of(MATRIX, RATIONAL)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.unproject(camera.project(points)), rays, atol=1e-12)
    np.testing.assert_allclose(camera.at_depth(camera.project(points), points[:, 2]), points, atol=1e-12)


def test_the_equidistant_projection_is_opencvs_fisheye(points):
    camera = CameraGeometry.of(MATRIX, FISHEYE, EQUIDISTANT)
    theirs, slopes = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), MATRIX, FISHEYE)
    seen, by_point, by_camera = camera.project_with_jacobian(points)
    np.testing.assert_allclose(seen, theirs[:, 0], atol=1e-9)
    # OpenCV's columns: f, c, k, rotation, translation, skew
    np.testing.assert_allclose(by_point, slopes[:, 11:14].reshape(-1, 2, 3), atol=1e-8)
    np.testing.assert_allclose(by_camera[:, :, [4, 5, 8, 9]], slopes[:, 4:8].reshape(-1, 2, 4), atol=1e-8)


@pytest.mark.parametrize(
    ("projection", "distortion"),
    [(EQUIDISTANT, FISHEYE), (Projection("splined_stereographic", 105.0), SPLINE)],
    ids=["equidistant", "splined"],
)
def test_slopes_and_rays_of_a_fisheye_up_to_100_degrees(projection, distortion):
    """Slopes against differences of step h = 1e-6, whose error is 420 px h^2 and rounding / h: below 1e-5 px a unit.
    The second sixth of the rays is on the axis, where the formulas divide 0 by 0.
    """
    rng = np.random.default_rng(3)
    angle, about = rng.uniform(0.0, np.deg2rad(100.0), 60), rng.uniform(0.0, 2 * np.pi, 60)
    angle[10:20] = 0.0
    across = np.sin(angle)
    points = 3.0 * np.column_stack([across * np.cos(about), across * np.sin(about), np.cos(angle)])
    camera = CameraGeometry.of(MATRIX, distortion, projection)
    seen, by_point, by_camera = camera.project_with_jacobian(points)
    np.testing.assert_allclose(camera.unproject(seen), points / 3.0, atol=1e-9)
    step = 1e-6
    for k, unit in enumerate(np.eye(3) * step):
        slope = (camera.project(points + unit) - camera.project(points - unit)) / (2 * step)
        np.testing.assert_allclose(by_point[:, :, k], slope, atol=1e-5)
    for k, unit in enumerate(np.eye(COUNT) * step):
        if projection.names[k]:
            one, other = (CameraGeometry(projection, camera.intrinsics + sign * unit) for sign in (1, -1))
            slope = (one.project(points) - other.project(points)) / (2 * step)
            np.testing.assert_allclose(by_camera[:, :, k], slope, atol=1e-5)


def test_a_projection_that_contradicts_itself_is_refused():
    with pytest.raises(ValueError, match="spline_angle_deg is None of a splined_stereographic projection"):
        Projection("splined_stereographic")
    with pytest.raises(ValueError, match="k1 k2 k3 k4"):
        CameraGeometry.of(MATRIX, BROWN, EQUIDISTANT)


def test_where_a_distortion_folds_there_is_no_ray():
    """x (1 - 0.5 x^2) is largest, 0.544, at x = 0.816: nothing is seen beyond."""
    camera = CameraGeometry.of(MATRIX, [-0.5, 0, 0, 0, 0])
    rays = camera.unproject(np.array([[203.0 + 420 * 0.5, 147.0], [203.0 + 420 * 0.6, 147.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1, 0])


def test_matrix_and_coefficients_come_back():
    camera = CameraGeometry.of(MATRIX, BROWN)
    np.testing.assert_array_equal(camera.matrix, MATRIX)
    np.testing.assert_array_equal(camera.distortion, BROWN)
    np.testing.assert_array_equal(CameraGeometry.of(MATRIX, RATIONAL).distortion, RATIONAL)
    np.testing.assert_array_equal(CameraGeometry.of(MATRIX, FISHEYE, EQUIDISTANT).distortion, FISHEYE)


def test_cross_matrices_are_cross_products(points):
    np.testing.assert_allclose(cross_matrices(points) @ [1.0, 2.0, 3.0], np.cross(points, [1.0, 2.0, 3.0]))


@pytest.fixture(scope="module")
def calibration():
    return calibrate_robustly(seen(np.random.default_rng(4), poses(12)), SHAPE)


def test_equal_cameras_imply_no_motion():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-200, 200, (80, 2)), rng.uniform(500, 900, 80)])
    rotation, shift = implied_motion(CAMERA, CAMERA, points)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(shift, 0.0, atol=1e-9)


def test_a_displaced_principal_point_is_mostly_a_turn():
    """5 px of the centre are a turn by 5 / f: what is left is second order in the field, and far below 5 px."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-200, 200, (80, 2)), rng.uniform(500, 900, 80)])
    other = CameraGeometry(PINHOLE, CAMERA.intrinsics + 5.0 * np.eye(COUNT)[2])
    found = difference(CAMERA, other, (np.eye(COUNT) * 1e-12,) * 2, points, points)
    assert np.linalg.norm(other.project(points) - CAMERA.project(points), axis=1).mean() == pytest.approx(5.0)
    assert found.rms_px < 0.5
    rotation, _ = implied_motion(CAMERA, other, points)
    # the image moves by +5 px, so the points have to move by -5 px to be seen where they were: a turn about y
    assert cv2.Rodrigues(rotation)[0][1, 0] == pytest.approx(-5.0 / 1400.0, rel=0.2)


def test_error_operator_has_no_motion_left_in_it():
    """On the corners that tie it down, its columns are orthogonal to every turn and shift."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-200, 200, (80, 2)), rng.uniform(500, 900, 80)])
    operator = error_operator(CAMERA, points, points).reshape(-1, 12)
    step = 1e-6
    for k in range(6):
        turn, shift = np.zeros(3), np.zeros(3)
        (turn if k < 3 else shift)[k % 3] = step
        mode = (CAMERA.project(points @ cv2.Rodrigues(turn)[0].T + shift) - CAMERA.project(points)).ravel() / step
        assert np.abs(mode @ operator).max() < 1e-4 * np.linalg.norm(mode) * np.linalg.norm(operator)


def test_uncertainty_is_least_where_the_boards_were(calibration):
    x, y = grid(SHAPE)
    image = grid_points(x, y)
    std = calibration.projection_std(image, 700.0).reshape(len(y), len(x))
    assert std.min() == pytest.approx(std[5:14, 7:18].min())
    assert std[0, 0] > 4 * std[len(y) // 2, len(x) // 2]
    far = calibration.projection_std(image, None).reshape(len(y), len(x))
    assert np.median(far) > np.median(std)  # no board was there


def test_difference_of_one_calibration_with_itself_is_none(calibration):
    points = calibration.points
    found = difference(calibration.camera, calibration.camera, (calibration.covariance,) * 2, points, points)
    assert found.rms_px < 1e-9
    assert found.significance_sigma < 1e-6
    # the mean variance over the corners is that of the map: both come from the same operator
    std = projection_std(calibration.camera, 2 * calibration.covariance, points, points)
    assert np.all(found.variances_px2.max(axis=1) <= std**2 * (1 + 1e-9))


def test_points_are_as_far_as_they_should_be():
    points = points_at(np.array([[10.0, 20.0], [640.0, 480.0]]), CAMERA, 1234.0)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1234.0)
    np.testing.assert_allclose(CAMERA.project(points), [[10.0, 20.0], [640.0, 480.0]], atol=1e-9)
