"""Scenes drawn by area: the share of every sample's square that each light covers. Nothing is point-sampled.

A scene is a ground that covers everything, and a few other lights, each with its coverage of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fresnel

from sim.scene import colorchecker
from sim.scene.scenes import (
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    PointArray,
    PosedEdges,
    Ramp,
    ReflectanceChart,
    Scene,
    ScreenImage,
    ScreenPattern,
    SiemensStar,
    SpectralImage,
    UniformField,
    ZonePlate,
)
from sim.scene.warp import Warp
from sim.spectrum import FloatArray, Spectrum

#: Radiance as the radiometer says (None: equal energy), and the reflectance of what it falls on (None: 1).
LitSurface = tuple[Spectrum | None, Spectrum | None]
Window = tuple[slice, slice]
EVERYWHERE: Window = (slice(None), slice(None))


@dataclass(frozen=True)
class Grid:
    """Square samples, `oversample` by `oversample` to the pixel, over a frame of (rows, cols) and `margin_px` around
    it.
    """

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
    """One light and its coverage: `coverage` in the part `window` of a grid, 0 elsewhere.

    It is a share 0..1 over a ground that emits light; over a dark ground it is any factor >= 0.
    """

    light: LitSurface
    window: Window
    coverage: FloatArray


@dataclass(frozen=True, eq=False)
class Drawing:
    """A scene on a grid. `ground` covers what the layers leave free; the layers' coverages add up to 1 at most."""

    ground: LitSurface
    layers: tuple[Layer, ...]


def draw(scene: Scene, grid: Grid) -> Drawing:
    """Return a scene drawn on a grid. Raises TypeError for one that can't be drawn: darkness, or one of another
    module."""
    if isinstance(scene, UniformField):
        return Drawing((scene.radiance, None), ())
    if isinstance(scene, ReflectanceChart):
        return _chart(scene, grid)
    if isinstance(scene, SpectralImage):
        return _bands(scene, grid)
    if isinstance(scene, ScreenImage):
        return _screen(scene, grid)
    if isinstance(scene, ScreenPattern):
        lit = cells(np.asarray(scene.pattern, float), scene.to_camera, grid, 0.0)
    elif isinstance(scene, PlanarTarget):
        lit = cells(np.asarray(scene.texture, float), scene.warp(), grid, scene.surround)
    elif isinstance(scene, KnifeEdge | PosedEdges):
        lit = _edges(scene, grid) if isinstance(scene, KnifeEdge) else _cut_posed_edges(scene, grid)
    elif isinstance(scene, ZonePlate):
        lit = _zone_plate(scene, grid)
    elif isinstance(scene, SiemensStar):
        lit = _star(scene, grid)
    elif isinstance(scene, Ramp):
        lit = _ramp(scene, grid)
    elif isinstance(scene, PointArray):
        lit = _points(scene, grid)
    else:
        raise TypeError(
            f"a scene of type {type(scene).__name__} can't be drawn: use one of `sim.scene` that sheds light"
        )
    return Drawing((scene.dark_radiance, None), (Layer((scene.light_radiance, None), EVERYWHERE, lit),))


