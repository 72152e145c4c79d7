"""Checkerboard corners by least squares: each corner as the product of two blurred edges, to hundredths of a pixel.

Points are those of OpenCV: (x, y) px, x to the right along columns, (0, 0) the centre of the top-left pixel.
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

    def only(self, kept: NDArray[np.bool_]) -> CornerFits:
        """Return the corners for which `kept` (n,) is true."""
        return CornerFits(self.points[kept], self.trusted[kept], self.std_px[kept])


def fit_corners(
    picture: Array,
    points: Array,
    across: Array,
    down: Array,
    half_px: Array,
    clear: Callable[[Array], NDArray[np.bool_]] | None = None,
    bend_per_px: Array | None = None,
) -> CornerFits:
    """Fit checkerboard corners by least squares (Levenberg-Marquardt, all corners at once).

        I = level + gradient . r + contrast E(d1) E(d2)

    E: a blurred edge, an error function of -1..1; d1, d2: distances from two lines through the corner, straight ones or
    parabolas with the curvatures `bend_per_px` (2, n, 2), vectors (x, y) of the lines along `across` and `down`.
    `points` (n, 2), (x, y): the first guess, good to about 2 px. `across`, `down` (n, 2): directions of the axes of the
    board there. `half_px` (n,): radius of the window. `clear(points) -> bool` says which pixels may be used. Trusted
    are fits that converged near the guess, are sharp enough, and explain the picture.
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
    bend = np.zeros((2, count, 2)) if bend_per_px is None else bend_per_px

    # Edge 1 runs along `across`, edge 2 along `down`. Parameters: place (2), angles of the normals (2), width, level,
    # gradient (2), contrast.
    p = np.zeros((count, 9))
    p[:, :2] = points - base
    p[:, 2] = np.arctan2(across[:, 0], -across[:, 1])
    p[:, 3] = np.arctan2(down[:, 0], -down[:, 1])
    p[:, 4] = 1.0
    p[:, 5:] = _damped_step(_corner_model(p, dx, dy, bend)[1][:, :, 5:], weight, value)[0]
    damping = np.full(count, 1e-3)
    cost = _residual_squares(p, dx, dy, bend, value, weight)
    limit = np.array([1.0, 1.0, 0.3, 0.3, 0.5, np.inf, np.inf, np.inf, np.inf])
    moving = np.arange(count)  # corners that still move
    for _ in range(25):
        model, jacobian = _corner_model(p[moving], dx, dy, bend[:, moving])
        change, _ = _damped_step(jacobian, weight[moving], value[moving] - model, damping[moving])
        tried = p[moving] + np.clip(change, -limit, limit)
        tried[:, 4] = np.clip(tried[:, 4], 0.2, 4.0)
        new = _residual_squares(tried, dx, dy, bend[:, moving], value[moving], weight[moving])
        better = new <= cost[moving]
        moved = np.abs(tried - p[moving])[:, :2].max(axis=1)
        p[moving[better]], cost[moving[better]] = tried[better], new[better]
        damping[moving] = np.clip(np.where(better, damping[moving] * 0.1, damping[moving] * 10.0), 1e-10, 1e6)
        moving = moving[np.where(better, moved > 1e-4, damping[moving] < 1e3)]
        if not len(moving):
            break
    covariance = _damped_step(_corner_model(p, dx, dy, bend)[1], weight, value)[1]
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


def _edge_distances(p: Array, dx: Array, dy: Array, bend: Array) -> list[tuple[Array, Array, Array]]:
    """Return for each of the two edges: the distance of the pixels from it (n, window), the place along it, px, and its
    curvature towards its normal (n, 1), 1/px. See `_corner_model`.
    """
    x, y = dx - p[:, :1], dy - p[:, 1:2]
    found: list[tuple[Array, Array, Array]] = []
    for angle, curvature in zip((p[:, 2:3], p[:, 3:4]), bend, strict=True):
        along = np.cos(angle) * y - np.sin(angle) * x
        towards = np.cos(angle) * curvature[:, :1] + np.sin(angle) * curvature[:, 1:]
        found.append((np.cos(angle) * x + np.sin(angle) * y - 0.5 * towards * along**2, along, towards))
    return found


def _corner_model(p: Array, dx: Array, dy: Array, bend: Array) -> tuple[Array, Array]:
    """Return the model (n, window) of the picture and its Jacobian (n, window, 9), in which a turn of an edge doesn't
    change its sag.

    `p` (n, 9): parameters of the corners, see `fit_corners`. `dx`, `dy` (window,): places of the pixels from the
    pixel of the corner, px. `bend` (2, n, 2): curvatures of the edges.
    """
    width, contrast = p[:, 4:5], p[:, 8:9]
    distances = _edge_distances(p, dx, dy, bend)
    edges = [erf(u / (np.sqrt(2.0) * width)) for u, _, _ in distances]
    derivatives = [np.sqrt(2.0 / np.pi) / width * np.exp(-0.5 * (u / width) ** 2) for u, _, _ in distances]
    slopes = [derivatives[0] * edges[1] * contrast, derivatives[1] * edges[0] * contrast]
    by_x, by_y = np.zeros_like(slopes[0]), np.zeros_like(slopes[0])
    for slope, angle, (_, along, towards) in zip(slopes, (p[:, 2:3], p[:, 3:4]), distances, strict=True):
        by_x -= slope * (np.cos(angle) + towards * along * np.sin(angle))
        by_y -= slope * (np.sin(angle) - towards * along * np.cos(angle))
    jacobian = np.stack(
        [
            by_x,
            by_y,
            slopes[0] * distances[0][1],
            slopes[1] * distances[1][1],
            -(slopes[0] * distances[0][0] + slopes[1] * distances[1][0]) / width,
            np.ones_like(by_x),
            np.broadcast_to(dx, by_x.shape),
            np.broadcast_to(dy, by_x.shape),
            edges[0] * edges[1],
        ],
        axis=-1,
    )
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + contrast * edges[0] * edges[1]
    return model, jacobian


def _residual_squares(p: Array, dx: Array, dy: Array, bend: Array, value: Array, weight: Array) -> Array:
    """Return the weighted sums of squared residuals (n,).

    `p`, `dx`, `dy`, `bend`: see `_corner_model`. `value`, `weight` (n, window): the picture, and 1 where a pixel is
    used, else 0.
    """
    width = np.sqrt(2.0) * p[:, 4:5]
    one, two = (erf(u / width) for u, _, _ in _edge_distances(p, dx, dy, bend))
    model = p[:, 5:6] + p[:, 6:7] * dx + p[:, 7:8] * dy + p[:, 8:9] * one * two
    return np.asarray((weight * (value - model) ** 2).sum(axis=1))


def _damped_step(jacobian: Array, weight: Array, residual: Array, damping: Array | None = None) -> tuple[Array, Array]:
    """Solve the damped least squares of every corner: steps (n, k) and the inverse normal matrices (n, k, k).

    `jacobian` (n, window, k), `weight`, `residual` (n, window), `damping` (n,): share of the diagonal that is added to
    it.
    """
    weighted = jacobian * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ jacobian
    scale = np.einsum("nkk->nk", normal)
    ridge = (1e-9 if damping is None else damping[:, None]) * scale + 1e-12
    normal = normal + ridge[:, :, None] * np.eye(normal.shape[1])
    inverse = np.linalg.inv(normal)
    right = np.swapaxes(weighted, 1, 2) @ residual[:, :, None]
    return (inverse @ right)[:, :, 0], inverse
