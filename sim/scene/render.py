"""Drawing scenes by area: the share of every sample's square that each light covers. Nothing is point-sampled.

A scene is a ground that covers everything and a few other lights, each with a picture of where it covers the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.scene import colorchecker
from sim.scene.scenes import PlanarTarget, ReflectanceChart, Scene, ScreenPattern, SpectralImage
from sim.scene.warp import Warp
from sim.spectrum import FloatArray, Spectrum

#: Radiance as the radiometer says (None: equal energy), and the reflectance of what it falls on (None: 1).
Light = tuple[Spectrum | None, Spectrum | None]
Window = tuple[slice, slice]
EVERYWHERE: Window = (slice(None), slice(None))


@dataclass(frozen=True)
class Grid:
    """Square samples, `oversample` by `oversample` to the pixel, over a frame of (rows, cols) and `margin_px` around it."""

    rows: int
    cols: int
    oversample: int = 1
    margin_px: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Samples down and across."""
        return (
            (self.rows + 2 * self.margin_px) * self.oversample,
            (self.cols + 2 * self.margin_px) * self.oversample,
        )

    def axes_px(self) -> tuple[FloatArray, FloatArray]:
        """Row and column (px) of the samples' centres."""
        row, col = ((np.arange(n) + 0.5) / self.oversample - 0.5 - self.margin_px for n in self.shape)
        return row, col


@dataclass(frozen=True, eq=False)
class Layer:
    """One light and where it is: `coverage` on the part `window` of a grid, 0 elsewhere. It's a share 0..1 over a ground that
    shines; over a ground of no light it's any factor >= 0."""

    light: Light
    window: Window
    coverage: FloatArray


@dataclass(frozen=True, eq=False)
class Drawing:
    """A scene on a grid. `ground` covers what the layers leave; the layers' coverages add up to 1 at most."""

    ground: Light
    layers: tuple[Layer, ...]


def draw(scene: Scene, grid: Grid) -> Drawing:
    """A chart, a screen or a printed target drawn on a grid. Raises TypeError for a scene that needs no drawing."""
    if isinstance(scene, ReflectanceChart):
        return _chart(scene, grid)
    if isinstance(scene, SpectralImage):
        return _bands(scene, grid)
    if isinstance(scene, ScreenPattern):
        lit = cells(np.asarray(scene.pattern, float), scene.to_camera, grid, 0.0)
    elif isinstance(scene, PlanarTarget):
        lit = cells(np.asarray(scene.texture, float), scene.warp(), grid, scene.surround)
    else:
        raise TypeError(
            f"a scene of type {type(scene).__name__} can't be drawn: use a chart, a screen or a planar target"
        )
    return Drawing((scene.dark_radiance, None), (Layer((scene.light_radiance, None), EVERYWHERE, lit),))


def half_plane(distance: FloatArray, slope_x: FloatArray | float, slope_y: FloatArray | float) -> FloatArray:
    """Share of unit squares on the positive side of the line g = 0, exactly.

    `distance` is g at the squares' centres, g = distance + slope_x x + slope_y y with x, y in -1/2..1/2: the distribution
    function of the sum of two uniform variables of widths a = |slope_x|, b = |slope_y|.
    """
    a, b = np.abs(slope_x), np.abs(slope_y)
    far = np.broadcast_to(0.5 * (a + b), np.shape(distance))
    out = (distance > 0).astype(float)
    cut = np.abs(distance) < far  # only squares that the line goes through need more
    d, far = np.abs(distance[cut]), far[cut]
    wide = np.broadcast_to(np.maximum(a, b), out.shape)[cut]
    # Of a line along an axis the ramp has no width: a sliver stands for it.
    narrow = np.maximum(np.broadcast_to(np.minimum(a, b), out.shape)[cut], 1e-9 * wide)
    ramp = np.minimum(far - d, narrow)
    beyond = np.where(ramp < narrow, 0.5 * ramp * ramp / narrow, 0.5 * wide - d) / wide
    out[cut] = np.where(distance[cut] > 0, 1.0 - beyond, beyond)
    return out


def cells(pattern: FloatArray, warp: Warp, grid: Grid, surround: float) -> FloatArray:
    """A pattern of cells (values 0..1) seen through a warp: the mean of `pattern`, and of `surround` outside it, over every
    sample's square.

    A square that lies across a cell's border is split by exact area (`half_plane`), one that holds a cell's corner by the
    product of two such shares. Squares larger than a cell are divided until they aren't. Raises ValueError for a pattern
    that isn't 2-D or has values outside 0..1.
    """
    pattern = np.asarray(pattern, float)
    if pattern.ndim != 2 or pattern.size == 0:
        raise ValueError(f"a pattern of shape {pattern.shape} has to be a picture of rows x cols cells")
    if not (np.min(pattern) >= 0 and np.max(pattern) <= 1):
        bad = pattern[~((pattern >= 0) & (pattern <= 1))].flat[0]
        raise ValueError(f"a pattern's cell is {bad}, outside the limits 0..1: scale it, 0 dark and 1 lit")
    return _means(pattern, warp, grid, surround)


