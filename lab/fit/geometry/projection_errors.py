"""How well a calibrated camera projects, and how two calibrations differ, without the rigid motion that they imply.

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

from lab.fit.geometry.pinhole import cross_matrices, intrinsics_of_fit, project, project_with_jacobian, unproject
from lab.formats.results import GeometryFit

Array = NDArray[np.floating[Any]]

GAUGE_CORNERS = 600  # that determine the rigid motion; more change nothing
GRID_COLS, GRID_ROWS = 25, 19
FLOOR_PX = 1e-3  # differences below this are rounding


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
        """Root mean square of the length of the vectors."""
        return float(np.sqrt(np.mean(np.sum(self.vectors_px**2, axis=1))))

    @property
    def expected_px(self) -> float:
        """Value of `rms_px` that the uncertainties alone let expect."""
        return float(np.sqrt(np.sum(self.factor**2) / len(self.vectors_px)))

    @property
    def variances_px2(self) -> Array:
        """Variances (n, 2) of the vectors."""
        return np.asarray(np.sum(self.factor**2, axis=1).reshape(-1, 2))

    @property
    def p_value(self) -> float:
        """Probability of such a difference by the uncertainties alone: chi2 over the directions in which the
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
        """`p_value` as standard deviations of a normal distribution, two-sided."""
        return -float(special.ndtri(max(self.p_value, 1e-300) / 2.0))


def grid(shape: tuple[int, int]) -> tuple[Array, Array]:
    """x of the columns and y of the rows of the maps, px, from edge to edge of a frame of `shape` (rows, cols)."""
    return np.linspace(0, shape[1] - 1, GRID_COLS), np.linspace(0, shape[0] - 1, GRID_ROWS)


def grid_points(x: Array, y: Array) -> Array:
    """Points (n, 2) of the grid, row by row."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def seen_points(fit: GeometryFit) -> Array:
    """Places (n, 3) of the corners that a calibration rests on, mm, in the frame of the camera."""
    image = np.array([(x, y) for view in fit.residuals for x, y in zip(view.x_px, view.y_px, strict=True)])
    depth = np.array([z for view in fit.residuals for z in view.depth_mm])
    if not len(image):
        return np.zeros((0, 3))
    points = unproject(image, intrinsics_of_fit(fit)) * depth[:, None]
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // GAUGE_CORNERS)]


def points_at(image: Array, intrinsics: Array, distance_mm: float | None) -> Array:
    """Points (n, 3), mm, that project to `image` (n, 2) at a distance from the camera; None: far away. NaN where there
    are none.
    """
    rays = unproject(image, intrinsics)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return rays * (1e9 if distance_mm is None else distance_mm)


def _motion_jacobian(points: Array, by_point: Array, unit_mm: float) -> Array:
    """Jacobian (n, 2, 6) of the projection by a rotation of the camera, and by a translation in units of `unit_mm`."""
    return np.concatenate([-by_point @ cross_matrices(points), by_point * unit_mm], axis=2)


def error_operator(intrinsics: Array, gauge: Array, points: Array) -> Array:
    """E (n, 2, 12): Jacobian of the projections of `points` by the intrinsics, without the motion implied on `gauge`
    (m, 3).
    """
    _, by_point, by_camera = project_with_jacobian(gauge, intrinsics)
    unit_mm = float(np.median(np.linalg.norm(gauge, axis=1)))
    motion = _motion_jacobian(gauge, by_point, unit_mm).reshape(-1, 6)
    implied = np.linalg.lstsq(motion, by_camera.reshape(-1, by_camera.shape[2]), rcond=1e-12)[0]
    _, by_point, by_camera = project_with_jacobian(points, intrinsics)
    return by_camera - _motion_jacobian(points, by_point, unit_mm) @ implied


def projection_std(intrinsics: Array, covariance: Array, gauge: Array, points: Array) -> Array:
    """Standard deviation (n,) of the projections of `points` in the worst direction, px; NaN where a point is NaN."""
    found = np.full(len(points), np.nan)
    there = np.isfinite(points).all(axis=1)
    operator = error_operator(intrinsics, gauge, points[there])
    blocks = operator @ covariance @ np.swapaxes(operator, 1, 2)
    found[there] = np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, -1], 0.0))
    return found


def implied_motion(first: Array, second: Array, gauge: Array) -> tuple[Array, Array]:
    """Rotation and translation from the frame of the first camera to that of the second.

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
    """How `second` (12,) projects `points` (n, 3), in the frame of the first camera, other than `first`.

    `covariance` (12, 12): of the difference of the two intrinsics; `gauge`: see `implied_motion`.
    """
    rotation, translation = implied_motion(first, second, gauge)
    vectors = project(points @ rotation.T + translation, second) - project(points, first)
    operator = error_operator(first, gauge, points).reshape(-1, len(first))
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # the scales differ by orders of magnitude
    values, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    return Difference(vectors, (operator * unit) @ (axes * np.sqrt(np.maximum(values, 0.0))))
