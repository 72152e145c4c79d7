"""Uncertainty of the depth that a stereo pair triangulates.

A point P in the frame of the left camera is seen at q(theta, P), (4,) px in both frames. With A = dq/dP and B =
dq/dtheta, the triangulated point moves by dP = -(A^T A)^-1 A^T (B dtheta - dq).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.formats.results import DepthUncertainty
from lab.observables.boards.bundle_adjustment import RIG, Solution
from lab.observables.boards.projection import cross_matrices, grid, grid_points

Array = NDArray[np.floating[Any]]


def triangulation_jacobian(solution: Solution, points: Array) -> tuple[Array, Array]:
    """Return the Jacobian of where both cameras see `points` (n, 3), left then right: by the point (n, 4, 3), and by
    the shared parameters (n, 4, parameters).
    """
    state, free = solution.state, solution.free
    shared = np.zeros((len(points), 4, len(solution.names)))
    by_point = np.empty((len(points), 4, 3))
    _, by_point[:, :2], by_camera = state.camera(0).project_with_jacobian(points)
    first = int(free[0].sum())
    shared[:, :2, :first] = by_camera[:, :, free[0]]
    turned = points @ state.rotation.T
    _, point_jacobian, by_camera = state.camera(1).project_with_jacobian(turned + state.translation_mm)
    by_point[:, 2:] = point_jacobian @ state.rotation
    at = solution.names.index(RIG[0])
    shared[:, 2:, first:at] = by_camera[:, :, free[1]]
    shared[:, 2:, at : at + 3] = -point_jacobian @ cross_matrices(turned)
    shared[:, 2:, at + 3 : at + 6] = point_jacobian
    return by_point, shared


def depth_std(solution: Solution, points: Array, corner_px_std: float) -> tuple[Array, Array]:
    """Return the standard deviation (n,), mm, of the triangulated depth of `points` (n, 3): by the calibration, and by
    calibration and corners together.

    `corner_px_std`: standard deviation of a coordinate of a corner in both pictures.
    """
    by_point, shared = triangulation_jacobian(solution, points)
    inverse = np.linalg.pinv(by_point)[:, 2, :]  # (n, 4): the row of the depth
    by_parameter = -np.einsum("nk,nkp->np", inverse, shared)
    calibration = np.einsum("np,pq,nq->n", by_parameter, solution.covariance, by_parameter)
    matching = corner_px_std**2 * np.sum(inverse**2, axis=1)
    return np.sqrt(calibration), np.sqrt(calibration + matching)


def depth_uncertainty(solution: Solution, depth_mm: float, shapes: Sequence[tuple[int, int]]) -> DepthUncertainty:
    """Map `depth_std` over the frame of the left camera at one depth, where the right camera sees the point.

    `depth_mm`: of the points, along the axis of the left camera; `shapes`: (rows, cols) of the left and right frames.
    """
    x, y = grid(shapes[0])
    state = solution.state
    points = state.camera(0).at_depth(grid_points(x, y), depth_mm)
    there = np.all(np.isfinite(points), axis=1)
    seen = np.full((len(points), 2), np.nan)
    on_right = points[there] @ state.rotation.T + state.translation_mm
    front = state.camera(1).projection.sees(on_right)
    there[there] = front
    seen[there] = state.camera(1).project(on_right[front])
    rows, cols = shapes[1]
    there &= (seen[:, 0] >= 0) & (seen[:, 0] <= cols - 1) & (seen[:, 1] >= 0) & (seen[:, 1] <= rows - 1)
    maps = np.full((2, len(points)), np.nan)
    if there.any():
        maps[:, there] = depth_std(solution, points[there], solution.noise_px)
    calibration, total = maps.reshape(2, len(y), len(x))
    return DepthUncertainty(
        depth_mm=float(depth_mm),
        x_px=x.tolist(),
        y_px=y.tolist(),
        calibration_mm_std=_open_rows(calibration),
        total_mm_std=_open_rows(total),
    )


def _open_rows(values: Array) -> tuple[tuple[float | None, ...], ...]:
    """Return a matrix, row by row, with None where it isn't finite."""
    return tuple(tuple(float(value) if np.isfinite(value) else None for value in row) for row in values)
