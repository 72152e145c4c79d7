"""The pinhole camera of OpenCV with its Jacobian, the uncertainty of its projections, and the difference of two of
them.

Radial (also rational) and tangential distortion:

    x, y = X / Z, Y / Z                    r2 = x^2 + y^2
    g    = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    u    = fx (x g + 2 p1 x y + p2 (r2 + 2 x^2)) + cx
    v    = fy (y g + p1 (r2 + 2 y^2) + 2 p2 x y) + cy

Points are (u, v) px with (0, 0) the centre of the top-left pixel; X is in the frame of the camera: x right, y down, z
forward. Intrinsics are one vector (12,) in the order of `NAMES`.

A calibration determines a camera only up to its pose: a slightly rotated camera with a slightly shifted principal
point sees boards almost alike. Errors of the intrinsics are therefore counted after the rigid motion that best
compensates them on the corners used (D. Kogan, mrcal: "projection uncertainty", "differencing"). To first order, with
the projection q(theta, X), its Jacobians J_theta by the intrinsics and J_X by the point, and that of the motion, J_m =
J_X [-[X]x, 1]:

    dq(X) = (J_theta(X) - J_m(X) G) dtheta,      G = (sum J_m^T J_m)^-1 sum J_m^T J_theta   over the corners used,

so that cov q = E cov(theta) E^T with E = J_theta - J_m G.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from lab.formats.results import GeometryFit

Array = NDArray[np.floating[Any]]
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
COUNT = len(NAMES)

GAUGE_CORNERS = 600  # that determine the rigid motion; more change nothing
GRID_COLS, GRID_ROWS = 25, 19
FLOOR_PX = 1e-3  # differences below this are rounding


def intrinsics_of(camera_matrix: Any, distortion: Any) -> Array:
    """Return the vector (12,) of a camera matrix (3, 3) and up to eight distortion coefficients in OpenCV's order."""
    matrix = np.asarray(camera_matrix, dtype=float)
    coefficients = np.zeros(8)
    coefficients[: len(distortion)] = distortion
    return np.concatenate([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], coefficients])


def intrinsics_of_fit(fit: GeometryFit) -> Array:
    """Return the vector (12,) of a fitted camera."""
    return intrinsics_of(fit.camera_matrix, fit.distortion)


def matrix_of(intrinsics: Array) -> Array:
    """Return the camera matrix (3, 3)."""
    fx, fy, cx, cy = intrinsics[:4]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def distortion_of(intrinsics: Array) -> Array:
    """Return the distortion coefficients in the order of OpenCV: five, or eight where a rational one is used."""
    return np.asarray(intrinsics[4:] if np.any(intrinsics[9:]) else intrinsics[4:9])


