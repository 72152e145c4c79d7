"""Boards drawn without the project's image former: each pixel's rays are traced to the board's plane."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.charuco import CharucoCapture
from lab.fit.geometry import fit_geometry
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.results import GeometryFit

SHAPE = (300, 400)
OVER = 3  # rays a pixel and axis


@dataclass(frozen=True)
class Truth:
    """Two pinhole cameras with distortion and the rig between them."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    distortion: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation_mm: NDArray[np.float64]

    @property
    def baseline_mm(self) -> float:
        return float(np.linalg.norm(self.translation_mm))


TRUTH = Truth(
    left=np.array([[420.0, 0, 203.0], [0, 421.0, 147.0], [0, 0, 1]]),
    right=np.array([[417.0, 0, 197.0], [0, 418.0, 152.0], [0, 0, 1]]),
    distortion=np.array([-0.12, 0.06, 0.0005, -0.0003, 0.0]),
    rotation=cv2.Rodrigues(np.array([0.01, -0.03, 0.006]))[0],
    translation_mm=np.array([-60.0, 0.4, 1.1]),
)
POSES = [  # rotation vector; the board's middle, mm, in the left camera's frame
    ((0.1, -0.08, 0.07), (30, 0, 420)),  # aligned with the pixels, the rays of a pixel would all miss an edge or none
    ((0.45, 0.0, 0.05), (20, -20, 380)),
    ((-0.4, 0.1, 0.0), (40, 20, 400)),
    ((0.05, 0.5, 0.0), (30, 0, 400)),
    ((0.0, -0.5, 0.1), (25, 10, 390)),
    ((0.3, 0.35, -0.2), (10, 30, 360)),
    ((-0.3, 0.3, 0.3), (50, -25, 370)),
    ((0.35, -0.3, 0.0), (15, 25, 410)),
]


def texture(capture: CharucoCapture, mm_per_texel: float) -> NDArray[np.float64]:
    """The board, 0 or 1, with its first square's corner at texel corner [0, 0]."""
    rows, cols = capture.squares
    side = round(capture.square_mm / mm_per_texel)
    if capture.dictionary == "none":
        return np.kron(np.indices((rows, cols)).sum(axis=0) % 2, np.ones((side, side)))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, capture.dictionary))
    board = cv2.aruco.CharucoBoard((cols, rows), capture.square_mm, capture.marker_mm, dictionary)
    return (board.generateImage((cols * side, rows * side), marginSize=0) > 127).astype(float)


def undistorted(x, y, distortion) -> NDArray[np.float64]:
    """Rays (n, 3) of normalised image points, by fixed-point iteration of Brown's model (contracts by ~0.1 a step)."""
    k1, k2, p1, p2, k3 = distortion
    u, v = x, y
    for _ in range(8):
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u, v = (
            (x - 2 * p1 * u * v - p2 * (r2 + 2 * u * u)) / radial,
            (y - p1 * (r2 + 2 * v * v) - 2 * p2 * u * v) / radial,
        )
    return np.column_stack([u, v, np.ones_like(u)])


@functools.cache
def fine_rays(matrix: tuple[float, ...], distortion: tuple[float, ...]) -> NDArray[np.float64]:
    """Rays (n, 3) through all samples of a frame, row by row; the same for every board that a camera sees."""
    fine = (np.arange(SHAPE[0] * OVER) + 0.5) / OVER - 0.5, (np.arange(SHAPE[1] * OVER) + 0.5) / OVER - 0.5
    y, x = np.meshgrid(*fine, indexing="ij")
    return undistorted((x.ravel() - matrix[2]) / matrix[0], (y.ravel() - matrix[5]) / matrix[4], distortion)


