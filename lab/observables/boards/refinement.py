"""Corners of a board that was found, fitted in its picture over the pixels that no marker touches; also where a lens
bends the edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.errors import NotDetermined
from lab.observables.boards.corner_fits import CornerFits, fit_corners
from lab.observables.boards.views import BoardView

Array = NDArray[np.floating[Any]]


WINDOW_PX = 9.0  # largest radius of the window of a corner
WINDOW_SHARE = 0.42  # of the side of a square, that radius
EDGE_SQUARES = 2  # on both sides of a corner, over which the curvature of an edge is measured
#: Distance from the bent homography, from which a corner isn't used for it: of the median distance, and of the spacing
#: of the corners, by which those at the rim of a wide board may be off.
OUTLYING_GUESS, OUTLYING_SQUARES = 5.0, 0.05


def refine_corners(
    picture: Array,
    points: Array,
    board: Array,
    square_mm: float,
    marker_mm: float,
    rows: int,
    cols: int,
    *,
    bent: bool = False,
) -> CornerFits:
    """Fit corners (n, 2), (x, y), in the picture, at the pixels that no marker touches.

    `points` (n, 2): first guess, (x, y), px; `board` (n, 2): places on the board, mm; `marker_mm`: side of a marker, 0
    without; `rows`, `cols`: squares of the board; `bent`: follow a lens that bends edges, with the curvature that the
    corners show. Raises `NotDetermined` where the points don't lie on a plane.
    """
    homography, _ = cv2.findHomography(board.astype(np.float64), points.astype(np.float64), cv2.RANSAC, 3.0)
    if homography is None:
        raise NotDetermined("geometry", "the corners found don't lie on a plane: light or place the board better")
    to_image, to_board = _plane_map(homography), _plane_map(np.linalg.inv(homography))
    if bent:
        to_image = _bent_map(homography, board, points)
        to_board = _bent_map(np.linalg.inv(homography), points, board)

    step = 0.5 * square_mm
    along = [
        to_image(board + np.array(d) * step) - to_image(board - np.array(d) * step) for d in ((1.0, 0.0), (0.0, 1.0))
    ]
    square_px = np.minimum(np.linalg.norm(along[0], axis=1), np.linalg.norm(along[1], axis=1))
    half = np.clip(WINDOW_SHARE * square_px, 2.0, WINDOW_PX)

    def clear(at_px: Array) -> NDArray[np.bool_]:
        """Tell which pixels (n, 2) are on the board with no marker that blurs into them."""
        mm = to_board(at_px)
        inside = np.all((mm > 0) & (mm < np.array([cols, rows]) * square_mm), axis=1)
        if marker_mm <= 0:
            return np.asarray(inside)
        blur_mm = 1.5 * square_mm / float(np.median(square_px))
        reach = 0.5 * marker_mm + blur_mm
        # Markers are in the light squares
        cell = np.floor(mm / square_mm)
        centre = (cell + 0.5) * square_mm
        near = np.all(np.abs(mm - centre) < reach, axis=1)
        light = light_squares[
            np.clip(cell[:, 1], 0, rows - 1).astype(int), np.clip(cell[:, 0], 0, cols - 1).astype(int)
        ]
        return np.asarray(inside & ~(near & light))

    light_squares = _light_squares(picture, to_image, square_mm, marker_mm, rows, cols)
    fits = fit_corners(picture, points, along[0], along[1], half, clear)
    if not bent:
        return fits
    known = np.where(fits.trusted[:, None], fits.points, np.nan)
    return fit_corners(picture, points, along[0], along[1], half, clear, edge_curvatures(board, known, square_mm))


def _plane_map(homography: Array) -> Callable[[Array], Array]:
    """Return the map of places (n, 2) by a homography (3, 3)."""
    return lambda at: np.asarray(
        cv2.perspectiveTransform(np.reshape(at, (-1, 1, 2)).astype(np.float64), homography)[:, 0]
    )


def _bent_map(homography: Array, source: Array, target: Array) -> Callable[[Array], Array]:
    """Return a map of places (n, 2) that takes `source` (n, 2) to `target` (n, 2), the corners of a board: by a
    homography, from (3, 3) on, and a polynomial of up to the fourth degree for what a lens that bends edges adds.
    """
    design, square = _polynomial(source, source, 4), float(np.ptp(target, axis=0).max() / np.sqrt(len(target)))
    near = np.ones(len(source), dtype=bool)
    for _ in range(3):  # a corner that was found at a wrong place would bend the map about its neighbours
        plane = _plane_map(homography)
        displaced = target - plane(source)
        coefficients = np.linalg.lstsq(design[near], displaced[near], rcond=1e-9)[0]
        distance = np.linalg.norm(displaced - design @ coefficients, axis=1)
        near = distance <= max(OUTLYING_GUESS * float(np.median(distance)), OUTLYING_SQUARES * square)
        # The given homography may follow a part of a wide board; the nearer it is to all, the less is left to bend
        whole, _ = cv2.findHomography(source[near].astype(np.float64), target[near].astype(np.float64), 0)
        homography = homography if whole is None else whole
    return lambda at: np.asarray(plane(at) + _polynomial(at, source, 4) @ coefficients)


def edge_curvatures(board: Array, points: Array, square_mm: float) -> Array:
    """Estimate the curvatures (2, n, 2), 1/px, of the images of the edges along x and along y of the board, as vectors
    (x, y) at its corners: `board` (n, 2), mm, seen at `points` (n, 2), px, NaN where one isn't known.

    A fit of straight edges to curved ones is off by about curvature times window^2 / 6: 0.02 px at half the frame of a
    fisheye. A polynomial goes through the corners of the same edge up to two squares away, or the nearest four. Its
    part along the edge is perspective's. Its noise, up to 14 / square^2 times that of a corner, is smoothed over the
    board by a polynomial of up to the third degree. 0 where fewer than four corners are known.
    """
    found = np.full((2, len(board), 2), np.nan)
    known = np.isfinite(points).all(axis=1)
    steps = board / square_mm
    for along in (0, 1):
        for k, place in enumerate(steps):
            away = steps - place
            on_edge = np.flatnonzero(known & (np.abs(away[:, 1 - along]) < 0.5))
            if len(on_edge) < 4:
                continue
            distance = np.abs(away[on_edge, along])
            nearest = on_edge[np.argsort(distance)][: max(4, int(np.sum(distance < EDGE_SQUARES + 0.5)))]
            design = np.vander(away[nearest, along], increasing=True)
            _, slope, half = np.linalg.solve(design, points[nearest])[:3]
            twice, square = 2.0 * half, float(slope @ slope)
            found[along, k] = (twice - (twice @ slope) / square * slope) / square
    terms = _polynomial(board, board, 3)
    for along in (0, 1):
        there = np.isfinite(found[along]).all(axis=1)
        if there.any():
            found[along] = terms @ np.linalg.lstsq(terms[there], found[along, there], rcond=1e-9)[0]
    return np.nan_to_num(found)


def _polynomial(at: Array, known: Array, highest: int) -> Array:
    """Return the terms (n, k), at places (n, 2), of a polynomial that `known` places (m, 2) determine: of the highest
    degree up to `highest` for which there are three of them a term.
    """
    degree = max((d for d in range(highest + 1) if 3 * (d + 1) * (d + 2) // 2 <= len(known)), default=0)
    x, y = ((at - known.mean(axis=0)) / (0.5 * float(np.ptp(known, axis=0).max()) + 1e-9)).T
    return np.column_stack([x**i * y ** (k - i) for k in range(degree + 1) for i in range(k + 1)])


def _light_squares(
    picture: Array, to_image: Any, square_mm: float, marker_mm: float, rows: int, cols: int
) -> NDArray[np.bool_]:
    """Tell which squares are light: of the two checker patterns, the one that agrees with the picture near the borders
    of the squares.

    `to_image` maps places on the board (n, 2), mm, to px. Returns a mask (rows, cols) of the squares.
    """
    row, col = np.indices((rows, cols))
    rim = 0.5 - 0.25 * max(1.0 - marker_mm / square_mm, 0.1)
    level = np.zeros((rows, cols))
    for dx, dy in ((rim, 0.0), (-rim, 0.0), (0.0, rim), (0.0, -rim)):
        at = to_image(np.column_stack([(col.ravel() + 0.5 + dx) * square_mm, (row.ravel() + 0.5 + dy) * square_mm]))
        level += ndimage.map_coordinates(picture, at[:, ::-1].T, order=1, mode="nearest").reshape(rows, cols)
    even = (row + col) % 2 == 0
    return np.asarray(even if level[even].mean() > level[~even].mean() else ~even)


def bend_px(view: BoardView) -> float:
    """Return how far straight edges, in place of the curved ones that the corners of a view show, move corners (rms,
    px).
    """
    square_mm = view.capture.square_mm
    curvature = edge_curvatures(view.board_mm[:, :2], view.image_px, square_mm)
    away = np.linalg.norm(view.board_mm[:, None] - view.board_mm, axis=2)
    one, other = np.nonzero(np.abs(away - square_mm) < 0.1 * square_mm)
    if not len(one):
        return 0.0
    square_px = float(np.median(np.linalg.norm(view.image_px[one] - view.image_px[other], axis=1)))
    half = float(np.clip(WINDOW_SHARE * square_px, 2.0, WINDOW_PX))
    return float(np.sqrt(np.mean(np.sum(curvature**2, axis=2)))) * half**2 / 6.0
