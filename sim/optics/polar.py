"""Looking up a spline over share of the cutoff and direction, compiled. Imported where it's needed: the compiler takes
a second.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.spectrum import FloatArray


@njit(cache=True)  # type: ignore[untyped-decorator]
def look_up(
    fx: FloatArray, fy: FloatArray, scale: float, pad: int, table: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Value at the frequencies fx, fy (both (n, m), any strides) of a cubic spline with coefficients `table`
    (pad + shares + pad, angles); `scale` x frequency is the share of the cutoff, 0..1 over the rows between the pads. 1
    from the cutoff on.
    """
    rows, columns = table.shape[0] - 2 * pad - 1, table.shape[1]
    turn = columns / (2.0 * math.pi)
    out = np.ones(fx.shape, np.complex128)
    along, across = np.empty(4), np.empty(4)
    for i in range(fx.shape[0]):
        for j in range(fx.shape[1]):
            x, y = fx[i, j], fy[i, j]
            share = math.sqrt(x * x + y * y) * scale
            if share >= 1.0:
                continue
            place = pad + share * rows
            angle = math.atan2(y, x) * turn
            row, column = int(place), math.floor(angle)
            _weights(place - row, along)
            _weights(angle - column, across)
            total = 0.0 + 0.0j
            for a in range(4):
                part = 0.0 + 0.0j
                for b in range(4):
                    part += across[b] * table[row - 1 + a, (column - 1 + b) % columns]
                total += along[a] * part
            out[i, j] = total
    return out


@njit(cache=True)  # type: ignore[untyped-decorator]
def _weights(t: float, weight: FloatArray) -> None:
    """The four cubic B-splines that overlap at the share t of a step."""
    u = 1.0 - t
    weight[0] = u * u * u / 6.0
    weight[1] = 2.0 / 3.0 - 0.5 * t * t * (2.0 - t)
    weight[2] = 2.0 / 3.0 - 0.5 * u * u * (2.0 - u)
    weight[3] = t * t * t / 6.0
