"""Drawing scenes by area: the share of every sample's square that each spectrum covers. Nothing is point-sampled.

A scene is a few spectra, each with a picture of where it is (a layer); the pictures add up to 1 everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sim.scene import colorchecker
from sim.scene.scenes import PlanarTarget, ReflectanceChart, Scene, ScreenPattern
from sim.scene.warp import Warp
from sim.spectrum import FloatArray, Spectrum


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


@dataclass(frozen=True)
class Layer:
    """One spectrum of a scene (`radiance`, as the radiometer says, times `reflectance` where there's a chart) and where it
    is: `coverage` 0..1 on the part `window` (slices of rows and columns) of a grid, 0 elsewhere."""

    radiance: Spectrum
    reflectance: Spectrum | None
    window: tuple[slice, slice]
    coverage: FloatArray


def half_plane(distance: FloatArray, slope_x: FloatArray | float, slope_y: FloatArray | float) -> FloatArray:
    """Share of unit squares on the positive side of the line g = 0, exactly.

    `distance` is g at the squares' centres, g = distance + slope_x x + slope_y y with x, y in -1/2..1/2: the distribution
    function of the sum of two uniform variables of widths a = |slope_x|, b = |slope_y|.
    """
    a, b = np.abs(slope_x), np.abs(slope_y)
    wide, narrow = np.maximum(a, b), np.minimum(a, b)
    # Flat top of the trapezoid, then its ramp; where the line is along an axis the ramp has no width.
    tiny = 1e-9 * np.maximum(wide, 1e-300)
    narrow = np.maximum(narrow, tiny)
    wide = np.maximum(wide, 1e-300)
    mid, far = 0.5 * (wide - narrow), 0.5 * (wide + narrow)
    d = np.abs(distance)
    ramp = np.clip(far - d, 0.0, narrow)
    light = np.where(d <= mid, 0.5 - d / wide, 0.5 * ramp * ramp / (wide * narrow))
    return np.where(np.asarray(distance) > 0, 1.0 - light, light)


def cells(pattern: FloatArray, warp: Warp, grid: Grid, surround: float) -> FloatArray:
    """A pattern of cells seen through a warp: mean of `pattern` (and of `surround` outside it) over every sample's square.

    Where a square lies across a cell's borders its parts are exact areas (`half_plane`); squares larger than a cell are
    divided until they aren't.
    """
    # The largest footprint of a sample in cells decides how finely the grid has to be divided.
    row, col = grid.axes_px()
    probe_r, probe_c = np.meshgrid(np.linspace(row[0], row[-1], 5), np.linspace(col[0], col[-1], 5), indexing="ij")
    h = 0.5 / grid.oversample
    (ua, va), (ub, vb) = warp.to_pattern(probe_r - h, probe_c), warp.to_pattern(probe_r + h, probe_c)
    (uc, vc), (ud, vd) = warp.to_pattern(probe_r, probe_c - h), warp.to_pattern(probe_r, probe_c + h)
    footprint = max(np.max(np.abs(ub - ua) + np.abs(ud - uc)), np.max(np.abs(vb - va) + np.abs(vd - vc)))
    divide = max(1, int(np.ceil(footprint / 0.999)))
    if divide > 1:
        fine = cells(pattern, warp, Grid(grid.rows, grid.cols, grid.oversample * divide, grid.margin_px), surround)
        n_rows, n_cols = grid.shape
        return fine.reshape(n_rows, divide, n_cols, divide).mean(axis=(1, 3))
    u, v = warp.grid_to_pattern(row, col)
    u_down, u_across = np.gradient(u)
    v_down, v_across = np.gradient(v)
    rows, cols = pattern.shape
    framed = np.pad(np.asarray(pattern, float), 1, constant_values=surround)
    near_u, near_v = np.rint(u), np.rint(v)
    right = half_plane(u - near_u, u_across, u_down)
    below = half_plane(v - near_v, v_across, v_down)
    # Cell j covers u = j..j+1: left of the border near_u is cell near_u - 1, which is column near_u of the framed pattern.
    j0 = np.clip(near_u, 0, cols + 1).astype(np.intp)
    j1 = np.clip(near_u + 1, 0, cols + 1).astype(np.intp)
    i0 = np.clip(near_v, 0, rows + 1).astype(np.intp)
    i1 = np.clip(near_v + 1, 0, rows + 1).astype(np.intp)
    top = framed[i0, j0] * (1.0 - right) + framed[i0, j1] * right
    bottom = framed[i1, j0] * (1.0 - right) + framed[i1, j1] * right
    return top * (1.0 - below) + bottom * below


def layers(scene: Scene, grid: Grid) -> Iterator[Layer]:
    """The layers of a scene on a grid, one at a time. For scenes that need blurring by convolution: charts, screens, targets."""
    everywhere = (slice(None), slice(None))
    if isinstance(scene, ReflectanceChart):
        yield from _chart(scene, grid)
    elif isinstance(scene, ScreenPattern):
        lit = cells(np.asarray(scene.pattern, float), scene.to_camera, grid, 0.0)
        yield Layer(scene.dark_radiance, None, everywhere, 1.0 - lit)
        yield Layer(scene.light_radiance, None, everywhere, lit)
    elif isinstance(scene, PlanarTarget):
        lit = cells(np.asarray(scene.texture, float), scene.warp(), grid, scene.surround)
        yield Layer(scene.dark_radiance, None, everywhere, 1.0 - lit)
        yield Layer(scene.light_radiance, None, everywhere, lit)
    else:
        raise TypeError(f"a scene of type {type(scene).__name__} can't be drawn: use one of sim.scene")


def _chart(scene: ReflectanceChart, grid: Grid) -> Iterator[Layer]:
    rows, cols = colorchecker.GRID
    gap = scene.gap
    # The corners are the outer corners of the corner patches: the grid is (n - gap) pitches wide.
    warp = Warp.from_corners(cols - gap, rows - gap, scene.corners)
    row, col = grid.axes_px()
    frame = np.ones(grid.shape)
    for index, (_, reflectance) in enumerate(colorchecker.reflectances(scene.name).items()):
        u0, v0 = float(index % cols), float(index // cols)
        size = 1.0 - gap
        corner_row, corner_col = warp.to_camera(
            np.array([u0, u0 + size, u0 + size, u0]), np.array([v0, v0, v0 + size, v0 + size])
        )
        window = _window(row, corner_row), _window(col, corner_col)
        coverage = quadrilateral(row[window[0]], col[window[1]], corner_row, corner_col)
        frame[window] -= coverage
        yield Layer(scene.illuminant_radiance, reflectance, window, coverage)
    yield Layer(
        scene.illuminant_radiance, colorchecker.FRAME_REFLECTANCE, (slice(None), slice(None)), np.maximum(frame, 0.0)
    )


def _window(axis: FloatArray, corners: FloatArray) -> slice:
    step = axis[1] - axis[0]
    low = int(np.searchsorted(axis, np.min(corners) - step))
    high = int(np.searchsorted(axis, np.max(corners) + step))
    return slice(low, high)


def quadrilateral(row: FloatArray, col: FloatArray, corner_row: FloatArray, corner_col: FloatArray) -> FloatArray:
    """Share of each sample's square (of the grid's step, centred at `row` x `col`) inside a convex polygon whose corners go
    round it clockwise on the screen."""
    step = row[1] - row[0] if row.size > 1 else col[1] - col[0]
    inside = np.ones((row.size, col.size))
    for k in range(len(corner_row)):
        r0, c0, r1, c1 = corner_row[k - 1], corner_col[k - 1], corner_row[k], corner_col[k]
        # Positive to the right of the direction of travel, which is inside.
        slope_row, slope_col = (c1 - c0), -(r1 - r0)
        g = slope_row * (row[:, None] - r0) + slope_col * (col[None, :] - c0)
        inside *= half_plane(g, slope_col * step, slope_row * step)
    return inside
