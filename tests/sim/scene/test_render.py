"""Scenes drawn by area: against integrals and closed forms, sample by sample."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim import frame as sim_frame
from sim.camera import CameraModel, Geometry
from sim.frame import Exposure
from sim.scene import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PointArray,
    Ramp,
    ReflectanceChart,
    Scene,
    Screen,
    ScreenImage,
    ScreenPattern,
    SiemensStar,
    SpectralImage,
    SubPixels,
    UniformField,
    Warp,
    ZonePlate,
    colorchecker,
)
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
    """Against 32 x 32 points a sample, which leave 1/32 x 1/sqrt(12) of a cell's step along a border: 0.01. At 64 cells
    over 30 px the squares are divided.
    """
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
        assert warp.is_upright
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


# --- drawn scenes
# ------------------------------------------------------------------------------------------------------

DARK = LIGHT.scale(0.0)


def covered(scene: Scene, grid: Grid) -> np.ndarray:
    """The light's share on the whole grid."""
    (layer,) = draw(scene, grid).layers
    assert layer.coverage.shape == grid.shape
    return layer.coverage


def blocks(fine: np.ndarray, n: int) -> np.ndarray:
    rows, cols = fine.shape
    return fine.reshape(rows // n, n, cols // n, n).mean(axis=(1, 3))


def edge(angle_deg: float, offset_px: float = 0.0) -> KnifeEdge:
    return KnifeEdge((EdgeRegion((0, 0, 20, 24), angle_deg, offset_px),), DARK, LIGHT)


STAR = SiemensStar((15.3, 14.6), 13.0, 12, DARK, LIGHT, turn_deg=7.0)
HOLES = PointArray(((4.2, 5.9), (20.01, 17.5)), 0.7, DARK, LIGHT)
STEPS = Ramp((14.5, 14.5), 25.0, DARK, LIGHT, angle_deg=33.0, steps=6)


@pytest.mark.parametrize("scene", [edge(5.0), edge(45.0), edge(271.0, 2.2), STAR, HOLES, STEPS])
def test_area_drawn_coarse_is_the_mean_of_area_drawn_fine(scene: Scene) -> None:
    """Exact areas add up: no sample depends on where or how finely others are drawn, so nothing can alias that the
    square's own mean doesn't let pass.
    """
    coarse = covered(scene, Grid(30, 30, 2, 1))
    np.testing.assert_allclose(blocks(covered(scene, Grid(30, 30, 8, 1)), 4), coarse, rtol=0, atol=1e-12)


@given(st.floats(-720, 720), st.floats(-40, 40))
def test_an_edge_of_any_angle_cuts_squares_exactly(angle_deg: float, offset_px: float) -> None:
    grid = Grid(20, 24, 2, 3)
    drawn = covered(edge(angle_deg, offset_px), grid)
    row, col = grid.axes_px()
    angle = np.deg2rad(angle_deg)
    distance = (col[None, :] - 11.5) * np.cos(angle) + (row[:, None] - 9.5) * np.sin(angle) - offset_px
    wanted = half_plane(distance, 0.5 * np.cos(angle), 0.5 * np.sin(angle))
    # half_plane gives a line along an axis a width of 1e-9 of a sample
    np.testing.assert_allclose(drawn, wanted, rtol=0, atol=2e-9)
    swapped = covered(edge(angle_deg + 180.0, -offset_px), grid)
    np.testing.assert_allclose(drawn + swapped, 1.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("angle_deg", "light"), [(0, "right"), (90, "below"), (180, "left"), (270, "above")])
def test_an_edges_light_side(angle_deg: float, light: str) -> None:
    drawn = covered(edge(angle_deg), Grid(20, 24, 1, 0))
    halves = {"left": drawn[:, :12], "right": drawn[:, 12:], "above": drawn[:10], "below": drawn[10:]}
    opposite = {"left": "right", "right": "left", "above": "below", "below": "above"}
    np.testing.assert_allclose(halves[light], 1.0, atol=1e-12)
    np.testing.assert_allclose(halves[opposite[light]], 0.0, atol=1e-12)


def test_of_several_edges_the_nearest_region_rules() -> None:
    left, right = EdgeRegion((0, 0, 20, 10), 5.0), EdgeRegion((0, 14, 20, 24), 185.0)
    grid = Grid(20, 24, 2, 0)
    drawn = covered(KnifeEdge((left, right), DARK, LIGHT), grid)
    one, other = (covered(KnifeEdge((region,), DARK, LIGHT), grid) for region in (left, right))
    np.testing.assert_array_equal(drawn[:, :23], one[:, :23])
    np.testing.assert_array_equal(drawn[:, 25:], other[:, 25:])


def test_a_drawn_edge_blurs_to_the_edges_exact_profile(mono_camera: CameraModel, lamp: Spectrum) -> None:
    """Drawn at 6 x 6 samples a pixel and seen through the same transfer. What is left is what squares of 1/6 px alias:
    with a line's spectrum of 1 / (2 pi f) a cycle and lens and pixel passing < 0.05 near 5 cy/px, below 1e-3 of the
    step.
    """
    camera = mono_camera.model_copy(update={"lens": mono_camera.lens.model_copy(update={"transmittance": 1.0})})
    dark = lamp.scale(0.2)
    for angle_deg in (0.0, 5.0, 45.0, 90.0, 187.0, 270.0):
        scene = KnifeEdge((EdgeRegion((0, 0, 72, 96), angle_deg, 0.3),), dark, lamp)
        drawn = draw(scene, Grid(72, 96, 6, 16))
        # The same picture as a screen's pattern of one cell a sample.
        pattern = ScreenPattern(
            drawn.layers[0].coverage.clip(0, 1),
            Warp.of([(1 / 6, 0, -0.5 - 16), (0, 1 / 6, -0.5 - 16), (0, 0, 1)]),
            dark,
            lamp,
            "slanted_edge",
        )
        exact = sim_frame.expected_electrons(camera, Exposure(scene, 0.01))
        blurred = sim_frame.expected_electrons(camera, Exposure(pattern, 0.01), oversample=6, margin_px=16)
        inside = (slice(24, 48), slice(24, 72))  # away from the grid's ends, where the other side's light comes in
        step = np.ptp(exact)
        np.testing.assert_allclose(blurred[inside], exact[inside], rtol=0, atol=2e-3 * step)


def plate(radius_px: float = 60.0, highest: float = 0.6, taper: float = 0.2) -> ZonePlate:
    return ZonePlate((64.0, 64.0), radius_px, highest, DARK, LIGHT, taper)


def test_a_zone_plates_squares_are_means_of_its_formula() -> None:
    grid = Grid(129, 129, 3, 0)
    drawn = covered(plate(), grid)
    n = 16
    axis = (np.arange(129 * 3 * n) + 0.5) / (3 * n) - 0.5 - 64.0
    wanted = np.empty(grid.shape)
    for i in range(grid.shape[0]):
        r = np.hypot(axis[i * n : (i + 1) * n, None], axis[None, :])
        fade = np.where(r < 48, 1.0, 0.5 + 0.5 * np.cos(np.pi * (np.minimum(r, 60) - 48) / 12))
        level = 0.5 + 0.5 * fade * np.cos(np.pi * 0.01 * r**2)
        wanted[i] = level.reshape(n, grid.shape[1], n).mean(axis=(0, 2))
    row, col = grid.axes_px()
    inside = np.hypot(row[:, None] - 64, col[None, :] - 64) < 47
    # Midpoints of 1/48 px: the second derivative of the cosine is below (2 pi 0.6)^2, / 24 x (1/48)^2 x 2 axes / 2.
    np.testing.assert_allclose(drawn[inside], wanted[inside], rtol=0, atol=3e-4)
    # In the taper, which is taken at the square's centre: slope pi / (2 x 12 px), half a sample each way, half the
    # contrast.
    np.testing.assert_allclose(drawn, wanted, rtol=0, atol=0.5 * np.pi / 24 / 3 * 0.5)


def test_a_zone_plates_mean_is_its_integral() -> None:
    """Without a taper the disc's integral of cos(pi k r^2) is sin(pi k R^2) / k; a taper over almost nothing leaves it
    so, to what the rim's squares, taken whole or not, hold: noise of sqrt(2 pi R) squares of 1/9 px^2.
    """
    for radius in (40.2, 41.0, 60.0):
        drawn = covered(plate(radius, 0.6, 1e-6), Grid(129, 129, 3, 0)) - 0.5
        k = 0.6 / radius
        wanted = 0.5 * np.sin(np.pi * k * radius**2) / k
        assert drawn.sum() / 9 == pytest.approx(wanted, abs=0.5 * np.sqrt(2 * np.pi * radius * 3) / 9 * 3)
    uniform = covered(plate(20.0), Grid(129, 129, 3, 0))
    np.testing.assert_array_equal(uniform[:100, :100], 0.5)


def test_a_zone_plate_holds_nothing_above_its_highest_frequency() -> None:
    """The rim's taper of T = 12 px is a raised cosine: beyond its first null, 1/T away, its spectrum is 31 dB down,
    8e-4 of the energy of the ring, which has 0.36 of the plate's area.
    """
    drawn = covered(plate(), Grid(129, 129, 3, 0)) - 0.5
    power = np.abs(np.fft.fft2(drawn)) ** 2
    f = np.fft.fftfreq(drawn.shape[0], 1 / 3)
    frequency = np.hypot(f[:, None], f[None, :])
    assert power[frequency > 0.6 + 1 / 12].sum() / power.sum() < 0.36 * 8e-4
    # and it reaches there: a disc of even density in frequency up to the taper
    assert power[frequency > 0.4].sum() / power.sum() > 0.25


def test_a_zone_plate_too_fine_for_the_grid_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1\.6 cy/px, above the limit of 1\.5 cy/px"):
        draw(plate(highest=1.6), Grid(30, 30, 3, 0))


def test_a_stars_area_is_its_triangles() -> None:
    for turn, spokes in ((0.0, 12), (7.0, 12), (0.0, 7), (0.0, 72)):
        star = SiemensStar((31.2, 30.7), 28.0, spokes, DARK, LIGHT, turn)
        drawn = covered(star, Grid(64, 64, 3, 0))
        assert drawn.sum() / 9 == pytest.approx(spokes * 0.5 * 28.0**2 * np.sin(np.pi / spokes), rel=1e-9)
        assert drawn.max() <= 1.0
        row, col = Grid(64, 64, 3, 0).axes_px()
        r = np.hypot(row[:, None] - 31.2, col[None, :] - 30.7)
        # Squares taken whole at two circles: 2 x 2 pi 26 x 3 of them, each off by at most 0.3 of a light or dark one.
        ring = (r > 4) & (r < 26)
        assert drawn[ring].mean() == pytest.approx(
            0.5, abs=4 * 0.3 * 0.5 * np.sqrt(ring.sum() ** 0.5 * 6) / ring.sum() ** 0.75
        )


def test_a_stars_middle_is_an_even_grey() -> None:
    """Spokes narrower than a tenth of a sample average to the duty."""
    star = SiemensStar((31.5, 31.5), 28.0, 500, DARK, LIGHT)
    drawn = covered(star, Grid(64, 64, 1, 0))
    assert drawn[28:36, 28:36] == pytest.approx(0.5, abs=0.05)
    assert drawn[30:34, 30:34].mean() == pytest.approx(0.5, abs=0.005)


@given(st.floats(5, 20), st.floats(5, 20), st.floats(0.01, 3.0), st.integers(1, 4))
def test_a_point_has_its_light_wherever_it_is(row: float, col: float, side: float, oversample: int) -> None:
    grid = Grid(26, 26, oversample, 2)
    drawn = covered(PointArray(((row, col),), side, DARK, LIGHT), grid)
    assert drawn.sum() / oversample**2 == pytest.approx(side**2, rel=1e-9)
    assert drawn.max() <= 1 + 1e-12
    if side <= 1 / oversample:
        at_row, at_col = grid.axes_px()
        share = drawn / drawn.sum()
        assert share.sum(1) @ at_row == pytest.approx(row, abs=1e-9)
        assert share.sum(0) @ at_col == pytest.approx(col, abs=1e-9)


def test_points_that_overlap_are_refused() -> None:
    with pytest.raises(ValueError, match="farther apart"):
        draw(PointArray(((10.0, 10.0), (10.2, 10.0)), 1.0, DARK, LIGHT), Grid(20, 20))


def test_ramps_rise_as_they_say() -> None:
    grid = Grid(10, 40, 2, 0)
    _, col = grid.axes_px()
    linear = covered(Ramp((4.5, 19.5), 40.0, DARK, LIGHT), grid)
    np.testing.assert_allclose(linear, np.broadcast_to((col + 0.5) / 40, grid.shape), atol=1e-12)
    steps = covered(Ramp((4.5, 19.5), 40.0, DARK, LIGHT, steps=5), grid)
    np.testing.assert_allclose(steps[0], np.repeat([0, 0.25, 0.5, 0.75, 1], 16), atol=1e-9)
    down = covered(Ramp((4.5, 19.5), 10.0, DARK, LIGHT, angle_deg=90.0), grid)
    np.testing.assert_allclose(down[:, 0], (grid.axes_px()[0] + 0.5) / 10, atol=1e-12)
    back = covered(Ramp((4.5, 19.5), 40.0, DARK, LIGHT, angle_deg=180.0), grid)
    np.testing.assert_allclose(back, 1 - linear, atol=1e-12)


def test_an_even_field_is_all_ground() -> None:
    drawing = draw(UniformField(LIGHT), Grid(4, 4))
    assert drawing.ground == (LIGHT, None)
    assert drawing.layers == ()


# --- cubes and screens
# -------------------------------------------------------------------------------------------------


def test_a_cube_keeps_its_radiance_and_its_light() -> None:
    rng = np.random.default_rng(5)
    cube = rng.random((12, 16, 4))
    bands = (400.0, 480.0, 600.0, 700.0)
    aligned = draw(SpectralImage(bands, cube), Grid(12, 16, 2, 3))
    for k, layer in enumerate(aligned.layers):
        assert layer.window == (slice(6, 30), slice(6, 38))
        np.testing.assert_array_equal(blocks(layer.coverage, 2), cube[:, :, k])
    # The triangles add up to any radiance's own curve.
    w = np.linspace(380, 720, 35)
    curve = sum(cube[3, 4, k] * layer.light[0].at(w) for k, layer in enumerate(aligned.layers))
    np.testing.assert_allclose(curve, Spectrum.of(bands, cube[3, 4]).at(w), atol=1e-15)
    # Elsewhere each sample covers its own area: 3.1 x 2.2 px, turned and not.
    for turn in (0.0, 0.2):
        c, s = np.cos(turn), np.sin(turn)
        warp = Warp.of([(3.1 * c, -2.2 * s, 20.0), (3.1 * s, 2.2 * c, 9.0), (0, 0, 1)])
        drawn = draw(SpectralImage(bands, cube, warp), Grid(50, 80, 2, 3))
        for k, layer in enumerate(drawn.layers):
            # A square that holds a turned corner is a product of shares: a few hundredths, of either sign, of few
            # squares.
            tolerance = 1e-12 if turn == 0 else 2e-4
            assert layer.coverage.sum() / 4 == pytest.approx(cube[:, :, k].sum() * 3.1 * 2.2, rel=tolerance)


POSE: dict[str, Any] = {
    "rotation": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "translation_mm": (-6.0, -4.0, 100.0),
    "geometry": Geometry(camera_matrix=((400.0, 0.0, 29.5), (0.0, 400.0, 19.5), (0.0, 0.0, 1.0))),
}


def screen(**changes: Any) -> Screen:
    primaries = tuple(Spectrum.of([400.0, 500.0, 600.0, 700.0], v) for v in ([0, 0, 1, 2], [0, 2, 1, 0], [3, 1, 0, 0]))
    return Screen(primaries=primaries, black_radiance=LIGHT.scale(0.01), **changes)


@pytest.mark.parametrize(
    "sub_pixels", [None, SubPixels(), SubPixels(width=1 / 3, height=1.0), SubPixels(width=0.1, height=0.5, order="BGR")]
)
@pytest.mark.parametrize("turn", [0.0, 0.15])
def test_a_screens_light_is_its_drives_whatever_its_sub_pixels(sub_pixels: SubPixels | None, turn: float) -> None:
    codes = np.random.default_rng(2).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    c, s = np.cos(turn), np.sin(turn)
    pose = POSE | {"rotation": ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)), "translation_mm": (-5.0, -4.0, 100.0)}
    shown = ScreenImage(screen(sub_pixels=sub_pixels, gamma=(2.2, 2.0, 1.8)), codes, 1.0, **pose)
    drawing = draw(shown, Grid(60, 80, 3, 4))
    assert drawing.ground[0] is not None
    assert not any(drawing.ground[0].value)
    # A screen's pixel is 4 px wide on the camera; stripes of 0.4 px under a turned grid leave a product's error at
    # corners.
    tolerance = 1e-12 if turn == 0 else 3e-3
    assert drawing.layers[0].coverage.sum() / 9 == pytest.approx(8 * 12 * 16, rel=tolerance)
    for k, layer in enumerate(drawing.layers[1:]):
        drive = (codes[:, :, k] / 255) ** (2.2, 2.0, 1.8)[k]
        assert layer.light[0] == shown.screen.primaries[k]
        assert layer.coverage.sum() / 9 == pytest.approx(drive.sum() * 16, rel=tolerance)


