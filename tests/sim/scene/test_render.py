from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.camera import Geometry
from sim.scene import Darkness, ReflectanceChart, ScreenPattern, Warp, colorchecker
from sim.scene.render import Grid, cells, draw, half_plane, quadrilateral
from sim.spectrum import Spectrum

LIGHT = Spectrum.of([400.0, 700.0], [1.0, 1.0])


@given(st.floats(-1.2, 1.2), st.floats(0, 2 * np.pi))
def test_half_plane_is_the_area_of_the_cut_square(distance: float, angle: float) -> None:
    a, b = np.cos(angle), np.sin(angle)
    # 400 x 400 midpoints: only those along the line are uncertain, at most 1.5 of 400.
    x = (np.arange(400) + 0.5) / 400 - 0.5
    counted = np.mean(distance + a * x[None, :] + b * x[:, None] > 0)
    assert half_plane(np.array([distance]), a, b)[0] == pytest.approx(counted, abs=2 / 400)


def test_half_plane_of_a_line_along_an_axis_is_linear() -> None:
    d = np.linspace(-0.7, 0.7, 15)
    np.testing.assert_allclose(half_plane(d, 1.0, 0.0), np.clip(d + 0.5, 0, 1), atol=1e-9)
    np.testing.assert_allclose(half_plane(d, 1.0, 1.0) + half_plane(-d, 1.0, 1.0), 1.0)


@settings(deadline=None)  # the first one loads or compiles the loops
@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=4, max_size=4),
    st.floats(0, 6.28),
    st.sampled_from([1.0, 0.5]),
    st.booleans(),
)
def test_a_quadrilateral_has_its_own_area(
    jitter: list[tuple[float, float]], turn: float, side: float, mirrored: bool
) -> None:
    square = np.array([(-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0), (10.0, -10.0)]) + np.array(jitter)
    c, s = np.cos(turn), np.sin(turn)
    corners = square @ np.array([[c, s], [-s, c]]) + 20.0
    if mirrored:
        corners = corners[::-1]
    axis = np.arange(0.0, 40.0, side)
    share = quadrilateral(axis, axis, side, corners[:, 0], corners[:, 1])
    row, col = corners.T
    area = 0.5 * abs(np.sum(row * np.roll(col, -1) - np.roll(row, -1) * col))
    assert share.sum() * side**2 == pytest.approx(area, rel=1e-9)
    assert share.min() >= 0 and share.max() <= 1 + 1e-12


def supersampled(pattern: np.ndarray, warp: Warp, grid: Grid, surround: float, n: int) -> np.ndarray:
    fine = Grid(grid.rows, grid.cols, grid.oversample * n, grid.margin_px)
    u, v = warp.grid_to_pattern(*fine.axes_px())
    i = np.clip(np.floor(v), -1, pattern.shape[0]).astype(int) + 1
    j = np.clip(np.floor(u), -1, pattern.shape[1]).astype(int) + 1
    picked = np.pad(pattern.astype(float), 1, constant_values=surround)[i, j]
    return picked.reshape(grid.shape[0], n, grid.shape[1], n).mean(axis=(1, 3))


GEOMETRY = Geometry(camera_matrix=((60.0, 0.0, 20.0), (0.0, 60.0, 15.0), (0.0, 0.0, 1.0)), distortion=(-0.2, 0.05))


@pytest.mark.parametrize(("size", "geometry"), [(10, None), (10, GEOMETRY), (64, None)])
def test_cells_are_means_over_squares(size: int, geometry: Geometry | None) -> None:
    """Against 32 x 32 points a sample, which leave 1/32 x 1/sqrt(12) of a cell's step along a border: 0.01. At 64 cells over
    30 px the squares are divided."""
    pattern = np.random.default_rng(3).integers(0, 2, (size, size)).astype(np.uint8)
    warp = Warp.from_corners(size, size, [(2.3, 4.1), (5.2, 36.4), (28.1, 33.0), (25.4, 1.9)], geometry)
    grid = Grid(30, 40, 2, 2)
    drawn = cells(pattern, warp, grid, 0.25)
    reference = supersampled(pattern, warp, grid, 0.25, 32)
    # A sample that holds a cell's corner under a turned grid is a product of shares: off by a few hundredths at most.
    assert np.sqrt(np.mean((drawn - reference) ** 2)) < 0.006
    assert np.max(np.abs(drawn - reference)) < 0.06
    assert drawn.mean() == pytest.approx(reference.mean(), abs=2e-4)


