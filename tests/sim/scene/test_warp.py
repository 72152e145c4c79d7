"""Projection and distortion of target planes against OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sim.camera import Geometry
from sim.scene import PlanarTarget, Warp
from sim.scene.warp import distort, undistort
from sim.spectrum import Spectrum

GEOMETRY = Geometry(
    camera_matrix=((1500.0, 0.0, 330.0), (0.0, 1510.0, 235.0), (0.0, 0.0, 1.0)),
    distortion=(-0.21, 0.12, 0.0011, -0.0007, 0.03),
)
DARK = Spectrum.of([400.0, 700.0], [0.0, 0.0])


def test_projection_is_opencvs() -> None:
    rotation = cv2.Rodrigues(np.array([0.2, -0.3, 0.1]))[0]
    target = PlanarTarget(
        texture=np.zeros((10, 12)),
        texel_mm=5.0,
        rotation=tuple(tuple(row) for row in rotation.tolist()),
        translation_mm=(-30.0, -20.0, 200.0),
        geometry=GEOMETRY,
        dark_radiance=DARK,
        light_radiance=DARK,
    )
    u, v = np.meshgrid(np.arange(13.0), np.arange(11.0))
    points = np.column_stack([5 * u.ravel(), 5 * v.ravel(), 0 * u.ravel()])
    wanted, _ = cv2.projectPoints(
        points,
        cv2.Rodrigues(rotation)[0],
        np.array(target.translation_mm),
        np.array(GEOMETRY.camera_matrix),
        np.array(GEOMETRY.distortion),
    )
    row, col = target.warp().to_camera(u.ravel(), v.ravel())
    np.testing.assert_allclose(np.column_stack([col, row]), wanted[:, 0], atol=1e-9)


def test_distortion_is_undone() -> None:
    x, y = np.meshgrid(np.linspace(-20, 660, 30), np.linspace(-20, 500, 30))
    back = undistort(*distort(x, y, GEOMETRY), GEOMETRY)
    np.testing.assert_allclose(back, (x, y), atol=1e-8)


def test_the_grids_shortcut_agrees_with_the_points() -> None:
    warp = Warp.from_corners(40, 30, [(20, 30), (35, 600), (470, 590), (455, 10)], GEOMETRY)
    row, col = np.linspace(-5, 485, 99), np.linspace(-5, 645, 101)
    u, v = warp.grid_to_pattern(row, col)
    u0, v0 = warp.to_pattern(*np.meshgrid(row, col, indexing="ij"))
    np.testing.assert_allclose(u, u0, atol=1e-6)
    np.testing.assert_allclose(v, v0, atol=1e-6)


def test_corners_go_where_they_are_told() -> None:
    corners = [(20.0, 30.0), (35.0, 600.0), (470.0, 590.0), (455.0, 10.0)]
    row, col = Warp.from_corners(6, 4, corners).to_camera([0, 6, 6, 0], [0, 0, 4, 4])
    np.testing.assert_allclose(np.column_stack([row, col]), corners, atol=1e-9)


def test_what_cannot_be_a_warp_is_refused() -> None:
    with pytest.raises(ValueError, match="invertible"):
        Warp.of(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="k1 k2 p1 p2 k3"):
        distort(0.0, 0.0, GEOMETRY.model_copy(update={"distortion": (0.0,) * 7 + (0.1,)}))
