"""Where a bundle adjustment begins: the camera without distortion, and the pose of each view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lab.errors import NotDetermined
from lab.observables.boards.bundle_adjustment import RigParameters
from lab.observables.boards.projection import CameraGeometry
from lab.observables.boards.views import BoardView
from sim.scene.projection import COUNT, PINHOLE, WIDEST_DEG, Projection

Array = NDArray[np.floating[Any]]


MIN_POSE_CORNERS = 4  # that determine the pose of a plane
FOCAL_VIEWS = 6  # with which the first focal length of a fisheye is chosen
#: Trial focal lengths, of the longer side: half of it is 143 deg of an equidistant lens off its axis at 0.2 (a circular
#: fisheye of 180 deg has 0.32), and 14 deg at 2. Steps of 1.4: from twice the right one the solve still converges.
FOCAL_SHARES = (0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2)


def board_pose(view: BoardView, camera: CameraGeometry) -> tuple[Array, Array]:
    """Find the rotation (3, 3) and translation (3,), mm, from the flat board to a camera, from one view. Raises
    `NotDetermined` where none fits.

    The rays of the corners are turned about their mean and seen by an ideal pinhole along it, so that a board far from
    the axis of a wide lens has a pose, too.
    """
    rays = camera.unproject(view.image_px.astype(float))
    there = np.isfinite(rays).all(axis=1)
    rays, points = rays[there], view.board_mm[there].astype(float)
    rotation, translation = np.eye(3), np.zeros(3)
    found = False
    if len(rays) >= MIN_POSE_CORNERS:
        turn = _towards_axis(rays.mean(axis=0))
        ahead = rays @ turn.T
        try:
            found, rotation_vector, of_board = cv2.solvePnP(
                points, ahead[:, :2] / ahead[:, 2:], np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
            )
        except cv2.error:
            found = False
        if found:
            rotation = turn.T @ np.asarray(cv2.Rodrigues(rotation_vector)[0])
            translation = turn.T @ np.asarray(of_board).ravel()
    placed = view.board_mm.astype(float) @ rotation.T + translation
    if not (found and camera.projection.sees(placed).all()):
        raise NotDetermined(
            "geometry", "no pose of the board fits its corners: check what the capture says of the board"
        )
    return rotation, translation


def _towards_axis(direction: Array) -> Array:
    """Return the smallest rotation (3, 3) that turns a direction (3,) to the axis of the camera."""
    axis = np.cross(direction, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, direction[2]))
    vector = axis * (angle / length) if length > 0.0 else np.zeros(3)
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def first_camera(
    views: Sequence[BoardView], shape: tuple[int, int], projection: Projection = PINHOLE
) -> CameraGeometry:
    """Return a camera without distortion to begin with. `shape`: (rows, cols) of the frames.

    The focal length of a pinhole is that of Zhang, or the width of the frame where the views determine none. That of
    another projection is the one with which the poses of a few views fit best.
    """
    middle = (shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0

    def camera(focal: float) -> CameraGeometry:
        return CameraGeometry.of([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]], (), projection)

    boards = [view.board_mm.astype(np.float32) for view in views]
    points = [view.image_px.astype(np.float32) for view in views]
    try:
        focal = float(cv2.initCameraMatrix2D(boards, points, shape[::-1], 1.0)[0, 0])
    except cv2.error:
        focal = np.nan
    if not 0.2 * max(shape) < focal < 50.0 * max(shape):
        focal = float(max(shape))
    if projection.kind == "pinhole":
        return camera(focal)
    few = views[:: max(1, len(views) // FOCAL_VIEWS)]
    trials = [camera(one) for one in (focal, *(share * max(shape) for share in FOCAL_SHARES))]
    return min(trials, key=lambda one: sum(_pose_square(view, one) for view in few))


def _pose_square(view: BoardView, camera: CameraGeometry) -> float:
    """Return the sum of squared residuals, px^2, of a view at its pose by `board_pose`; infinite without one."""
    try:
        rotation, translation = board_pose(view, camera)
    except NotDetermined:
        return np.inf
    return float(np.sum((camera.project(view.board_mm @ rotation.T + translation) - view.image_px) ** 2))


def splined(camera: CameraGeometry, shape: tuple[int, int]) -> CameraGeometry:
    """Return a camera with a splined stereographic projection that projects as `camera` does, an equidistant one. The
    spline ends at the corner of the frame that is farthest from the axis. `shape`: (rows, cols) of the frame.
    """
    ends = np.array([(x, y) for x in (0.0, shape[1] - 1.0) for y in (0.0, shape[0] - 1.0)])
    z = camera.unproject(ends)[:, 2]
    widest = float(np.rad2deg(np.arccos(np.clip(z[np.isfinite(z)].min(initial=1.0), -1.0, 1.0))))
    if not np.isfinite(z).all():  # the polynomial has no inverse there: as without distortion
        widest = float(np.rad2deg(np.max(np.linalg.norm(ends - camera.intrinsics[2:4], axis=1)) / camera.intrinsics[0]))
    projection = Projection("splined_stereographic", float(np.clip(widest, 1.0, WIDEST_DEG)))
    assert projection.spline_angle_deg is not None
    angle = np.linspace(0.0, np.deg2rad(projection.spline_angle_deg), 200)[1:]
    points = np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])
    start = np.concatenate([camera.intrinsics[:4], np.zeros(COUNT - 4)])
    wanted = camera.project(points)[:, 0] - projection.project(points, start)[:, 0]
    by_camera = projection.project_with_jacobian(points, start)[2][:, 0]
    radial = [projection.names.index(name) for name in projection.coefficients if name.startswith("s")]
    start[radial] = np.linalg.lstsq(by_camera[:, radial], wanted, rcond=1e-9)[0]
    return CameraGeometry(projection, start)


def first_state(views: Sequence[BoardView], camera: CameraGeometry) -> RigParameters:
    """Return the parameters of one camera to begin with, each view with a pose of its own."""
    poses = [board_pose(view, camera) for view in views]
    return RigParameters(
        projections=(camera.projection,),
        intrinsics=camera.intrinsics[None, :],
        rotation=np.eye(3),
        translation_mm=np.zeros(3),
        warps_mm=np.zeros((1, 3)),
        rotations=np.array([rotation for rotation, _ in poses]),
        translations_mm=np.array([translation for _, translation in poses]),
    )


def with_boards(state: RigParameters, boards: int) -> RigParameters:
    """Return the state with `boards` flat boards."""
    return replace(state, warps_mm=np.zeros((boards, 3)))
