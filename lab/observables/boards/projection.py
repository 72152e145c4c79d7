"""A camera as boards show it: its projection (`sim.scene.projection`) with its intrinsics, the uncertainty of what it
projects, and the difference of two of them.

A calibration determines a camera only up to its pose: a slightly rotated camera with a slightly shifted principal
point sees boards almost alike. Errors of the intrinsics are therefore counted after the rigid motion that best
compensates them on the corners used (D. Kogan, mrcal: "projection uncertainty", "differencing"). To first order, with
the projection q(theta, X), its Jacobians J_theta by the intrinsics and J_X by the point, and that of the motion, J_m =
J_X [-[X]x, 1]:

    dq(X) = (J_theta(X) - J_m(X) G) dtheta,      G = (sum J_m^T J_m)^-1 sum J_m^T J_theta   over the corners used,

so that cov q = E cov(theta) E^T with E = J_theta - J_m G.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from lab.formats.results import GeometryFit
from sim.scene.projection import COUNT, PINHOLE, Projection

Array = NDArray[np.floating[Any]]

GAUGE_CORNERS = 600  # that determine the rigid motion; more change nothing
GRID_COLS, GRID_ROWS = 25, 19
FLOOR_PX = 1e-3  # differences below this are rounding


@dataclass(frozen=True)
class CameraGeometry:
    """A projection with its `intrinsics` (12,), in the order of `projection.names`."""

    projection: Projection
    intrinsics: Array

    @classmethod
    def of(
        cls, camera_matrix: ArrayLike, distortion: Sequence[float] = (), projection: Projection = PINHOLE
    ) -> CameraGeometry:
        """Return a camera from its matrix (3, 3), px, and its distortion coefficients."""
        return cls(projection, projection.intrinsics(camera_matrix, distortion))

    @classmethod
    def of_fit(cls, fit: GeometryFit) -> CameraGeometry:
        """Return a fitted camera."""
        return cls.of(fit.camera_matrix, fit.distortion, Projection(fit.lens_projection, fit.spline_angle_deg))

    @property
    def matrix(self) -> Array:
        """Return the camera matrix (3, 3)."""
        fx, fy, cx, cy = self.intrinsics[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """Return the distortion coefficients as results state them."""
        return self.projection.distortion(self.intrinsics)

    def project(self, points: Array) -> Array:
        """Project points (n, 3) in the frame of the camera to px (n, 2)."""
        return self.projection.project(points, self.intrinsics)

    def project_with_jacobian(self, points: Array) -> tuple[Array, Array, Array]:
        """Project points (n, 3) to px (n, 2). Returns these and their Jacobians by the point (n, 2, 3) and by the
        intrinsics (n, 2, 12).
        """
        return self.projection.project_with_jacobian(points, self.intrinsics)

    def unproject(self, image: Array) -> Array:
        """Find the rays (n, 3) of length 1 of px (n, 2); NaN where the projection has no inverse."""
        return self.projection.unproject(image, self.intrinsics)

    def at_depth(self, image: Array, depth_mm: ArrayLike) -> Array:
        """Return the points (n, 3), mm, that project to `image` (n, 2) at a depth along the axis; NaN where none
        does.
        """
        rays = self.unproject(image)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.asarray(depth_mm) / rays[:, 2]
        return rays * np.where(distance > 0.0, distance, np.nan)[:, None]


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
    points = CameraGeometry.of_fit(fit).at_depth(image, depth)
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // GAUGE_CORNERS)]


def points_at(image: Array, camera: CameraGeometry, distance_mm: float | None) -> Array:
    """Return the points (n, 3), mm, that project to `image` (n, 2) at a distance from the camera; None: far away. NaN
    where there are none.
    """
    return camera.unproject(image) * (1e9 if distance_mm is None else distance_mm)


def _motion_jacobian(points: Array, by_point: Array, unit_mm: float) -> Array:
    """Return the Jacobian (n, 2, 6) of the projection by a rotation of the camera, and by a translation in units of
    `unit_mm`.
    """
    return np.concatenate([-by_point @ cross_matrices(points), by_point * unit_mm], axis=2)


def error_operator(camera: CameraGeometry, gauge: Array, points: Array) -> Array:
    """Return E (n, 2, 12), the Jacobian of the projections of `points` by the intrinsics, without the motion implied on
    `gauge` (m, 3).
    """
    _, by_point, by_camera = camera.project_with_jacobian(gauge)
    unit_mm = float(np.median(np.linalg.norm(gauge, axis=1)))
    motion = _motion_jacobian(gauge, by_point, unit_mm).reshape(-1, 6)
    implied = np.linalg.lstsq(motion, by_camera.reshape(-1, by_camera.shape[2]), rcond=1e-12)[0]
    _, by_point, by_camera = camera.project_with_jacobian(points)
    return by_camera - _motion_jacobian(points, by_point, unit_mm) @ implied


def projection_std(camera: CameraGeometry, covariance: Array, gauge: Array, points: Array) -> Array:
    """Return the standard deviation (n,) of the projections of `points` in the worst direction, px; NaN where a point
    is NaN.

    `covariance` (12, 12) of the intrinsics; `gauge` (m, 3), `points` (n, 3), mm, in the frame of the camera.
    """
    found = np.full(len(points), np.nan)
    there = np.isfinite(points).all(axis=1)
    operator = error_operator(camera, gauge, points[there])
    blocks = operator @ covariance @ np.swapaxes(operator, 1, 2)
    found[there] = np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, -1], 0.0))
    return found


def implied_motion(first: CameraGeometry, second: CameraGeometry, gauge: Array) -> tuple[Array, Array]:
    """Find the rotation and translation from the frame of the first camera to that of the second.

    With it `second` projects `gauge` (m, 3), points in the frame of the first, to where `first` does; by Gauss-Newton.
    """
    wanted = first.project(gauge)
    rotation, translation = np.eye(3), np.zeros(3)
    for _ in range(10):
        points = gauge @ rotation.T + translation
        seen, by_point, _ = second.project_with_jacobian(points)
        jacobian = np.concatenate([-by_point @ cross_matrices(points - translation), by_point], axis=2).reshape(-1, 6)
        scale = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / scale, (wanted - seen).ravel(), rcond=1e-12)[0] / scale
        rotation, translation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, translation + step[3:]
        if np.abs(jacobian @ step).max() < 1e-9:
            break
    return rotation, translation


def difference(
    first: CameraGeometry, second: CameraGeometry, covariances: tuple[Array, Array], gauge: Array, points: Array
) -> Difference:
    """Compare how `second` projects `points` (n, 3), in the frame of the first camera, with `first`.

    `covariances` (12, 12): of the intrinsics of the first and of the second camera, whose errors are independent;
    `gauge`: see `implied_motion`. The cameras may have different projections.
    """
    rotation, translation = implied_motion(first, second, gauge)
    moved, moved_gauge = (one @ rotation.T + translation for one in (points, gauge))
    vectors = second.project(moved) - first.project(points)
    factors = [
        _error_factor(camera, covariance, own_gauge, own_points)
        for camera, covariance, own_gauge, own_points in (
            (first, covariances[0], gauge, points),
            (second, covariances[1], moved_gauge, moved),
        )
    ]
    return Difference(vectors, np.concatenate(factors, axis=1))


def _error_factor(camera: CameraGeometry, covariance: Array, gauge: Array, points: Array) -> Array:
    """Return a factor (2n, 12) of the covariance of the projections of `points` (n, 3), without an implied motion."""
    operator = error_operator(camera, gauge, points).reshape(-1, COUNT)
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))  # the scales differ by orders of magnitude
    values, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray((operator * unit) @ (axes * np.sqrt(np.maximum(values, 0.0))))