def draw(capture: CharucoCapture, matrix, distortion, rotation, translation, blur_px=0.6) -> NDArray[np.float64]:
    """Share of the light, (rows, cols), 1 outside of the board."""
    mm_per_texel = 0.25
    board = texture(capture, mm_per_texel)
    rays = fine_rays(tuple(matrix.ravel()), tuple(distortion))
    to_board = np.linalg.inv(np.column_stack([rotation[:, 0], rotation[:, 1], translation]))
    at = rays @ to_board.T
    col, row = (at[:, :2] / at[:, 2:] / mm_per_texel).T
    inside = (row >= 0) & (row < board.shape[0]) & (col >= 0) & (col < board.shape[1])
    value = np.ones(len(row))
    value[inside] = board[row[inside].astype(int), col[inside].astype(int)]
    image = value.reshape(SHAPE[0] * OVER, SHAPE[1] * OVER)
    image = ndimage.gaussian_filter(image, blur_px * OVER)
    return image.reshape(SHAPE[0], OVER, SHAPE[1], OVER).mean(axis=(1, 3))


@functools.cache
def seen(dictionary: str, squares: tuple[int, int], side: str, turn: tuple[float, ...], middle: tuple[float, ...]):
    """The board as the camera of `side` sees it; `turn` and `middle` are in the left camera's frame."""
    capture = board_captures(side, dictionary, squares, 1)[0]
    rotation = cv2.Rodrigues(np.array(turn, dtype=float))[0]
    half = np.array([squares[1], squares[0], 0.0]) * capture.square_mm / 2
    translation = np.array(middle, dtype=float) - rotation @ half
    matrix = TRUTH.left
    if side == "right":
        rotation, translation = TRUTH.rotation @ rotation, TRUTH.rotation @ translation + TRUTH.translation_mm
        matrix = TRUTH.right
    return draw(capture, matrix, TRUTH.distortion, rotation, translation)


def board_captures(side: str, dictionary: str, squares: tuple[int, int], poses: int) -> list[CharucoCapture]:
    return [
        CharucoCapture(
            id=f"charuco-{side}-{k}",
            kind="charuco",
            side=side,
            frame=f"frames/{side}-{k}.npy",
            exposure_s=0.01,
            dictionary=dictionary,
            squares=squares,
            square_mm=24.0,
            marker_mm=18.0,
            pose=f"pose-{k}",
        )
        for k in range(poses)
    ]


def make_boards(
    dictionary: str = "DICT_4X4_50",
    squares: tuple[int, int] = (6, 8),
    cfa: str = "RGGB",
    poses: int = len(POSES),
    *,
    sides: tuple[str, ...] = ("left", "right"),
) -> RecordingSet:
    rng = np.random.default_rng(8)
    camera = DataSheet(
        rows=SHAPE[0],
        cols=SHAPE[1],
        pixel_pitch_um=3.0,
        fill_factor=1.0,
        cfa=cfa,
        bit_depth=12,
        black_level_dn=64.0,
    )
    gains = np.ones((2, 2)) if cfa == "MONO" else np.array([[0.55, 1.0], [1.02, 0.45]])
    frames, captures = {}, []
    for side in sides:
        for capture, (turn, middle) in zip(board_captures(side, dictionary, squares, poses), POSES, strict=False):
            light = seen(capture.dictionary, squares, side, turn, middle)
            electrons = 6000 * (0.04 + 0.96 * light) * np.tile(gains, (SHAPE[0] // 2, SHAPE[1] // 2))
            frames[capture.frame] = (64 + 0.4 * rng.poisson(electrons)).astype(np.uint16)
            captures.append(capture)
    manifest = Manifest(cameras=dict.fromkeys(sides, camera), captures=tuple(captures))
    return RecordingSet(manifest, frames=frames)


@pytest.fixture(scope="session")
def boards() -> Callable[..., RecordingSet]:
    """Makes recordings of a board in front of both cameras of `truth`."""
    return make_boards


@pytest.fixture(scope="session")
def charuco_boards() -> RecordingSet:
    """ChArUco boards on a Bayer pair."""
    return make_boards()


@pytest.fixture(scope="session")
def charuco_fits(charuco_boards: RecordingSet) -> dict[str, GeometryFit]:
    """The geometry of both cameras of `charuco_boards`."""
    return {"left": fit_geometry(charuco_boards, "left"), "right": fit_geometry(charuco_boards, "right")}


@pytest.fixture(scope="session")
def truth() -> Truth:
    return TRUTH