def half_plane(distance: FloatArray, slope_x: FloatArray | float, slope_y: FloatArray | float) -> FloatArray:
    """Compute the share of unit squares on the positive side of the line g = 0, exactly: the distribution function
    of the sum of two uniform variables of widths |slope_x| and |slope_y|.

    distance : g at the squares' centres; slope_x, slope_y : of g = distance + slope_x x + slope_y y, x and y in
        -1/2..1/2

    Returns the share, 0..1, of the shape of `distance`.

    >>> half_plane(np.array([-1.0, 0.0, 0.25, 1.0]), 1.0, 0.0).round(6).tolist()
    [0.0, 0.5, 0.75, 1.0]
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
    """Return a pattern of cells (values 0..1) seen through a warp: the mean of `pattern`, and of `surround` outside it,
    over every sample's square.

    A square across a cell's border is split by exact area (`half_plane`), one that contains a cell's corner by the
    product of two such shares. Squares larger than a cell are subdivided. Raises ValueError for a pattern that isn't
    2-D or has values outside 0..1.
    """
    pattern = np.asarray(pattern, float)
    if pattern.ndim != 2 or pattern.size == 0:
        raise ValueError(f"a pattern of shape {pattern.shape} has to be a picture of rows x cols cells")
    if not (np.min(pattern) >= 0 and np.max(pattern) <= 1):
        bad = pattern[~((pattern >= 0) & (pattern <= 1))].flat[0]
        raise ValueError(f"a pattern's cell is {bad}, outside the limits 0..1: scale it, 0 dark and 1 lit")
    return cell_means(pattern, warp, grid, surround)


def cell_means(
    pattern: FloatArray, warp: Warp, grid: Grid, surround: float, lit: tuple[float, float, float, float] | None = None
) -> FloatArray:
    """`cells` for cells of any finite value. `lit` (u0, u1, v0, v1): the part of every cell that has its value, the
    rest having `surround`; None: all of it."""
    if warp.is_upright:
        return _upright_means(pattern, warp, grid, surround, lit)
    from sim.scene.area import average_mapped, project_means  # here: the compiler's library takes a while to load

    divide = max(1, int(np.ceil(_footprint(pattern.shape, warp, grid) / 0.999)))
    if divide > MOST_DIVISIONS:
        raise ValueError(
            f"the pattern's cells are {1.0 / (divide * grid.oversample):.3g} px on the camera, below the limit of "
            f"{1.0 / (MOST_DIVISIONS * grid.oversample):.3g} px: use larger cells or bring the target closer"
        )
    pattern = np.ascontiguousarray(pattern, float)
    row, col = grid.axes_px()
    step = 1.0 / grid.oversample
    out = np.empty(grid.shape)
    if warp.is_straight:
        back = np.linalg.inv(np.asarray(warp.homography))
        project_means(pattern, back, row, col, step, divide, lit, surround, out)
        return out
    # Through a distorting lens pattern points are splines' values, with one more all round for the squares' sides.
    fine = step / divide
    offset = (np.arange(divide) + 0.5) * fine - 0.5 * step
    across = (col[:, None] + offset).ravel()
    across = np.concatenate([[across[0] - fine], across, [across[-1] + fine]])
    mapper = warp.mapper((row[0] - step, row[-1] + step), across)
    strips = max(1, (row.size * divide * across.size) // 100_000)  # strips that stay in the processor's cache
    for part in np.array_split(np.arange(row.size), min(strips, row.size)):
        down = (row[part, None] + offset).ravel()
        down = np.concatenate([[down[0] - fine], down, [down[-1] + fine]])
        u, v = mapper(down)
        average_mapped(pattern, u, v, divide, lit, surround, out[part[0] : part[-1] + 1])
    return out


def _upright_means(
    pattern: FloatArray, warp: Warp, grid: Grid, surround: float, lit: tuple[float, float, float, float] | None
) -> FloatArray:
    """`cell_means` where the pattern isn't rotated: exact means along columns, then along rows, of cells of any
    size.
    """
    from sim.scene.area import means_down

    h = np.asarray(warp.homography) / warp.homography[2][2]
    step = 1.0 / grid.oversample
    u0, u1, v0, v1 = (0.0, 1.0, 0.0, 1.0) if lit is None else lit
    row, col = (np.append(axis - 0.5 * step, axis[-1] + 0.5 * step) for axis in grid.axes_px())
    across = means_down(np.ascontiguousarray(pattern.T, float), (col - h[0, 2]) / h[0, 0], u0, u1, surround)
    return np.asarray(means_down(np.ascontiguousarray(across.T), (row - h[1, 2]) / h[1, 1], v0, v1, surround))


#: A sample's square isn't divided more finely than so many times each way.
MOST_DIVISIONS = 16


def _footprint(shape: tuple[int, ...], warp: Warp, grid: Grid) -> float:
    """Largest extent, in cells, of a sample's square, over the parts of the pattern that the grid sees."""
    rows, cols = shape
    u, v = np.meshgrid(np.linspace(0.0, cols, 9), np.linspace(0.0, rows, 9))
    row, col = warp.to_camera(u, v)
    axis_row, axis_col = grid.axes_px()
    is_inside = (row >= axis_row[0]) & (row <= axis_row[-1]) & (col >= axis_col[0]) & (col <= axis_col[-1])
    if not np.any(is_inside):
        # The grid may lie inside one cell, or off the pattern: ask at the grid's middle.
        row, col, is_inside = np.array([np.mean(axis_row)]), np.array([np.mean(axis_col)]), np.array([True])
    row, col = row[is_inside], col[is_inside]
    h = 0.5 / grid.oversample
    (ua, va), (ub, vb) = warp.to_pattern(row - h, col), warp.to_pattern(row + h, col)
    (uc, vc), (ud, vd) = warp.to_pattern(row, col - h), warp.to_pattern(row, col + h)
    extent = np.maximum(np.abs(ub - ua) + np.abs(ud - uc), np.abs(vb - va) + np.abs(vd - vc))
    return float(np.max(extent))


#: No light: the ground of scenes whose layers just add up.
NO_LIGHT = Spectrum(wavelength_nm=(300.0, 1100.0), value=(0.0, 0.0))


