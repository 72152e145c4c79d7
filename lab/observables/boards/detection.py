"""Which corners of a ChArUco board or a plain checkerboard are seen in a frame, and where.

The boards are the `charuco` captures. A plain checkerboard is a `charuco` capture whose `dictionary` is `"none"`:
`squares` counts its squares `[rows, cols]`, so that it has `rows - 1` x `cols - 1` inner corners. `marker_mm` is
ignored then, and all inner corners have to be in view. Pictures of a plain checkerboard become a recording set that
way, each picture one capture, the pictures of a pair under one `pose`. A grid of dots is one whose `dictionary` is
`"dots"`: its `rows - 1` x `cols - 1` dots stand where a checkerboard has its inner corners (`dot_grid`).

Corners are found on the raw mosaic. A board is black and white, so that each plane of the mosaic, levelled by itself,
shows the same picture. Interleaved they are the luminance, sampled at every pixel. No demosaicing moves a corner. Each
corner is then fitted as the product of two blurred straight edges, to hundredths of a pixel (`fit_corners`), over the
pixels that no marker touches.

Points are those of OpenCV: (x, y) px, x to the right along columns, (0, 0) the centre of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import erf

from lab.capture_kinds.charuco import CharucoCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Skipped
from sim.camera import Side
from sim.sensor.mosaic import phases, planes

Array = NDArray[np.floating[Any]]

#: Radius of the window about a dot, over the spacing of the dots; and the share of that radius beyond which is
#: background.
DOT_WINDOW, DOT_BACKGROUND = 0.5, 0.8
#: Share of a dot's contrast that is subtracted from the weights; least contrast of a dot, in a picture of 0..1.
LEAST_DOT_SHARE, LEAST_DOT_CONTRAST = 0.1, 0.1
CENTROID_PASSES = 4

MIN_CORNERS = 8  # of a view: a pose has six parameters
WINDOW_PX = 9.0  # largest radius of the window of a corner
WINDOW_SHARE = 0.42  # of the side of a square, that radius
#: Displacement of corners by the curvature of their edges (rms; median over the views), below which edges are taken as
#: straight: half of the hundredth of a pixel that corners are fitted to. Pictures through a pinhole show 0.001 px.
LEAST_BEND_PX = 0.005
EDGE_SQUARES = 2  # on both sides of a corner, over which the curvature of an edge is measured
#: Distance from the bent homography, from which a corner isn't used for it: of the median distance, and of the spacing
#: of the corners, by which those at the rim of a wide board may be off.
OUTLYING_GUESS, OUTLYING_SQUARES = 5.0, 0.05


class CornerFits(NamedTuple):
    """Corners (n, 2), (x, y), px; which fits are to be trusted (n,); standard deviation of a coordinate by the noise
    of the picture, px (n,).
    """

    points: Array
    trusted: NDArray[np.bool_]
    std_px: Array


def fit_corners(
    picture: Array,
    points: Array,
    across: Array,
    down: Array,
    half_px: Array,
    clear: Callable[[Array], NDArray[np.bool_]] | None = None,
    bend_per_px: Array | None = None,
) -> CornerFits:
    """Fit checkerboard corners by least squares (Levenberg-Marquardt, all corners at once).

        I = level + gradient . r + contrast E(d1) E(d2)

    E: a blurred edge, an error function of -1..1; d1, d2: distances from two lines through the corner, straight ones or
    parabolas with the curvatures `bend_per_px` (2, n, 2), vectors (x, y) of the lines along `across` and `down`.
    `points` (n, 2), (x, y): the first guess, good to about 2 px. `across`, `down` (n, 2): directions of the axes of the
    board there. `half_px` (n,): radius of the window. `clear(points) -> bool` says which pixels may be used. Trusted
    are fits that converged near the guess, are sharp enough, and explain the picture.
    """
    points = np.array(points, dtype=float)
    count = len(points)
    size = int(np.ceil(half_px.max()))
    offset = np.arange(-size, size + 1, dtype=float)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    dx, dy = dx[np.hypot(dx, dy) <= half_px.max() + 0.5], dy[np.hypot(dx, dy) <= half_px.max() + 0.5]
    base = np.round(points)
    x, y = base[:, :1] + dx, base[:, 1:] + dy  # (n, window)
    rows, cols = picture.shape
    used = (x >= 0) & (x < cols) & (y >= 0) & (y < rows)
    used &= np.hypot(dx, dy)[None, :] <= half_px[:, None] + 0.5
    if clear is not None:
        used &= clear(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(used.shape)
    value = picture[np.clip(y, 0, rows - 1).astype(int), np.clip(x, 0, cols - 1).astype(int)]
    weight = used.astype(float)
    bend = np.zeros((2, count, 2)) if bend_per_px is None else bend_per_px

    # Edge 1 runs along `across`, edge 2 along `down`. Parameters: place (2), angles of the normals (2), width, level,
    # gradient (2), contrast.
    p = np.zeros((count, 9))
    p[:, :2] = points - base
    p[:, 2] = np.arctan2(across[:, 0], -across[:, 1])
    p[:, 3] = np.arctan2(down[:, 0], -down[:, 1])
    p[:, 4] = 1.0
    p[:, 5:] = _damped_step(_corner_model(p, dx, dy, bend)[1][:, :, 5:], weight, value)[0]
    damping = np.full(count, 1e-3)
    cost = _residual_squares(p, dx, dy, bend, value, weight)
    limit = np.array([1.0, 1.0, 0.3, 0.3, 0.5, np.inf, np.inf, np.inf, np.inf])
    moving = np.arange(count)  # corners that still move
    for _ in range(25):
        model, jacobian = _corner_model(p[moving], dx, dy, bend[:, moving])
        change, _ = _damped_step(jacobian, weight[moving], value[moving] - model, damping[moving])
        tried = p[moving] + np.clip(change, -limit, limit)
        tried[:, 4] = np.clip(tried[:, 4], 0.2, 4.0)
        new = _residual_squares(tried, dx, dy, bend[:, moving], value[moving], weight[moving])
        better = new <= cost[moving]
        moved = np.abs(tried - p[moving])[:, :2].max(axis=1)
        p[moving[better]], cost[moving[better]] = tried[better], new[better]
        damping[moving] = np.clip(np.where(better, damping[moving] * 0.1, damping[moving] * 10.0), 1e-10, 1e6)
        moving = moving[np.where(better, moved > 1e-4, damping[moving] < 1e3)]
        if not len(moving):
            break
    covariance = _damped_step(_corner_model(p, dx, dy, bend)[1], weight, value)[1]
    unit_std = np.sqrt(np.abs(covariance[:, 0, 0] + covariance[:, 1, 1]))
    pixels = weight.sum(axis=1)
    residual = np.sqrt(cost / np.maximum(pixels - 9.0, 1.0))
    found = base + p[:, :2]
    trusted = (
        (np.linalg.norm(found - points, axis=1) < 2.5)
        & (pixels > 16)
        & (np.abs(p[:, 8]) > 3.0 * residual)
        & (residual * unit_std < 0.5)
    )
    return CornerFits(found, trusted, residual * unit_std / np.sqrt(2.0))


def _edge_distances(p: Array, dx: Array, dy: Array, bend: Array) -> list[tuple[Array, Array, Array]]:
    """Return for each of the two edges: the distance of the pixels from it (n, window), the place along it, px, and its
    curvature towards its normal (n, 1), 1/px. See `_corner_model`.
    """
    x, y = dx - p[:, :1], dy - p[:, 1:2]
    found: list[tuple[Array, Array, Array]] = []
    for angle, curvature in zip((p[:, 2:3], p[:, 3:4]), bend, strict=True):
        along = np.cos(angle) * y - np.sin(angle) * x
        towards = np.cos(angle) * curvature[:, :1] + np.sin(angle) * curvature[:, 1:]
        found.append((np.cos(angle) * x + np.sin(angle) * y - 0.5 * towards * along**2, along, towards))
    return found


def _corner_model(p: Array, dx: Array, dy: Array, bend: Array) -> tuple[Array, Array]:
    """Return the model (n, window) of the picture and its Jacobian (n, window, 9), in which a turn of an edge doesn't
    change its sag.

    `p` (n, 9): parameters of the corners, see `fit_corners`. `dx`, `dy` (window,): places of the pixels from the
    pixel of the corner, px. `bend` (2, n, 2): curvatures of the edges.
    """
    width, contrast = p[:, 4:5], p[:, 8:9]
    distances = _edge_distances(p, dx, dy, bend)
    edges = [erf(u / (np.sqrt(2.0) * width)) for u, _, _ in distances]
    derivatives = [np.sqrt(2.0 / np.pi) / width * np.exp(-0.5 * (u / width) ** 2) for u, _, _ in distances]
    slopes = [derivatives[0] * edges[1] * contrast, derivatives[1] * edges[0] * contrast]
    by_x, by_y = np.zeros_like(slopes[0]), np.zeros_like(slopes[0])
    for slope, angle, (_, along, towards) in zip(slopes, (p[:, 2:3], p[:, 3:4]), distances, strict=True):
        by_x -= slope * (np.cos(angle) + towards * along * np.sin(angle))
        by_y -= slope * (np.sin(angle) - towards * along * np.cos(angle))
    jacobian = np.stack(
        [
            by_x,
            by_y,
            slopes[0] * distances[0][1],
            slopes[1] * distances[1][1],
            -(slopes[0] * distances[0][0] + slopes[1] * distances[1][0]) / width,
            np.ones_like(by_x),
            np.broadcast_to(dx, by_x.shape),
            np.broadcast_to(dy, by_x.shape),
            edges[0] * edges[1],
        ],
        axis=-1,
    )
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + contrast * edges[0] * edges[1]
    return model, jacobian


def _residual_squares(p: Array, dx: Array, dy: Array, bend: Array, value: Array, weight: Array) -> Array:
    """Return the weighted sums of squared residuals (n,).

    `p`, `dx`, `dy`, `bend`: see `_corner_model`. `value`, `weight` (n, window): the picture, and 1 where a pixel is
    used, else 0.
    """
    width = np.sqrt(2.0) * p[:, 4:5]
    one, two = (erf(u / width) for u, _, _ in _edge_distances(p, dx, dy, bend))
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + p[:, 8:9] * one * two
    return np.asarray((weight * (value - model) ** 2).sum(axis=1))


def _damped_step(jacobian: Array, weight: Array, residual: Array, damping: Array | None = None) -> tuple[Array, Array]:
    """Solve the damped least squares of every corner: steps (n, k) and the inverse normal matrices (n, k, k).

    `jacobian` (n, window, k), `weight`, `residual` (n, window), `damping` (n,): share of the diagonal that is added to
    it.
    """
    weighted = jacobian * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ jacobian
    scale = np.einsum("nkk->nk", normal)
    ridge = (1e-9 if damping is None else damping[:, None]) * scale + 1e-12
    normal = normal + ridge[:, :, None] * np.eye(normal.shape[1])
    inverse = np.linalg.inv(normal)
    right = np.swapaxes(weighted, 1, 2) @ residual[:, :, None]
    return (inverse @ right)[:, :, 0], inverse


def dot_grid(grey: NDArray[np.uint8], rows: int, cols: int) -> Array:
    """Find a grid of dots: first estimates of their centres, (rows, cols, 2), (x, y) px. Dots are dark on light or
    light on dark, and all are in view.

    Raises `NotDetermined` where no grid of that size is found.
    """
    for picture in (grey, np.ascontiguousarray(255 - grey)):
        for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
            found, centres = cv2.findCirclesGrid(picture, (cols, rows), flags=flags)
            if found:
                return np.asarray(centres.reshape(rows, cols, 2), float)
    raise NotDetermined("geometry", f"no grid of {rows} x {cols} dots found: all of it has to be in view, and in focus")


def dot_centres(
    picture: Array, points: Array, rows: int, cols: int, index: NDArray[np.int64] | None = None
) -> CornerFits:
    """Measure the centroids of the dots at `points` (n, 2), (x, y), in a picture (rows, cols) of 0..1.

        c = sum w r / sum w,   w = max((I - background) / (peak - background) - `LEAST_DOT_SHARE`, 0)

    within half a spacing. The background is the median beyond 0.8 of that radius. A coordinate has the standard
    deviation s sqrt(sum |r - c|^2 / 2) / sum w, with s the noise of the background over the contrast. In perspective,
    the centroid of the ellipse isn't the image of the dot's centre: for dots of radius a at distance z and a focal
    length of f px they differ by about f (a / z)^2 sin(2 tilt) / 2 px.
    """
    points = np.array(points, float)
    index = np.arange(rows * cols) if index is None else index
    spacing = _spacing(points, index, cols)
    radius = np.maximum(DOT_WINDOW * spacing, 2.0)
    size = int(np.ceil(radius.max())) + 1
    offset = np.arange(-size, size + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    std = np.full(len(points), np.inf)
    trusted = np.zeros(len(points), bool)
    for k in range(len(points)):
        found = _centroid(picture, points[k], float(radius[k]), dx, dy)
        if found is not None:
            points[k], std[k], trusted[k] = found[0], found[1], True
    return CornerFits(points, trusted, std)


def _centroid(
    picture: Array, start: Array, radius: float, dx: NDArray[np.int64], dy: NDArray[np.int64]
) -> tuple[Array, float] | None:
    """Measure the centroid of one dot and the standard deviation of a coordinate; None where there is no dot, or it
    touches the frame's border.

    `picture` (rows, cols), `start` (2,), (x, y), and `radius` of the window in px; `dx`, `dy`: places of its pixels
    from the middle.
    """
    height, width = picture.shape
    at, std = start, np.inf
    for _ in range(CENTROID_PASSES):
        x, y = np.rint(at[0]) + dx, np.rint(at[1]) + dy
        away = np.hypot(x - at[0], y - at[1])
        near = away <= radius
        x, y, away = x[near], y[near], away[near]
        if min(x.min(), y.min()) < 0 or x.max() >= width or y.max() >= height:
            return None
        value = picture[y.astype(int), x.astype(int)]
        rim, inner, inside = (
            value[away > DOT_BACKGROUND * radius],
            value[away < 0.3 * radius],
            away <= DOT_BACKGROUND * radius,
        )
        background = float(np.median(rim)) if rim.size else np.nan
        contrast = float(np.mean(inner)) - background if inner.size else np.nan
        if not abs(contrast) >= LEAST_DOT_CONTRAST:
            return None
        share = (value - background) / contrast
        weight = np.where(inside, np.maximum(share - LEAST_DOT_SHARE, 0.0), 0.0)
        total = float(weight.sum())
        at = np.array([weight @ x, weight @ y]) / total
        noise = float(np.median(np.abs(rim - background))) / 0.6745 / abs(contrast)
        std = noise * float(np.sqrt(0.5 * np.sum(np.square(away[weight > 0])))) / total
    return (at, std) if np.hypot(*(at - start)) < 0.5 * radius else None


def _spacing(points: Array, index: NDArray[np.int64], cols: int) -> Array:
    """Return the distance of each dot to the nearest of its neighbours in the grid, px."""
    place = {int(number): k for k, number in enumerate(index)}
    found = np.full(len(points), np.inf)
    for number, k in place.items():
        for other in (number + cols, number + 1 if (number + 1) % cols else -1):
            if other in place:
                distance = float(np.hypot(*(points[place[other]] - points[k])))
                found[k], found[place[other]] = min(found[k], distance), min(found[place[other]], distance)
    return np.where(np.isfinite(found), found, np.nanmedian(found))


@dataclass(frozen=True)
class BoardView:
    """Corners of a board in one frame.

    `board_mm` (n, 3), z = 0; `image_px` (n, 2), (x, y); `index` (n,) numbers the corners row by row; `std_px` (n,):
    standard deviation of a coordinate by the noise of the picture, where it is known; `bent`: whether edges were fitted
    with the curvature that their corners show.
    """

    capture: CharucoCapture
    index: NDArray[np.int64]
    board_mm: Array
    image_px: Array
    std_px: Array | None = None
    bent: bool = False

    def only(self, kept: NDArray[np.bool_]) -> BoardView:
        """Return the view with the corners for which `kept` (n,) is true."""
        std = None if self.std_px is None else self.std_px[kept]
        return BoardView(self.capture, self.index[kept], self.board_mm[kept], self.image_px[kept], std, self.bent)


def luminance(frame: NDArray[np.generic], cfa: Any) -> Array:
    """Level the mosaic (rows, cols) of a black and white scene to one picture, 0 dark .. 1 light: each plane between
    its 2 % and 98 % quantiles.

    `frame` (rows, cols), DN; `cfa`: pattern of its colours.
    """
    picture = np.array(frame, dtype=float)
    for plane in planes(picture, cfa).values():  # views of the picture
        low, high = np.quantile(plane, [0.02, 0.98])
        plane[:] = (plane - low) / max(high - low, 1e-12)
    return picture


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


def _grid_steps(index: NDArray[np.int64], cols: int) -> Array:
    """Return the places (x, y) of corners in squares, from the first inner corner."""
    return np.column_stack([index % cols, index // cols]).astype(float)


def board_points(capture: CharucoCapture, index: NDArray[np.int64]) -> Array:
    """Return the places (x, y, 0), mm, of the inner corners of these numbers; the first square begins at 0."""
    return np.column_stack(
        [(_grid_steps(index, capture.squares[1] - 1) + 1.0) * capture.square_mm, np.zeros(len(index))]
    )


def _add_missing_corners(
    index: NDArray[np.int64], points: Array, rows: int, cols: int, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], Array]:
    """Add the corners between markers that couldn't be read, where a homography and a quadratic correction predict
    them.

    `index` (n,): numbers of the corners found at `points` (n, 2), (x, y), px; `rows`, `cols`: inner corners of the
    board; `shape` of the frame.
    """
    homography, _ = cv2.findHomography(_grid_steps(index, cols), points, cv2.RANSAC, 3.0)
    if homography is None:
        return index, points

    def plane(of: NDArray[np.int64]) -> Array:
        return np.asarray(cv2.perspectiveTransform(_grid_steps(of, cols)[:, None, :], homography)[:, 0])

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


def channel_corners(frame: NDArray[np.generic], cfa: Any, view: BoardView) -> dict[str, CornerFits]:
    """Fit the corners of `view` in each colour of its own frame, on the pixels of that colour; green is the mean of its
    two phases.

    `frame` (rows, cols), DN. Returns the fits by channel, in px of the frame.
    """
    capture = view.capture
    rows, cols = capture.squares
    found: dict[str, CornerFits] = {}
    for channel, places in phases(cfa).items():
        of_phases = []
        for row, col in places:
            plane = np.asarray(frame[row::2, col::2], dtype=float)
            low, high = np.quantile(plane, [0.02, 0.98])
            plane = (plane - low) / max(high - low, 1e-12)
            guess = (view.image_px - [col, row]) / 2.0
            if capture.dictionary == "dots":
                fits = dot_centres(plane, guess, rows - 1, cols - 1, view.index)
            else:
                marker_mm = float(capture.marker_mm or 0.0) if capture.has_markers else 0.0
                fits = refine_corners(
                    plane, guess, view.board_mm[:, :2], capture.square_mm, marker_mm, rows, cols, bent=view.bent
                )
            of_phases.append(CornerFits(2.0 * fits.points + [col, row], fits.trusted, 2.0 * fits.std_px))
        found[channel] = CornerFits(
            np.mean([fits.points for fits in of_phases], axis=0),
            np.all([fits.trusted for fits in of_phases], axis=0),
            np.sqrt(np.mean([fits.std_px**2 for fits in of_phases], axis=0) / len(of_phases)),
        )
    return found


def find_boards(recordings: RecordingSet, side: Side) -> tuple[list[BoardView], list[Skipped]]:
    """Find the boards of all `charuco` captures of `side`, and list the captures in which there is none, with the
    reason. Where the lens bends edges so far that it counts, they are found again by corners of bent edges.
    """
    views, rejected = _find_boards(recordings, side)
    bends = [bend_px(view) for view in views if view.capture.dictionary != "dots"]
    if bends and float(np.median(bends)) > LEAST_BEND_PX:
        return _find_boards(recordings, side, bent=True)
    return views, rejected


def _find_boards(recordings: RecordingSet, side: Side, *, bent: bool = False) -> tuple[list[BoardView], list[Skipped]]:
    """Find the boards of all captures, with edges that are straight or `bent`."""
    cfa = recordings.camera(side).cfa
    views, rejected = [], []
    for capture in recordings.captures(CharucoCapture, side):
        try:
            views.append(find_board(luminance(recordings.frame(capture), cfa), capture, bent=bent))
        except NotDetermined as refused:
            rejected.append(Skipped(step=capture.id, reason=refused.reason, side=side))
    return views, rejected
