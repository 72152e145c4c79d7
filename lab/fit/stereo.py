"""Extrinsics of a stereo pair: x_right = rotation x_left + translation_mm, from poses of a board that both cameras saw.

One least-squares problem over everything the pairs say: the rig's rotation and translation, both cameras' intrinsics (from
where the single cameras' fits ended) and the board's pose in every pair. Solving for the rig alone, with the intrinsics held
where each camera's own views put them, would push their errors into the rig and leave them out of its uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from lab.errors import NotDetermined
from lab.fit.geometry import BoardView, find_boards
from lab.recording import RecordingSet
from lab.results import GeometryFit, StereoFit

Array = NDArray[np.floating[Any]]

MIN_PAIRS = 2
INTRINSICS = 9  # fx fy cx cy k1 k2 p1 p2 k3
OUTLYING_PAIR = 3.0  # times the median rms of the pairs


def fit_stereo(recordings: RecordingSet, left: GeometryFit, right: GeometryFit) -> StereoFit:
    """Rotation and translation between the cameras from the `charuco` captures of equal `pose`, with uncertainties.

    `rms_px` is over all corners of both cameras, of the corner's distance from its prediction. A view that the single camera's
    fit has rejected isn't used, nor is a pair whose rms is more than 3 times the pairs' median. Raises `NotDetermined`
    below 2 pairs.
    """
    pairs = paired_views(recordings, left, right)
    if len(pairs) < MIN_PAIRS:
        raise NotDetermined(
            "stereo",
            f"{len(pairs)} poses of the board were found by both cameras, {MIN_PAIRS} are needed: capture charuco poses with "
            "both, under the same pose name",
        )
    while True:
        rig = solve_rig(pairs, left, right)
        worst = int(np.argmax(rig.rms_of_pairs_px))
        limit = max(OUTLYING_PAIR * float(np.median(rig.rms_of_pairs_px)), 0.1)
        if len(pairs) == MIN_PAIRS or rig.rms_of_pairs_px[worst] <= limit:
            break
        pairs = [pair for k, pair in enumerate(pairs) if k != worst]
    translation, covariance = rig.translation_mm, rig.covariance
    rotation, by_turn = cv2.Rodrigues(rig.turn)
    # The uncertainty as a small rotation about the camera's axes: R(turn + d) R(turn)^T = 1 + [w]x, w linear in d
    small = [by_turn[k].reshape(3, 3) @ rotation.T for k in range(3)]
    axes = np.array([[s[2, 1], s[0, 2], s[1, 0]] for s in small]).T
    turn_covariance = axes @ covariance[:3, :3] @ axes.T
    baseline = float(np.linalg.norm(translation))
    along = translation / baseline
    return StereoFit(
        rotation=tuple((float(a), float(b), float(c)) for a, b, c in rotation),
        rotation_std_rad=_three(np.sqrt(np.diag(turn_covariance))),
        translation_mm=_three(translation),
        translation_mm_std=_three(np.sqrt(np.diag(covariance)[3:6])),
        baseline_mm=baseline,
        baseline_mm_std=float(np.sqrt(along @ covariance[3:6, 3:6] @ along)),
        rms_px=rig.rms_px,
        pairs=len(pairs),
    )


def paired_views(recordings: RecordingSet, left: GeometryFit, right: GeometryFit) -> list[tuple[BoardView, BoardView]]:
    """Views of both cameras with the same `pose`, the first of each where a pose was repeated, in the left one's order."""
    of_side: dict[str, dict[str, BoardView]] = {}
    for side, fit in (("left", left), ("right", right)):
        refused = {item.step for item in fit.rejected}
        views, _ = find_boards(recordings, "left" if side == "left" else "right")
        of_side[side] = {}
        for view in views:
            if view.capture.id not in refused:
                of_side[side].setdefault(view.capture.pose, view)
    return [(view, of_side["right"][pose]) for pose, view in of_side["left"].items() if pose in of_side["right"]]


@dataclass(frozen=True)
class Rig:
    """Outcome of the joint solve: `turn` (rotation vector) and `translation_mm`, their covariance (6, 6), and what is left, px."""

    turn: Array
    translation_mm: Array
    covariance: Array
    rms_px: float
    rms_of_pairs_px: Array


def solve_rig(pairs: Sequence[tuple[BoardView, BoardView]], left: GeometryFit, right: GeometryFit) -> Rig:
    """Joint least squares of the rig, both cameras' intrinsics and the boards' poses."""
    problem = _Problem(pairs, (_intrinsics(left), _intrinsics(right)))
    start = problem.start()
    scale = np.maximum(np.linalg.norm(problem.evaluate(start)[1], axis=0), 1e-12)
    found = least_squares(
        lambda p: problem.evaluate(p)[0],
        start,
        jac=lambda p: problem.evaluate(p)[1],
        x_scale=1.0 / scale,
        method="lm",
        max_nfev=200,
    )
    residual, slopes = problem.evaluate(found.x)
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-12)
    normal = (slopes / scale).T @ (slopes / scale)
    variance = float(residual @ residual) / max(len(residual) - len(found.x), 1)
    covariance = variance * np.linalg.pinv(normal, rcond=1e-13)[:6, :6] / np.outer(scale[:6], scale[:6])
    ends = np.cumsum([2 * (len(one.index) + len(two.index)) for one, two in pairs])[:-1]
    return Rig(
        turn=found.x[:3],
        translation_mm=found.x[3:6],
        covariance=covariance,
        rms_px=float(np.sqrt(2.0 * np.mean(residual**2))),
        rms_of_pairs_px=np.array([np.sqrt(2.0 * np.mean(part**2)) for part in np.split(residual, ends)]),
    )


