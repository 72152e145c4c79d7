"""Kernels on samples of a part of a pixel, and the same on the pixels of the sensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


def on_pixels(fine: Array, oversample: int) -> Array:
    """A kernel from samples of 1 / `oversample` px to pixels, sum 1."""
    matrix = pixel_matrix(len(fine), oversample)
    kernel = matrix @ fine @ matrix.T
    return np.asarray(kernel / kernel.sum())


def pixel_matrix(size: int, oversample: int) -> Array:
    """One axis of `on_pixels`, (pixels, size).

    Light spread over a pixel is light spread over `oversample` adjacent samples: a filter with the response sinc(f) /
    sinc(f / oversample).
    """
    reach = oversample
    half = (size // 2 - oversample // 2) // oversample
    taps = symmetric_taps(lambda f: np.sinc(f) / np.sinc(f / oversample), 0.8, oversample, reach)
    matrix = np.zeros((2 * half + 1, size + 2 * reach))
    for row in range(2 * half + 1):
        middle = size // 2 + reach + oversample * (row - half)
        matrix[row, middle - reach : middle + reach + 1] = taps
    return matrix[:, reach : matrix.shape[1] - reach]


def symmetric_taps(response: Callable[[Array], Array], highest_cy_per_px: float, oversample: int, reach: int) -> Array:
    """2 reach + 1 symmetric filter taps on samples of 1 / `oversample` px, sum 1.

    Their frequency response is the least-squares fit of `response` (cy/px) up to `highest_cy_per_px`.
    """
    frequency = np.linspace(0.0, highest_cy_per_px, 61)
    order = np.arange(reach + 1)
    terms = np.cos(2.0 * np.pi * frequency[:, None] * order / oversample) * np.where(order > 0, 2.0, 1.0)
    weight = np.where(frequency == 0.0, 1e3, 1.0)
    # At fine sampling the taps are nearly collinear over the band: the solution of least norm
    taps = np.linalg.lstsq(terms * weight[:, None], weight * response(frequency), rcond=1e-9)[0]
    taps = np.concatenate([taps[:0:-1], taps])
    return np.asarray(taps / taps.sum())
