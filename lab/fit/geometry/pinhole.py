"""The pinhole camera of OpenCV with its Jacobian: radial (also rational) and tangential distortion.

    x, y = X / Z, Y / Z                    r2 = x^2 + y^2
    g    = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    u    = fx (x g + 2 p1 x y + p2 (r2 + 2 x^2)) + cx
    v    = fy (y g + p1 (r2 + 2 y^2) + 2 p2 x y) + cy

Points are (u, v) px with (0, 0) the centre of the top-left pixel; X is in the frame of the camera: x right, y down, z
forward. Intrinsics are one vector (12,) in the order of `NAMES`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.formats.results import GeometryFit

Array = NDArray[np.floating[Any]]
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
COUNT = len(NAMES)


def intrinsics_of(camera_matrix: Any, distortion: Any) -> Array:
    """Vector (12,) of a camera matrix (3, 3) and up to eight distortion coefficients in the order of OpenCV."""
    matrix = np.asarray(camera_matrix, dtype=float)
    coefficients = np.zeros(8)
    coefficients[: len(distortion)] = distortion
    return np.concatenate([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], coefficients])


def intrinsics_of_fit(fit: GeometryFit) -> Array:
    """Vector (12,) of a fitted camera."""
    return intrinsics_of(fit.camera_matrix, fit.distortion)


def matrix_of(intrinsics: Array) -> Array:
    """Camera matrix (3, 3)."""
    fx, fy, cx, cy = intrinsics[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def distortion_of(intrinsics: Array) -> Array:
    """Distortion coefficients in the order of OpenCV: five, or eight where a rational one is used."""
    return np.asarray(intrinsics[4:] if np.any(intrinsics[9:]) else intrinsics[4:9])


def _distorted(x: Array, y: Array, k: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Distorted x, y; g; dg/dr2; and the denominator of g."""
    r2 = x * x + y * y
    above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    above_derivative = k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[4])
    below_derivative = k[5] + r2 * (2.0 * k[6] + 3.0 * r2 * k[7])
    g = above / below
    derivative = (above_derivative - g * below_derivative) / below
    xd = x * g + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
    yd = y * g + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
    return xd, yd, g, derivative, below


def _distortion_jacobian(x: Array, y: Array, k: Array, g: Array, derivative: Array) -> tuple[Array, Array, Array]:
    """dxd/dx, dxd/dy (= dyd/dx) and dyd/dy."""
    cross = 2.0 * (x * y * derivative + k[2] * x + k[3] * y)
    return (
        g + 2.0 * (x * x * derivative + k[2] * y + 3.0 * k[3] * x),
        cross,
        g + 2.0 * (y * y * derivative + 3.0 * k[2] * y + k[3] * x),
    )


def project(points: Array, intrinsics: Array) -> Array:
    """Project points (n, 3) in the frame of the camera to px (n, 2)."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    xd, yd = _distorted(x, y, intrinsics[4:])[:2]
    return np.column_stack([intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3]])


def project_with_jacobian(points: Array, intrinsics: Array) -> tuple[Array, Array, Array]:
    """Projected points, px (n, 2), and their Jacobians by the point (n, 2, 3) and by the intrinsics (n, 2, 12)."""
    fx, fy, cx, cy = intrinsics[:4]
    k = intrinsics[4:]
    depth = points[:, 2]
    x, y = points[:, 0] / depth, points[:, 1] / depth
    xd, yd, g, derivative, below = _distorted(x, y, k)
    xx, cross, yy = _distortion_jacobian(x, y, k, g, derivative)
    by_point = np.empty((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 1] = fx * xx / depth, fx * cross / depth
    by_point[:, 1, 0], by_point[:, 1, 1] = fy * cross / depth, fy * yy / depth
    by_point[:, :, 2] = -(by_point[:, :, 0] * x[:, None] + by_point[:, :, 1] * y[:, None])
    r2 = x * x + y * y
    by_camera = np.zeros((len(points), 2, COUNT))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = xd, yd
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    for row, focal, at in ((0, fx, x), (1, fy, y)):
        for column, power in ((4, 1), (5, 2), (8, 3)):
            by_camera[:, row, column] = focal * at * r2**power / below
            by_camera[:, row, {4: 9, 5: 10, 8: 11}[column]] = -focal * at * g * r2**power / below
    by_camera[:, 0, 6], by_camera[:, 0, 7] = fx * 2.0 * x * y, fx * (r2 + 2.0 * x * x)
    by_camera[:, 1, 6], by_camera[:, 1, 7] = fy * (r2 + 2.0 * y * y), fy * 2.0 * x * y
    return np.column_stack([fx * xd + cx, fy * yd + cy]), by_point, by_camera


def unproject(image: Array, intrinsics: Array) -> Array:
    """Rays (n, 3) with z = 1 of px (n, 2), by Newton iterations; NaN where the distortion has no inverse."""
    k = intrinsics[4:]
    wanted_x = (image[:, 0] - intrinsics[2]) / intrinsics[0]
    wanted_y = (image[:, 1] - intrinsics[3]) / intrinsics[1]
    x, y = wanted_x.copy(), wanted_y.copy()
    with np.errstate(all="ignore"):
        for _ in range(20):
            xd, yd, g, derivative, _ = _distorted(x, y, k)
            xx, cross, yy = _distortion_jacobian(x, y, k, g, derivative)
            determinant = xx * yy - cross * cross
            miss_x, miss_y = xd - wanted_x, yd - wanted_y
            x = x - (yy * miss_x - cross * miss_y) / determinant
            y = y - (xx * miss_y - cross * miss_x) / determinant
        xd, yd, g, derivative, _ = _distorted(x, y, k)
        xx, cross, yy = _distortion_jacobian(x, y, k, g, derivative)
        # A distortion that folds maps two rays to one pixel; the valid one has a positive Jacobian
        valid = (np.hypot(xd - wanted_x, yd - wanted_y) < 1e-9) & (xx * yy - cross * cross > 0) & (xx > 0)
    return np.column_stack([np.where(valid, x, np.nan), np.where(valid, y, np.nan), np.ones_like(x)])


def cross_matrices(points: Array) -> Array:
    """Cross-product matrices [p]x (n, 3, 3) of points (n, 3): [p]x q = p x q."""
    found = np.zeros((len(points), 3, 3))
    found[:, 0, 1], found[:, 0, 2], found[:, 1, 2] = -points[:, 2], points[:, 1], -points[:, 0]
    return found - np.swapaxes(found, 1, 2)
