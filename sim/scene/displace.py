"""A compiled loop that moves a drawing: samples between samples by cubic splines.

Import it where it is used, not at the top of a module: the compiler's library takes a while to load.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import spline_filter

from sim.optics.bspline import spline_weights
from sim.spectrum import FloatArray


def displace_drawing(
    drawn: NDArray[np.floating[Any]], from_row_px: FloatArray, from_col_px: FloatArray, oversample: int
) -> FloatArray:
    """Return a drawing's samples taken at other places, (n oversample, m oversample) as `drawn`.

    `from_row_px`, `from_col_px`: (n + 2, m + 2) places in pixels of the drawing, the first of which has its centre at
    (0, 0), that the light at its pixels comes from, with one more pixel all round; linear between them. Outside the
    drawing its border goes on. A cubic B-spline goes through the samples (Unser, IEEE Signal Process. Mag. 16(6),
    1999).
    """
    out = np.empty(drawn.shape)
    _displace(spline_filter(drawn, mode="nearest"), from_row_px, from_col_px, oversample, out)
    return out


@njit(cache=True)
def _displace(coefficients, from_row_px, from_col_px, oversample, out):  # type: ignore[no-untyped-def]
    rows, cols = coefficients.shape
    w_row, w_col = np.empty(4), np.empty(4)
    at_row, at_col = np.empty(4, np.int64), np.empty(4, np.int64)
    for i in range(rows):
        y = (i + 0.5) / oversample + 0.5  # in pixels of the places, which start one before the drawing
        r = int(y)
        dy = y - r
        for j in range(cols):
            x = (j + 0.5) / oversample + 0.5
            c = int(x)
            dx = x - c
            a, b, d, e = (1 - dy) * (1 - dx), (1 - dy) * dx, dy * (1 - dx), dy * dx
            row_px = (
                a * from_row_px[r, c]
                + b * from_row_px[r, c + 1]
                + d * from_row_px[r + 1, c]
                + e * from_row_px[r + 1, c + 1]
            )
            col_px = (
                a * from_col_px[r, c]
                + b * from_col_px[r, c + 1]
                + d * from_col_px[r + 1, c]
                + e * from_col_px[r + 1, c + 1]
            )
            _taps((row_px + 0.5) * oversample - 0.5, rows, w_row, at_row)
            _taps((col_px + 0.5) * oversample - 0.5, cols, w_col, at_col)
            total = 0.0
            for k in range(4):
                line = 0.0
                for m in range(4):
                    line += w_col[m] * coefficients[at_row[k], at_col[m]]
                total += w_row[k] * line
            out[i, j] = total


@njit(cache=True, inline="always")
def _taps(place, count, weight, at):  # type: ignore[no-untyped-def]
    """Weights of the four cubic B-splines about a place, and whose they are, the ends standing for what lies
    outside.
    """
    place = min(max(place, -1.0), float(count))
    first = int(np.floor(place))
    weight[0], weight[1], weight[2], weight[3] = spline_weights(place - first)
    for k in range(4):
        at[k] = min(max(first - 1 + k, 0), count - 1)
