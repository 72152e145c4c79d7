"""Bernoulli targets blurred by known kernels, in their place and displaced."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.signal import fftconvolve
from scipy.special import j1


def by_area(light, support, over=8):
    """Kernel of a distribution given at points, averaged over the pixels, sum 1."""
    x = (np.arange(support * over) + 0.5) / over - support / 2
    row, col = np.meshgrid(x, x, indexing="ij")
    kernel = light(row, col).astype(float).reshape(support, over, support, over).mean(axis=(1, 3))
    return kernel / kernel.sum()


def gaussian(support, sigma_row, sigma_col, angle_deg=0.0):
    x = np.arange(support) - support // 2
    row, col = np.meshgrid(x, x, indexing="ij")
    a = np.radians(angle_deg)
    u, v = row * np.cos(a) + col * np.sin(a), col * np.cos(a) - row * np.sin(a)
    kernel = np.exp(-0.5 * (u / sigma_row) ** 2 - 0.5 * (v / sigma_col) ** 2)
    return kernel / kernel.sum()


def four_spots(row, col):
    total = 0.0
    for a in (-0.6, 0.6):
        for b in (-0.6, 0.6):
            q = np.hypot(row - a, col - b) / 0.35 + 1e-9
            total = total + (2 * j1(q) / q) ** 2
    return total


KERNELS = {  # name: kernel, goal in dB
    "Gauss 1": (gaussian(17, 1, 1), 71.5),
    "Gauss 2.2 x 1.5": (gaussian(25, 2.2, 1.5, 30), 60.5),
    "disc 4.5": (by_area(lambda r, c: np.hypot(r, c) <= 4.5, 25), 53.5),
    "streak 13": (by_area(lambda r, c: (abs(r) <= 0.5) & (abs(c) <= 6.5), 25), 69.0),
    "4 spots": (by_area(four_spots, 17), 67.0),
    "Gauss 3": (gaussian(33, 3, 3), 52.0),
    "ring 7": (by_area(lambda r, c: (np.hypot(r, c) <= 7) & (np.hypot(r, c) >= 5.5), 33), 53.0),
}


def blurred_target(kernel, size=256, noise=0.01, seed=0):
    rng = np.random.default_rng(seed)
    sharp = rng.integers(0, 2, (size, size)).astype(float)
    wide = np.pad(sharp, len(kernel) // 2, mode="wrap")
    return sharp, fftconvolve(wide, kernel, mode="valid") + rng.normal(0, noise, sharp.shape)


def psnr_db(estimate, kernel):
    """Peak: the kernel's maximum."""
    return 20 * np.log10(kernel.max() / np.sqrt(np.mean((estimate - kernel) ** 2)))


def misplaced_target(kernel, corner_px, size=256, square=32, seed=0):
    """A target drawn with errors of the checkerboard's corners, bilinear between them, of the size of
    `blurred_target`.
    """
    return misplacement(kernel, corner_px, size, square, seed)[:2]


def misplacement(kernel, corner_px, size=256, square=32, seed=0):
    """As `misplaced_target`, and the displacement (2, rows, cols), px."""
    rng = np.random.default_rng(seed)
    wide = size + 2 * square
    sharp = rng.integers(0, 2, (wide, wide)).astype(float)
    r, c = np.indices((wide, wide))
    inner = np.s_[square:-square, square:-square]
    moved = [
        map_coordinates(nodes, [r / square, c / square], order=1)
        for nodes in rng.normal(0, corner_px, (2, wide // square + 2, wide // square + 2))
    ]
    field = np.array([d - d[inner].mean() for d in moved])
    blurred = map_coordinates(fftconvolve(sharp, kernel, mode="same"), np.array([r, c]) + field, order=5)
    return sharp[inner], blurred[inner] + rng.normal(0, 0.01, (size, size)), field[:, *inner]
