"""Corners of a checkerboard in a picture: the product of two blurred straight edges, fitted to hundredths of a
pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.floating[Any]]


class CornerFits(NamedTuple):
    """Corners (n, 2), (x, y), px; which fits are to be trusted (n,); standard deviation of a coordinate by the noise
    of the picture, px (n,).
    """

    points: Array
    trusted: NDArray[np.bool_]
    std_px: Array


def fit_corners(
    picture: Array,
    points: Array,
    across: Array,
    down: Array,
    half_px: Array,
    clear: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> CornerFits:
    """Checkerboard corners by least squares (Levenberg-Marquardt, all corners at once).

        I = level + gradient . r + contrast E(d1) E(d2)

    E: a blurred edge, an error function of -1..1; d1, d2: distances from two lines through the corner. `points` (n,
    2), (x, y): the first guess, good to about 2 px. `across`, `down` (n, 2): directions of the axes of the board
    there. `half_px` (n,): radius of the window. `clear(points) -> bool` says which pixels may be used. Trusted are
    fits that converged near the guess, are sharp enough, and explain the picture.
    """
    points = np.array(points, dtype=float)
    count = len(points)
    size = int(np.ceil(half_px.max()))
    offset = np.arange(-size, size + 1, dtype=float)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    dx, dy = dx[np.hypot(dx, dy) <= half_px.max() + 0.5], dy[np.hypot(dx, dy) <= half_px.max() + 0.5]
    base = np.round(points)
    x, y = base[:, :1] + dx, base[:, 1:] + dy  # (n, window)
    rows, cols = picture.shape
    used = (x >= 0) & (x < cols) & (y >= 0) & (y < rows)
    used &= np.hypot(dx, dy)[None, :] <= half_px[:, None] + 0.5
    if clear is not None:
        used &= clear(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(used.shape)
    value = picture[np.clip(y, 0, rows - 1).astype(int), np.clip(x, 0, cols - 1).astype(int)]
    weight = used.astype(float)

    # Edge 1 runs along `across`, edge 2 along `down`. Parameters: place (2), angles of the normals (2), width, level,
    # gradient (2), contrast.
    p = np.zeros((count, 9))
    p[:, :2] = points - base
    p[:, 2] = np.arctan2(across[:, 0], -across[:, 1])
    p[:, 3] = np.arctan2(down[:, 0], -down[:, 1])
    p[:, 4] = 1.0
    p[:, 5:] = _damped_step(_corner_model(p, dx, dy)[1][:, :, 5:], weight, value)[0]
    damping = np.full(count, 1e-3)
    cost = _residual_squares(p, dx, dy, value, weight)
    limit = np.array([1.0, 1.0, 0.3, 0.3, 0.5, np.inf, np.inf, np.inf, np.inf])
    moving = np.arange(count)  # corners that still move
    for _ in range(25):
        model, jacobian = _corner_model(p[moving], dx, dy)
        change, _ = _damped_step(jacobian, weight[moving], value[moving] - model, damping[moving])
        tried = p[moving] + np.clip(change, -limit, limit)
        tried[:, 4] = np.clip(tried[:, 4], 0.2, 4.0)
        new = _residual_squares(tried, dx, dy, value[moving], weight[moving])
        better = new <= cost[moving]
        moved = np.abs(tried - p[moving])[:, :2].max(axis=1)
        p[moving[better]], cost[moving[better]] = tried[better], new[better]
        damping[moving] = np.clip(np.where(better, damping[moving] * 0.1, damping[moving] * 10.0), 1e-10, 1e6)
        moving = moving[np.where(better, moved > 1e-4, damping[moving] < 1e3)]
        if not len(moving):
            break
    covariance = _damped_step(_corner_model(p, dx, dy)[1], weight, value)[1]
    unit_std = np.sqrt(np.abs(covariance[:, 0, 0] + covariance[:, 1, 1]))
    pixels = weight.sum(axis=1)
    residual = np.sqrt(cost / np.maximum(pixels - 9.0, 1.0))
    found = base + p[:, :2]
    trusted = (
        (np.linalg.norm(found - points, axis=1) < 2.5)
        & (pixels > 16)
        & (np.abs(p[:, 8]) > 3.0 * residual)
        & (residual * unit_std < 0.5)
    )
    return CornerFits(found, trusted, residual * unit_std / np.sqrt(2.0))


def _corner_model(p: Array, dx: Array, dy: Array) -> tuple[Array, Array]:
    """Model (n, window) and its Jacobian (n, window, 9)."""
    x, y = dx - p[:, :1], dy - p[:, 1:2]
    width = p[:, 4:5]
    edges, derivatives, across, along = [], [], [], []
    for angle in (p[:, 2:3], p[:, 3:4]):
        u = np.cos(angle) * x + np.sin(angle) * y
        edges.append(erf(u / (np.sqrt(2.0) * width)))
        derivatives.append(np.sqrt(2.0 / np.pi) / width * np.exp(-0.5 * (u / width) ** 2))
        across.append(np.cos(angle) * y - np.sin(angle) * x)
        along.append(u)
    contrast = p[:, 8:9]
    first, second = derivatives[0] * edges[1] * contrast, derivatives[1] * edges[0] * contrast
    jacobian = np.stack(
        [
            -first * np.cos(p[:, 2:3]) - second * np.cos(p[:, 3:4]),
            -first * np.sin(p[:, 2:3]) - second * np.sin(p[:, 3:4]),
            first * across[0],
            second * across[1],
            -(first * along[0] + second * along[1]) / width,
            np.ones_like(x),
            np.broadcast_to(dx, x.shape),
            np.broadcast_to(dy, x.shape),
            edges[0] * edges[1],
        ],
        axis=-1,
    )
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + contrast * edges[0] * edges[1]
    return model, jacobian


def _residual_squares(p: Array, dx: Array, dy: Array, value: Array, weight: Array) -> Array:
    """Weighted sum of squared residuals (n,)."""
    x, y = dx - p[:, :1], dy - p[:, 1:2]
    width = np.sqrt(2.0) * p[:, 4:5]
    one, two = (erf((np.cos(angle) * x + np.sin(angle) * y) / width) for angle in (p[:, 2:3], p[:, 3:4]))
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + p[:, 8:9] * one * two
    return np.asarray((weight * (value - model) ** 2).sum(axis=1))


def _damped_step(jacobian: Array, weight: Array, residual: Array, damping: Array | None = None) -> tuple[Array, Array]:
    """Damped least squares of every corner: steps (n, k) and the inverse normal matrices (n, k, k)."""
    weighted = jacobian * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ jacobian
    scale = np.einsum("nkk->nk", normal)
    ridge = (1e-9 if damping is None else damping[:, None]) * scale + 1e-12
    normal = normal + ridge[:, :, None] * np.eye(normal.shape[1])
    inverse = np.linalg.inv(normal)
    right = np.swapaxes(weighted, 1, 2) @ residual[:, :, None]
    return (inverse @ right)[:, :, 0], inverse
