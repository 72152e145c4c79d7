"""Superposition of field-dependent point spread functions against exact sums over the sources."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numba import njit

from sim.optics.distorted import distort
from sim.optics.field_mapping import ImageFrame, field_mapping, illumination, source_grid
from sim.optics.kernels import Kernels
from sim.optics.superposition import superpose
from sim.scene.render import Grid
from sim.spectrum import FloatArray

WAVELENGTH = 650.0


@njit(cache=True)
def _exact(x, y, light, first, pitch, half, node, weight, blob, out):  # type: ignore[no-untyped-def]
    """Every source's Gaussians over every pixel's square, by Gauss-Legendre nodes."""
    for s in range(x.size):
        r = np.hypot(x[s], y[s])
        ex, ey = (x[s] / r, y[s] / r) if r > 1e-9 else (0.0, 1.0)
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                dx, dy = first[0] + j * pitch - x[s], first[1] + i * pitch - y[s]
                if abs(dx) > 20.0 or abs(dy) > 20.0:
                    continue
                total = 0.0
                for a in range(node.size):
                    for b in range(node.size):
                        u, v = dx + half * node[a], dy + half * node[b]
                        along, across = u * ex + v * ey, u * ey - v * ex
                        for k in range(blob.shape[1]):
                            t = ((along - blob[s, k, 1]) / blob[s, k, 2]) ** 2 + (across / blob[s, k, 3]) ** 2
                            norm = 2.0 * np.pi * blob[s, k, 2] * blob[s, k, 3]
                            total += weight[a] * weight[b] * blob[s, k, 0] / norm * np.exp(-0.5 * t)
                out[i, j] += light[s] * 0.25 * total * pitch * pitch


def _scene(row: FloatArray, col: FloatArray, side: float) -> FloatArray:
    """Thirty waves below 0.8 cy/px on a ground of 1/2: means over squares of `side` px (0: values)."""
    rng = np.random.default_rng(5)
    out = np.full((row.size, col.size), 0.5)
    for _ in range(30):
        (fy, fx), phase = rng.uniform(-0.8, 0.8, 2), rng.uniform(0, 2 * np.pi)
        wave = np.cos(2 * np.pi * (fy * row[:, None] + fx * col[None, :]) + phase)
        out += 0.05 * np.sinc(fx * side) * np.sinc(fy * side) * wave
    return out


def _weights(lens: Any) -> FloatArray:
    """Light of 650 nm alone, for one channel."""
    table = lens.table()
    weight = np.zeros((1, len(table.field_deg), table.wavelength_nm.size))
    weight[0, :, list(table.wavelength_nm).index(WAVELENGTH)] = 1.0
    return weight


@pytest.mark.parametrize(
    "place", ["middle", "aside", "corner", "all of a small field", "without symmetry", "other grids"]
)
def test_superposition_is_the_exact_sum_over_sources(synthetic_lens: Any, place: str) -> None:
    """3e-3 rms of the image's contrast (its own standard deviation, ten times less than its mean), for lenses that
    change all over 500 px and, harsher than any real one, over 60 px. Sources: four Gauss points to each sample's
    square.
    """
    lens = synthetic_lens(corner_um=250.0 if place.startswith("all") else 2500.0, grid=place == "without symmetry")
    axis = {"aside": (-100.0, -30.0), "corner": (-400.0, -500.0), "without symmetry": (-300.0, -400.0)}.get(
        place, (9.5, 9.5)
    )
    s = 4 if place == "other grids" else 3
    n, pitch = 20, 3.0
    table = lens.table()
    frame = ImageFrame(n, n, pitch, 0.9, axis)
    target = Grid(n, n, s, 16)
    source = source_grid(table, frame, s, 16)
    row, col = source.axes_px()
    kernels = Kernels(table, _weights(lens), frame, s, distorted=True)
    got = np.zeros((n, n))
    distorted = distort(_scene(row, col, 1.0 / s), source, target, table, frame)
    superpose(distorted, target, kernels, [[(0, 0)]], 1, got)

    fine_row, fine_col = ((a[:, None] + np.array([-0.5, 0.5]) / np.sqrt(3.0) / s).ravel() for a in (row, col))
    x, y = np.meshgrid((fine_col - axis[1]) * pitch, (fine_row - axis[0]) * pitch)
    r = np.hypot(x, y)
    h = r / lens.corner_um
    chief = 1.0 + lens.k * h * h
    image_x, image_y = x * chief, y * chief
    first = -axis[1] * pitch, -axis[0] * pitch
    near = (np.abs(image_x - first[0] - 1.5 * n) < 1.5 * n + 22) & (np.abs(image_y - first[1] - 1.5 * n) < 1.5 * n + 22)
    blob = np.stack(
        [np.stack([np.broadcast_to(v, h[near].shape) for v in b], axis=1) for b in lens.blobs(h[near], WAVELENGTH)],
        axis=1,
    )
    light = (_scene(fine_row, fine_col, 0.0) * lens.area(r) * lens.illumination(h))[near] / (2 * s) ** 2
    wanted = np.zeros((n, n))
    half = 0.5 * pitch * np.sqrt(0.9)
    _exact(image_x[near], image_y[near], light, first, pitch, half, *np.polynomial.legendre.leggauss(4), blob, wanted)
    error = np.sqrt(np.mean((got - wanted) ** 2))
    assert error < 3e-3 * np.std(wanted)
    assert got.sum() == pytest.approx(wanted.sum(), rel=5e-5)  # the Gaussians' tails beyond the table's circle


@pytest.mark.parametrize("corner_um", [2500.0, 500.0])
def test_a_sources_light_arrives(synthetic_lens: Any, corner_um: float) -> None:
    """All of it on full pixels, wherever the source stands: 1e-6."""
    lens = synthetic_lens(corner_um=corner_um)
    n = 160
    frame, target, table = ImageFrame(n, n, 3.0, 1.0, (79.5, 79.5)), Grid(n, n, 3, 16), lens.table()
    kernels = Kernels(table, _weights(lens), frame, 3, distorted=True)
    row, col = target.axes_px()
    for i, j in np.random.default_rng(3).integers(120, 400, (6, 2)):
        picture, image = np.zeros(target.shape, np.float32), np.zeros((n, n))
        picture[i, j] = 9.0  # one pixel's light
        superpose(picture, target, kernels, [[(0, 0)]], 1, image)
        x, y = field_mapping(table).ideal_um(*(np.array(a) for a in frame.um(row[i], col[j])))
        wanted = lens.illumination(np.hypot(x, y) / corner_um)
        # the wing of 4e-6 beyond the circle falls off the frame in part
        assert image.sum() == pytest.approx(wanted, rel=1e-6, abs=3e-6 * (corner_um < 1000))


def test_distorting_conserves_light_and_keeps_a_uniform_picture(synthetic_lens: Any) -> None:
    lens = synthetic_lens(k=-0.08)
    table = lens.table()
    frame = ImageFrame(240, 320, 11.0, 1.0, (119.5, 159.5))
    target = Grid(240, 320, 3, 8)
    source = source_grid(table, frame, 3, 8)
    assert source.margin_px > 8  # a barrel draws in what lies beyond the frame
    even = distort(np.ones(source.shape), source, target, table, frame)
    np.testing.assert_allclose(even[12:-12, 12:-12], 1.0, atol=4e-3)  # ripples of samples that stand 24 % closer
    row, col = source.axes_px()
    inside = np.hypot(row[:, None] - 119.5, col[None, :] - 159.5) < 100.0
    picture = np.random.default_rng(0).random(source.shape) * inside
    r = np.hypot(row[:, None] - 119.5, col[None, :] - 159.5) * 11.0
    got = distort(picture, source, target, table, frame)
    assert got.sum(dtype=float) == pytest.approx(np.sum(picture * lens.area(r)), rel=1e-6)


def test_both_kinds_of_tables_distort_alike(synthetic_lens: Any) -> None:
    frame, target = ImageFrame(60, 80, 30.0, 1.0, (29.5, 39.5)), Grid(60, 80, 3, 4)
    pictures = []
    for grid in (False, True):
        table = synthetic_lens(k=-0.05, grid=grid).table()
        source = source_grid(table, frame, 3, 8)
        row, col = source.axes_px()
        smooth = 1.0 + np.sin(row[:, None] / 5.0) * np.cos(col[None, :] / 7.0)
        pictures.append(distort(smooth, source, target, table, frame))
    # Cubic splines over 15 x 17 fields, and straight lines between nodes 2 px apart.
    np.testing.assert_allclose(pictures[0][12:-12, 12:-12], pictures[1][12:-12, 12:-12], atol=5e-3)


def test_distortion_has_an_inverse(synthetic_lens: Any) -> None:
    x, y = np.meshgrid(np.linspace(-1500.0, 1500.0, 7), np.linspace(-1200.0, 1200.0, 6))
    for grid in (False, True):
        lens = field_mapping(synthetic_lens(k=-0.05, grid=grid).table())
        back = lens.ideal_um(*lens.real_um(x, y))
        np.testing.assert_allclose(back[0], x, atol=2e-3)
        np.testing.assert_allclose(back[1], y, atol=2e-3)
    assert lens.lies_outside(np.array([1900.0]), np.array([0.0]))


def test_an_even_scene_takes_the_relative_illumination(synthetic_lens: Any) -> None:
    """In closed form, and scattered: lateral colour spreads its light over 0.06 % more area."""
    lens = synthetic_lens()
    table = lens.table()
    frame, target = ImageFrame(96, 120, 20.0, 1.0, (47.5, 59.5)), Grid(96, 120, 3, 8)
    source = source_grid(table, frame, 3, 8)
    kernels = Kernels(table, _weights(lens), frame, 3, distorted=True)
    got = np.zeros((96, 120))
    superpose(distort(np.ones(source.shape), source, target, table, frame), target, kernels, [[(0, 0)]], 1, got)
    even = illumination(table, _weights(lens)[0], frame)
    x, y = frame.um(np.arange(96.0)[:, None], np.arange(120.0)[None, :])
    ideal = np.hypot(*field_mapping(table).ideal_um(x, y))
    np.testing.assert_allclose(even, lens.illumination(ideal / 2500.0), rtol=1e-6)
    np.testing.assert_allclose(got, even, rtol=1.5e-3)


def test_only_the_lattices_asked_for_are_touched(synthetic_lens: Any) -> None:
    """A mosaic's pixels get what they get in a full image."""
    lens = synthetic_lens()
    table = lens.table()
    frame, target = ImageFrame(50, 70, 3.0, 0.9, (24.5, 300.0)), Grid(50, 70, 3, 16)
    picture = np.random.default_rng(0).random(target.shape).astype(np.float32)
    kernels = Kernels(table, _weights(lens), frame, 3, distorted=False)
    full, part = np.zeros((50, 70)), np.zeros((50, 70))
    superpose(picture, target, kernels, [[(0, 0)]], 1, full)
    superpose(picture, target, kernels, [[(0, 1), (1, 0)]], 2, part)
    np.testing.assert_allclose(part[::2, 1::2], full[::2, 1::2], rtol=2e-5)
    np.testing.assert_allclose(part[1::2, ::2], full[1::2, ::2], rtol=2e-5)
    assert not part[::2, ::2].any()


