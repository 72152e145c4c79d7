"""Projection and distortion of target planes against OpenCV's."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sim.camera import CameraModel, Geometry
from sim.effects.defocus import Defocus
from sim.effects.distortion import Distortion
from sim.effects.field_curvature import FieldCurvature
from sim.frame import Exposure, expected_electrons
from sim.scene import EdgeRegion, KnifeEdge, PlanarTarget, PlaneEdge, PosedEdges, ReflectanceChart, Warp
from sim.scene.render import Grid, draw
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
        distort(0.0, 0.0, GEOMETRY.model_copy(update={"distortion": (0.0,) * 8 + (0.1,)}))


# --- Knife edges in a plane at a pose, against straight edges and against the same edges drawn by area ----------------


FACING = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def pinhole(camera: CameraModel, *distortion: float) -> Geometry:
    """1 px a mm at 800 mm."""
    centre = 0.5 * (camera.cols - 1), 0.5 * (camera.rows - 1)
    return Geometry(
        camera_matrix=((800.0, 0.0, centre[0]), (0.0, 800.0, centre[1]), (0.0, 0.0, 1.0)), distortion=distortion
    )


def edges(camera: CameraModel, lamp: Spectrum, *distortion: float) -> PosedEdges:
    one = (PlaneEdge((0.0, 0.0), (0.3, 0.0), 5.0),)
    return PosedEdges(one, FACING, (0.0, 0.0, 800.0), pinhole(camera, *distortion), lamp.scale(0.02), lamp)


def test_a_facing_edge_is_a_straight_one(colour_camera: CameraModel, lamp: Spectrum) -> None:
    region = EdgeRegion((0, 0, colour_camera.rows, colour_camera.cols), 5.0, 0.3 * np.cos(np.deg2rad(5.0)))
    straight = KnifeEdge((region,), lamp.scale(0.02), lamp)
    for effects in ((), (Defocus(defocus_um=20.0),)):
        one, other = (
            expected_electrons(colour_camera, Exposure(scene, 0.01), effects)
            for scene in (edges(colour_camera, lamp), straight)
        )
        assert np.allclose(one, other, rtol=1e-6)


@pytest.mark.parametrize("turned", [False, True])
def test_a_bent_edge_is_what_drawing_by_area_gives(colour_camera: CameraModel, lamp: Spectrum, turned: bool) -> None:
    """The frame of the exact profiles, against the drawing blurred as any picture is: 0.5 % of white at 4 samples a
    pixel.
    """
    scene = edges(colour_camera, lamp, -0.2, 0.0, 1e-3, -1e-3)
    if turned:
        c, s = float(np.cos(0.5)), float(np.sin(0.5))
        scene = replace(scene, rotation=((c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)))
    grid = Grid(colour_camera.rows, colour_camera.cols, 4, 0)
    (layer,) = draw(scene, grid).layers
    rows, cols = colour_camera.rows, colour_camera.cols
    share = layer.coverage.reshape(rows, 4, cols, 4).mean(axis=(1, 3))
    seen = expected_electrons(colour_camera, Exposure(scene, 0.01))
    green = seen[0::2, 0::2] / seen[0::2, 0::2].max()
    # half of the light lies where half of the pixel does
    crossing = [np.interp(0.5, row, np.arange(row.size)) for row in green[4:-4]]
    drawn = [np.interp(0.5, row, np.arange(row.size)) for row in share[0::2, 0::2][4:-4]]
    assert np.max(np.abs(np.subtract(crossing, drawn))) < 0.15


def test_an_edge_is_blurred_as_its_place_is(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """A tilt that the frame's centre doesn't feel blurs an edge near the rim as so much defocus does."""
    tilt = FieldCurvature(tilt_x_um=60.0)
    place = PlaneEdge((36.0, 0.0), (36.0, 0.0), 5.0)
    scene = replace(edges(colour_camera, lamp), edges=(place,))
    away_um = 60.0 * 36.0 / colour_camera.half_diagonal_px
    tilted, defocused = (
        expected_electrons(colour_camera, Exposure(scene, 0.01), (effect,))
        for effect in (tilt, Defocus(defocus_um=away_um))
    )
    assert np.allclose(tilted, defocused, rtol=1e-6)


def test_light_that_is_moved_moves_the_edge(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """20 % at the corner, and in proportion to the cube of the distance from the axis elsewhere: a row's sum falls by
    contrast x shift.
    """
    place = PlaneEdge((30.0, 0.0), (30.3, 0.0), 0.0)
    scene = replace(edges(colour_camera, lamp), edges=(place,))
    level = [
        expected_electrons(colour_camera, Exposure(scene, 0.01), effects)[36, 1::2]
        for effects in ((), (Distortion(corner_percent=20.0),))
    ]
    at = [-2.0 * (row.sum() / row.max() - 0.02 * row.size) / 0.98 for row in level]  # samples are 2 px apart
    x = 30.3
    radius = x / colour_camera.half_diagonal_px
    assert at[1] - at[0] == pytest.approx(0.2 * x * radius**2, abs=0.1)


def test_a_target_without_edges_is_refused(colour_camera: CameraModel, lamp: Spectrum) -> None:
    with pytest.raises(ValueError, match="at least one"):
        replace(edges(colour_camera, lamp), edges=())


def test_a_charts_patches_are_distorted(colour_camera: CameraModel, lamp: Spectrum) -> None:
    geometry = pinhole(colour_camera, -5.0)
    corners = (8.0, 10.0), (8.0, 86.0), (62.0, 86.0), (62.0, 10.0)
    chart = ReflectanceChart(corners, lamp, geometry=geometry)
    grid = Grid(colour_camera.rows, colour_camera.cols, 2, 0)
    first = draw(chart, grid).layers[0]
    row, col = (axis[part] for axis, part in zip(grid.axes_px(), first.window, strict=True))
    middle = [float(np.sum(first.coverage * place) / np.sum(first.coverage)) for place in (row[:, None], col[None, :])]
    warp = Warp.from_corners(6 - chart.gap, 4 - chart.gap, corners)
    straight = warp.to_camera(0.5 * (1 - chart.gap), 0.5 * (1 - chart.gap))
    x, y = distort(straight[1], straight[0], geometry)
    assert middle == pytest.approx([float(y), float(x)], abs=0.05)
    assert abs(float(x) - float(straight[1])) > 0.1


# --- fisheyes ---------------------------------------------------------------------------------------------------------


FISHEYE = Geometry(
    camera_matrix=((180.0, 0.0, 160.0), (0.0, 181.0, 118.0), (0.0, 0.0, 1.0)),
    distortion=(0.02, -0.01, 0.002, 0.0),
    projection="equidistant",
)


def test_a_board_before_a_fisheye_is_where_opencv_has_it() -> None:
    rotation = cv2.Rodrigues(np.array([0.3, -0.4, 0.2]))[0]
    pose = np.column_stack([rotation[:, :2], [-50.0, -40.0, 60.0]])
    warp = Warp.of(np.array(FISHEYE.camera_matrix) @ pose, FISHEYE)
    u, v = (part.ravel() for part in np.meshgrid(np.linspace(0, 100, 9), np.linspace(0, 80, 7)))
    points = np.column_stack([u, v, np.zeros_like(u)])
    wanted, _ = cv2.fisheye.projectPoints(
        points[:, None], cv2.Rodrigues(rotation)[0], pose[:, 2], np.array(FISHEYE.camera_matrix),
        np.array(FISHEYE.distortion),
    )  # fmt: skip
    row, col = warp.to_camera(u, v)
    np.testing.assert_allclose(np.column_stack([col, row]), wanted[:, 0], atol=1e-9)
    np.testing.assert_allclose(warp.to_pattern(row, col), (u, v), atol=1e-7)


def test_the_grid_of_a_fisheye_agrees_with_its_points_and_knows_what_lies_behind() -> None:
    """Pixels 320 px off the axis see 100 deg and more: their rays don't meet a plane before the camera. Rays are
    interpolated to 1e-5 px; near the horizon of the plane a pixel is many cells.
    """
    warp = Warp.of(np.array(FISHEYE.camera_matrix) @ np.diag([1.0, 1.0, 50.0]), FISHEYE)
    row, col = np.linspace(0.0, 239.0, 80), np.linspace(-200.0, 500.0, 120)
    u, v = warp.grid_to_pattern(row, col)
    u0, v0 = warp.to_pattern(*np.meshgrid(row, col, indexing="ij"))
    near = np.hypot(u0, v0) < 200.0
    assert near.sum() > 2000
    np.testing.assert_allclose(u[near], u0[near], atol=1e-3)
    np.testing.assert_allclose(v[near], v0[near], atol=1e-3)
    assert np.all(u[:, 0] > 1e8)
