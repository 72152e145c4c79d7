"""Boards in frames: which corners of a ChArUco board or a plain checkerboard are seen, and where, to hundredths of a pixel.

The boards are the `charuco` captures. A plain checkerboard is a `charuco` capture whose `dictionary` is `"none"`: `squares`
counts its squares `[rows, cols]`, so that it has `rows - 1` x `cols - 1` inner corners; `marker_mm` says nothing then, and
all inner corners have to be in view. A folder of pictures of a plain checkerboard becomes a recording set that way, each
picture one capture, the pictures of a pair under one `pose`.

Corners are found on the raw mosaic itself: a board is black and white, so that each plane, levelled by itself, shows the same
picture, and interleaved they are the luminance, sampled at every pixel. No demosaicing moves a corner. Each corner is then
fitted: the product of two blurred straight edges, by least squares over the pixels that no marker touches.

Points are OpenCV's: (x, y) px, x to the right along columns, (0, 0) the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import erf

from lab.errors import NotDetermined
from lab.formats.recording_set import Charuco, RecordingSet
from lab.formats.results import Skipped
from sim.camera import Side
from sim.sensor.mosaic import phases, planes

Array = NDArray[np.floating[Any]]

MIN_CORNERS = 8  # of a view: six degrees of freedom of the pose need more than six numbers, with a margin
WINDOW_PX = 9.0  # largest half-window of a corner's fit


@dataclass(frozen=True)
class BoardView:
    """Corners of a board in one frame. `board_mm` (n, 3), z = 0; `image_px` (n, 2), (x, y); `index` (n,) names each corner,
    row by row; `std_px` (n,): what the picture's own noise leaves open of each coordinate, where that is known."""

    capture: Charuco
    index: NDArray[np.int64]
    board_mm: Array
    image_px: Array
    std_px: Array | None = None

    def only(self, kept: NDArray[np.bool_]) -> BoardView:
        """The corners for which `kept` (n,) is true."""
        std = None if self.std_px is None else self.std_px[kept]
        return BoardView(self.capture, self.index[kept], self.board_mm[kept], self.image_px[kept], std)


class CornerFits(NamedTuple):
    """Corners (n, 2), (x, y); which fits are to be trusted; standard deviation of each coordinate by the picture's noise, px."""

    points: Array
    trusted: NDArray[np.bool_]
    std_px: Array


def luminance(frame: NDArray[np.generic], cfa: Any) -> Array:
    """The mosaic of a black and white scene as one picture, 0 dark .. 1 light: each plane between its 2 % and 98 % quantiles."""
    picture = np.array(frame, dtype=float)
    for plane in planes(picture, cfa).values():  # views: what is written to them is written to the picture
        low, high = np.quantile(plane, [0.02, 0.98])
        plane[:] = (plane - low) / max(high - low, 1e-12)
    return picture


def find_board(picture: Array, capture: Charuco) -> BoardView:
    """The board's corners in a picture (rows, cols) of 0..1; `NotDetermined` with the reason where it isn't found."""
    rows, cols = capture.squares
    grey = np.clip(255.0 * ndimage.gaussian_filter(picture, 0.7), 0, 255).astype(np.uint8)
    if capture.dictionary == "none":
        index, points = _plain_corners(grey, rows - 1, cols - 1)
        marker_mm = 0.0
    else:
        index, points = _charuco_corners(grey, capture)
        marker_mm = float(capture.marker_mm or 0.0)
    if len(index) < MIN_CORNERS:
        mirrored = np.ascontiguousarray(grey[:, ::-1])
        if capture.dictionary != "none" and len(_charuco_corners(mirrored, capture)[0]) >= MIN_CORNERS:
            raise NotDetermined(
                "geometry", "the picture is mirrored: its board is found in the reflection; flip the frames"
            )
        raise NotDetermined(
            "geometry",
            f"only {len(index)} corners found, {MIN_CORNERS} needed: light or place the board better, and check that it has "
            f"{rows} x {cols} squares and its dictionary is {capture.dictionary}",
        )
    if len(index) < (rows - 1) * (cols - 1):
        index, points = _completed(index, points, rows - 1, cols - 1, picture.shape)
    board = board_points(capture, index)
    fitted, trusted, std_px = _refine(picture, points, board[:, :2], capture.square_mm, marker_mm, rows, cols)
    if trusted.sum() < MIN_CORNERS:
        raise NotDetermined(
            "geometry",
            f"only {trusted.sum()} corners are clear enough, {MIN_CORNERS} needed: focus or light the board better",
        )
    return BoardView(capture, index, board, fitted, std_px).only(trusted)