def _bands(scene: SpectralImage, grid: Grid) -> Drawing:
    """One layer for each band on a dark ground: the light is the band's triangle over wavelength, the "coverage" its
    radiance."""
    planes = np.moveaxis(scene.radiance, 2, 0)
    lights = [(light, None) for light in scene.bands()]
    if scene.to_camera is not None or planes[0].shape != (grid.rows, grid.cols):
        warp = scene.warp()
        return Drawing(
            (NO_LIGHT, None),
            tuple(
                Layer(light, EVERYWHERE, cell_means(plane, warp, grid, 0.0))
                for light, plane in zip(lights, planes, strict=True)
            ),
        )
    # Sample and pixel are the same square: nothing is cut.
    s, m = grid.oversample, grid.margin_px * grid.oversample
    window = slice(m, m + grid.rows * s), slice(m, m + grid.cols * s)
    return Drawing(
        (NO_LIGHT, None),
        tuple(
            Layer(light, window, np.repeat(np.repeat(plane, s, axis=0), s, axis=1) if s > 1 else plane)
            for light, plane in zip(lights, planes, strict=True)
        ),
    )


def _screen(scene: ScreenImage, grid: Grid) -> Drawing:
    """Leakage of black and one layer for each primary on a dark ground; all fall off with the viewing angle."""
    warp = scene.warp()
    screen = scene.screen
    pictures: list[tuple[Spectrum, FloatArray, tuple[float, float, float, float] | None]] = []
    if any(screen.black_radiance.value):
        pictures.append((screen.black_radiance, np.ones(scene.codes.shape[:2]), None))
    for channel, (primary, drive) in enumerate(zip(screen.primaries, screen.drives(scene.codes), strict=True)):
        if screen.sub_pixels is None:
            pictures.append((primary, drive, None))
        else:
            pictures.append((primary, drive / screen.sub_pixels.share, screen.sub_pixels.locate_stripe(channel)))
    drawn = tuple(
        Layer((light, None), EVERYWHERE, cell_means(picture, warp, grid, 0.0, lit)) for light, picture, lit in pictures
    )
    if screen.falloff_exponent:
        falloff = scene.cosine(*grid.axes_px()) ** screen.falloff_exponent
        for layer in drawn:
            np.multiply(layer.coverage, falloff, out=layer.coverage)
    return Drawing((NO_LIGHT, None), drawn)


def _edges(scene: KnifeEdge, grid: Grid) -> FloatArray:
    """Every sample belongs to the edge of the nearest region, whose line cuts it by exact area."""
    row, col = grid.axes_px()
    if len(scene.regions) == 1:
        return _light_side(scene.regions[0], grid)
    owner = scene.owner(row[:, None], col[None, :])
    lit = np.empty(grid.shape)
    for index, edge in enumerate(scene.regions):
        mine = owner == index
        lit[mine] = _light_side(edge, grid)[mine]
    return lit


def _cut_posed_edges(scene: PosedEdges, grid: Grid) -> FloatArray:
    """Every sample is cut by the edge's line at that position, by exact area."""
    owner, away = scene.distances(*grid.axes_px())
    lit = np.empty(grid.shape)
    for index, distance in enumerate(away):
        mine = owner == index
        down, across = np.gradient(distance)
        lit[mine] = half_plane(distance[mine], across[mine], down[mine])
    return lit


def _light_side(edge: EdgeRegion, grid: Grid) -> FloatArray:
    """Share of every sample on the light side of an edge, whose part of the grid is a polygon."""
    row, col = grid.axes_px()
    half = 0.5 / grid.oversample
    top, bottom, left, right = row[0] - half, row[-1] + half, col[0] - half, col[-1] + half
    corners = np.array([(top, left), (top, right), (bottom, right), (bottom, left)])
    distance = edge.distance_px(corners[:, 0], corners[:, 1])
    kept = []
    for k in range(4):
        if (distance[k - 1] > 0) != (distance[k] > 0):
            share = distance[k - 1] / (distance[k - 1] - distance[k])
            kept.append(corners[k - 1] + (corners[k] - corners[k - 1]) * share)
        if distance[k] > 0:
            kept.append(corners[k])
    if len(kept) < 3:
        return np.zeros(grid.shape)
    points = np.array(kept)
    return quadrilateral(row, col, 2.0 * half, points[:, 0], points[:, 1])


