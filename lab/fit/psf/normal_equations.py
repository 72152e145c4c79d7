"""Normal equations of blurred = kernel * sharp, without borders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of blurred = kernel * sharp: `gram` (k, k), `right` (k,), `power` = sum of blurred^2, `count`
    samples.
    """

    gram: Array
    right: Array
    power: float
    count: int

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.gram + other.gram, self.right + other.right, self.power + other.power, self.count + other.count
        )


def normal_equations(sharp: Array, blurred: Array, support: int) -> NormalEquations:
    """Exact normal equations over the pixels for which the whole kernel (support, support) sees `sharp`; both pictures
    (rows, cols).

    Each product of `sharp` with itself shifted is summed once over the part common to all windows, and by running sums
    over the margins: O(support^2 pixels) instead of O(support^4 pixels).
    """
    s, h = support, support // 2
    rows, cols = sharp.shape
    tall, wide = rows - 2 * h, cols - 2 * h
    offset = float(sharp.mean())  # centred values: no digits are lost to the mean
    u = sharp - offset
    index = np.arange(s)

    def windows(product: Array) -> Array:
        """Sums over all `tall` x `wide` windows that begin at rows and columns 0..support-1: (support, support)."""
        by_row = np.empty((s, product.shape[1]))
        by_row[0] = product[:tall].sum(axis=0)
        by_row[1:] = by_row[0] + np.cumsum(product[tall : tall + s - 1] - product[: s - 1], axis=0)
        total = np.empty((s, s))
        total[:, 0] = by_row[:, :wide].sum(axis=1)
        total[:, 1:] = total[:, :1] + np.cumsum(by_row[:, wide : wide + s - 1] - by_row[:, : s - 1], axis=1)
        return total

    # Kernel element (i, j) sees the window that begins at (2 h - i, 2 h - j)
    gram = np.zeros((s, s, s, s))
    for di in range(s):
        for dj in range(-(s - 1) if di else 0, s):
            shifted = np.zeros_like(u)
            source = u[: rows - di, max(0, -dj) : cols - max(0, dj)]
            shifted[di:, max(0, dj) : cols - max(0, -dj)] = source
            sums = windows(u * shifted)[::-1, ::-1]  # [i, j]: window of (i, j) with that of (i + di, j + dj)
            ii, jj = np.ix_(index[: s - di], index[max(0, -dj) : s - max(0, dj)])
            part = sums[ii, jj]
            gram[ii, jj, ii + di, jj + dj] = part
            gram[ii + di, jj + dj, ii, jj] = part
    means = windows(u)[::-1, ::-1].ravel()
    # Back from the centred values: sharp = u + offset
    count = tall * wide
    full = gram.reshape(s * s, s * s) + offset * (means[:, None] + means) + offset**2 * count
    return NormalEquations(full, *normal_equations_right(sharp, blurred, support), count)


def normal_equations_right(sharp: Array, blurred: Array, support: int) -> tuple[Array, float]:
    """The parts that depend on `blurred`: the right side (support^2,) and the power."""
    s, h = support, support // 2
    tall, wide = sharp.shape[0] - 2 * h, sharp.shape[1] - 2 * h
    seen = blurred[h : h + tall, h : h + wide]
    offset, level = float(sharp.mean()), float(seen.mean())
    u, b = sharp - offset, seen - level
    right = np.empty((s, s))
    for i in range(s):
        for j in range(s):
            part = u[2 * h - i : 2 * h - i + tall, 2 * h - j : 2 * h - j + wide]
            right[i, j] = np.vdot(part, b) + level * part.sum()
    # blurred = b + level, sum of b over the region 0
    return right.ravel() + offset * level * tall * wide, float(np.vdot(b, b)) + level**2 * tall * wide