def test_light_outside_the_window_lies_around_it(synthetic_lens: Any) -> None:
    """A table that holds 97 % of the light: the rest arrives as 1 / r^3, on the frame or off it."""
    lens = synthetic_lens()
    table = lens.table()
    table = replace(table, psf=0.97 * table.psf, encircled_share=0.97 * table.encircled_share, content_hash="dimmed")
    n = 256
    frame, target = ImageFrame(n, n, 3.0, 1.0, (127.5, 127.5)), Grid(n, n, 3, 16)
    picture, image = np.zeros(target.shape, np.float32), np.zeros((n, n))
    at = (128 + 16) * 3 + 1
    picture[at, at] = 9.0
    superpose(picture, target, Kernels(table, _weights(lens), frame, 3, distorted=False), [[(0, 0)]], 1, image)
    radius = 16.0
    d = np.hypot(np.arange(n)[:, None] - 128.0, np.arange(n)[None, :] - 128.0) * 3.0
    for r in (100.0, 200.0, 300.0):
        # beyond r: radius / r of the wing; cells of 12 um blur its rim
        assert image[d < r].sum() == pytest.approx(1.0 - 0.03 * radius / r, abs=3e-4)
    density = np.mean([image[128, 188], image[128, 68], image[188, 128], image[68, 128]]) / 9.0
    assert density == pytest.approx(0.03 * radius / (2 * np.pi * 180.0**3), rel=0.05)


