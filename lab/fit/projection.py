"""How well a calibrated camera projects, and how two calibrations differ: with the motion that they imply taken out.

A calibration knows its camera only up to where the camera was: a slightly turned camera whose principal point lies a little
aside sees boards almost alike. Errors of the intrinsics are therefore counted after the rigid motion that best undoes them
on the corners that were used, as mrcal does (D. Kogan, mrcal: "projection uncertainty", "differencing"). In first order, with the
projection q(theta, X), its slopes J_theta by the intrinsics and J_X by the point, and the motion's J_m = J_X [-[X]x, 1]:

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

from lab.fit.pinhole import cross_matrices, intrinsics_of_fit, project, project_slopes, unproject
from lab.formats.results import GeometryFit

Array = NDArray[np.floating[Any]]

GAUGE_CORNERS = 600  # as many corners as tie the motion down; more change nothing
GRID_COLS, GRID_ROWS = 25, 19
FLOOR_PX = 1e-3  # below this no difference counts: two calibrations of the same numbers differ by rounding


@dataclass(frozen=True)
class Difference:
    """Two calibrations at n points of the frame: `vectors_px` (n, 2), second less first with the implied motion taken out, and a
    `factor` (2n, k) of their covariance, factor factor^T."""

    vectors_px: Array
    factor: Array

    @property
    def rms_px(self) -> float:
        """Root of the mean squared length."""
        return float(np.sqrt(np.mean(np.sum(self.vectors_px**2, axis=1))))

    @property
    def expected_px(self) -> float:
        """What `rms_px` would be by the uncertainties alone."""
        return float(np.sqrt(np.sum(self.factor**2) / len(self.vectors_px)))

    @property
    def variances_px2(self) -> Array:
        """(n, 2) of the vectors."""
        return np.asarray(np.sum(self.factor**2, axis=1).reshape(-1, 2))

    @property
    def p_value(self) -> float:
        """Chance of such a difference by the uncertainties alone: chi2 over the directions in which the calibrations can
        differ at all."""
        directions, spread, _ = np.linalg.svd(self.factor, full_matrices=False)
        open_ones = spread > max(1e-3 * float(spread[0]), FLOOR_PX)
        if not open_ones.any():
            return 1.0 if self.rms_px < 10 * FLOOR_PX else 0.0
        along = directions[:, open_ones].T @ self.vectors_px.ravel()
        return float(special.chdtrc(int(open_ones.sum()), np.sum((along / spread[open_ones]) ** 2)))

    @property
    def significance_sigma(self) -> float:
        """`p_value` as that many standard deviations of a normal distribution, two-sided."""
        return -float(special.ndtri(max(self.p_value, 1e-300) / 2.0))


def grid(shape: tuple[int, int]) -> tuple[Array, Array]:
    """Columns' x and rows' y of the maps, px, from edge to edge of a frame of `shape` (rows, cols)."""
    return np.linspace(0, shape[1] - 1, GRID_COLS), np.linspace(0, shape[0] - 1, GRID_ROWS)


def grid_points(x: Array, y: Array) -> Array:
    """(n, 2) points of the grid, row by row."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def seen_points(fit: GeometryFit) -> Array:
    """Places (n, 3) of the corners that a calibration rests on, in the camera's frame."""
    image = np.array([(x, y) for view in fit.residuals for x, y in zip(view.x_px, view.y_px, strict=True)])
    depth = np.array([z for view in fit.residuals for z in view.depth_mm])
    if not len(image):
        return np.zeros((0, 3))
    points = unproject(image, intrinsics_of_fit(fit)) * depth[:, None]
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // GAUGE_CORNERS)]


def points_at(image: Array, intrinsics: Array, distance_mm: float | None) -> Array:
    """Points (n, 3) that project to `image` (n, 2) at a distance from the camera; far away for None. NaN where none does."""
    rays = unproject(image, intrinsics)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return rays * (1e9 if distance_mm is None else distance_mm)


def _motion_slopes(points: Array, by_point: Array, unit_mm: float) -> Array:
    """Slopes (n, 2, 6) of the projection by a turn of the camera, and by a shift in units of `unit_mm`."""
    return np.concatenate([-by_point @ cross_matrices(points), by_point * unit_mm], axis=2)


def error_operator(intrinsics: Array, gauge: Array, points: Array) -> Array:
    """E (n, 2, 12): how the projections of `points` answer to the intrinsics, the implied motion taken out."""
    _, by_point, by_camera = project_slopes(gauge, intrinsics)
    unit_mm = float(np.median(np.linalg.norm(gauge, axis=1)))
    motion = _motion_slopes(gauge, by_point, unit_mm).reshape(-1, 6)
    implied = np.linalg.lstsq(motion, by_camera.reshape(-1, by_camera.shape[2]), rcond=1e-12)[0]
    _, by_point, by_camera = project_slopes(points, intrinsics)
    return by_camera - _motion_slopes(points, by_point, unit_mm) @ implied


def projection_std(intrinsics: Array, covariance: Array, gauge: Array, points: Array) -> Array:
    """Standard uncertainty (n,) of the projections of `points` in the worst direction, px; NaN where a point is NaN."""
    found = np.full(len(points), np.nan)
    there = np.isfinite(points).all(axis=1)
    operator = error_operator(intrinsics, gauge, points[there])
    blocks = operator @ covariance @ np.swapaxes(operator, 1, 2)
    found[there] = np.sqrt(np.maximum(np.linalg.eigvalsh(blocks)[:, -1], 0.0))
    return found


def implied_motion(first: Array, second: Array, gauge: Array) -> tuple[Array, Array]:
    """Rotation and shift of points from the first camera's frame to the second's, so that `second` projects `gauge`, points in
    the first's frame, to where `first` does: by Gauss and Newton."""
    wanted = project(gauge, first)
    rotation, shift = np.eye(3), np.zeros(3)
    for _ in range(10):
        points = gauge @ rotation.T + shift
        seen, by_point, _ = project_slopes(points, second)
        slopes = np.concatenate([-by_point @ cross_matrices(points - shift), by_point], axis=2).reshape(-1, 6)
        scale = np.linalg.norm(slopes, axis=0)
        step = np.linalg.lstsq(slopes / scale, (wanted - seen).ravel(), rcond=1e-12)[0] / scale
        rotation, shift = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation, shift + step[3:]
        if np.abs(slopes @ step).max() < 1e-9:
            break
    return rotation, shift


def difference(
    first: Array,
    second: Array,
    covariance: Array,
    gauge: Array,
    points: Array,
) -> Difference:
    """How `second` (12,) projects `points`, in the first camera's frame, otherwise than `first`; `covariance` (12, 12) of the two
    intrinsics' difference."""
    rotation, shift = implied_motion(first, second, gauge)
    vectors = project(points @ rotation.T + shift, second) - project(points, first)
    operator = error_operator(first, gauge, points).reshape(-1, len(first))
    unit = np.sqrt(
        np.maximum(np.diag(covariance), 1e-300)
    )  # focal lengths and coefficients differ by orders of magnitude
    values, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    return Difference(vectors, (operator * unit) @ (axes * np.sqrt(np.maximum(values, 0.0))))