def test_sub_pixels_lie_where_they_are_said_to() -> None:
    shown = ScreenImage(
        screen(sub_pixels=SubPixels(width=0.25, height=0.5)),
        np.full((1, 1, 3), 255, np.uint8),
        5.0,
        POSE["rotation"],
        (-2.5, -2.5, 100.0),
        POSE["geometry"],
    )
    grid = Grid(40, 60, 4, 0)
    row, col = grid.axes_px()
    for k, layer in enumerate(draw(shown, grid).layers[1:]):
        share = layer.coverage / layer.coverage.sum()
        assert share.sum(0) @ col == pytest.approx(29.5 + 20 * ((k + 0.5) / 3 - 0.5), abs=1e-9)
        assert share.sum(1) @ row == pytest.approx(19.5, abs=1e-9)
        # a box of 20 px x 0.25, drawn by area
        assert layer.coverage.max() == pytest.approx(1 / (0.25 * 0.5), rel=1e-12)
        assert (layer.coverage > 1e-9).sum() / 16 == pytest.approx(5.0 * 10.0, rel=0.1)


def test_a_screen_falls_off_with_the_angle_of_view() -> None:
    codes = np.full((8, 12, 3), 255, np.uint8)
    even, falling = (
        draw(ScreenImage(screen(falloff_exponent=n), codes, 1.0, **POSE), Grid(40, 60, 2, 0)) for n in (0.0, 3.0)
    )
    # Facing the camera at 400 px of focal length, a point at r px of the axis is seen at atan(r / 400) off its normal.
    row, col = Grid(40, 60, 2, 0).axes_px()
    cosine = 400 / np.sqrt(400**2 + (row[:, None] - 19.5) ** 2 + (col[None, :] - 29.5) ** 2)
    for one, other in zip(even.layers, falling.layers, strict=True):
        np.testing.assert_allclose(other.coverage, one.coverage * cosine**3, atol=1e-12)
    # Turned by 60 degrees about its upright axis through the middle, the middle is seen at 60 degrees.
    c, s = 0.5, np.sqrt(0.75)
    turned = ScreenImage(
        screen(falloff_exponent=2.0),
        codes,
        1.0,
        ((c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)),
        (-6.0 * c, -4.0, 100.0 + 6.0 * s),
        POSE["geometry"],
    )
    assert turned.cosine(np.array([19.5, 20.5]), np.array([29.5, 30.5]))[0, 0] == pytest.approx(0.5, rel=1e-9)