def test_upright_cells_are_exact_whatever_their_size() -> None:
    """Against integrals summed cell by cell; 4000 cells on 10 px, and cells of 3.7 px."""
    rng = np.random.default_rng(1)
    for count, size in ((400, 10.0), (3, 11.1)):
        pattern = rng.random((count, count))
        warp = Warp.from_corners(count, count, [(1, 1), (1, 1 + size), (1 + size, 1 + size), (1 + size, 1)])
        assert warp.upright
        grid = Grid(14, 15, 2, 1)
        drawn = cells(pattern, warp, grid, 0.25)
        weights = []
        for axis in grid.axes_px():
            low, high = (axis - 0.25 - 1) / size * count, (axis + 0.25 - 1) / size * count
            j = np.arange(count)[None, :]
            overlap = np.minimum(high[:, None], j + 1) - np.maximum(low[:, None], j)
            weights.append(np.maximum(overlap, 0) / (high - low)[:, None])
        wanted = 0.25 + weights[0] @ (pattern - 0.25) @ weights[1].T
        np.testing.assert_allclose(drawn, wanted, rtol=0, atol=1e-12)


def test_cells_beyond_what_can_be_drawn_are_refused() -> None:
    warp = Warp.from_corners(4000, 4000, [(0, 5), (5, 10), (10, 5), (5, 0)])
    with pytest.raises(ValueError, match="use larger cells"):
        cells(np.zeros((4000, 4000)), warp, Grid(10, 10, 1, 0), 0.0)
    with pytest.raises(ValueError, match=r"outside the limits 0\.\.1"):
        cells(np.full((2, 2), 255.0), Warp.from_corners(2, 2, [(0, 0), (0, 9), (9, 9), (9, 0)]), Grid(10, 10), 0.0)


@pytest.mark.parametrize("turned", [0, 2])
def test_a_charts_patches_lie_between_its_corners(turned: int) -> None:
    corners = [(10.0, 12.0), (14.0, 110.0), (80.0, 106.0), (78.0, 9.0)]
    corners = corners[turned:] + corners[:turned]
    chart = ReflectanceChart(tuple(corners), LIGHT)
    grid = Grid(90, 120, 2, 4)
    drawing = draw(chart, grid)
    assert len(drawing.layers) == 24
    covered = np.zeros(grid.shape)
    row, col = grid.axes_px()
    centres = {}
    for (name, reflectance), layer in zip(colorchecker.reflectances().items(), drawing.layers, strict=True):
        assert layer.light == (LIGHT, reflectance)
        covered[layer.window] += layer.coverage
        weight = layer.coverage / layer.coverage.sum()
        centres[name] = (weight.sum(1) @ row[layer.window[0]], weight.sum(0) @ col[layer.window[1]])
    assert covered.max() <= 1 + 1e-9
    for corner, name in zip(corners, ("dark skin", "bluish green", "black", "white"), strict=True):
        # A patch's centre lies half a patch's diagonal (some 10 px) within its corner.
        assert np.hypot(*np.subtract(centres[name], corner)) < 13
    for corner, name in zip(corners, ("dark skin", "bluish green", "black", "white"), strict=True):
        others = [np.hypot(*np.subtract(centres[n], corner)) for n in centres if n != name]
        assert min(others) > np.hypot(*np.subtract(centres[name], corner))


def test_a_screen_has_two_lights() -> None:
    drawing = draw(
        ScreenPattern(
            np.ones((2, 2), np.uint8), Warp.from_corners(2, 2, [(0, 0), (0, 9), (9, 9), (9, 0)]), LIGHT, LIGHT
        ),
        Grid(10, 10),
    )
    assert len(drawing.layers) == 1
    with pytest.raises(TypeError, match="Darkness"):
        draw(Darkness(), Grid(10, 10))


def test_the_colorchecker_has_24_patches_from_dark_skin_to_black() -> None:
    curves = colorchecker.reflectances("ColorChecker24")
    assert tuple(curves) == colorchecker.PATCHES
    assert curves["white"].at(550.0) == pytest.approx(0.9, abs=0.03)
    assert curves["black"].at(550.0) == pytest.approx(0.032, abs=0.005)
    assert curves["red"].at(650.0) > 5 * curves["red"].at(500.0)
    with pytest.raises(ValueError, match="IT8"):
        colorchecker.reflectances("IT8")