class _Problem:
    """Parameters: rig (3 + 3), intrinsics of both cameras (those that are fitted), pose of the board in every pair (3 + 3)."""

    def __init__(self, pairs: Sequence[tuple[BoardView, BoardView]], cameras: tuple[Array, Array]) -> None:
        self.pairs = pairs
        self.cameras = cameras
        self.free = [np.append(np.ones(8, dtype=bool), c[8] != 0.0) for c in cameras]  # a k3 that wasn't fitted stays 0
        edges = np.cumsum([6, *(int(mask.sum()) for mask in self.free)])
        self.at_camera = [slice(edges[0], edges[1]), slice(edges[1], edges[2])]
        self.at_poses = int(edges[2])

    def start(self) -> Array:
        """From the single cameras' intrinsics and the board's pose in each."""
        poses, rigs = [], []
        for pair in self.pairs:
            (turn_one, shift_one), (turn_two, shift_two) = (
                _pose(view, camera) for view, camera in zip(pair, self.cameras, strict=True)
            )
            rotation = cv2.Rodrigues(turn_two)[0] @ cv2.Rodrigues(turn_one)[0].T
            rigs.append(np.concatenate([cv2.Rodrigues(rotation)[0].ravel(), shift_two - rotation @ shift_one]))
            poses.append(np.concatenate([turn_one, shift_one]))
        intrinsics = [camera[mask] for camera, mask in zip(self.cameras, self.free, strict=True)]
        return np.concatenate([np.median(rigs, axis=0), *intrinsics, *poses])

    def camera(self, p: Array, number: int) -> Array:
        """All nine intrinsics of a camera."""
        intrinsics = np.zeros(INTRINSICS)
        intrinsics[self.free[number]] = p[self.at_camera[number]]
        return intrinsics

    def evaluate(self, p: Array) -> tuple[Array, Array]:
        """Residuals, and their Jacobian: (x, y) of every corner, left then right, pair by pair."""
        residuals, rows = [], []
        for k, (one, two) in enumerate(self.pairs):
            at = slice(self.at_poses + 6 * k, self.at_poses + 6 * k + 6)
            turn, shift = p[at][:3], p[at][3:]
            residual, by_pose, by_camera = _project(one, turn, shift, self.camera(p, 0))
            row = np.zeros((len(residual), len(p)))
            row[:, self.at_camera[0]] = by_camera[:, self.free[0]]
            row[:, at] = by_pose
            residuals.append(residual)
            rows.append(row)

            turn, shift, *slopes = cv2.composeRT(turn, shift, p[:3], p[3:6])
            by_board = np.block([[slopes[0], slopes[1]], [slopes[4], slopes[5]]])
            by_rig = np.block([[slopes[2], slopes[3]], [slopes[6], slopes[7]]])
            residual, by_pose, by_camera = _project(two, turn, shift, self.camera(p, 1))
            row = np.zeros((len(residual), len(p)))
            row[:, :6] = by_pose @ by_rig
            row[:, self.at_camera[1]] = by_camera[:, self.free[1]]
            row[:, at] = by_pose @ by_board
            residuals.append(residual)
            rows.append(row)
        return np.concatenate(residuals), np.concatenate(rows)


def _intrinsics(fit: GeometryFit) -> Array:
    matrix = fit.camera_matrix
    distortion = (*fit.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return np.array([matrix[0][0], matrix[1][1], matrix[0][2], matrix[1][2], *distortion])


def _matrix(camera: Array) -> Array:
    return np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])


def _pose(view: BoardView, camera: Array) -> tuple[Array, Array]:
    """The board's rotation vector and translation in the camera's frame."""
    found, turn, shift = cv2.solvePnP(
        view.board_mm.astype(float), view.image_px.astype(float), _matrix(camera), camera[4:], flags=cv2.SOLVEPNP_IPPE
    )
    if not found:
        raise NotDetermined(
            "stereo", f"{view.capture.id}: no pose of the board fits its corners: leave the capture out"
        )
    turn, shift = cv2.solvePnPRefineLM(
        view.board_mm.astype(float), view.image_px.astype(float), _matrix(camera), camera[4:], turn, shift
    )
    return turn.ravel(), shift.ravel()


def _project(view: BoardView, turn: Array, shift: Array, camera: Array) -> tuple[Array, Array, Array]:
    """Predicted less seen (2n,), and its derivatives by the pose (2n, 6) and by the intrinsics (2n, 9)."""
    points, slopes = cv2.projectPoints(view.board_mm.astype(float), turn, shift, _matrix(camera), camera[4:])
    residual = (points.reshape(-1, 2) - view.image_px).ravel()
    return residual, slopes[:, :6], slopes[:, 6:15]


def _three(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