def test_black_and_white_codes_are_a_screens_pattern(mono_camera: CameraModel) -> None:
    """The screen's model and the pattern of cells that the recordings' screens show are one thing at codes 0 and
    255.
    """
    pattern = np.random.default_rng(4).integers(0, 2, (8, 12), dtype=np.uint8)
    codes = np.repeat(255 * pattern[:, :, None], 3, axis=2)
    image = ScreenImage(screen(gamma=(1.0, 2.2, 3.0)), codes, 1.0, **POSE)
    # Around a pattern the screen is dark but leaks; around a picture there's no screen.
    framed = np.pad(codes, ((5, 5), (5, 5), (0, 0)))
    image = replace(image, codes=framed, translation_mm=(-11.0, -9.0, 100.0))
    shown = ScreenPattern(
        pattern, ScreenImage(image.screen, codes, 1.0, **POSE).warp(), LIGHT.scale(0.01), image.screen.white_radiance
    )
    camera = mono_camera.model_copy(update={"rows": 40, "cols": 60})
    one, other = (
        sim_frame.expected_electrons(camera, Exposure(scene, 0.001), oversample=2, margin_px=4)
        for scene in (image, shown)
    )
    # The two spread their lights over wavelengths by other Gauss rules, each within 1e-3 of the transfer.
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-3 * np.max(other))
