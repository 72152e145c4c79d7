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
SAMPLE = 500_000  # pixels of an image by which it is told where others are clipped
MEDIAN_OF = 5  # most frames whose median shows defective pixels
SMOOTH_PX, LOCAL_PX = 9, 33  # sides of the boxes for the local mean and the local variance of a pixel's surroundings
BLOCK_PX = 3  # side of the blocks for the means that tell where squares are clipped


def from_surroundings(frames: list[Image], step_dn: float = 1.0) -> tuple[Image, Image]:
    """Departures (rows, cols) of the pixels of the frames' lower median from their local mean, without the means of
    rows and columns; and their local standard deviation, DN. `step_dn`: step of the codes."""
    means = [row_means(f, step_dn)[:, None] for f in frames]
    median: Image = np.empty(frames[0].shape, np.float32)
    for start in range(0, len(median), BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        level = np.array([f[rows] - mean[rows] for f, mean in zip(frames, means, strict=True)])
        median[rows] = lower_median(level)

    std = robust_std(median, step_dn)
    flat, _ = without_lines(median, np.clip(median, -CLIP * std, CLIP * std))
    del median
    cut = np.clip(flat, -CLIP * std, CLIP * std)
    for r in range(2):  # the mosaic's four phases
        phases = [cut[r::2, c::2].mean(dtype=float) for c in range(2)]
        flat[r::2] -= np.resize(phases, flat.shape[1]).astype(np.float32)
    np.clip(flat, -CLIP * std, CLIP * std, out=cut)
    around = ndimage.uniform_filter(cut, SMOOTH_PX, mode="mirror")
    np.subtract(flat, around, out=cut)
    # a second pass, so that hot pixels in a glow don't shift the mean around them
    around += ndimage.uniform_filter(np.clip(cut, -CLIP * std, CLIP * std, out=cut), SMOOTH_PX, mode="mirror")
    del cut
    away = np.subtract(flat, around, out=flat)
    del around
    local = np.sqrt(np.maximum(local_variance(np.square(away), 1), 0.25 * step_dn**2)) * np.sqrt(
        SMOOTH_PX**2 / (SMOOTH_PX**2 - 1.0)
    )
    return away, local


def lower_median(images: Image) -> Image:
    """Return the lower median (rows, cols) of a few images (n, rows, cols): of up to five by comparing pairs, which
    takes a tenth of the time of sorting."""
    n, least, most = len(images), np.minimum, np.maximum
    if n > MEDIAN_OF:
        return np.asarray(np.partition(images, (n - 1) // 2, axis=0)[(n - 1) // 2])
    if n < 3:
        return np.asarray(images[0] if n == 1 else least(*images))
    a, b = least(images[0], images[1]), most(images[0], images[1])
    if n == 3:
        return np.asarray(most(a, least(b, images[2])))
    c, d = least(images[2], images[3]), most(images[2], images[3])
    low, high = most(a, c), least(b, d)  # of four, one is below `low` and one above `high`
    if n == 4:
        return np.asarray(least(low, high))
    return np.asarray(most(least(low, high), least(most(low, high), images[4])))


def sampled(image: Image) -> Image:
    """Return some `SAMPLE` pixels of an image, spread evenly over rows, columns and mosaic."""
    step = max(image.size // SAMPLE, 1) | 1  # odd: of all phases of the mosaic
    while step > 1 and image.shape[-1] % step == 0:  # else of few columns
        step += 2
    return np.asarray(image.reshape(-1)[::step])


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
    step of the codes. Of a large image by `SAMPLE` of its pixels: to 0.1 %, as it is where pixels are clipped."""
    pixels = sampled(image)
    low, high = np.quantile(pixels, [0.02, 0.98])
    std = max(float(high - low) / 4.107, 0.3 * step_dn)
    for _ in range(3):
        inside = pixels[np.abs(pixels) < 5.0 * std]
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
    apart = np.diff(cut, axis=1)
    own = (
        float(np.einsum("ij,ij->", apart, apart, dtype=np.float64) / apart.size - np.mean(apart, dtype=float) ** 2)
        / 2.0
    )
    spare: dict[Lines, float] = {
        "rows": float(np.var(np.diff(rows))) / 2.0 - own / cut.shape[1],
        "columns": float(np.var(np.diff(cols))) / 2.0 - own / cut.shape[0],
    }
    mean = float(cut.mean(dtype=np.float64))
    return (image - (rows - mean)[:, None].astype(np.float32) - cols[None, :].astype(np.float32)), spare


def _coarse_means(image: Image) -> Image:
    """Return means over `LOCAL_PX` x `LOCAL_PX` pixels, equal within blocks of `BLOCK_PX` x `BLOCK_PX`: a ninth of the
    time of means about every pixel."""
    short = [-n % BLOCK_PX for n in image.shape]
    whole = np.pad(image, [(0, n) for n in short], mode="edge")
    rows, cols = (n // BLOCK_PX for n in whole.shape)
    blocks = whole.reshape(rows, BLOCK_PX, cols, BLOCK_PX).mean(axis=(1, 3))
    means = ndimage.uniform_filter(blocks, LOCAL_PX // BLOCK_PX, mode="mirror")
    return np.asarray(means.repeat(BLOCK_PX, 0).repeat(BLOCK_PX, 1)[: image.shape[0], : image.shape[1]])


def local_variance(squares: Image, freedom: int) -> Image:
    """Local variance (rows, cols): mean of `squares` over `LOCAL_PX` x `LOCAL_PX` pixels, outliers clipped, over the
    degrees of freedom of a pixel's sum of squares."""
    usual = float(np.mean(np.minimum(squares, 16.0 * freedom * np.median(sampled(squares)) / 0.45)))
    cap = np.float32(64.0 * usual)
    rough = _coarse_means(np.minimum(squares, cap))
    cap_here = 16.0 * rough if freedom == 1 else (1.0 + 12.0 / np.sqrt(freedom)) * rough
    fine = ndimage.uniform_filter(np.minimum(squares, cap_here), LOCAL_PX, mode="mirror")
    return np.asarray(np.maximum(fine / np.float32(freedom), np.float32(1e-3)))
