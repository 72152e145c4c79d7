"""Corners of a board as known cameras see them, by OpenCV's projection: truths for the calibration's tests and
benchmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.charuco import CharucoCapture
from lab.observables.boards.views import BoardView, board_points

SHAPE = (960, 1280)
Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Truth:
    """Two cameras, the rig between them, and a board that isn't flat (bend x, bend y, twist; mm)."""

    left: Array = field(default_factory=lambda: np.array([[1400.0, 0, 642.0], [0, 1402.0, 475.0], [0, 0, 1]]))
    right: Array = field(default_factory=lambda: np.array([[1395.0, 0, 630.0], [0, 1396.0, 483.0], [0, 0, 1]]))
    distortion_left: Array = field(default_factory=lambda: np.array([-0.12, 0.08, 4e-4, -3e-4, -0.02]))
    distortion_right: Array = field(default_factory=lambda: np.array([-0.115, 0.07, -2e-4, 2e-4, -0.01]))
    rotation: Array = field(default_factory=lambda: cv2.Rodrigues(np.array([0.01, -0.06, 0.006]))[0])
    translation_mm: Array = field(default_factory=lambda: np.array([-80.0, 0.4, 1.1]))
    warp_mm: tuple[float, float, float] = (0.4, -0.3, 0.2)

    @property
    def intrinsics_left(self) -> Array:
        """fx fy cx cy k1 k2 p1 p2 k3."""
        return np.array([self.left[0, 0], self.left[1, 1], self.left[0, 2], self.left[1, 2], *self.distortion_left[:5]])


TRUTH = Truth()


def capture(
    number: int, side: str = "left", squares: tuple[int, int] = (9, 12), square_mm: float = 25.0
) -> CharucoCapture:
    return CharucoCapture(
        id=f"{side}-{number}", kind="charuco", side=side, frame="none.npy", exposure_s=0.01, dictionary="none",
        squares=squares, square_mm=square_mm, pose=f"pose-{number}",
    )  # fmt: skip


def bent(board: Array, of: CharucoCapture, warp_mm: tuple[float, ...]) -> Array:
    """The board's corners with z = a (x^2 - 1/3) + b (y^2 - 1/3) + c x y."""
    x = 2 * board[:, 0] / (of.squares[1] * of.square_mm) - 1
    y = 2 * board[:, 1] / (of.squares[0] * of.square_mm) - 1
    out = board.copy()
    out[:, 2] += warp_mm[0] * (x * x - 1 / 3) + warp_mm[1] * (y * y - 1 / 3) + warp_mm[2] * x * y
    return out


def poses(
    count: int, seed: int = 5, distance_mm: float = 700.0, tilt_rad: float = 0.45, squares: tuple[int, int] = (9, 12)
) -> list[tuple[Array, Array]]:
    """Rotations and translations of a board about the middle of the left frame; the same for a seed."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        turn = cv2.Rodrigues(rng.normal(0, tilt_rad, 3) * [1, 1, 0.5])[0]
        middle = np.array([rng.normal(0, 0.13), rng.normal(0, 0.1), rng.uniform(0.7, 1.2)]) * distance_mm
        found.append((turn, middle - turn @ [squares[1] * 12.5, squares[0] * 12.5, 0]))
    return found


def seen(
    rng: np.random.Generator,
    at: list[tuple[Array, Array]],
    truth: Truth = TRUTH,
    noise_px: float = 0.1,
    side: str = "left",
    squares: tuple[int, int] = (9, 12),
    warps_mm: list[tuple[float, float, float]] | None = None,
) -> list[BoardView]:
    """A view for each pose, with Gaussian noise on each coordinate; corners outside of the frame are missing."""
    views = []
    for number, pose in enumerate(at):
        turn, shift = pose
        of = capture(number, side, squares)
        index = np.arange((squares[0] - 1) * (squares[1] - 1))
        board = board_points(of, index)
        shape = bent(board, of, truth.warp_mm if warps_mm is None else warps_mm[number])
        if side == "right":
            turn, shift = truth.rotation @ pose[0], truth.rotation @ pose[1] + truth.translation_mm
        matrix, distortion = (
            (truth.left, truth.distortion_left) if side == "left" else (truth.right, truth.distortion_right)
        )
        points = cv2.projectPoints(shape, cv2.Rodrigues(turn)[0], shift, matrix, distortion)[0][:, 0]
        inside = np.all((points > 4) & (points < np.array(SHAPE[::-1]) - 5), axis=1)
        noisy = points[inside] + rng.normal(0, noise_px, (int(inside.sum()), 2))
        views.append(BoardView(of, index[inside], board[inside], noisy))
    return views