def _distort(x: Array, y: Array, k: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return the distorted x, y; g; dg/dr2; and the denominator of g.

    `x`, `y` (n,): rays with z = 1; `k` (8,): distortion coefficients.
    """
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
    """Return dxd/dx, dxd/dy (= dyd/dx) and dyd/dy."""
    cross = 2.0 * (x * y * derivative + k[2] * x + k[3] * y)
    return (
        g + 2.0 * (x * x * derivative + k[2] * y + 3.0 * k[3] * x),
        cross,
        g + 2.0 * (y * y * derivative + 3.0 * k[2] * y + k[3] * x),
    )


def project(points: Array, intrinsics: Array) -> Array:
    """Project points (n, 3) in the frame of the camera to px (n, 2)."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    xd, yd = _distort(x, y, intrinsics[4:])[:2]
    return np.column_stack([intrinsics[0] * xd + intrinsics[2], intrinsics[1] * yd + intrinsics[3]])


def project_with_jacobian(points: Array, intrinsics: Array) -> tuple[Array, Array, Array]:
    """Project points (n, 3) to px (n, 2). Returns these and their Jacobians by the point (n, 2, 3) and by the
    intrinsics (n, 2, 12).
    """
    fx, fy, cx, cy = intrinsics[:4]
    k = intrinsics[4:]
    depth = points[:, 2]
    x, y = points[:, 0] / depth, points[:, 1] / depth
    xd, yd, g, derivative, below = _distort(x, y, k)
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
    """Find the rays (n, 3) with z = 1 of px (n, 2), by Newton iterations; NaN where the distortion has no inverse."""
    k = intrinsics[4:]
    wanted_x = (image[:, 0] - intrinsics[2]) / intrinsics[0]
    wanted_y = (image[:, 1] - intrinsics[3]) / intrinsics[1]
    x, y = wanted_x.copy(), wanted_y.copy()
    with np.errstate(all="ignore"):
        for _ in range(20):
            xd, yd, g, derivative, _ = _distort(x, y, k)
            xx, cross, yy = _distortion_jacobian(x, y, k, g, derivative)
            determinant = xx * yy - cross * cross
            miss_x, miss_y = xd - wanted_x, yd - wanted_y
            x = x - (yy * miss_x - cross * miss_y) / determinant
            y = y - (xx * miss_y - cross * miss_x) / determinant
        xd, yd, g, derivative, _ = _distort(x, y, k)
        xx, cross, yy = _distortion_jacobian(x, y, k, g, derivative)
        # A distortion that folds maps two rays to one pixel; the valid one has a positive Jacobian
        valid = (np.hypot(xd - wanted_x, yd - wanted_y) < 1e-9) & (xx * yy - cross * cross > 0) & (xx > 0)
    return np.column_stack([np.where(valid, x, np.nan), np.where(valid, y, np.nan), np.ones_like(x)])


def cross_matrices(points: Array) -> Array:
    """Return the cross-product matrices [p]x (n, 3, 3) of points (n, 3): [p]x q = p x q."""
    found = np.zeros((len(points), 3, 3))
    found[:, 0, 1], found[:, 0, 2], found[:, 1, 2] = -points[:, 2], points[:, 1], -points[:, 0]
    return found - np.swapaxes(found, 1, 2)


@dataclass(frozen=True)
class Difference:
    """Two calibrations at n points of the frame.

    `vectors_px` (n, 2): second less first, without the implied motion. `factor` (2n, k): a factor of their covariance,
    factor factor^T.
    """

    vectors_px: Array
    factor: Array

    @property
    def rms_px(self) -> float:
        """Return the root mean square of the length of the vectors."""
        return float(np.sqrt(np.mean(np.sum(self.vectors_px**2, axis=1))))

    @property
    def expected_px(self) -> float:
        """Return the value of `rms_px` that the uncertainties alone let expect."""
        return float(np.sqrt(np.sum(self.factor**2) / len(self.vectors_px)))

    @property
    def variances_px2(self) -> Array:
        """Return the variances (n, 2) of the vectors."""
        return np.asarray(np.sum(self.factor**2, axis=1).reshape(-1, 2))

    @property
    def p_value(self) -> float:
        """Return the probability of such a difference by the uncertainties alone: chi2 over the directions in which the
        calibrations can differ.
        """
        directions, spread, _ = np.linalg.svd(self.factor, full_matrices=False)
        determined = spread > max(1e-3 * float(spread[0]), FLOOR_PX)
        if not determined.any():
            return 1.0 if self.rms_px < 10 * FLOOR_PX else 0.0
        along = directions[:, determined].T @ self.vectors_px.ravel()
        return float(special.chdtrc(int(determined.sum()), np.sum((along / spread[determined]) ** 2)))

    @property
    def significance_sigma(self) -> float:
        """Return `p_value` as standard deviations of a normal distribution, two-sided."""
        return -float(special.ndtri(max(self.p_value, 1e-300) / 2.0))


def grid(shape: tuple[int, int]) -> tuple[Array, Array]:
    """Return x of the columns and y of the rows of the maps, px, from edge to edge of a frame (rows, cols)."""
    return np.linspace(0, shape[1] - 1, GRID_COLS), np.linspace(0, shape[0] - 1, GRID_ROWS)


def grid_points(x: Array, y: Array) -> Array:
    """Return the points (n, 2) of the grid, row by row."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def seen_points(fit: GeometryFit) -> Array:
    """Return the places (n, 3) of the corners that a calibration rests on, mm, in the frame of the camera."""
    image = np.array([(x, y) for view in fit.residuals for x, y in zip(view.x_px, view.y_px, strict=True)])
    depth = np.array([z for view in fit.residuals for z in view.depth_mm])
    if not len(image):
        return np.zeros((0, 3))
    points = unproject(image, intrinsics_of_fit(fit)) * depth[:, None]
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // GAUGE_CORNERS)]


def points_at(image: Array, intrinsics: Array, distance_mm: float | None) -> Array:
    """Return the points (n, 3), mm, that project to `image` (n, 2) at a distance from the camera; None: far away. NaN
    where there are none.
    """
    rays = unproject(image, intrinsics)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return rays * (1e9 if distance_mm is None else distance_mm)


def _motion_jacobian(points: Array, by_point: Array, unit_mm: float) -> Array:
    """Return the Jacobian (n, 2, 6) of the projection by a rotation of the camera, and by a translation in units of
    `unit_mm`.
    """
    return np.concatenate([-by_point @ cross_matrices(points), by_point * unit_mm], axis=2)


def error_operator(intrinsics: Array, gauge: Array, points: Array) -> Array:
    """Return E (n, 2, 12), the Jacobian of the projections of `points` by the intrinsics, without the motion implied on
    `gauge` (m, 3).
    """
    _, by_point, by_camera = project_with_jacobian(gauge, intrinsics)
    unit_mm = float(np.median(np.linalg.norm(gauge, axis=1)))
    motion = _motion_jacobian(gauge, by_point, unit_mm).reshape(-1, 6)
    implied = np.linalg.lstsq(motion, by_camera.reshape(-1, by_camera.shape[2]), rcond=1e-12)[0]
    _, by_point, by_camera = project_with_jacobian(points, intrinsics)
    return by_camera - _motion_jacobian(points, by_point, unit_mm) @ implied


def projection_std(intrinsics: Array, covariance: Array, gauge: Array, points: Array) -> Array:
    """Return the standard deviation (n,) of the projections of `points` in the worst direction, px; NaN where a point
    is NaN.

    `covariance` (12, 12) of the `intrinsics` (12,); `gauge` (m, 3), `points` (n, 3), mm, in the frame of the camera.
    """
    found = np.full(len(points), np.nan)
    there = np.isfinite(points).all(axis=1)
    operator = error_operator(intrinsics, gauge, points[there])
    blocks = operator @ covariance @ np.swapaxes(operator, 1, 2)
    found[there] = np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, -1], 0.0))
    return found


def implied_motion(first: Array, second: Array, gauge: Array) -> tuple[Array, Array]:
    """Find the rotation and translation from the frame of the first camera to that of the second.

    With it `second` projects `gauge` (m, 3), points in the frame of the first, to where `first` does; by Gauss-Newton.
    """
    wanted = project(gauge, first)
    rotation, translation = np.eye(3), np.zeros(3)
    for _ in range(10):
        points = gauge @ rotation.T + translation
        seen, by_point, _ = project_with_jacobian(points, second)
        jacobian = np.concatenate([-by_point @ cross_matrices(points - translation), by_point], axis=2).reshape(-1, 6)
        scale = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / scale, (wanted - seen).ravel(), rcond=1e-12)[0] / scale
        rotation, translation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, translation + step[3:]
        if np.abs(jacobian @ step).max() < 1e-9:
            break
    return rotation, translation


def difference(
    first: Array,
    second: Array,
    covariance: Array,
    gauge: Array,
    points: Array,
) -> Difference:
    """Compare how `second` (12,) projects `points` (n, 3), in the frame of the first camera, with `first`.

    `covariance` (12, 12): of the difference of the two intrinsics; `gauge`: see `implied_motion`.
    """
    rotation, translation = implied_motion(first, second, gauge)
    vectors = project(points @ rotation.T + translation, second) - project(points, first)
    operator = error_operator(first, gauge, points).reshape(-1, len(first))
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # the scales differ by orders of magnitude
    values, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    return Difference(vectors, (operator * unit) @ (axes * np.sqrt(np.maximum(values, 0.0))))
