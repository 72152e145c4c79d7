"""Errors that neighbouring corners share, from the residuals: the error of the model beside the noise of the corners.

A board that ripples, a print that is off, or a lens that the model does not follow displaces neighbouring corners
alike. The covariance of a solve takes corners as independent, and is too small then. Here the residuals of one
coordinate, over all corners of a pose, are drawn from

    V = s^2 (1 + a C K),      K_ij = exp(-(dx / lx)^2 / 2 - (dy / ly)^2 / 2),

with dx, dy the distances of two corners on the board, and C_ij = 1 within one camera, r between two. Poses are
independent: the error falls with the number of poses, not with that of corners. The parameters maximise the restricted
likelihood (Patterson and Thompson 1971), which allows for what the fit has absorbed. Where it is no better than that of
independent corners, nothing changes.

The estimates of the solve stay. Their covariance becomes the sandwich A^-1 B A^-1 of Huber (1967) and White (1980), with
A = sum J^T J the normal matrix of the solve, J the Jacobian without the poses, and B the covariance of the scores J^T r of
the poses. A dozen poses are too few for a matrix of a dozen parameters: their B is shrunk towards sum J^T V J.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

Array = NDArray[np.floating[Any]]

#: Twice the log of the ratio of likelihoods, above which corners are taken as correlated: chi2 of four parameters
#: exceeds it once in 1000.
LEAST_LIKELIHOOD_RATIO = 18.5
LENGTHS_SQUARES = (0.5, 10.0)  # bounds of lx and ly
AMOUNTS = (1e-3, 1e4)  # bounds of a
LARGEST_BETWEEN = 0.999  # bound of r
START = (1.0, 1.5, 1.5, 0.5)  # a, lx, ly, r
STIFFNESS = 1.0  # degrees of freedom of the fitted V beside those of the scores, of the number of parameters
TOLERANCE = 1e-6  # relative, of the deviance of about 1e4: 0.01
MOST_POSES = 40  # that V is fitted to; more change little and take long


@dataclass(frozen=True)
class PoseErrors:
    """What the corners of one pose say of V.

    `squares` (n, 2): places on the board, in squares. `camera` (n,): 0 or 1. `residuals` (n, 2), px. `shared` (n, 2,
    k), `by_pose` (n, 2, 6): Jacobians of both coordinates by the shared parameters and by the pose.
    """

    squares: Array
    camera: NDArray[np.int64]
    residuals: Array
    shared: Array
    by_pose: Array


@dataclass(frozen=True)
class CorrelatedErrors:
    """V, fitted.

    `noise_px`: s. `amplitude_px`: s sqrt(a), before the fit absorbs a part. `length_squares`: lx, ly. `between_cameras`:
    r; 1 of a single camera. `likelihood_ratio`: 2 log of the likelihood over that of independent corners.
    """

    noise_px: float
    amplitude_px: float
    length_squares: tuple[float, float]
    between_cameras: float
    likelihood_ratio: float

    def covariance(self, pose: PoseErrors) -> Array:
        """V (n, n), px^2, of one coordinate of the corners of a pose."""
        shared = correlation(pose, self.length_squares, self.between_cameras)
        return np.asarray(self.amplitude_px**2 * shared + self.noise_px**2 * np.eye(len(shared)))


def correlation(pose: PoseErrors, length_squares: tuple[float, float], between_cameras: float) -> Array:
    """C K (n, n) of the corners of a pose."""
    at = pose.squares / np.array(length_squares)
    square = np.sum((at[:, None, :] - at[None, :, :]) ** 2, axis=2)
    same = pose.camera[:, None] == pose.camera[None, :]
    return np.asarray(np.exp(-0.5 * square) * np.where(same, 1.0, between_cameras))


def fit_correlated_errors(poses: Sequence[PoseErrors], prior: Array) -> CorrelatedErrors | None:
    """V from the residuals at the end of a solve; None where independent corners explain them.

    `prior` (k,): what priors add to the diagonal of the normal matrix of the shared parameters.
    """
    poses = poses[:: -(-len(poses) // MOST_POSES)]
    freedom = sum(2 * len(pose.squares) - 6 for pose in poses) - len(prior)
    if freedom < 1 or not any(np.any(pose.residuals) for pose in poses):
        return None
    groups = _equal_poses(poses)
    two = any(np.ptp(pose.camera) > 0 for pose in poses)

    def deviance_of(point: Array) -> tuple[float, float]:
        amount, along_x, along_y = np.exp(point[:3])
        return _deviance(groups, prior, float(amount), (along_x, along_y), float(point[3]) if two else 1.0)

    count = 4 if two else 3
    bounds = [*np.log([AMOUNTS, LENGTHS_SQUARES, LENGTHS_SQUARES]).tolist(), [0.0, LARGEST_BETWEEN]][:count]
    start = np.array([*np.log(START[:3]), START[3]][:count])
    best = optimize.minimize(
        lambda point: deviance_of(point)[0], start, bounds=bounds, method="L-BFGS-B", options={"ftol": TOLERANCE}
    )
    ratio = _deviance(groups, prior, 0.0, (1.0, 1.0), 1.0)[0] - float(best.fun)
    if not ratio > LEAST_LIKELIHOOD_RATIO:
        return None
    noise_px = float(np.sqrt(deviance_of(best.x)[1]))
    amount, along_x, along_y = (float(value) for value in np.exp(best.x[:3]))
    between = float(best.x[3]) if two else 1.0
    return CorrelatedErrors(noise_px, noise_px * float(np.sqrt(amount)), (along_x, along_y), between, ratio)


def sandwich_covariance(poses: Sequence[PoseErrors], errors: CorrelatedErrors, prior: Array) -> Array:
    """Covariance (k, k) of the shared parameters: A^-1 B A^-1.

    B is sum J^T V J of the fitted V, brought to the size of the scores s = J^T r of the poses, whose covariance under V
    is known. Their mean square over all directions gives its amount; their matrix, shrunk to that amount with
    `STIFFNESS` k degrees of freedom, gives the directions.
    """
    free, model = [], []
    for pose in poses:
        count = len(pose.squares)
        own = pose.by_pose.reshape(2 * count, 6)
        shared = pose.shared.reshape(2 * count, -1)
        # Without the part that the pose takes up
        free.append(shared - own @ np.linalg.lstsq(own, shared, rcond=None)[0])
        model.append(errors.covariance(pose))
    scale = np.sqrt(np.maximum(sum(np.sum(one**2, axis=0) for one in free) + prior, 1e-300))
    free = [one / scale for one in free]
    normals = np.array([one.T @ one for one in free])
    middles = np.array(
        [one.T @ (v @ one.reshape(len(v), -1)).reshape(one.shape) for one, v in zip(free, model, strict=True)]
    )
    scores = np.array([one.T @ pose.residuals.ravel() for one, pose in zip(free, poses, strict=True)])
    own_prior = np.diag(prior / scale**2)
    inverse = np.linalg.inv(normals.sum(axis=0) + own_prior)
    middle = middles.sum(axis=0) + own_prior * errors.noise_px**2
    middle = _as_scores_say(middle, middles, normals @ inverse, scores)
    found = inverse @ middle @ inverse / np.outer(scale, scale)
    return np.asarray(0.5 * (found + found.T))


def _as_scores_say(middle: Array, middles: Array, leverage: Array, scores: Array) -> Array:
    """B (k, k), from `middle`, that of V, and the `scores` (poses, k). `leverage` (poses, k, k): A_p A^-1.

    The parameters have absorbed a part of the scores: s_p = e_p - A_p A^-1 sum e, with e_p ~ (0, B_p).
    """
    turned = leverage @ middles
    expected = middles - turned - np.swapaxes(turned, 1, 2) + leverage @ middle @ np.swapaxes(leverage, 1, 2)
    size, count = len(middle), len(scores)
    try:
        whitening = np.linalg.cholesky(expected.sum(axis=0))
        factor = np.linalg.cholesky(middle)
    except np.linalg.LinAlgError:
        return middle
    white = np.linalg.solve(whitening, scores.T)
    seen = white @ white.T
    stiffness = STIFFNESS * size
    amount = float(np.trace(seen)) / size
    mixed = (stiffness * amount * np.eye(size) + (count - 1) * seen) / (stiffness + count - 1)
    return np.asarray(factor @ mixed @ factor.T)


@dataclass(frozen=True)
class _EqualPoses:
    """Poses in which the same corners were seen; they have one V.

    `square_x`, `square_y` (n, n): squared distances on the board. `same_camera` (n, n). `columns` (n, poses, 2, k + 7):
    Jacobians and residuals.
    """

    square_x: Array
    square_y: Array
    same_camera: NDArray[np.bool_]
    columns: Array


def _equal_poses(poses: Sequence[PoseErrors]) -> list[_EqualPoses]:
    groups: dict[bytes, list[PoseErrors]] = {}
    for pose in poses:
        groups.setdefault(pose.squares.tobytes() + pose.camera.tobytes(), []).append(pose)
    found = []
    for group in groups.values():
        x, y = group[0].squares.T
        camera = group[0].camera
        columns = [np.concatenate([one.shared, one.by_pose, one.residuals[:, :, None]], axis=2) for one in group]
        found.append(
            _EqualPoses(
                (x[:, None] - x) ** 2, (y[:, None] - y) ** 2, camera[:, None] == camera, np.stack(columns, axis=1)
            )
        )
    return found


def _deviance(
    groups: Sequence[_EqualPoses],
    prior: Array,
    amount: float,
    length_squares: tuple[float, float],
    between_cameras: float,
) -> tuple[float, float]:
    """-2 log of the restricted likelihood, with s^2 at its maximum, and that s^2:

    (N - p) log s^2 + log |V / s^2| + log |X^T V^-1 X s^2|,      s^2 = r^T P r / (N - p).
    """
    size = len(prior)
    normal, log_determinant, freedom = np.zeros((size + 1, size + 1)), 0.0, -size
    for group in groups:
        count, poses, _, width = group.columns.shape
        shared = np.exp(-0.5 * (group.square_x / length_squares[0] ** 2 + group.square_y / length_squares[1] ** 2))
        unit = amount * np.where(group.same_camera, shared, between_cameras * shared)
        unit[np.diag_indices(count)] += 1.0
        factor = linalg.cholesky(unit, lower=True, check_finite=False)
        white = linalg.solve_triangular(factor, group.columns.reshape(count, -1), lower=True, check_finite=False)
        of_poses = np.moveaxis(white.reshape(count, poses, 2, width), 1, 0).reshape(poses, 2 * count, width)
        product = np.swapaxes(of_poses, 1, 2) @ of_poses
        pose, rest = slice(size, size + 6), [*range(size), size + 6]
        own, mixed = product[:, pose, pose], product[:, pose, rest]
        # Schur complement of the poses
        normal += (product[:, rest][:, :, rest] - np.swapaxes(mixed, 1, 2) @ np.linalg.solve(own, mixed)).sum(axis=0)
        log_determinant += 4.0 * poses * float(np.log(np.diag(factor)).sum()) + float(np.linalg.slogdet(own)[1].sum())
        freedom += poses * (2 * count - 6)
    right, square = normal[:-1, -1], float(normal[-1, -1])
    matrix = normal[:-1, :-1] + np.diag(prior)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(scale, scale)
    log_determinant += float(np.linalg.slogdet(scaled)[1]) + 2.0 * float(np.log(scale).sum())
    square -= float((right / scale) @ np.linalg.solve(scaled, right / scale))
    variance = max(square / freedom, 1e-300)
    return freedom * float(np.log(variance)) + log_determinant, variance
