"""The pinhole with distortion against OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lab.fit.geometry.pinhole import (
    cross_matrices,
    distortion_of,
    intrinsics_of,
    matrix_of,
    project,
    project_with_jacobian,
    unproject,
)

MATRIX = np.array([[420.0, 0, 203.0], [0, 421.0, 147.0], [0, 0, 1]])
BROWN = np.array([-0.12, 0.06, 5e-4, -3e-4, 0.02])
RATIONAL = np.array([-0.12, 0.06, 5e-4, -3e-4, 0.02, 0.03, -0.01, 0.004])


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.normal(0, 0.3, (60, 2)), rng.uniform(0.8, 2, 60)])


@pytest.mark.parametrize("distortion", [np.zeros(5), BROWN, RATIONAL])
def test_projection_and_slopes_are_opencvs(points, distortion):
    intrinsics = intrinsics_of(MATRIX, distortion)
    seen, by_point, by_camera = project_with_jacobian(points, intrinsics)
    all_eight = np.pad(distortion, (0, 8 - len(distortion)))
    theirs, slopes = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, all_eight)
    np.testing.assert_allclose(seen, theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(project(points, intrinsics), theirs[:, 0], atol=1e-9)
    np.testing.assert_allclose(by_point, slopes[:, 3:6].reshape(-1, 2, 3), atol=1e-8)
    np.testing.assert_allclose(by_camera, slopes[:, 6:18].reshape(-1, 2, 12), atol=1e-8)


def test_rays_are_the_inverse(points):
    intrinsics = intrinsics_of(MATRIX, RATIONAL)
    np.testing.assert_allclose(unproject(project(points, intrinsics), intrinsics), points / points[:, 2:], atol=1e-12)


def test_where_a_distortion_folds_there_is_no_ray():
    """x (1 - 0.5 x^2) is largest, 0.544, at x = 0.816: nothing is seen beyond."""
    intrinsics = intrinsics_of(MATRIX, [-0.5, 0, 0, 0, 0])
    rays = unproject(np.array([[203.0 + 420 * 0.5, 147.0], [203.0 + 420 * 0.6, 147.0]]), intrinsics)
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1, 0])


def test_matrix_and_coefficients_come_back():
    intrinsics = intrinsics_of(MATRIX, BROWN)
    np.testing.assert_array_equal(matrix_of(intrinsics), MATRIX)
    np.testing.assert_array_equal(distortion_of(intrinsics), BROWN)
    np.testing.assert_array_equal(distortion_of(intrinsics_of(MATRIX, RATIONAL)), RATIONAL)


def test_cross_matrices_are_cross_products(points):
    np.testing.assert_allclose(cross_matrices(points) @ [1.0, 2.0, 3.0], np.cross(points, [1.0, 2.0, 3.0]))