def _charuco_corners(grey: NDArray[np.uint8], capture: Charuco) -> tuple[NDArray[np.int64], Array]:
    code = getattr(cv2.aruco, capture.dictionary, None)
    if not isinstance(code, int) or not capture.dictionary.startswith("DICT_"):
        raise NotDetermined(
            "geometry", f"OpenCV knows no dictionary '{capture.dictionary}': give one of its names, DICT_..."
        )
    rows, cols = capture.squares
    best: tuple[NDArray[np.int64], Array] = (np.empty(0, np.int64), np.empty((0, 2)))
    for legacy in (False, True):  # boards of an even number of rows begin otherwise since OpenCV 4.6
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


def _grid(index: NDArray[np.int64], cols: int) -> Array:
    """(x, y) of corners in squares, from the first inner corner."""
    return np.column_stack([index % cols, index // cols]).astype(float)


def board_points(capture: Charuco, index: NDArray[np.int64]) -> Array:
    """(x, y, 0) mm of the board's inner corners of these numbers; the first square begins at 0."""
    return np.column_stack([(_grid(index, capture.squares[1] - 1) + 1.0) * capture.square_mm, np.zeros(len(index))])


def _completed(
    index: NDArray[np.int64], points: Array, rows: int, cols: int, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], Array]:
    """The corners between markers that couldn't be read, where the board's plane and a smooth bend put them; the fit decides."""
    homography, _ = cv2.findHomography(_grid(index, cols), points, cv2.RANSAC, 3.0)
    if homography is None:
        return index, points

    def plane(of: NDArray[np.int64]) -> Array:
        return np.asarray(cv2.perspectiveTransform(_grid(of, cols)[:, None, :], homography)[:, 0])

    known = plane(index)
    centre, scale = known.mean(axis=0), known.std() + 1.0

    def bends(at: Array) -> Array:
        x, y = ((at - centre) / scale).T
        terms = [np.ones_like(x), x, y]
        if len(index) >= 12:
            terms += [x * x, x * y, y * y]
        return np.column_stack(terms)

    gap = np.linalg.lstsq(bends(known), points - known, rcond=None)[0]
    missing = np.setdiff1d(np.arange(rows * cols), index)
    guess = plane(missing)
    guess = guess + bends(guess) @ gap
    inside = np.all((guess > 4) & (guess < np.array([shape[1], shape[0]]) - 5), axis=1)
    index = np.concatenate([index, missing[inside]])
    order = np.argsort(index)
    return index[order], np.concatenate([points, guess[inside]])[order]


def _plain_corners(grey: NDArray[np.uint8], rows: int, cols: int) -> tuple[NDArray[np.int64], Array]:
    found, corners = cv2.findChessboardCorners(
        grey, (cols, rows), flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:  # slower, and finds more
        found, corners = cv2.findChessboardCornersSB(grey, (cols, rows), flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        raise NotDetermined(
            "geometry", f"no checkerboard of {rows} x {cols} inner corners found: all of it has to be in view"
        )
    grid = corners.reshape(rows, cols, 2).astype(float)
    turned = [np.rot90(grid, k) for k in range(4)] if rows == cols else [grid, grid[::-1, ::-1]]
    turned += [g[:, ::-1] for g in turned]
    # Seen from the front, along a row and then down is a clockwise turn. Of what is left, the one whose first square is dark,
    # so that both cameras of a pair number alike; boards that look the same turned by 180 deg begin at the top left.
    front = [g for g in turned if _turn(g[0, -1] - g[0, 0], g[-1, 0] - g[0, 0]) > 0]
    if (rows + cols) % 2:
        front = [g for g in front if _first_square_is_dark(grey, g)] or front
    first = min(front, key=lambda g: float(g[0, 0].sum()))
    return np.arange(rows * cols), first.reshape(-1, 2)


def _turn(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _first_square_is_dark(grey: NDArray[np.uint8], grid: Array) -> bool:
    """Whether the square between the first four inner corners, which has the first square's colour, is darker than its
    neighbours."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    level = ndimage.map_coordinates(grey.astype(float), middles[..., ::-1].reshape(-1, 2).T, order=1, mode="nearest")
    even = np.indices(middles.shape[:2]).sum(axis=0).ravel() % 2 == 0
    return bool(level[even].mean() < level[~even].mean())


def _refine(
    picture: Array, points: Array, board: Array, square_mm: float, marker_mm: float, rows: int, cols: int
) -> CornerFits:
    """Corners fitted in the picture."""
    homography, _ = cv2.findHomography(board.astype(np.float64), points.astype(np.float64), cv2.RANSAC, 3.0)
    if homography is None:
        raise NotDetermined("geometry", "the corners found don't lie on a plane: light or place the board better")
    inverse = np.linalg.inv(homography)

    def to_image(at: Array) -> Array:
        return np.asarray(cv2.perspectiveTransform(at[:, None, :].astype(np.float64), homography)[:, 0])

    step = 0.5 * square_mm
    along = [
        to_image(board + np.array(d) * step) - to_image(board - np.array(d) * step) for d in ((1.0, 0.0), (0.0, 1.0))
    ]
    square_px = np.minimum(np.linalg.norm(along[0], axis=1), np.linalg.norm(along[1], axis=1))
    half = np.clip(0.42 * square_px, 2.0, WINDOW_PX)

    def clear(at_px: Array) -> NDArray[np.bool_]:
        """Pixels (n, 2) that no marker blurs into and that are on the board."""
        mm = cv2.perspectiveTransform(at_px.reshape(-1, 1, 2).astype(np.float64), inverse)[:, 0]
        inside = np.all((mm > 0) & (mm < np.array([cols, rows]) * square_mm), axis=1)
        if marker_mm <= 0:
            return np.asarray(inside)
        blur_mm = 1.5 * square_mm / float(np.median(square_px))
        reach = 0.5 * marker_mm + blur_mm
        # Markers stand in the light squares; the dark ones are of one level, so that leaving them out costs nothing but pixels:
        # which squares are light is seen in the picture, not assumed.
        cell = np.floor(mm / square_mm)
        centre = (cell + 0.5) * square_mm
        near = np.all(np.abs(mm - centre) < reach, axis=1)
        light = light_squares[
            np.clip(cell[:, 1], 0, rows - 1).astype(int), np.clip(cell[:, 0], 0, cols - 1).astype(int)
        ]
        return np.asarray(inside & ~(near & light))

    light_squares = _light_squares(picture, to_image, square_mm, marker_mm, rows, cols)
    return fit_corners(picture, points, along[0], along[1], half, clear)


def _light_squares(
    picture: Array, to_image: Any, square_mm: float, marker_mm: float, rows: int, cols: int
) -> NDArray[np.bool_]:
    """Which squares are light: of the two checker patterns, the one that agrees with the picture at the squares' rims."""
    row, col = np.indices((rows, cols))
    rim = 0.5 - 0.25 * max(1.0 - marker_mm / square_mm, 0.1)
    level = np.zeros((rows, cols))
    for dx, dy in ((rim, 0.0), (-rim, 0.0), (0.0, rim), (0.0, -rim)):
        at = to_image(np.column_stack([(col.ravel() + 0.5 + dx) * square_mm, (row.ravel() + 0.5 + dy) * square_mm]))
        level += ndimage.map_coordinates(picture, at[:, ::-1].T, order=1, mode="nearest").reshape(rows, cols)
    even = (row + col) % 2 == 0
    return np.asarray(even if level[even].mean() > level[~even].mean() else ~even)


def fit_corners(
    picture: Array, points: Array, across: Array, down: Array, half_px: Array, clear: Any = None
) -> CornerFits:
    """Checkerboard corners by least squares: I = level + slope . r + contrast E(d1) E(d2), E a blurred edge, -1..1.

    `points` (n, 2), (x, y), are the first guess, good to about 2 px; `across` and `down` (n, 2) the directions of the board's
    axes there; `half_px` (n,) the window. `clear(points) -> bool` says which pixels may be used. Trusted are fits that
    converged near the guess, are sharp enough, and explain what is seen.
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

    # Edge 1 runs along `across`, edge 2 along `down`. Parameters: place (2), angles of the normals (2), width, level, slope (2),
    # contrast.
    p = np.zeros((count, 9))
    p[:, :2] = points - base
    p[:, 2] = np.arctan2(across[:, 0], -across[:, 1])
    p[:, 3] = np.arctan2(down[:, 0], -down[:, 1])
    p[:, 4] = 1.0
    p[:, 5:] = _solve(_corner_slopes(p, dx, dy)[1][:, :, 5:], weight, value)[0]
    damping = np.full(count, 1e-3)
    cost = _corner_cost(p, dx, dy, value, weight)
    limit = np.array([1.0, 1.0, 0.3, 0.3, 0.5, np.inf, np.inf, np.inf, np.inf])
    going = np.arange(count)  # corners that still move
    for _ in range(25):
        model, slopes = _corner_slopes(p[going], dx, dy)
        change, _ = _solve(slopes, weight[going], value[going] - model, damping[going])
        tried = p[going] + np.clip(change, -limit, limit)
        tried[:, 4] = np.clip(tried[:, 4], 0.2, 4.0)
        new = _corner_cost(tried, dx, dy, value[going], weight[going])
        better = new <= cost[going]
        moved = np.abs(tried - p[going])[:, :2].max(axis=1)
        p[going[better]], cost[going[better]] = tried[better], new[better]
        damping[going] = np.clip(np.where(better, damping[going] * 0.1, damping[going] * 10.0), 1e-10, 1e6)
        going = going[np.where(better, moved > 1e-4, damping[going] < 1e3)]
        if not len(going):
            break
    covariance = _solve(_corner_slopes(p, dx, dy)[1], weight, value)[1]
    spread = np.sqrt(np.abs(covariance[:, 0, 0] + covariance[:, 1, 1]))
    pixels = weight.sum(axis=1)
    residual = np.sqrt(cost / np.maximum(pixels - 9.0, 1.0))
    found = base + p[:, :2]
    trusted = (
        (np.linalg.norm(found - points, axis=1) < 2.5)
        & (pixels > 16)
        & (np.abs(p[:, 8]) > 3.0 * residual)
        & (residual * spread < 0.5)
    )
    return CornerFits(found, trusted, residual * spread / np.sqrt(2.0))


def _corner_slopes(p: Array, dx: Array, dy: Array) -> tuple[Array, Array]:
    """Model (n, window) and its derivatives (n, window, 9)."""
    x, y = dx - p[:, :1], dy - p[:, 1:2]
    width = p[:, 4:5]
    edges, steps, turns, lags = [], [], [], []
    for angle in (p[:, 2:3], p[:, 3:4]):
        u = np.cos(angle) * x + np.sin(angle) * y
        edges.append(erf(u / (np.sqrt(2.0) * width)))
        steps.append(np.sqrt(2.0 / np.pi) / width * np.exp(-0.5 * (u / width) ** 2))
        turns.append(np.cos(angle) * y - np.sin(angle) * x)
        lags.append(u)
    contrast = p[:, 8:9]
    first, second = steps[0] * edges[1] * contrast, steps[1] * edges[0] * contrast
    slopes = np.stack(
        [
            -first * np.cos(p[:, 2:3]) - second * np.cos(p[:, 3:4]),
            -first * np.sin(p[:, 2:3]) - second * np.sin(p[:, 3:4]),
            first * turns[0],
            second * turns[1],
            -(first * lags[0] + second * lags[1]) / width,
            np.ones_like(x),
            np.broadcast_to(dx, x.shape),
            np.broadcast_to(dy, x.shape),
            edges[0] * edges[1],
        ],
        axis=-1,
    )
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + contrast * edges[0] * edges[1]
    return model, slopes


def _corner_cost(p: Array, dx: Array, dy: Array, value: Array, weight: Array) -> Array:
    x, y = dx - p[:, :1], dy - p[:, 1:2]
    width = np.sqrt(2.0) * p[:, 4:5]
    one, two = (erf((np.cos(angle) * x + np.sin(angle) * y) / width) for angle in (p[:, 2:3], p[:, 3:4]))
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + p[:, 8:9] * one * two
    return np.asarray((weight * (value - model) ** 2).sum(axis=1))


def _solve(slopes: Array, weight: Array, residual: Array, damping: Array | None = None) -> tuple[Array, Array]:
    """Damped least squares of every corner: changes (n, k) and the inverse normal matrices (n, k, k)."""
    weighted = slopes * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ slopes
    scale = np.einsum("nkk->nk", normal)
    ridge = (1e-9 if damping is None else damping[:, None]) * scale + 1e-12
    normal = normal + ridge[:, :, None] * np.eye(normal.shape[1])
    inverse = np.linalg.inv(normal)
    right = np.swapaxes(weighted, 1, 2) @ residual[:, :, None]
    return (inverse @ right)[:, :, 0], inverse


def channel_corners(frame: NDArray[np.generic], cfa: Any, view: BoardView) -> dict[str, CornerFits]:
    """The corners of `view` in each colour of its own frame, on the colour's own pixels; green is the mean of its two phases."""
    capture = view.capture
    rows, cols = capture.squares
    found: dict[str, CornerFits] = {}
    for channel, places in phases(cfa).items():
        of_phases = []
        for row, col in places:
            plane = np.asarray(frame[row::2, col::2], dtype=float)
            low, high = np.quantile(plane, [0.02, 0.98])
            plane = (plane - low) / max(high - low, 1e-12)
            fits = _refine(
                plane,
                (view.image_px - [col, row]) / 2.0,
                view.board_mm[:, :2],
                capture.square_mm,
                0.0 if capture.dictionary == "none" else float(capture.marker_mm or 0.0),
                rows,
                cols,
            )
            of_phases.append(CornerFits(2.0 * fits.points + [col, row], fits.trusted, 2.0 * fits.std_px))
        found[channel] = CornerFits(
            np.mean([fits.points for fits in of_phases], axis=0),
            np.all([fits.trusted for fits in of_phases], axis=0),
            np.sqrt(np.mean([fits.std_px**2 for fits in of_phases], axis=0) / len(of_phases)),
        )
    return found


def find_boards(recordings: RecordingSet, side: Side) -> tuple[list[BoardView], list[Skipped]]:
    """The boards of all `charuco` captures of `side`, and those that couldn't be found, with the reason."""
    cfa = recordings.camera(side).cfa
    views, rejected = [], []
    for capture in recordings.captures("charuco", side):
        try:
            views.append(find_board(luminance(recordings.frame(capture), cfa), capture))
        except NotDetermined as refused:
            rejected.append(Skipped(step=capture.id, reason=refused.reason, side=side))
    return views, rejected
