"""A picture on the ideal (undistorted) grid resampled to where the lens images it, its light conserved."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.optics.bspline import spline_weights
from sim.optics.field_mapping import FieldMapping, ImageFrame, exceeds_field, field_mapping
from sim.optics.table import LensTable
from sim.scene.render import Grid
from sim.spectrum import FloatArray

Float32Array = NDArray[np.float32]


def distort(picture: FloatArray, source: Grid, target: Grid, table: LensTable, frame: ImageFrame) -> Float32Array:
    """Return a picture on the ideal grid `source` resampled to where the lens images it, on the grid `target`.

    The light of a sample is its value times the area that its square has in the image. It is distributed around the
    image point with the weights of a cubic B-spline, which add up to 1, so that light is conserved; `superpose` undoes
    the spline's blur. A uniform picture stays uniform. Light that falls off the target is dropped.
    """
    lens = field_mapping(table)
    row, col = source.axes_px()
    first_row, first_col = (axis[0] for axis in target.axes_px())
    out = np.zeros(target.shape, np.float32)
    picture = _visible(picture, row, col, frame, lens)
    if lens.symmetric:
        x, y = frame.um(row, col)
        scale = target.oversample / frame.pitch_um
        origin = (
            (frame.axis[0] - first_row) * target.oversample,
            (frame.axis[1] - first_col) * target.oversample,
        )
        ratio, area, apart = lens.radial(float(np.max(np.abs(x))) ** 2 + float(np.max(np.abs(y))) ** 2)
        _distribute_radially(out, picture, x, y, ratio, area, apart, scale, *origin)
        return out
    step = 2 * source.oversample
    nodes = [np.arange(-step, n + 2 * step, step, dtype=float) for n in (row.size, col.size)]
    node_row, node_col = (axis[0] + n / source.oversample for axis, n in zip((row, col), nodes, strict=True))
    at = np.meshgrid(node_row, node_col, indexing="ij")
    real_row, real_col = frame.px(*lens.real_um(*frame.um(*at)))
    _distribute(
        out,
        picture,
        (real_row - first_row) * target.oversample,
        (real_col - first_col) * target.oversample,
        step,
    )
    return out


def _visible(
    picture: FloatArray, row: FloatArray, col: FloatArray, frame: ImageFrame, lens: FieldMapping
) -> FloatArray:
    """Return the picture with 0 outside the lens's field, where the frame reaches beyond it."""
    if not exceeds_field(frame, lens):
        return picture
    return np.where(lens.lies_outside(*frame.um(row[:, None], col[None, :])), 0.0, picture)


@njit(cache=True)
def _distribute(out, picture, node_row, node_col, step):  # type: ignore[no-untyped-def]
    """Distribute the light of every sample (value x determinant of the map) around its image point; the map is bilinear
    between nodes.
    """
    ny, nx = picture.shape
    inverse = 1.0 / step
    for i in range(ny):
        a = i // step + 1
        v = (i - (a - 1) * step) * inverse
        for j in range(nx):
            value = picture[i, j]
            if value == 0.0:
                continue
            b = j // step + 1
            u = (j - (b - 1) * step) * inverse
            r00, r01, r10, r11 = node_row[a, b], node_row[a, b + 1], node_row[a + 1, b], node_row[a + 1, b + 1]
            c00, c01, c10, c11 = node_col[a, b], node_col[a, b + 1], node_col[a + 1, b], node_col[a + 1, b + 1]
            row_v = ((r10 - r00) * (1.0 - u) + (r11 - r01) * u) * inverse
            row_u = ((r01 - r00) * (1.0 - v) + (r11 - r10) * v) * inverse
            col_v = ((c10 - c00) * (1.0 - u) + (c11 - c01) * u) * inverse
            col_u = ((c01 - c00) * (1.0 - v) + (c11 - c10) * v) * inverse
            row = (r00 * (1.0 - u) + r01 * u) * (1.0 - v) + (r10 * (1.0 - u) + r11 * u) * v
            col = (c00 * (1.0 - u) + c01 * u) * (1.0 - v) + (c10 * (1.0 - u) + c11 * u) * v
            light = value * abs(row_v * col_u - row_u * col_v)
            _drop(out, row, col, light)


@njit(cache=True)
def _distribute_radially(out, picture, x_um, y_um, ratio, area, apart, scale, row0, col0):  # type: ignore[no-untyped-def]
    """`_distribute` for a radial map, from tables over the squared radius."""
    inverse = 1.0 / apart
    for i in range(y_um.size):
        for j in range(x_um.size):
            value = picture[i, j]
            if value == 0.0:
                continue
            at = (x_um[j] * x_um[j] + y_um[i] * y_um[i]) * inverse
            k = int(at)
            t = at - k
            by = ratio[k] + t * (ratio[k + 1] - ratio[k])
            light = value * (area[k] + t * (area[k + 1] - area[k]))
            _drop(out, row0 + y_um[i] * by * scale, col0 + x_um[j] * by * scale, light)


@njit(cache=True, inline="always")
def _drop(out, row, col, light):  # type: ignore[no-untyped-def]
    """Distribute light around a point with a cubic B-spline."""
    k, m = int(np.floor(row)), int(np.floor(col))
    if k >= 1 and m >= 1 and k < out.shape[0] - 2 and m < out.shape[1] - 2:
        a0, a1, a2, a3 = spline_weights(row - k)
        b0, b1, b2, b3 = spline_weights(col - m)
        _add_four(out, k - 1, m - 1, light * a0, b0, b1, b2, b3)
        _add_four(out, k, m - 1, light * a1, b0, b1, b2, b3)
        _add_four(out, k + 1, m - 1, light * a2, b0, b1, b2, b3)
        _add_four(out, k + 2, m - 1, light * a3, b0, b1, b2, b3)


@njit(cache=True, inline="always")
def _add_four(out, k, m, light, b0, b1, b2, b3):  # type: ignore[no-untyped-def]
    out[k, m] += light * b0
    out[k, m + 1] += light * b1
    out[k, m + 2] += light * b2
    out[k, m + 3] += light * b3
