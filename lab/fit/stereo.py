"""Extrinsics of a stereo pair: x_right = rotation x_left + translation_mm, from poses of a board that both cameras
saw.

One least-squares problem over everything that both cameras saw: rotation and translation of the rig, the intrinsics of
both cameras, the warp of the boards and the pose of the board in every capture
(`lab.observables.boards.bundle_adjustment`). A solve for the rig alone, with the intrinsics held at the values of the
single cameras, would transfer their errors to the rig and leave them out of its uncertainty.

The joint covariance gives the uncertainty of a depth (`lab.fit.depth`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lab.errors import NotDetermined
from lab.fit.depth import depth_uncertainty
from lab.fit.geometry import corner_errors
from lab.formats.recording_set import RecordingSet
from lab.formats.results import GeometryFit, Rectification, Skipped, StereoFit
from lab.observables.boards.bundle_adjustment import (
    RIG,
    BundleAdjustment,
    Observation,
    RigParameters,
    Solution,
    rms_px,
)
from lab.observables.boards.calibration import list_reasons
from lab.observables.boards.corners import board_corners
from lab.observables.boards.first_state import board_pose
from lab.observables.boards.pairs import StereoPair, pair_views, rig_poses
from lab.observables.boards.projection import CameraGeometry
from lab.observables.boards.views import BoardView, board_key
from lab.one_blas_thread import one_blas_thread
from sim.camera import Side
from sim.scene.projection import Projection

Array = NDArray[np.floating[Any]]

MIN_PAIRS = 2
OUTLYING_PAIR = 3.0  # times the median rms of the pairs
OUTLYING_PAIR_PX = 0.1
REVERSED_DEG = 10.0  # turn beside the other pairs, below which the renumbered view explains a pair
SIDES_SIGMA = 2.6  # significance of 1 %, above which the right camera stands on the left
NO_RIG = 5.0  # times the single cameras' rms (and at least 1 px), above which no rig explains the pairs
DEPTHS_MM = (500.0, 1000.0, 2000.0)


@one_blas_thread
def fit_stereo(
    recordings: RecordingSet,
    left: GeometryFit,
    right: GeometryFit,
    depths_mm: Sequence[float] = DEPTHS_MM,
) -> StereoFit:
    """Fit rotation and translation between the cameras to the `charuco` captures of equal `pose`, with uncertainties.

    `rms_px` is the root mean square of the distances of all corners of both cameras from their predictions. The corners
    are those that the fits of the single cameras rest on. A pair whose rms is more than 3 times the median of the pairs
    is left out, and one whose views are numbered from opposite ends. `depths_mm`: where the uncertainty of the depth is
    mapped. Raises `NotDetermined` below 2 pairs, or where no rig explains them.
    """
    shapes = tuple((recordings.camera(side).rows, recordings.camera(side).cols) for side in ("left", "right"))
    pairs = pair_views(fitted_views(recordings, "left", left), fitted_views(recordings, "right", right))
    return fit_pairs(pairs, left, right, shapes, depths_mm)


def fit_pairs(
    pairs: Sequence[StereoPair],
    left: GeometryFit,
    right: GeometryFit,
    shapes: Sequence[tuple[int, int]],
    depths_mm: Sequence[float] = DEPTHS_MM,
) -> StereoFit:
    """Fit the rig to pairs of views, as `fit_stereo`; `shapes` are (rows, cols) of the left and right frames."""
    if len(pairs) < MIN_PAIRS:
        raise NotDetermined(
            "stereo",
            f"{len(pairs)} poses of the board were found by both cameras, {MIN_PAIRS} are needed: capture charuco "
            "poses with both, under the same pose name",
        )
    every_pair, alone = pairs, max(left.rms_px, right.rms_px)
    pairs, rejected = _split_by_numbering(pairs, left, right)
    if len(pairs) < MIN_PAIRS:
        raise NotDetermined("stereo", f"{len(pairs)} pairs can be used, {MIN_PAIRS} are needed{list_reasons(rejected)}")
    while True:
        solution = solve_rig(pairs, left, right, shapes[0])
        of_pairs = [
            rms_px(np.concatenate(solution.residuals[2 * k : 2 * k + 2])) for k in range(len(pairs))
        ]  # two observations a pair, left then right
        worst = int(np.argmax(of_pairs))
        limit = max(OUTLYING_PAIR * float(np.median(of_pairs)), OUTLYING_PAIR_PX)
        if len(pairs) == MIN_PAIRS or of_pairs[worst] <= limit:
            break
        reason = f"rms {of_pairs[worst]:.2f} px, where the other pairs have {np.median(of_pairs):.2f} px"
        rejected.append(Skipped(step=f"pose {pairs[worst].pose}", reason=reason))
        pairs = [pair for k, pair in enumerate(pairs) if k != worst]
    solution = BundleAdjustment(rig_observations(pairs), solution.free, shapes[0]).with_correlated_errors(solution)
    if not _explains(solution, alone) or not solution.determined:
        late = _shifted_pose(every_pair, left, right, shapes[0], alone)
        raise NotDetermined(
            "stereo",
            f"no rig explains the pairs (rms {solution.rms_px:.1f} px, each camera alone {alone:.2f} px; worst: pose "
            f"{pairs[worst].pose}, {of_pairs[worst]:.1f} px{list_reasons(rejected)}): check that equal "
            "poses are the same pose of the board, that the rig was rigid, and that neither camera's frames are "
            f"mirrored{late}",
        )
    return _result(solution, pairs, shapes, depths_mm, tuple(rejected))


def _explains(solution: Solution, alone_px: float) -> bool:
    """Tell whether a rig explains the pairs as well as the cameras alone do, whose larger rms is `alone_px`."""
    return solution.rms_px < max(NO_RIG * alone_px, 1.0)


def _shifted_pose(
    pairs: Sequence[StereoPair], left: GeometryFit, right: GeometryFit, shape: tuple[int, int], alone_px: float
) -> str:
    """Say that a rig explains the pairs if the right views belong to the pose before or after theirs; empty where none
    does. For the end of a sentence.
    """
    for later, name in ((1, "next"), (-1, "previous")):
        of_left, of_right = (pairs[:-1], pairs[1:]) if later > 0 else (pairs[1:], pairs[:-1])
        moved = [
            StereoPair(left_pair.left, right_pair.right)
            for left_pair, right_pair in zip(of_left, of_right, strict=True)
        ]
        if len(moved) <= MIN_PAIRS:
            continue
        try:
            solution = solve_rig(moved, left, right, shape)
        except NotDetermined:
            continue
        if _explains(solution, alone_px):
            return f"; each left picture fits the right one of the {name} pose: the right ones are one pose off"
    return ""


def fitted_views(recordings: RecordingSet, side: Side, fit: GeometryFit) -> list[BoardView]:
    """Return the views that the fit of a camera rests on, without the corners that it left out."""
    views = board_corners(recordings, side).by_capture()
    views_used = []
    for residuals in fit.residuals:
        view = views.get(residuals.capture)
        if view is None:
            raise NotDetermined(
                "stereo", f"the {side} geometry rests on '{residuals.capture}', which isn't here: fit it again"
            )
        views_used.append(view.only(np.isin(view.index, residuals.corner)))
    return views_used


def free_of(fit: GeometryFit) -> NDArray[np.bool_]:
    """Return the mask (12,) of the intrinsics that a fit has fitted."""
    if fit.parameters:
        return np.array([name in fit.parameters for name in CameraGeometry.of_fit(fit).projection.names])
    return np.append(np.ones(8, dtype=bool), CameraGeometry.of_fit(fit).intrinsics[8:] != 0.0)


def _split_by_numbering(
    pairs: Sequence[StereoPair], left: GeometryFit, right: GeometryFit
) -> tuple[list[StereoPair], list[Skipped]]:
    """Split the pairs into those in which both cameras number the board from the same corner, and those in which they
    don't.

    A plain board looks alike from both ends. Numbered from the other one, it is rotated by 180 deg about its normal,
    and so is the rig of this pair: most pairs say which is right.
    """
    turns, reversed_turns = [], []
    half_turn = Rotation.from_rotvec([0.0, 0.0, np.pi])
    for pair in pairs:
        of_left, of_right = (
            Rotation.from_matrix(board_pose(view, CameraGeometry.of_fit(fit))[0])
            for view, fit in ((pair.left, left), (pair.right, right))
        )
        turns.append(of_right * of_left.inv())
        reversed_turns.append(of_right * half_turn * of_left.inv())
    apart = np.array([[(turn_a.inv() * turn_b).magnitude() for turn_a in turns] for turn_b in turns])
    typical = turns[int(np.argmin(apart.sum(axis=1)))]  # the one nearest to all others
    kept: list[StereoPair] = []
    rejected: list[Skipped] = []
    for pair, turn, reverse in zip(pairs, turns, reversed_turns, strict=True):
        off, off_reversed = (float(np.rad2deg((typical.inv() * rotation).magnitude())) for rotation in (turn, reverse))
        if len(pairs) == MIN_PAIRS or off < 90.0 or off_reversed > REVERSED_DEG:
            kept.append(pair)
            continue
        reason = (
            f"the cameras number its corners from opposite ends: the rig would be turned by {off:.0f} deg beside the "
            f"other pairs, and by {off_reversed:.1f} deg with one view renumbered; use a board with markers, or an "
            "odd number of rows plus columns"
        )
        rejected.append(Skipped(step=f"pose {pair.pose}", reason=reason))
    return kept, rejected


def rig_observations(pairs: Sequence[StereoPair]) -> list[Observation]:
    """Make the observations of a rig, pair by pair, left then right; pairs of equal boards share the board."""
    keys = list(dict.fromkeys(board_key(pair.left) for pair in pairs))
    observations = []
    for k, pair in enumerate(pairs):
        board = keys.index(board_key(pair.left))
        observations += [Observation(pair.left, k, board, 0), Observation(pair.right, k, board, 1)]
    return observations


def solve_rig(pairs: Sequence[StereoPair], left: GeometryFit, right: GeometryFit, shape: tuple[int, int]) -> Solution:
    """Solve the joint least squares of the rig, the intrinsics of both cameras, the warps of the boards and their
    poses.

    It starts from the fits of the single cameras. Its covariance takes corners as independent. Observations are pair by
    pair, left then right. `shape`: (rows, cols).
    """
    cameras = CameraGeometry.of_fit(left), CameraGeometry.of_fit(right)
    observations = rig_observations(pairs)
    poses = rig_poses(pairs, *cameras)
    rotation, translation_mm = poses.median
    start = RigParameters(
        projections=tuple(camera.projection for camera in cameras),
        intrinsics=np.array([camera.intrinsics for camera in cameras]),
        rotation=rotation,
        translation_mm=translation_mm,
        warps_mm=np.zeros((1 + max(observation.board for observation in observations), 3)),
        rotations=poses.rotations,
        translations_mm=poses.translations_mm,
    )
    return BundleAdjustment(observations, np.array([free_of(left), free_of(right)]), shape).solve(start)


def _result(
    solution: Solution,
    pairs: Sequence[StereoPair],
    shapes: Sequence[tuple[int, int]],
    depths_mm: Sequence[float],
    rejected: tuple[Skipped, ...],
) -> StereoFit:
    """State the rig as a result, with its depth maps and its rectification."""
    state = solution.state
    at = solution.names.index(RIG[0])
    std = np.sqrt(np.diag(solution.covariance)[at : at + 6])
    left, right = state.camera(0), state.camera(1)
    translation = state.translation_mm
    baseline = float(np.linalg.norm(translation))
    along = translation / baseline
    of_translation = solution.covariance[at + 3 : at + 6, at + 3 : at + 6]
    return StereoFit(
        rotation=state.rotation.tolist(),
        rotation_std_rad=std[:3].tolist(),
        translation_mm=translation.tolist(),
        translation_mm_std=std[3:].tolist(),
        baseline_mm=baseline,
        baseline_mm_std=float(np.sqrt(along @ of_translation @ along)),
        rms_px=solution.rms_px,
        pairs=len(pairs),
        lens_projection_left=left.projection.kind,
        spline_angle_deg_left=left.projection.spline_angle_deg,
        camera_matrix_left=left.matrix.tolist(),
        distortion_left=left.distortion.tolist(),
        lens_projection_right=right.projection.kind,
        spline_angle_deg_right=right.projection.spline_angle_deg,
        camera_matrix_right=right.matrix.tolist(),
        distortion_right=right.distortion.tolist(),
        parameters=solution.names,
        covariance=solution.covariance.tolist(),
        corner_px_std=solution.noise_px,
        corner_errors=corner_errors(solution),
        rejected=rejected,
        rectification=rectification(state, pairs, shapes[0]) if shapes[0] == shapes[1] else None,
        remarks=tuple(_side_remarks(state, float(std[3]))),
        depth=tuple(depth_uncertainty(solution, depth_mm, shapes) for depth_mm in depths_mm),
    )


def _side_remarks(state: RigParameters, x_std_mm: float) -> list[str]:
    """Say that the right camera stands left of the left one. `x_std_mm`: standard deviation of the x of the
    translation.

    A rig whose cameras stand mostly above or behind each other has no left and right.
    """
    x, y, z = -state.rotation.T @ state.translation_mm  # the right camera in the frame of the left one
    if not (x < -SIDES_SIGMA * x_std_mm and abs(x) > max(abs(y), abs(z))):
        return []
    exchanged = (
        f"The right camera stands {abs(x):.4g} mm left of the left one: are the pictures of the sides exchanged, or is "
        "the rig upside down? Where they are exchanged, state the other side; nothing was changed."
    )
    return [exchanged]


def rectification(state: RigParameters, pairs: Sequence[StereoPair], shape: tuple[int, int]) -> Rectification:
    """Compute the rectification of OpenCV, with the rms difference of the rows of the corners that both cameras saw.

    `shape`: (rows, cols) of the frames.
    """
    cameras = state.camera(0), state.camera(1)
    if all(camera.projection.kind == "pinhole" for camera in cameras):
        distortions, alpha = [camera.distortion for camera in cameras], 0.0
    else:  # OpenCV knows only Brown's distortion; the rectified pair then has the scale of the cameras' axes
        distortions, alpha = [np.zeros(5)] * 2, -1.0
    rectified = cv2.stereoRectify(
        cameras[0].matrix, distortions[0], cameras[1].matrix, distortions[1],
        shape[::-1], state.rotation, state.translation_mm[:, None], alpha=alpha,
    )  # fmt: skip
    rotation_one, rotation_two, new_one, new_two, to_depth = rectified[:5]
    gaps = []
    for pair in pairs:
        at_left, at_right = pair.common
        rows_px = [
            _rectified_rows(view.image_px[at], camera, turn, new)
            for view, at, camera, turn, new in (
                (pair.left, at_left, cameras[0], rotation_one, new_one),
                (pair.right, at_right, cameras[1], rotation_two, new_two),
            )
        ]
        gaps.append(rows_px[1] - rows_px[0])
    gap = np.concatenate(gaps)
    gap = gap[np.isfinite(gap)]  # a ray of 90 deg or more from the rectified axis has no row
    return Rectification(
        rotation_left=rotation_one.tolist(),
        rotation_right=rotation_two.tolist(),
        projection_left=new_one.tolist(),
        projection_right=new_two.tolist(),
        disparity_to_depth=to_depth.tolist(),
        row_rms_px=float(np.sqrt(np.mean(gap**2))) if len(gap) else None,
    )


def _rectified_rows(image: Array, camera: CameraGeometry, turn: Array, new: Array) -> Array:
    """Return the rows (n,), px, of the rectified frame in which corners at `image` (n, 2) lie; NaN behind it.

    `turn` (3, 3): rotation of the camera to the rectified one; `new` (3, 4): projection of that.
    """
    rays = camera.unproject(image) @ np.asarray(turn).T
    return (
        np.where(rays[:, 2] > 0.0, new[1, 1] * rays[:, 1] / np.where(rays[:, 2] > 0.0, rays[:, 2], 1.0), np.nan)
        + new[1, 2]
    )


def rectification_maps(stereo: StereoFit, shape: tuple[int, int]) -> dict[Side, tuple[Array, Array]]:
    """Return the maps (x, y) of OpenCV, each of `shape` (rows, cols), float32, for `cv2.remap` of the frames of each
    side into the rectified pair.

    In it a point is in the same row of both frames. Raises `NotDetermined` where the fit has no rectification.
    """
    if stereo.rectification is None or stereo.camera_matrix_left is None or stereo.camera_matrix_right is None:
        raise NotDetermined("rectification", "the stereo fit has none: fit again cameras of equal size")
    rectified = stereo.rectification
    left, right = _cameras_of(stereo)
    x, y = np.meshgrid(np.arange(shape[1], dtype=float), np.arange(shape[0], dtype=float))
    maps: dict[Side, tuple[Array, Array]] = {}
    sides: tuple[tuple[Side, CameraGeometry, Any, Any], ...] = (
        ("left", left, rectified.rotation_left, rectified.projection_left),
        ("right", right, rectified.rotation_right, rectified.projection_right),
    )
    for side, camera, turn, new in sides:
        pixels = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
        rays = pixels @ np.linalg.inv(np.array(new)[:, :3]).T @ np.array(turn)
        seen = camera.project(rays).astype(np.float32)
        seen[~camera.projection.sees(rays)] = -1.0  # outside of the frame
        maps[side] = seen[:, 0].reshape(shape), seen[:, 1].reshape(shape)
    return maps


def _cameras_of(stereo: StereoFit) -> tuple[CameraGeometry, CameraGeometry]:
    """Return the cameras of a stereo fit, as fitted together."""
    left, right = (
        CameraGeometry.of(matrix, distortion or (), Projection(kind, angle))
        for matrix, distortion, kind, angle in (
            (
                stereo.camera_matrix_left, stereo.distortion_left,
                stereo.lens_projection_left, stereo.spline_angle_deg_left,
            ),
            (
                stereo.camera_matrix_right, stereo.distortion_right,
                stereo.lens_projection_right, stereo.spline_angle_deg_right,
            ),
        )
        if matrix is not None
    )  # fmt: skip
    return left, right