def _zone_plate(scene: ZonePlate, grid: Grid) -> FloatArray:
    """cos(pi k (x^2 + y^2)) = Re exp(i pi k x^2) exp(i pi k y^2).

    Its mean over a square is a product of two Fresnel integrals, exactly; the taper near the border, which is smooth,
    is taken at the square's centre.
    """
    from sim.scene.area import draw_tapered_rings

    if scene.highest_cy_per_px > 0.5 * grid.oversample:
        raise ValueError(
            f"the zone plate rises to {scene.highest_cy_per_px:g} cy/px, above the limit of {0.5 * grid.oversample:g} "
            f"cy/px of {grid.oversample} samples a pixel: draw with more samples, or lower highest_cy_per_px"
        )
    k = scene.highest_cy_per_px / scene.radius_px
    step = 1.0 / grid.oversample
    parts, squares = [], []
    for axis, centre in zip(grid.axes_px(), scene.centre, strict=True):
        edges = np.append(axis - 0.5 * step, axis[-1] + 0.5 * step) - centre
        sine, cosine = fresnel(np.sqrt(2.0 * k) * edges)
        parts.append((np.diff(cosine) + 1j * np.diff(sine)) / (np.sqrt(2.0 * k) * step))
        squares.append((axis - centre) ** 2)
    lit = np.empty(grid.shape)
    draw_tapered_rings(*parts, *squares, (1.0 - scene.taper) * scene.radius_px, scene.radius_px, lit)
    return lit


def _star(scene: SiemensStar, grid: Grid) -> FloatArray:
    """Triangles from the centre, each clipped exactly."""
    from sim.scene.area import add_polygon

    lit = np.zeros(grid.shape)
    row, col = grid.axes_px()
    for corners in scene.triangles():
        add_polygon(corners, row[0], col[0], 1.0 / grid.oversample, 1.0, lit)
    # Shares of up to a spoke's number of triangles were added up in the squares at the centre.
    return np.minimum(lit, 1.0)


def _ramp(scene: Ramp, grid: Grid) -> FloatArray:
    row, col = grid.axes_px()
    angle = np.deg2rad(scene.angle_deg)
    across, down = np.cos(angle), np.sin(angle)
    # 0 at the start of the ramp, 1 at its end
    place = (
        ((col - scene.centre[1]) * across)[None, :] + ((row - scene.centre[0]) * down)[:, None]
    ) / scene.length_px + 0.5
    if scene.steps == 0:
        return np.clip(place, 0.0, 1.0)
    slope = 1.0 / (grid.oversample * scene.length_px)
    lit = np.zeros(grid.shape)
    for n in range(1, scene.steps):
        lit += half_plane(place - n / scene.steps, across * slope, down * slope)
    return lit / (scene.steps - 1)


def _points(scene: PointArray, grid: Grid) -> FloatArray:
    """Square holes; one narrower than a sample is spread over a sample's width, with its energy and centroid."""
    step = 1.0 / grid.oversample
    wide = max(scene.side_px, step)
    lit = np.zeros(grid.shape)
    for point in scene.points:
        shares = []
        windows = []
        for axis, centre in zip(grid.axes_px(), point, strict=True):
            low, high = np.searchsorted(axis, [centre - 0.5 * (wide + step), centre + 0.5 * (wide + step)])
            near = axis[low:high]
            overlap = np.minimum(near + 0.5 * step, centre + 0.5 * wide) - np.maximum(
                near - 0.5 * step, centre - 0.5 * wide
            )
            shares.append(np.maximum(overlap, 0.0) / step * (scene.side_px / wide))
            windows.append(slice(int(low), int(high)))
        lit[windows[0], windows[1]] += np.outer(*shares)
    if np.max(lit, initial=0.0) > 1.0 + 1e-9:
        raise ValueError(f"points of {scene.side_px:g} px overlap: put them farther apart than their side")
    return lit


def _chart(scene: ReflectanceChart, grid: Grid) -> Drawing:
    patches = scene.reflectances or tuple(colorchecker.reflectances(scene.name).values())
    rows, cols = colorchecker.grid(scene.name)
    if not 0.0 <= scene.gap < 1.0:
        raise ValueError(
            f"the gap between patches is {scene.gap} of their distance, outside 0..1: a ColorChecker has 0.13"
        )
    # The corners are the outer corners of the corner patches: the grid is (n - gap) distances wide.
    size = 1.0 - scene.gap
    warp = Warp.from_corners(cols - scene.gap, rows - scene.gap, scene.corners, scene.geometry)
    row, col = grid.axes_px()
    drawn = []
    for index, reflectance in enumerate(patches):
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
    """Share of each sample's square (`side` px wide, centred at the even axes `row` x `col`) inside a convex polygon,
    exactly.
    """
    from sim.scene.area import polygon_share

    if not (row.size and col.size):
        return np.ones((row.size, col.size))
    corners = np.column_stack([corner_row, corner_col])
    return polygon_share(corners, float(row[0]), float(col[0]), side, (row.size, col.size))
