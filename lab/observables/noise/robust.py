"""Outlying pixels of dark frames, and robust statistics that leave them out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim.sensor.lines import Lines
from sim.spectrum import FloatArray

Image = NDArray[np.float32]

CLIP = 4.5  # standard deviations at which pixels are clipped in robust statistics
SIGNIFICANT = 3.0  # standard deviations from which on a spread isn't that by derived noise
BLOCK_ROWS = 64  # of frames that are compared with each other
MEDIAN_OF = 5  # most frames whose median shows defective pixels
SMOOTH_PX, LOCAL_PX = 9, 33  # sides of the boxes for the local mean and the local variance of a pixel's surroundings


def from_surroundings(frames: list[Image], step_dn: float = 1.0) -> tuple[Image, Image]:
    """Departures (rows, cols) of the pixels of the frames' lower median from their local mean, without the means of
    rows and columns; and their local standard deviation, DN. `step_dn`: step of the codes."""
    means = [row_means(f, step_dn)[:, None] for f in frames]
    median: Image = np.empty(frames[0].shape, np.float32)
    for start in range(0, len(median), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        level = np.array([f[rows] - mean[rows] for f, mean in zip(frames, means, strict=True)])
        median[rows] = np.partition(level, (len(frames) - 1) // 2, axis=0)[(len(frames) - 1) // 2]

    std = robust_std(median, step_dn)
    flat, _ = without_lines(median, np.clip(median, -CLIP * std, CLIP * std))
    step = 2
    for r in range(step):
        for c in range(step):
            phase = flat[r::step, c::step]
            phase -= np.float32(np.mean(np.clip(phase, -CLIP * std, CLIP * std)))
    around = ndimage.uniform_filter(np.clip(flat, -CLIP * std, CLIP * std), SMOOTH_PX, mode="mirror")
    steep = np.clip(flat - around, -CLIP * std, CLIP * std)
    # a second pass, so that hot pixels in a glow don't shift the mean around them
    around += ndimage.uniform_filter(steep, SMOOTH_PX, mode="mirror")
    away = flat - around
    local = np.sqrt(np.maximum(local_variance(np.square(away), 1), 0.25 * step_dn**2)) * np.sqrt(
        SMOOTH_PX**2 / (SMOOTH_PX**2 - 1.0)
    )
    return away, local


def median_std(away: FloatArray, least: float, independent: float = 1.0) -> float:
    """Return the standard deviation of departures (n,) from their median modulus, where that is significantly above
    `least`, their standard deviation by derived noise; else `least`. `independent`: share of them that counts, where
    neighbours have pixels in common.

    The median modulus of n normal numbers has a relative standard deviation of 1.17 / sqrt(n), of which three count:
    the larger of an estimate and its own expectation would be too large by 1.17 / sqrt(n) in half of all cases.
    """
    found = 1.4826 * float(np.median(np.abs(away))) if len(away) else 0.0
    number = max(independent * len(away), 1.0)
    return found if found > least * (1.0 + SIGNIFICANT * 1.17 / np.sqrt(number)) else least


def robust_std(image: Image, step_dn: float = 1.0) -> float:
    """Standard deviation of the pixels within five standard deviations of 0, by iteration; at least a quarter of the
    step of the codes."""
    low, high = np.quantile(image.ravel()[:: max(image.size // 200_000, 1)], [0.02, 0.98])
    std = max(float(high - low) / 4.107, 0.3 * step_dn)
    for _ in range(3):
        inside = image[np.abs(image) < 5.0 * std]
        std = max(float(inside.std(dtype=np.float64)), 0.25 * step_dn)
    return std


def row_means(image: Image, step_dn: float = 1.0) -> Image:
    """Means (rows,) of the rows, pixels clipped at `CLIP` standard deviations."""
    std = robust_std(image, step_dn)
    return np.asarray(np.clip(image, -CLIP * std, CLIP * std).mean(axis=1))


def without_lines(image: Image, cut: Image) -> tuple[Image, dict[Lines, float]]:
    """Return an image less the means of the rows and columns of `cut`, the clipped image; and the variance of these
    means beyond that of independent pixels, by lines. It is taken from differences of neighbouring lines, in which
    smooth structure cancels."""
    rows, cols = cut.mean(axis=1, dtype=np.float64), cut.mean(axis=0, dtype=np.float64)
    own = float(np.var(np.diff(cut, axis=1), dtype=np.float64)) / 2.0
    spare: dict[Lines, float] = {
        "rows": float(np.var(np.diff(rows))) / 2.0 - own / cut.shape[1],
        "columns": float(np.var(np.diff(cols))) / 2.0 - own / cut.shape[0],
    }
    mean = float(cut.mean(dtype=np.float64))
    return (image - (rows - mean)[:, None].astype(np.float32) - cols[None, :].astype(np.float32)), spare


def local_variance(squares: Image, freedom: int) -> Image:
    """Local variance (rows, cols): mean of `squares` over `LOCAL_PX` x `LOCAL_PX` pixels, outliers clipped, over the
    degrees of freedom of a pixel's sum of squares."""
    usual = float(np.mean(np.minimum(squares, 16.0 * freedom * np.median(squares) / 0.45)))
    cap = np.float32(64.0 * usual)
    rough = ndimage.uniform_filter(np.minimum(squares, cap), LOCAL_PX, mode="mirror")
    cap_here = 16.0 * rough if freedom == 1 else (1.0 + 12.0 / np.sqrt(freedom)) * rough
    fine = ndimage.uniform_filter(np.minimum(squares, cap_here), LOCAL_PX, mode="mirror")
    return np.asarray(np.maximum(fine / np.float32(freedom), np.float32(1e-3)))
