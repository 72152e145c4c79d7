"""Which corners of a ChArUco board or a plain checkerboard are seen in a picture, and where.

The boards are the `charuco` captures. A plain checkerboard is a `charuco` capture whose `dictionary` is `"none"`:
`squares` counts its squares `[rows, cols]`, so that it has `rows - 1` x `cols - 1` inner corners. `marker_mm` is
ignored then, and all inner corners have to be in view. Pictures of a plain checkerboard become a recording set that
way, each picture one capture, the pictures of a pair under one `pose`. A grid of dots is one whose `dictionary` is
`"dots"`: its `rows - 1` x `cols - 1` dots stand where a checkerboard has its inner corners (`dot_grid`).

Corners are found on the raw frame. A board is black and white, so that each plane of the 2 x 2 cell of the mosaic,
levelled by itself, shows the same picture. Interleaved they are the luminance, sampled at every pixel. No demosaicing
moves a corner. Each corner is then fitted as the product of two blurred straight edges, to hundredths of a pixel
(`fit_corners`), over the pixels that no marker touches.

Points are those of OpenCV: (x, y) px, x to the right along columns, (0, 0) the centre of the top-left pixel.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.charuco import CharucoCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import CELLS
from lab.observables.boards.dots import dot_centres, dot_grid
from lab.observables.boards.refinement import refine_corners
from lab.observables.boards.views import MIN_CORNERS, BoardView, board_points, grid_steps

Array = NDArray[np.floating[Any]]
#: Largest difference of the planes' quantiles, of their contrast, at which a frame has no mosaic: a code or two of an
#: 8-bit picture. Filters make planes differ by tens of per cent.
EQUAL_LEVELS = 0.03


def luminance(frame: NDArray[np.generic]) -> Array:
    """Level a frame (rows, cols), DN, of a black and white scene to one picture, 0 dark .. 1 light: each plane of the
    2 x 2 cell between its 2 % and 98 % quantiles, whatever its colour is. Where the planes' quantiles agree to
    `EQUAL_LEVELS`, as of a sensor without a mosaic, it is levelled as a whole: their scatter would be a pattern.
    """
    picture = np.array(frame, dtype=float)
    planes = [picture[row::2, col::2] for row, col in CELLS]  # views of the picture
    levels = np.array([quantiles(plane) for plane in planes])
    if np.ptp(levels, axis=0).max() <= EQUAL_LEVELS * np.ptp(levels, axis=1).mean():
        return levelled(picture)
    for plane, between in zip(planes, levels, strict=True):
        plane[:] = levelled(plane, between)
    return picture


def quantiles(plane: Array) -> Array:
    """Return the 2 % and 98 % quantiles of a plane (rows, cols), DN."""
    return np.asarray(np.quantile(plane, [0.02, 0.98]))


def levelled(plane: Array, between: Array | None = None) -> Array:
    """Level a plane (rows, cols), DN: the first of the levels `between` (2,), DN, by default its `quantiles`, to 0, the
    second to 1."""
    low, high = quantiles(plane) if between is None else between
    return np.asarray((plane - low) / max(high - low, 1e-12))


def as_grey(picture: Array) -> NDArray[np.uint8]:
    """Convert a picture (rows, cols) of 0..1 to grey values, smoothed, as detectors take it."""
    return np.clip(255.0 * ndimage.gaussian_filter(picture, 0.7), 0, 255).astype(np.uint8)


def find_board(picture: Array, capture: CharucoCapture, *, bent: bool = False) -> BoardView:
    """Find the corners of the board in a picture (rows, cols) of 0..1. Raises `NotDetermined` where it isn't found,
    with the reason. `bent`: follow a lens that bends edges.
    """
    rows, cols = capture.squares
    grey = as_grey(picture)
    if capture.dictionary == "dots":
        return _dot_view(picture, grey, capture)
    if capture.dictionary == "none":
        index, points = _plain_corners(grey, rows - 1, cols - 1)
        marker_mm = 0.0
    else:
        index, points = _charuco_corners(grey, capture)
        marker_mm = float(capture.marker_mm or 0.0)
    if len(index) < MIN_CORNERS:
        mirrored = np.ascontiguousarray(grey[:, ::-1])
        if capture.has_markers and len(_charuco_corners(mirrored, capture)[0]) >= MIN_CORNERS:
            raise NotDetermined(
                "geometry", "the picture is mirrored: its board is found in the reflection; flip the frames"
            )
        raise NotDetermined(
            "geometry",
            f"only {len(index)} corners found, {MIN_CORNERS} needed: light or place the board better, and check that "
            f"it has {rows} x {cols} squares and its dictionary is {capture.dictionary}",
        )
    if len(index) < (rows - 1) * (cols - 1):
        index, points = _add_missing_corners(index, points, rows - 1, cols - 1, picture.shape)
    board = board_points(capture, index)
    fitted, trusted, std_px = refine_corners(
        picture, points, board[:, :2], capture.square_mm, marker_mm, rows, cols, bent=bent
    )
    if trusted.sum() < MIN_CORNERS:
        raise NotDetermined(
            "geometry",
            f"only {trusted.sum()} corners are clear enough, {MIN_CORNERS} needed: focus or light the board better",
        )
    return BoardView(capture, index, board, fitted, std_px, bent).only(trusted)


def _charuco_corners(grey: NDArray[np.uint8], capture: CharucoCapture) -> tuple[NDArray[np.int64], Array]:
    """Find the numbers and places of the inner corners of a ChArUco board, by the detector of OpenCV.

    `grey` (rows, cols). Returns numbers (n,) and places (n, 2), (x, y), px. Raises `NotDetermined` for an unknown
    dictionary.
    """
    code = getattr(cv2.aruco, capture.dictionary, None)
    if not isinstance(code, int) or not capture.dictionary.startswith("DICT_"):
        raise NotDetermined(
            "geometry", f"OpenCV knows no dictionary '{capture.dictionary}': give one of its names, DICT_..."
        )
    rows, cols = capture.squares
    best: tuple[NDArray[np.int64], Array] = (np.empty(0, np.int64), np.empty((0, 2)))
    for legacy in (False, True):  # since OpenCV 4.6 boards of an even number of rows begin differently
        board = cv2.aruco.CharucoBoard(
            (cols, rows), capture.square_mm, capture.marker_mm or 0.0, cv2.aruco.getPredefinedDictionary(code)
        )
        board.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if ids is not None and len(ids) > len(best[0]):
            best = (ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(float))
        if len(best[0]) or rows % 2:
            break
    return best


def _add_missing_corners(
    index: NDArray[np.int64], points: Array, rows: int, cols: int, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], Array]:
    """Add the corners between markers that couldn't be read, where a homography and a quadratic correction predict
    them.

    `index` (n,): numbers of the corners found at `points` (n, 2), (x, y), px; `rows`, `cols`: inner corners of the
    board; `shape` of the frame.
    """
    homography, _ = cv2.findHomography(grid_steps(index, cols), points, cv2.RANSAC, 3.0)
    if homography is None:
        return index, points

    def plane(of: NDArray[np.int64]) -> Array:
        return np.asarray(cv2.perspectiveTransform(grid_steps(of, cols)[:, None, :], homography)[:, 0])

    known = plane(index)
    centre, scale = known.mean(axis=0), known.std() + 1.0

    def quadratic_terms(at: Array) -> Array:
        x, y = ((at - centre) / scale).T
        terms = [np.ones_like(x), x, y]
        if len(index) >= 12:
            terms += [x * x, x * y, y * y]
        return np.column_stack(terms)

    gap = np.linalg.lstsq(quadratic_terms(known), points - known, rcond=None)[0]
    missing = np.setdiff1d(np.arange(rows * cols), index)
    guess = plane(missing)
    guess = guess + quadratic_terms(guess) @ gap
    inside = np.all((guess > 4) & (guess < np.array([shape[1], shape[0]]) - 5), axis=1)
    index = np.concatenate([index, missing[inside]])
    order = np.argsort(index)
    return index[order], np.concatenate([points, guess[inside]])[order]


def _plain_corners(grey: NDArray[np.uint8], rows: int, cols: int) -> tuple[NDArray[np.int64], Array]:
    """Find the numbers and places of the inner corners of a plain checkerboard; all of them have to be in view.

    `grey` (rows, cols) of the frame; `rows`, `cols`: inner corners of the board. Raises `NotDetermined` where it isn't
    found.
    """
    found, corners = cv2.findChessboardCorners(
        grey, (cols, rows), flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:  # slower, finds more
        found, corners = cv2.findChessboardCornersSB(grey, (cols, rows), flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        raise NotDetermined(
            "geometry", f"no checkerboard of {rows} x {cols} inner corners found: all of it has to be in view"
        )
    grid = corners.reshape(rows, cols, 2).astype(float)
    return np.arange(rows * cols), order_grid(grid, grey if (rows + cols) % 2 else None)


def order_grid(grid: Array, grey: NDArray[np.uint8] | None = None) -> Array:
    """Return the points of a grid (rows, cols, 2) in the order of the board, (rows x cols, 2). `grey`: a checkerboard's
    picture, by whose dark first square it is numbered.
    """
    rows, cols = grid.shape[:2]
    candidates = [np.rot90(grid, k) for k in range(4)] if rows == cols else [grid, grid[::-1, ::-1]]
    candidates += [g[:, ::-1] for g in candidates]
    # Seen from the front, a row and a column turn clockwise. Of these, the one whose first square is dark, so that both
    # cameras of a pair number alike. Boards that look the same rotated by 180 deg begin at the top left.
    front = [g for g in candidates if _cross(g[0, -1] - g[0, 0], g[-1, 0] - g[0, 0]) > 0]
    if grey is not None:
        front = [g for g in front if _first_square_is_dark(grey, g)] or front
    return min(front, key=lambda g: float(g[0, 0].sum())).reshape(-1, 2)


def _dot_view(picture: Array, grey: NDArray[np.uint8], capture: CharucoCapture) -> BoardView:
    """Find the centres of a grid of dots."""
    rows, cols = capture.squares
    points = order_grid(dot_grid(grey, rows - 1, cols - 1))
    index = np.arange((rows - 1) * (cols - 1))
    fits = dot_centres(picture, points, rows - 1, cols - 1)
    if fits.trusted.sum() < MIN_CORNERS:
        raise NotDetermined(
            "geometry",
            f"only {fits.trusted.sum()} dots are clear enough, {MIN_CORNERS} needed: focus or light the grid better",
        )
    return BoardView(capture, index, board_points(capture, index), fits.points, fits.std_px).only(fits.trusted)


def _cross(a: Array, b: Array) -> float:
    """Return the z component of the cross product of two vectors."""
    return float(a[0] * b[1] - a[1] * b[0])


def _first_square_is_dark(grey: NDArray[np.uint8], grid: Array) -> bool:
    """Tell whether the square between the first four inner corners, which has the colour of the first square, is darker
    than its neighbours.
    """
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    level = ndimage.map_coordinates(grey.astype(float), middles[..., ::-1].reshape(-1, 2).T, order=1, mode="nearest")
    even = np.indices(middles.shape[:2]).sum(axis=0).ravel() % 2 == 0
    return bool(level[even].mean() < level[~even].mean())
