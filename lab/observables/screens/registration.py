"""Where a pattern on a screen lies in the frame of the camera, by the corners of a checkerboard.

The corners are found and fitted in the levelled mosaic (`poses`). They are
numbered by growing a grid from one of them, and matched to the target by the Bernoulli pattern, which unlike a
checkerboard fits in one place only. The map from camera px to target cells is a homography H after a smooth
displacement D, cubic in the position, good to a few thousandths of a pixel:

    cell(p) = H(p + D(p))

Points are (x, y), x along columns; the cell (i, j) of the target covers j..j+1 by i..i+1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, spatial
from scipy.interpolate import RectBivariateSpline

from lab.errors import NotDetermined
from lab.observables.boards.corner_fits import fit_corners
from sim.camera import Cfa
from sim.sensor.mosaic import phases
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]

ORDER = 3  # of the displacement, in x and y together
MIN_CORNERS = 12
COARSE_PX = 8.0  # step of the grid on which the map is computed
LEAST_RADIUS_PX = 4.0  # of a corner's window, in which green pixels alone, 25 of them, tell its nine parameters
LEAST_CORRELATION = 0.5  # of the levelled picture with the pattern; below it, the picture shows another one


@dataclass(frozen=True)
class ScreenWarp:
    """Map from camera px to target cells; see the module.

    `homography` (3, 3). `displacement` (2, terms), px, of a polynomial in (p - centre) / scale. `corner_rms_px`:
    residual of the corners; `corner_std_px`: standard deviation of their mean.
    """

    homography: Array
    displacement: Array
    centre: Array
    scale: float
    corner_rms_px: float
    corner_std_px: float

    @staticmethod
    def of_corners(corners: Array, shape: tuple[int, ...]) -> ScreenWarp:
        """Return the homography that takes four points (x, y), clockwise from top left, to the corners of a target of
        `shape`.
        """
        cells = np.array([[0, 0], [shape[1], 0], [shape[1], shape[0]], [0, shape[0]]], dtype=np.float32)
        homography = cv2.getPerspectiveTransform(np.asarray(corners, dtype=np.float32), cells)
        centre = np.asarray(corners, dtype=float).mean(axis=0)
        return ScreenWarp(homography, np.zeros((2, 10)), centre, float(np.ptp(corners, axis=0).max()) / 2.0, 0.0, 0.0)

    def basis(self, points: Array) -> Array:
        """Return the polynomial terms (terms, n) at `points` (n, 2); the first is constant."""
        x, y = ((points - self.centre) / self.scale).T
        return np.array([x**i * y**j for n in range(ORDER + 1) for i, j in ((n - k, k) for k in range(n + 1))])

    def cells(self, points: Array) -> Array:
        """Map points (n, 2) in px to cells (n, 2), (x, y)."""
        moved = points + (self.displacement @ self.basis(points)).T
        return np.asarray(cv2.perspectiveTransform(moved[:, None, :].astype(np.float64), self.homography)[:, 0])

    def cells_on(self, row: Array, col: Array) -> tuple[Array, Array]:
        """Map the points of a grid of rows (m,) and columns (n,), px, to cells x and y, (m, n) each.

        The map is smooth: it is computed every `COARSE_PX` and interpolated by cubic splines."""
        y, x = (np.arange(at[0] - 2.0 * COARSE_PX, at[-1] + 3.0 * COARSE_PX, COARSE_PX) for at in (row, col))
        at = self.cells(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
        across, down = (RectBivariateSpline(y, x, at[:, :, k])(row, col) for k in (0, 1))
        return np.asarray(across), np.asarray(down)

    def shift_origin(self, origin: Array) -> ScreenWarp:
        """Return the same map for a picture of which this one is the part that begins at `origin`, (x, y)."""
        shift = np.array([[1.0, 0.0, -origin[0]], [0.0, 1.0, -origin[1]], [0.0, 0.0, 1.0]])
        return replace(self, homography=self.homography @ shift, centre=self.centre + origin)

    def displace(self, change: Array) -> ScreenWarp:
        """Return the map with `change` (2, terms) added to the displacement."""
        return replace(self, displacement=self.displacement + change)


def register(
    checkerboard: Array,
    bernoulli: Array,
    checkerboard_target: NDArray[np.uint8],
    bernoulli_target: NDArray[np.uint8],
    cell_px: float | None,
    fitted: NDArray[np.bool_],
) -> ScreenWarp:
    """Register pictures of a checkerboard and a Bernoulli pattern: the warp to their targets.

    The pictures (rows, cols) are levelled, 0 dark .. 1 lit, NaN where the screen isn't; the targets (rows, cols) hold
    a value per cell. `cell_px`: nominal size of a cell in camera px; None where the whole target is in view. `fitted`
    (rows, cols): pixels to which the corners are fitted, see `reference_pixels`. Raises `NotDetermined` where corners
    or pattern aren't found.
    """
    rows, cols = target_corners(checkerboard_target)
    seen = np.isfinite(checkerboard)
    if seen.sum() < 100:
        raise NotDetermined("psf", "white and black captures show no lit screen: light it, or expose longer")
    if cell_px is None:  # the whole target is taken to be in view
        cell_px = float(np.sqrt(seen.sum() / checkerboard_target.size))
    square_px = cell_px * float(rows[1] - rows[0])
    picture = np.where(seen, checkerboard, 0.0)
    points, grid, across, down = _number_corners(picture, seen, square_px)
    radius = float(np.clip(0.4 * square_px, 2.5, 9.0))
    if radius < LEAST_RADIUS_PX:
        fitted = np.ones(picture.shape, dtype=bool)

    def in_channel(at: Array) -> NDArray[np.bool_]:
        """Tell which places (n, 2), (x, y), px, are pixels of the channel. Those beyond the frame aren't used."""
        row, col = (np.clip(at[:, axis].astype(int), 0, picture.shape[1 - axis] - 1) for axis in (1, 0))
        return fitted[row, col]

    found, trusted, _ = fit_corners(picture, points, across, down, np.full(len(points), radius), in_channel)
    points, grid = found[trusted], grid[trusted]
    if len(points) < MIN_CORNERS:
        raise NotDetermined(
            "psf", f"{len(points)} corners of the checkerboard found, {MIN_CORNERS} needed: focus the screen better"
        )
    cells = _match_cells(points, grid, rows, cols, bernoulli, bernoulli_target)
    return _fit_warp(points, cells)


