"""Compiled loops over the pixels of a frame: sums by plane, Welford's recursion, spatial sums."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.spectrum import FloatArray

# mypy: disallow-untyped-decorators=False

Float32Array = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@njit(cache=True)
def plane_sums(frame: NDArray[np.uint16], bad: BoolArray, period: int) -> tuple[FloatArray, NDArray[np.int64]]:
    """Sums of a frame (rows, cols) by phase of the mosaic.

    Sums over all pixels and over the good ones (2, phases); the highest code, how often it and 0 come, and less the
    number of bad pixels (4, phases).
    """
    phases = period * period
    sums = np.zeros((2, phases))
    counts = np.zeros((4, phases), np.int64)
    rows, cols = frame.shape
    for i in range(rows):
        for offset in range(period):
            p = (i % period) * period + offset
            total, highest, zeros = np.int64(0), np.int64(0), np.int64(0)
            for j in range(offset, cols, period):
                value = np.int64(frame[i, j])
                total += value
                highest = max(highest, value)
                zeros += value == 0
            sums[0, p] += total
            counts[2, p] += zeros
            if highest > counts[0, p]:
                counts[0, p], counts[1, p] = highest, 0
            if highest == counts[0, p]:
                for j in range(offset, cols, period):
                    counts[1, p] += frame[i, j] == highest
    sums[1] = sums[0]
    if bad.size > 0:
        for i in range(rows):
            for j in range(cols):
                if bad[i, j]:
                    p = (i % period) * period + j % period
                    sums[1, p] -= frame[i, j]
                    counts[3, p] -= 1
    return sums, counts


@njit(cache=True)
def add_frame(
    frame: NDArray[np.uint16],
    mean: Float32Array,
    squares: Float32Array,
    shift: FloatArray,
    bad: BoolArray,
    period: int,
    count: int,
    products: FloatArray,
    pairs: NDArray[np.int64],
    row_squares: FloatArray,
) -> None:
    """Add frame number `count` (from 2) to `mean` and `squares`, by Welford's recursion.

    `shift` (phases,): by how much the mean of each phase lies above that of `mean`. `products`, `pairs` (2, phases):
    sums of products of adjacent and of diagonal neighbours, and their numbers. `row_squares` (phases,): sums over the
    rows of the squared sum of a row over its number of pixels.
    """
    rows, cols = frame.shape
    share, inverse = np.float32((count - 1) / count), np.float32(1.0 / count)
    above, row = np.zeros(cols, np.float32), np.zeros(cols, np.float32)
    some_bad = bad.size > 0
    for i in range(rows):
        first = (i % period) * period
        for j in range(cols):
            delta = np.float32(frame[i, j]) - mean[i, j] - np.float32(shift[first + j % period])
            mean[i, j] += delta * inverse
            squares[i, j] += delta * delta * share
            row[j] = np.float32(0.0) if some_bad and bad[i, j] else delta
        # Sums of a row in single precision, of the frame in double: exact to 1e-6
        for offset in range(period):
            here, there = first + offset, first + (offset + 1) % period
            beside = np.float32(0.0)
            for j in range(offset, cols - 1, period):
                beside += row[j] * row[j + 1]
            number = len(range(offset, cols - 1, period))
            total = 0.0
            for j in range(offset, cols, period):
                total += row[j]
            row_squares[here] += share * total * total / len(range(offset, cols, period))
            for p in (here, there):
                products[0, p] += share * beside
                pairs[0, p] += number
            if i == 0:
                continue
            upper = ((i - 1) % period) * period
            straight = np.float32(0.0)
            for j in range(offset, cols, period):
                straight += row[j] * above[j]
            for p in (here, upper + offset):
                products[0, p] += share * straight
                pairs[0, p] += len(range(offset, cols, period))
            left, right = np.float32(0.0), np.float32(0.0)
            for j in range(offset, cols - 1, period):
                right += row[j] * above[j + 1]
                left += row[j + 1] * above[j]
            other = upper + (offset + 1) % period
            for p in (here, other):
                products[1, p] += share * right
                pairs[1, p] += number
            for p in (there, upper + offset):
                products[1, p] += share * left
                pairs[1, p] += number
        above, row = row, above


@njit(cache=True)
def pattern_sums(
    image: Float32Array, surface: Float32Array, bad: BoolArray, mean: float, good_mean: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Spatial sums of an image.

    Of image - mean over all pixels: sum of squares, sums of rows and of columns. Of image - good_mean over good
    pixels: sum and sum of squares. Of image - surface over good pixels: sum, sum of squares, largest modulus, sums of
    rows and of columns.
    """
    rows, cols = image.shape
    sums = np.zeros(6)
    row_sums, col_sums, row_rest, col_rest = np.zeros(rows), np.zeros(cols), np.zeros(rows), np.zeros(cols)
    some_bad = bad.size > 0
    for i in range(rows):
        for j in range(cols):
            value = float(image[i, j])
            from_mean = value - mean
            sums[0] += from_mean * from_mean
            row_sums[i] += from_mean
            col_sums[j] += from_mean
            if some_bad and bad[i, j]:
                continue
            good = value - good_mean
            sums[1] += good
            sums[2] += good * good
            rest = value - surface[i, j]
            sums[3] += rest
            sums[4] += rest * rest
            sums[5] = max(sums[5], abs(rest))
            row_rest[i] += rest
            col_rest[j] += rest
    return sums, row_sums, col_sums, row_rest, col_rest
