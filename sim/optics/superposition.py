"""Shift-variant blur: the superposition of the point spread functions of all points of a picture.

    image(x) = sum over sources s of light(s) PSF(x - s; field of s)

The picture lies where the lens images it (`sim.optics.distorted`). It is averaged over the pixel's aperture first, as a
lens changes too little across a pixel for the order to matter, and cut into tiles of sources. Within a tile the kernel
of a source at s is a cubic polynomial in s, tap by tap (`sim.optics.kernels`). A polynomial in s is a polynomial
in x of the same degree, so that a tile adds to a pixel a blend of sixteen sums over its sources. Kernels have the sum
that the lens table states there, and only the requested pixels are computed.

Light outside the table's window, and in its corners, is spread as 1 / r^3, as an edge diffracts it. Energy is
conserved: the light of a source arrives with the share 1, on or off the frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft

from sim.optics.field_mapping import over_field
from sim.optics.kernels import NODES, Kernels, Tile, lagrange
from sim.scene.render import Grid
from sim.spectrum import FloatArray

Float32Array = NDArray[np.float32]

#: Pixels of a row that are summed at once.
BLOCK_PX = 16
#: Side, px, of the squares on which light outside the table's window is spread.
WING_CELL_PX = 4


def superpose(
    picture: Float32Array,
    grid: Grid,
    kernels: Kernels,
    places: Sequence[Sequence[tuple[int, int]]],
    period: int,
    image: FloatArray,
    tiles: Sequence[Tile] | None = None,
) -> None:
    """Add to `image` (rows, cols) a picture on the image's grid, blurred by the kernels of every channel. Raises
    ValueError for a margin that is too narrow.

    `places`: for every channel of `kernels`, the first [row, col] of each of its lattices of `period` px; only those
    pixels change. `tiles` None: those of `kernels.tiles`.
    """
    frame, s = kernels.frame, grid.oversample
    half = (kernels.size - s) // 2  # samples before a pixel's first
    halo = kernels.halo_px
    if grid.margin_px < halo:
        raise ValueError(
            f"the margin of {grid.margin_px} px is below the limit of {halo} px that the lens's window of "
            f"{2 * kernels.radius_um:g} um asks for: take a wider margin"
        )
    through_pixels = kernels.through_pixels(picture)
    taps = _taps_in_circle(kernels)
    for tile in kernels.tiles(grid) if tiles is None else tiles:
        top, bottom, left, right = tile.top, tile.bottom, tile.left, tile.right
        g = _by_pixel(kernels.at_nodes(tile), kernels, bottom - top, right - left)
        # the tile's sources in a border of zeros, columns sorted by their position in the lattice
        origin = (top - halo) * s - half, (left - halo) * s - half
        high = (bottom + halo) * s + half - origin[0]
        stride = period * s
        # wider, as taps come in fours and pixels in blocks
        wide = (right + halo) * s + half + 4 - origin[1] + BLOCK_PX * stride
        local = np.zeros((high, -(-wide // stride) * stride), np.float32)
        part = through_pixels[
            (top + grid.margin_px) * s : (bottom + grid.margin_px) * s,
            (left + grid.margin_px) * s : (right + grid.margin_px) * s,
        ]
        down, across = top * s - origin[0], left * s - origin[1]
        correction = _light_correction(kernels, tile, part.shape)
        local[down : down + part.shape[0], across : across + part.shape[1]] = (
            part if correction is None else part * correction
        )
        columns = np.ascontiguousarray(local.reshape(high, -1, stride).transpose(2, 0, 1))
        seen_rows = max(top - halo, 0), min(bottom + halo, frame.rows)
        seen_cols = max(left - halo, 0), min(right + halo, frame.cols)
        for channel, lattices in enumerate(places):
            for row0, col0 in lattices:
                first = seen_rows[0] + (row0 - seen_rows[0]) % period, seen_cols[0] + (col0 - seen_cols[0]) % period
                _gather(
                    image, columns, g[channel], taps, (first[0], seen_rows[1]), (first[1], seen_cols[1]), period, s,
                    (half + origin[0], half + origin[1]), (top - 0.5, bottom - 0.5), (left - 0.5, right - 0.5),
                )  # fmt: skip
    _spread_wings(picture, grid, kernels, places, period, image)


def _taps_in_circle(kernels: Kernels) -> NDArray[np.int64]:
    """(size, 2): for every row of a kernel, the first tap that may differ from 0 and the end of the last, in multiples
    of four.
    """
    away = np.arange(kernels.size) - 0.5 * (kernels.size - 1)
    radius = kernels.reach_um / kernels.step_um + (kernels.box - 1) / np.sqrt(2.0)
    wide = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    first = np.ceil(0.5 * (kernels.size - 1) - wide).astype(np.int64)
    count = np.where(wide > 0, kernels.size - 2 * first, 0)
    return np.stack([first, first + count + (-count) % 4], axis=1)


def _light_correction(kernels: Kernels, tile: Tile, shape: tuple[int, ...]) -> Float32Array | None:
    """Factors on a tile's sources that replace the polynomials' light by the table's: at 17 x 17 points, linear
    between. None where light may be negative, so that there is no ratio.
    """
    if np.min(kernels.light) < 0 or np.min(np.sum(kernels.light - kernels.lost, axis=0)) <= 0:
        return None
    at = np.linspace(0.0, 1.0, 17)
    light = [
        np.sum(kernels.held(*kernels.frame.um(*tile.place(*np.meshgrid(t, t, indexing="ij")))), axis=0)
        for t in (at, NODES)
    ]
    share = lagrange(at)
    ratio = light[0] / (share.T @ light[1] @ share)
    down, across = (
        np.maximum(1.0 - np.abs((np.arange(n) + 0.5)[:, None] * (at.size - 1) / n - np.arange(at.size)), 0.0)
        for n in shape
    )
    return np.asarray(down @ ratio @ across.T, np.float32)


def _by_pixel(at_nodes: Float32Array, kernels: Kernels, height: int, width: int) -> Float32Array:
    """Return a tile's kernels (4, 4, C, size, size) as polynomials in the position of the *pixel* instead of the
    source: (C, 4, 4, size, size).

    With the nodes t_m, L_i(t + tau) = sum_m L_i(t_m + tau) L_m(t): a polynomial in the position of a source at tau from
    the pixel is one in the position of the pixel.
    """
    tau_px = (np.arange(kernels.size) - 0.5 * (kernels.size - 1)) / kernels.oversample
    by_row, by_col = (
        np.moveaxis(lagrange(NODES[:, None] + tau_px[None, :] / n), 0, -1).astype(np.float32)  # [node, tap, i]
        for n in (height, width)
    )
    g = np.einsum("mai,ijcab->mjcab", by_row, at_nodes)
    return np.ascontiguousarray(np.einsum("kbj,mjcab->cmkab", by_col, g))


def _spread_wings(
    picture: Float32Array,
    grid: Grid,
    kernels: Kernels,
    places: Sequence[Sequence[tuple[int, int]]],
    period: int,
    image: FloatArray,
) -> None:
    """Add the light outside the table's circle of radius a: a / (2 pi r^3) per area beyond it, on cells of a few
    pixels.
    """
    frame, table = kernels.frame, kernels.table
    if not np.any(np.abs(kernels.lost) > 1e-9 * np.abs(kernels.lost).max(initial=0.0)):
        return
    cell = WING_CELL_PX * grid.oversample
    whole = [n // cell * cell for n in picture.shape]  # leaves out some of the margin
    light = (
        picture[: whole[0], : whole[1]].reshape(whole[0] // cell, cell, -1, cell).sum(axis=3).sum(axis=1, dtype=float)
    )
    light /= grid.oversample**2  # in pixels' light
    rows, cols = light.shape
    middle = (0.5 * (WING_CELL_PX - 1)) - grid.margin_px
    row, col = np.arange(rows) * WING_CELL_PX + middle, np.arange(cols) * WING_CELL_PX + middle
    kernel = _wing(rows, cols, WING_CELL_PX * frame.pitch_um, kernels.radius_um)
    shape = tuple(fft.next_fast_len(2 * n, real=True) for n in light.shape)
    transfer = fft.rfft2(kernel, shape)
    x, y = frame.um(row[:, None], col[None, :])
    at_row = (np.arange(frame.rows) - row[0]) / WING_CELL_PX
    at_col = (np.arange(frame.cols) - col[0]) / WING_CELL_PX
    for lattices, lost in zip(places, kernels.lost, strict=True):
        share = over_field(table, lost, *np.broadcast_arrays(x, y))
        spread = fft.irfft2(fft.rfft2(light * share, shape) * transfer, shape)[
            rows - 1 : 2 * rows - 1, cols - 1 : 2 * cols - 1
        ]
        spread = spread / WING_CELL_PX**2
        for row0, col0 in lattices:
            image[row0::period, col0::period] += _bilinear(spread, at_row[row0::period], at_col[col0::period])


def _wing(rows: int, cols: int, cell_um: float, radius_um: float) -> FloatArray:
    """Share of a cell's light in every cell around it, (2 rows - 1, 2 cols - 1); near cells are averaged over 16 x 16
    points.
    """
    y, x = (np.arange(1 - n, n) * cell_um for n in (rows, cols))
    r = np.hypot(y[:, None], x[None, :])
    out = np.where(r > 0, radius_um * cell_um**2 / (2.0 * np.pi * np.maximum(r, 1e-9) ** 3), 0.0)
    near = int(np.ceil(2.0 * radius_um / cell_um)) + 2
    fine = ((np.arange(16) + 0.5) / 16 - 0.5) * cell_um
    for i in range(-min(near, rows - 1), min(near, rows - 1) + 1):
        for j in range(-min(near, cols - 1), min(near, cols - 1) + 1):
            d = np.hypot(i * cell_um + fine[:, None], j * cell_um + fine[None, :])
            density = np.where(d > radius_um, radius_um / (2.0 * np.pi * np.maximum(d, radius_um) ** 3), 0.0)
            out[rows - 1 + i, cols - 1 + j] = float(np.mean(density)) * cell_um**2
    return out


def _bilinear(values: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
    i = np.clip(row.astype(int), 0, values.shape[0] - 2)
    j = np.clip(col.astype(int), 0, values.shape[1] - 2)
    v, u = (row - i)[:, None], (col - j)[None, :]
    above = values[i][:, j] * (1 - u) + values[i][:, j + 1] * u
    below = values[i + 1][:, j] * (1 - u) + values[i + 1][:, j + 1] * u
    return above * (1 - v) + below * v


@njit(cache=True, fastmath={"contract"})
def _gather(image, columns, g, within, rows, cols, period, oversample, origin, row_range, col_range):  # type: ignore[no-untyped-def]
    """Add a tile's light to the pixels of one lattice: kernels are interpolated for a row, then four sums a pixel along
    it.

    `columns` [k, row, i] is the tile's column stride i + k: neighbouring pixels of the lattice lie side by side in it.
    `origin`: its first row and column, in samples from the first that pixel 0 takes. `within`: a kernel's taps, row by
    row. `row_range`, `col_range`: where the tile lies, px.
    """
    size = g.shape[2]
    stride = period * oversample
    count = (cols[1] - cols[0] + period - 1) // period
    if count <= 0:
        return
    # unsigned offsets into one flat array are faster than views, which are reference-counted and check for negative
    # indices
    flat = columns.ravel()
    plane, line = columns.shape[1] * columns.shape[2], columns.shape[2]
    blend = np.zeros((4, size, size + 4), np.float32)
    share = np.empty(4)
    blocks = (count + BLOCK_PX - 1) // BLOCK_PX
    sums = np.empty((4, blocks * BLOCK_PX), np.float32)
    height, width = row_range[1] - row_range[0], col_range[1] - col_range[0]
    fine_col = cols[0] * oversample - origin[1]
    for row in range(rows[0], rows[1], period):
        _cubic((row - row_range[0]) / height, share)
        w0, w1, w2, w3 = np.float32(share[0]), np.float32(share[1]), np.float32(share[2]), np.float32(share[3])
        for j in range(4):
            for a in range(size):
                for b in range(size):
                    blend[j, a, b] = w0 * g[0, j, a, b] + w1 * g[1, j, a, b] + w2 * g[2, j, a, b] + w3 * g[3, j, a, b]
        sums[:] = 0.0
        base = row * oversample - origin[0]
        for a in range(size):
            at = (base + a) * line
            for b in range(within[a, 0], within[a, 1], 4):
                q = fine_col + b
                o0 = np.uintp((q % stride) * plane + at + q // stride)
                o1 = np.uintp(((q + 1) % stride) * plane + at + (q + 1) // stride)
                o2 = np.uintp(((q + 2) % stride) * plane + at + (q + 2) // stride)
                o3 = np.uintp(((q + 3) % stride) * plane + at + (q + 3) // stride)
                a0, a1, a2, a3 = blend[0, a, b], blend[0, a, b + 1], blend[0, a, b + 2], blend[0, a, b + 3]
                b0, b1, b2, b3 = blend[1, a, b], blend[1, a, b + 1], blend[1, a, b + 2], blend[1, a, b + 3]
                c0, c1, c2, c3 = blend[2, a, b], blend[2, a, b + 1], blend[2, a, b + 2], blend[2, a, b + 3]
                d0, d1, d2, d3 = blend[3, a, b], blend[3, a, b + 1], blend[3, a, b + 2], blend[3, a, b + 3]
                for i in range(blocks * BLOCK_PX):
                    n = np.uintp(i)
                    p0, p1, p2, p3 = flat[o0 + n], flat[o1 + n], flat[o2 + n], flat[o3 + n]
                    sums[0, n] += a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3
                    sums[1, n] += b0 * p0 + b1 * p1 + b2 * p2 + b3 * p3
                    sums[2, n] += c0 * p0 + c1 * p1 + c2 * p2 + c3 * p3
                    sums[3, n] += d0 * p0 + d1 * p1 + d2 * p2 + d3 * p3
        for i in range(count):
            col = cols[0] + i * period
            _cubic((col - col_range[0]) / width, share)
            image[row, col] += (
                share[0] * sums[0, i] + share[1] * sums[1, i] + share[2] * sums[2, i] + share[3] * sums[3, i]
            )


@njit(cache=True, inline="always")
def _cubic(t, out):  # type: ignore[no-untyped-def]
    """`lagrange` for a degree of 3."""
    a, b, c, d = t, t - 1.0 / 3.0, t - 2.0 / 3.0, t - 1.0
    out[0] = -4.5 * b * c * d
    out[1] = 13.5 * a * c * d
    out[2] = -13.5 * a * b * d
    out[3] = 4.5 * a * b * c