def reference_pixels(shape: tuple[int, ...], cfa: Cfa) -> NDArray[np.bool_]:
    """Return the mask (rows, cols) of a frame's green pixels, or of all pixels of a MONO sensor.

    Corners are fitted to them alone: beside a lens with lateral colour, those of the whole mosaic would lie between the
    places of its channels. Their diagonals sample an edge along rows or columns at every pixel, which those of red
    or blue don't: where edges stand square, these can't tell a displacement from a blur."""
    mask = np.zeros(shape, dtype=bool)
    for row, col in phases(cfa)["Y" if cfa == "MONO" else "G"]:
        mask[row :: period(cfa), col :: period(cfa)] = True
    return mask


def target_corners(target: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and columns, in cells, of the inner corners of a checkerboard target."""
    t = target.astype(bool)
    corner = (t[:-1, :-1] == t[1:, 1:]) & (t[:-1, 1:] == t[1:, :-1]) & (t[:-1, :-1] != t[:-1, 1:])
    rows = np.flatnonzero(corner.any(axis=1)) + 1
    cols = np.flatnonzero(corner.any(axis=0)) + 1
    if len(rows) < 2 or len(cols) < 2 or not corner[np.ix_(rows - 1, cols - 1)].all():
        raise NotDetermined("psf", "the checkerboard's target is no checkerboard of 3 x 3 squares or more")
    return rows, cols


def _number_corners(
    picture: Array, seen: NDArray[np.bool_], square_px: float
) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """Number the corners by their steps along two directions: points (n, 2), steps (n, 2), and the two step vectors (n,
    2) at each.

    Candidates are the maxima of the saddle strength Ixy^2 - Ixx Iyy.
    """
    sigma = float(np.clip(0.08 * square_px, 1.2, 4.0))
    xx, yy, xy = (ndimage.gaussian_filter(picture, sigma, order) for order in ((0, 2), (2, 0), (1, 1)))
    saddle = xy**2 - xx * yy
    saddle[ndimage.binary_dilation(~seen, iterations=int(2 * sigma) + 1)] = 0.0
    peak = (saddle == ndimage.maximum_filter(saddle, size=int(0.6 * square_px) | 1)) & (saddle > 0)
    if not peak.any():
        raise NotDetermined("psf", "no checkerboard corners found: is it in focus and in view?")
    peak &= saddle > 0.25 * np.quantile(saddle[peak], 0.9)
    points = np.argwhere(peak)[:, ::-1].astype(float)
    if len(points) < MIN_CORNERS:
        raise NotDetermined(
            "psf", f"{len(points)} corners of the checkerboard found, {MIN_CORNERS} needed: focus the screen better"
        )
    tree = spatial.cKDTree(points)
    best: dict[tuple[int, int], int] = {}
    vectors: dict[tuple[int, int], tuple[Array, Array]] = {}
    for seed in tree.query(points.mean(axis=0), k=min(6, len(points)))[1]:
        numbered, steps = _grow_grid(points, tree, int(seed))
        if len(numbered) > len(best):
            best, vectors = numbered, steps
        if len(best) > 0.7 * len(points):
            break
    at = list(best)
    return (
        points[[best[a] for a in at]],
        np.array(at),
        np.array([vectors[a][0] for a in at]),
        np.array([vectors[a][1] for a in at]),
    )


def _grow_grid(
    points: Array, tree: spatial.cKDTree, seed: int
) -> tuple[dict[tuple[int, int], int], dict[tuple[int, int], tuple[Array, Array]]]:
    """Grow grid numbers from `seed` by nearest neighbours. Returns them and the step vectors at each number.

    `points` (n, 2), (x, y), px, and their `tree`.
    """
    near = points[tree.query(points[seed], k=min(9, len(points)))[1][1:]] - points[seed]
    first = near[0]
    turned = near @ np.array([-first[1], first[0]]) / (np.linalg.norm(near, axis=1) * np.linalg.norm(first))
    square = near[(turned > 0.8) & (np.linalg.norm(near, axis=1) < 1.6 * np.linalg.norm(first))]
    if not len(square):
        return {}, {}
    numbered, taken = {(0, 0): seed}, {seed}
    vectors = {(0, 0): (first, square[0])}
    queue = [(0, 0)]
    for at in queue:  # the list grows in the loop
        across, down = vectors[at]
        for step, vector in (((1, 0), across), ((-1, 0), -across), ((0, 1), down), ((0, -1), -down)):
            to = (at[0] + step[0], at[1] + step[1])
            if to in numbered:
                continue
            distance, found = tree.query(points[numbered[at]] + vector)
            if distance > 0.25 * np.linalg.norm(vector) or found in taken:
                continue
            moved = points[found] - points[numbered[at]]
            numbered[to] = int(found)
            taken.add(int(found))
            vectors[to] = (moved * step[0], down) if step[0] else (across, moved * step[1])
            queue.append(to)
    return numbered, vectors


def _match_cells(
    points: Array,
    grid: NDArray[np.int64],
    rows: NDArray[np.int64],
    cols: NDArray[np.int64],
    bernoulli: Array,
    target: NDArray[np.uint8],
) -> Array:
    """Find the cells (x, y) of the corners (n, 2), NaN where unknown: of all rotations and shifts of the grid, the one
    with the highest correlation of the Bernoulli picture with its target.

    `points` (n, 2), px, with their steps `grid` (n, 2); `rows`, `cols`: inner corners of the checkerboard target,
    cells; `bernoulli` (rows, cols): its levelled picture; `target`: its cells. Raises `NotDetermined` where none fits.
    """
    some = np.argwhere(np.isfinite(bernoulli))
    some = some[np.random.default_rng(0).integers(0, len(some), 4000)]
    value = bernoulli[some[:, 0], some[:, 1]]
    best, score = None, -1.0
    for quarter_turn in ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0)):
        turned = grid @ np.array(quarter_turn).reshape(2, 2).T
        turned = turned - turned.min(axis=0)
        extent = turned.max(axis=0)
        for sx in range(max(1, len(cols) - int(extent[0]))):
            for sy in range(max(1, len(rows) - int(extent[1]))):
                x, y = turned[:, 0] + sx, turned[:, 1] + sy
                known = (x < len(cols)) & (y < len(rows))
                if known.sum() < MIN_CORNERS:
                    continue
                cells = np.column_stack([cols[np.minimum(x, len(cols) - 1)], rows[np.minimum(y, len(rows) - 1)]])
                homography, _ = cv2.findHomography(points[known], cells[known].astype(float), 0)
                if homography is None:
                    continue
                at = np.floor(
                    cv2.perspectiveTransform(some[:, None, ::-1].astype(np.float64), homography)[:, 0]
                ).astype(int)
                inside = np.all((at >= 0) & (at < np.array(target.shape)[::-1]), axis=1)
                if inside.sum() < 500:
                    continue
                lit = target[at[inside, 1], at[inside, 0]].astype(float)
                agreement = float(np.corrcoef(lit, value[inside])[0, 1]) if lit.std() > 0 else 0.0
                if agreement > score:
                    score, best = agreement, (known, cells)
    if best is None or score < LEAST_CORRELATION:
        raise NotDetermined(
            "psf",
            f"the Bernoulli capture doesn't show its target (correlation {max(score, 0.0):.2f}): was the screen moved?",
        )
    known, cells = best
    matched = np.full((len(points), 2), np.nan)
    matched[known] = cells[known]
    return matched


def _fit_warp(points: Array, cells: Array) -> ScreenWarp:
    """Fit homography and cubic displacement through the corners, without outliers beyond 5 standard deviations.

    `points` (n, 2), px; `cells` (n, 2), NaN where unknown.
    """
    used = np.isfinite(cells[:, 0])
    points, cells = points[used], cells[used]
    homography, _ = cv2.findHomography(points, cells, 0)
    warp = ScreenWarp(
        homography, np.zeros((2, 10)), points.mean(axis=0), float(np.ptp(points, axis=0).max() / 2.0), 0.0, 0.0
    )
    back = np.linalg.inv(homography)
    expected = cv2.perspectiveTransform(cells[:, None, :].astype(np.float64), back)[:, 0]
    gap = expected - points  # by which D has to move the points
    basis = warp.basis(points)
    # The homography is kept; few corners determine few terms
    terms = 10 if len(points) >= 40 else 6 if len(points) >= 20 else 1
    kept = np.ones(len(points), dtype=bool)
    for _ in range(4):
        displacement = np.zeros((2, 10))
        displacement[:, :terms] = np.linalg.lstsq(basis[:terms, kept].T, gap[kept], rcond=None)[0].T
        left = np.linalg.norm(gap - (displacement @ basis).T, axis=1)
        rms = float(np.sqrt(np.mean(left[kept] ** 2)))
        kept = left < 5.0 * rms / np.sqrt(2.0) + 1e-6
    std = rms / float(np.sqrt(2.0 * max(int(kept.sum()) - terms, 1)))
    return ScreenWarp(homography, displacement, warp.centre, warp.scale, rms, std)


def draw_by_area(target: Array, cell_x: Array, cell_y: Array) -> Array:
    """Average `target` (cells) over squares the size of a sample about the points `cell_x`, `cell_y`; dark outside.

    The squares are aligned with the cells: the error is of second order in their rotation. A square may hold any
    number of cells.
    """
    from sim.scene.area import aligned_means  # here: the compiler's library takes a while to load

    table = np.pad(target.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    wide, high = (
        float(sum(np.abs(part).mean() for part in np.gradient(cell[::16, ::16]))) / 16.0 for cell in (cell_x, cell_y)
    )
    return np.asarray(aligned_means(table, cell_x, cell_y, wide, high))
