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

    The sums over the windows of all elements are those over the window of the last element, updated by the rows and columns that enter and
    leave: O(support^2 pixels) instead of O(support^4 pixels).
    """
    s, h = support, support // 2
    rows, cols = sharp.shape
    tall, wide = rows - 2 * h, cols - 2 * h
    offset = float(sharp.mean())  # centred values: no digits are lost to the mean
    u = sharp - offset
    padded = np.pad(u, ((s - 1, 0), (s - 1, s - 1)))
    i, j = np.arange(s)[:, None, None], np.arange(s)[:, None]
    gram = np.zeros((s, s, s, s))
    for down in range(s):
        # Element (i, j) sees the window that begins at (2 h - i, 2 h - j), element (i + down, j') the one `down` rows above
        sums = _lagged_sums(u, padded[s - 1 - down : s - 1 - down + rows], tall, wide)
        part = sums[s - 1 - i[: s - down], s - 1 - j, s - 1 + j - j.T]
        at = np.arange(s - down)
        gram[at, :, at + down, :] = part
        gram[at + down, :, at, :] = part.transpose(0, 2, 1)
    means = _window_sums(u, tall, wide)[::-1, ::-1].ravel()
    # Back from the centred values: sharp = u + offset
    count = tall * wide
    full = gram.reshape(s * s, s * s) + offset * (means[:, None] + means) + offset**2 * count
    return NormalEquations(full, *normal_equations_right(sharp, blurred, support), count)


def _window_sums(picture: Array, tall: int, wide: int) -> Array:
    """Sums (s, s) of a picture (rows, cols) over all its windows of `tall` x `wide`, s = rows - tall + 1."""
    cumulative = np.pad(picture.cumsum(axis=0), ((1, 0), (0, 0)))
    by_row = np.pad((cumulative[tall:] - cumulative[: len(cumulative) - tall]).cumsum(axis=1), ((0, 0), (1, 0)))
    return np.asarray(by_row[:, wide:] - by_row[:, : by_row.shape[1] - wide])


def _lagged_sums(u: Array, other: Array, tall: int, wide: int) -> Array:
    """Sums (s, s, 2 s - 1) of u[r, c] other[r, c + lag] over the windows of `tall` x `wide` that begin at (row, col).

    `u` (rows, cols), `other` (rows, cols + 2 s - 2), s = cols - wide + 1. Over the first window by matrix products of blocks of columns, of
    which the diagonals are the lags; over the others by what their rows and columns add and leave out.
    """
    cols = u.shape[1]
    s = cols - wide + 1
    lags = 2 * s - 1
    by_column = np.empty((cols, lags))  # over the first `tall` rows
    for first in range(0, cols, 2 * s):
        last = min(first + 2 * s, cols)
        products = u[:tall, first:last].T @ other[:tall, first : last + lags - 1]
        row, item = products.strides
        by_column[first:last] = np.lib.stride_tricks.as_strided(products, (last - first, lags), (row + item, item))
    views = np.lib.stride_tricks.sliding_window_view(other, lags, axis=1)  # (rows, cols, lags)
    enters, leaves = np.arange(tall, tall + s - 1), np.arange(s - 1)
    # Down the rows: over the first `wide` columns together, and each column that a window further right leaves out or adds
    within = np.empty((s, lags))
    within[0] = by_column[:wide].sum(axis=0)
    row_sums = _row_products(u[:, :wide], other[:, : wide + lags - 1], np.concatenate([enters, leaves]))
    within[1:] = within[0] + np.cumsum(row_sums[: s - 1] - row_sums[s - 1 :], axis=0)
    change = np.empty((s, s - 1, lags))  # of a window one further right
    change[0] = by_column[wide:] - by_column[: s - 1]
    right, left = slice(wide, None), slice(None, s - 1)
    added = [u[rows, at, None] * views[rows, at] for rows in (enters, leaves) for at in (right, left)]
    change[1:] = change[0] + np.cumsum(added[0] - added[1] - added[2] + added[3], axis=0)
    out = np.empty((s, s, lags))
    out[:, 0] = within
    out[:, 1:] = within[:, None] + np.cumsum(change, axis=1)
    return out


def _row_products(u: Array, other: Array, rows: NDArray[np.int64]) -> Array:
    """Sums (rows, lags) of u[r, c] other[r, c + lag] over the columns, for chosen `rows`."""
    views = np.lib.stride_tricks.sliding_window_view(other, u.shape[1], axis=1)  # (rows, lags, cols)
    return np.array([views[r] @ u[r] for r in rows]).reshape(len(rows), views.shape[1])


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
