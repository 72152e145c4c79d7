"""Edges whose transfer function is known in closed form."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

SUBSAMPLES = 5


def gaussian_edge(
    sigma_px: float,
    angle_deg: float = 5.0,
    shape: tuple[int, int] = (100, 64),
    levels: tuple[float, float] = (1000.0, 4000.0),
) -> np.ndarray:
    """Return a near-vertical edge, light on the right, blurred by a Gaussian and averaged over 5 x 5 points a pixel."""
    rows, cols = shape
    tilt, cosine = np.tan(np.radians(angle_deg)), np.cos(np.radians(angle_deg))
    places = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES - 0.5
    found = np.zeros(shape)
    for down in places:
        for across in places:
            row, col = np.arange(rows)[:, None] + down, np.arange(cols)[None, :] + across
            distance = (col - 0.5 * (cols - 1) - 0.2 + tilt * (row - 0.5 * (rows - 1))) * cosine
            found += 0.5 * (1.0 + erf(distance / np.sqrt(2.0) / sigma_px))
    return levels[0] + (levels[1] - levels[0]) * found / SUBSAMPLES**2


def gaussian_transfer(sigma_px: float, angle_deg: float, frequency: np.ndarray) -> np.ndarray:
    """Return its transfer function along the normal: Gaussian, times that of the points a pixel is averaged over."""
    found = np.exp(-2.0 * (np.pi * sigma_px * frequency) ** 2)
    for part in (np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))):
        f = np.maximum(frequency * part, 1e-9)
        found = found * np.abs(np.sin(np.pi * f) / (SUBSAMPLES * np.sin(np.pi * f / SUBSAMPLES)))
    return found


def noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the edge with shot noise of 0.5 DN/e above a black level of 500 DN."""
    return image + rng.standard_normal(image.shape) * noise_of(image)


def noise_of(level: np.ndarray | float) -> np.ndarray:
    """Return the standard deviation of that noise at a level, DN."""
    return np.sqrt(np.clip(0.5 * (np.asarray(level) - 500.0), 0.0, None))