def _means(pattern: FloatArray, warp: Warp, grid: Grid, surround: float) -> FloatArray:
    """`cells` for cells of any finite value."""
    divide = max(1, int(np.ceil(_footprint(pattern.shape, warp, grid) / 0.999)))
    if divide > MOST_DIVISIONS:
        raise ValueError(
            f"the pattern's cells are {1.0 / (divide * grid.oversample):.3g} px on the camera, below the limit of {1.0 / (MOST_DIVISIONS * grid.oversample):.3g} px: use larger cells or bring the target closer"
        )
    row, col = grid.axes_px()
    step = 1.0 / grid.oversample
    offset = ((np.arange(divide) + 0.5) / divide - 0.5) * step
    fine_col = (col[:, None] + offset).ravel()
    mapper = warp.mapper((row[0] - step, row[-1] + step), (col[0] - step, col[-1] + step))
    # A frame around the pattern, wide enough that no neighbour of a border falls off it.
    framed = np.pad(pattern, 2, constant_values=surround)
    out = np.empty(grid.shape)
    strips = max(1, (row.size * divide * fine_col.size) // 100_000)  # strips that stay in the processor's cache
    for part in np.array_split(np.arange(row.size), min(strips, row.size // 2)):
        fine_row = (row[part, None] + offset).ravel()
        fine = _cells_on(framed, *mapper(fine_row, fine_col))
        out[part] = fine if divide == 1 else fine.reshape(part.size, divide, col.size, divide).mean(axis=(1, 3))
    return out


#: A sample's square isn't divided more finely than so many times each way.
MOST_DIVISIONS = 16


def _footprint(shape: tuple[int, ...], warp: Warp, grid: Grid) -> float:
    """The largest extent, in cells, of a sample's square, over those parts of the pattern that the grid sees."""
    rows, cols = shape
    u, v = np.meshgrid(np.linspace(0.0, cols, 9), np.linspace(0.0, rows, 9))
    row, col = warp.to_camera(u, v)
    axis_row, axis_col = grid.axes_px()
    seen = (row >= axis_row[0]) & (row <= axis_row[-1]) & (col >= axis_col[0]) & (col <= axis_col[-1])
    if not np.any(seen):
        # The grid may lie inside one cell, or off the pattern: ask at the grid's middle.
        row, col, seen = np.array([np.mean(axis_row)]), np.array([np.mean(axis_col)]), np.array([True])
    row, col = row[seen], col[seen]
    h = 0.5 / grid.oversample
    (ua, va), (ub, vb) = warp.to_pattern(row - h, col), warp.to_pattern(row + h, col)
    (uc, vc), (ud, vd) = warp.to_pattern(row, col - h), warp.to_pattern(row, col + h)
    extent = np.maximum(np.abs(ub - ua) + np.abs(ud - uc), np.abs(vb - va) + np.abs(vd - vc))
    return float(np.max(extent))


def _cells_on(framed: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """`cells` for samples no larger than a cell, at pattern points (u, v); `framed` has two cells more on each side."""
    rows, cols = framed.shape[0] - 4, framed.shape[1] - 4
    u_down, u_across = np.gradient(u)
    v_down, v_across = np.gradient(v)
    near_u, near_v = np.rint(u), np.rint(v)
    right = half_plane(u - near_u, u_across, u_down)
    below = half_plane(v - near_v, v_across, v_down)
    # Left of the border u = j is cell j - 1, which is column j + 1 of the framed pattern.
    left = np.clip(near_u, -1, cols + 1, out=near_u)
    top = np.clip(near_v, -1, rows + 1, out=near_v)
    width = framed.shape[1]
    at = ((top + 1) * width + (left + 1)).astype(np.intp)
    flat = framed.ravel()
    above = flat[at]
    above += (flat[1:][at] - above) * right
    under = flat[width:][at]
    under += (flat[width + 1 :][at] - under) * right
    above += (under - above) * below
    return above


#: No light: the ground of scenes whose layers just add up.
NO_LIGHT = Spectrum(wavelength_nm=(300.0, 1100.0), value=(0.0, 0.0))


def _bands(scene: SpectralImage, grid: Grid) -> Drawing:
    """One layer a band on a dark ground: the light is the band's triangle over wavelength, the "coverage" its radiance."""
    drawn = tuple(
        Layer((light, None), EVERYWHERE, _means(plane, scene.warp(), grid, 0.0))
        for light, plane in zip(scene.bands(), np.moveaxis(scene.radiance, 2, 0), strict=True)
    )
    return Drawing((NO_LIGHT, None), drawn)


def _chart(scene: ReflectanceChart, grid: Grid) -> Drawing:
    rows, cols = colorchecker.GRID
    if not 0.0 <= scene.gap < 1.0:
        raise ValueError(
            f"the gap between patches is {scene.gap} of their distance, outside 0..1: a ColorChecker has 0.13"
        )
    # The corners are the outer corners of the corner patches: the grid is (n - gap) distances wide.
    size = 1.0 - scene.gap
    warp = Warp.from_corners(cols - scene.gap, rows - scene.gap, scene.corners)
    row, col = grid.axes_px()
    drawn = []
    for index, reflectance in enumerate(colorchecker.reflectances(scene.name).values()):
        u, v = float(index % cols), float(index // cols)
        corner_row, corner_col = warp.to_camera([u, u + size, u + size, u], [v, v, v + size, v + size])
        window = _window(row, corner_row), _window(col, corner_col)
        coverage = quadrilateral(row[window[0]], col[window[1]], 1.0 / grid.oversample, corner_row, corner_col)
        if coverage.size:
            drawn.append(Layer((scene.illuminant_radiance, reflectance), window, coverage))
    return Drawing((scene.illuminant_radiance, colorchecker.FRAME_REFLECTANCE), tuple(drawn))


def _window(axis: FloatArray, corners: FloatArray) -> slice:
    step = axis[1] - axis[0]
    low, high = np.searchsorted(axis, [np.min(corners) - step, np.max(corners) + step])
    return slice(int(low), int(high))


def quadrilateral(
    row: FloatArray, col: FloatArray, side: float, corner_row: FloatArray, corner_col: FloatArray
) -> FloatArray:
    """Share of each sample's square (`side` px wide, centred at `row` x `col`) inside a convex polygon, exactly.

    Along the polygon's sides by `half_plane`; the few squares that hold a corner are clipped by the polygon.
    """
    if _area(np.column_stack([corner_row, corner_col])) < 0:
        corner_row, corner_col = corner_row[::-1], corner_col[::-1]
    inside = np.ones((row.size, col.size))
    if not inside.size:
        return inside
    crossed = np.zeros(inside.shape, int)
    for k in range(len(corner_row)):
        slope_row, slope_col = _inward(corner_row, corner_col, k)
        g = slope_row * (row[:, None] - corner_row[k]) + slope_col * (col[None, :] - corner_col[k])
        share = half_plane(g, slope_col * side, slope_row * side)
        crossed += (share > 0.0) & (share < 1.0)
        inside = np.minimum(inside, share)
    for i, j in np.argwhere((crossed > 1) & (inside > 0.0)):
        inside[i, j] = _clipped_area(row[i], col[j], side, corner_row, corner_col) / side**2
    return inside


def _inward(corner_row: FloatArray, corner_col: FloatArray, k: int) -> tuple[float, float]:
    """(row, col) part of the normal into the polygon of the side that ends in corner k."""
    return -(corner_col[k] - corner_col[k - 1]), corner_row[k] - corner_row[k - 1]


def _area(points: FloatArray) -> float:
    """Signed area of a polygon of (row, col) points."""
    row, col = points[:, 0], points[:, 1]
    return 0.5 * float(np.sum(row * np.roll(col, -1) - np.roll(row, -1) * col))


def _clipped_area(row: float, col: float, side: float, corner_row: FloatArray, corner_col: FloatArray) -> float:
    """Area of a square inside a convex polygon: the square cut by one side after the other (Sutherland and Hodgman)."""
    h = 0.5 * side
    points = np.array([(row - h, col - h), (row - h, col + h), (row + h, col + h), (row + h, col - h)])
    for k in range(len(corner_row)):
        slope = np.array(_inward(corner_row, corner_col, k))
        g = (points - np.array([corner_row[k], corner_col[k]])) @ slope
        kept = []
        for n in range(len(points)):
            if (g[n - 1] > 0) != (g[n] > 0):
                kept.append(points[n - 1] + (points[n] - points[n - 1]) * (g[n - 1] / (g[n - 1] - g[n])))
            if g[n] > 0:
                kept.append(points[n])
        if len(kept) < 3:
            return 0.0
        points = np.array(kept)
    return abs(_area(points))
