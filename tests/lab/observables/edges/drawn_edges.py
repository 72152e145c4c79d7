"""Edges with a transfer function in closed form: blurred by a Gaussian, they are an error function of the distance."""

from __future__ import annotations

import numpy as np
from scipy.special import erf, ndtr

FULL_E = 9000.0


def edge(size, angle_deg, sigma_px, bend_px=0.0, *, offset_px=0.3, dark=0.1, row0=0.0, col0=0.0, step=1):
    """Unit edge, light on the right of a vertical one, exact at the samples; bent, it is a circle with that sagitta."""
    r = row0 + step * np.arange(size)[:, None] - (size * step - 1) / 2
    c = col0 + step * np.arange(size)[None, :] - (size * step - 1) / 2
    a = np.radians(angle_deg)
    d = c * np.cos(a) + r * np.sin(a) - offset_px
    if bend_px:
        radius = (size * step / 2) ** 2 / (2 * bend_px)
        d = np.hypot(radius + d, -c * np.sin(a) + r * np.cos(a)) - radius
    return dark + 0.5 * (1 + erf(d / sigma_px / np.sqrt(2)))


def gaussian_mtf(sigma_px, frequency):
    return np.exp(-2 * (np.pi * sigma_px * frequency) ** 2)


def gaussian_mtf50(sigma_px):
    return np.sqrt(2 * np.log(2)) / (2 * np.pi * sigma_px)


def noisy(mean, rng):
    electrons = mean * FULL_E
    return np.round(0.4 * rng.normal(electrons, np.sqrt(electrons + 4.0)))


def squares(shape, boxes, sigma_px):
    """Dark squares (row, col, half side, degrees) on light, blurred: products of normal distribution functions but for
    the corners.
    """
    r, c = np.indices(shape, dtype=float)
    light = np.ones(shape)
    for row, col, half, angle_deg in boxes:
        a = np.radians(angle_deg)
        u, v = (r - row) * np.cos(a) + (c - col) * np.sin(a), (c - col) * np.cos(a) - (r - row) * np.sin(a)
        across, down = (ndtr((x + half) / sigma_px) - ndtr((x - half) / sigma_px) for x in (u, v))
        light -= 0.9 * across * down
    return light