def test_a_frame_beyond_the_lens_is_dark(synthetic_lens: Any) -> None:
    lens = synthetic_lens(corner_um=600.0)
    table = lens.table()
    frame, target = ImageFrame(200, 480, 3.0, 1.0, (99.5, 239.5)), Grid(200, 480, 3, 16)
    source = source_grid(table, frame, 3, 16)
    even = illumination(table, _weights(lens)[0], frame)
    distorted = distort(np.ones(source.shape), source, target, table, frame)
    assert even[100, 5] == 0.0 and even[100, 240] > 0.9
    assert distorted[3 * 116, 3 * 21] == 0.0 and distorted[3 * 116, 3 * 256] == pytest.approx(1.0, abs=1e-4)


def test_too_narrow_a_margin_is_named(synthetic_lens: Any) -> None:
    lens = synthetic_lens()
    frame, target = ImageFrame(40, 40, 3.0, 0.9, (19.5, 19.5)), Grid(40, 40, 3, 2)
    kernels = Kernels(lens.table(), _weights(lens), frame, 3, distorted=False)
    with pytest.raises(ValueError, match=r"margin of 2 px is below the limit of \d+ px .* take a wider margin"):
        superpose(np.zeros(target.shape, np.float32), target, kernels, [[(0, 0)]], 1, np.zeros((40, 40)))
