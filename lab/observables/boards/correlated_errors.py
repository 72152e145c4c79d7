"""Errors that the corners of a pose share, and the covariance of a bundle adjustment that holds them.

A board that ripples, a print that is off, or a lens that the model does not follow displaces neighbouring corners
alike. That is an error of the model, beside the noise of the corners. The covariance of a solve takes corners as
independent, and is too small then. Here the residuals of one coordinate, over all corners of a pose, are drawn from

    V = s^2 (1 + a C K),      K_ij = exp(-(dx / lx)^2 / 2 - (dy / ly)^2 / 2),

with dx, dy the distances of two corners on the board, and C_ij = 1 within one camera, r between two. Poses are
independent: the error falls with the number of poses, not with that of corners. The parameters maximise the restricted
likelihood (Patterson and Thompson 1971), which allows for what the fit has absorbed. Where it is no better than that of
independent corners, nothing changes.

A lens that doesn't project as its model displaces the corners at one place of the frame alike in every view. Neither
views nor halves of them show that by their scatter; what shows it is that residuals have a mean over the frame. This
discrepancy is taken as radial, d(r) = (r / R) h(r / R), R the distance of the farthest corner from the principal point,
with h a Gaussian process of variance b^2 and correlation length R / 4 (Kennedy and O'Hagan 2001). b is the most likely
one, given what poses and parameters leave of d in the residuals (`fit_lens_error`). The part of d that the parameters
have absorbed, a focal length that is off, is in their covariance: A^-1 (sum J^T d) (sum J^T d)^T A^-1 over all poses.

The estimates of the solve stay. Their covariance becomes the sandwich A^-1 B A^-1 of Huber (1967) and White (1980),
with A = sum J^T J the normal matrix of the solve, J the Jacobian without the poses, and B the covariance of the scores
J^T r of the poses. A dozen poses are too few for a matrix of a dozen parameters: their B is shrunk towards sum J^T V J.
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
ERROR_LENGTHS_SQUARES = (0.5, 10.0)  # bounds of lx and ly
ERROR_AMOUNTS = (1e-3, 1e4)  # bounds of a
LARGEST_BETWEEN = 0.999  # bound of r
FIRST_ERRORS = (1.0, 1.5, 1.5, 0.5)  # a, lx, ly, r
STIFFNESS = 1.0  # degrees of freedom of the fitted V beside those of the scores, of the number of parameters
DEVIANCE_TOLERANCE = 1e-6  # relative, of the deviance of about 1e4: 0.01
MOST_POSES = 40  # that V is fitted to; more change little and take long
#: Of the discrepancy of a lens: places at which it is free; its correlation length, of the radius of the farthest
#: corner. What varies more slowly the polynomials of the projections follow, and residuals can't show it.
LENS_NODES = 8
LENS_LENGTH = 0.25
LEAST_SHOWN = 1e-4  # of the largest part of the discrepancy, below which parameters have taken up a part of it
#: Twice the log of the ratio of likelihoods, above which a lens is taken as departing from its projection: half a chi2
#: of one parameter, whose bound is 0, exceeds it once in 1000.
LEAST_LENS_RATIO = 9.55
LENS_RANGE = 12.0  # of the log of b, below the largest part that is seen: 6e-6 of it


@dataclass(frozen=True)
class PoseErrors:
    """Residuals and Jacobians of the corners of one pose, which determine V.

    `squares` (n, 2): places on the board, in squares. `camera` (n,): 0 or 1. `residuals` (n, 2), px. `shared` (n, 2,
    k), `by_pose` (n, 2, 6): Jacobians of both coordinates by the shared parameters and by the pose. `away` (n, 2): from
    the principal point of the camera, over the distance of its farthest corner.
    """

    squares: Array
    camera: NDArray[np.int64]
    residuals: Array
    shared: Array
    by_pose: Array
    away: Array


def _lens_columns(pose: PoseErrors) -> Array:
    """Return the displacements (n, 2, m), px, of the corners of a pose by the discrepancy of the lens, d(r) for b = 1:
    one for each of its m independent parts, those of camera 0, then those of camera 1.
    """
    nodes = np.linspace(0.0, 1.0, LENS_NODES)

    def covariance(a: Array, b: Array) -> Array:
        return np.asarray(np.exp(-0.5 * ((a[:, None] - b[None, :]) / LENS_LENGTH) ** 2))

    factor = np.linalg.cholesky(covariance(nodes, nodes) + 1e-9 * np.eye(LENS_NODES))
    radius = np.linalg.norm(pose.away, axis=1)
    parts = linalg.solve_triangular(factor, covariance(nodes, radius), lower=True).T
    found = np.zeros((len(radius), 2, 2 * LENS_NODES))
    for camera in (0, 1):
        its = pose.camera == camera
        found[its, :, camera * LENS_NODES : (camera + 1) * LENS_NODES] = pose.away[its, :, None] * parts[its, None, :]
    return found


@dataclass(frozen=True)
class CorrelatedErrors:
    """V, fitted.

    `noise_px`: s. `amplitude_px`: s sqrt(a), before the fit absorbs a part. `length_squares`: lx, ly.
    `between_cameras`: r; 1 of a single camera. `likelihood_ratio`: 2 log of the likelihood over that of independent
    corners.
    """

    noise_px: float
    amplitude_px: float
    length_squares: tuple[float, float]
    between_cameras: float
    likelihood_ratio: float

    def covariance(self, squares: Array, camera: NDArray[np.int64]) -> Array:
        """Return the covariance V (n, n), px^2, of one coordinate of the corners of a pose: `squares` (n, 2), `camera`
        (n,), see `PoseErrors`.
        """
        shared = correlation(squares, camera, self.length_squares, self.between_cameras)
        return np.asarray(self.amplitude_px**2 * shared + self.noise_px**2 * np.eye(len(shared)))


def correlation(
    squares: Array, camera: NDArray[np.int64], length_squares: tuple[float, float], between_cameras: float
) -> Array:
    """Return the correlations C K (n, n) of the corners of a pose."""
    at = squares / np.array(length_squares)
    square = np.sum((at[:, None, :] - at[None, :, :]) ** 2, axis=2)
    same = camera[:, None] == camera[None, :]
    return np.asarray(np.exp(-0.5 * square) * np.where(same, 1.0, between_cameras))


def fit_correlated_errors(poses: Sequence[PoseErrors], prior: Array) -> CorrelatedErrors | None:
    """Fit V to the residuals at the end of a solve; None where independent corners explain them.

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
    bounds = [*np.log([ERROR_AMOUNTS, ERROR_LENGTHS_SQUARES, ERROR_LENGTHS_SQUARES]).tolist(), [0.0, LARGEST_BETWEEN]][
        :count
    ]
    start = np.array([*np.log(FIRST_ERRORS[:3]), FIRST_ERRORS[3]][:count])
    best = optimize.minimize(
        lambda point: deviance_of(point)[0],
        start,
        bounds=bounds,
        method="L-BFGS-B",
        options={"ftol": DEVIANCE_TOLERANCE},
    )
    ratio = _deviance(groups, prior, 0.0, (1.0, 1.0), 1.0)[0] - float(best.fun)
    if not ratio > LEAST_LIKELIHOOD_RATIO:
        return None
    noise_px = float(np.sqrt(deviance_of(best.x)[1]))
    amount, along_x, along_y = (float(value) for value in np.exp(best.x[:3]))
    between = float(best.x[3]) if two else 1.0
    return CorrelatedErrors(noise_px, noise_px * float(np.sqrt(amount)), (along_x, along_y), between, ratio)


def fit_lens_error(
    poses: Sequence[PoseErrors], errors: CorrelatedErrors | None, noise_px: float, prior: Array, values: Array
) -> tuple[float, Array]:
    """Fit the discrepancy of the lens to the residuals at the end of a solve. Returns b, px, its standard deviation at
    the farthest corner, and what it adds to the covariance (k, k) of the shared parameters.

    With F the columns of d for b = 1, without what poses and parameters take up, F^T r = F^T (F c + e) has the
    covariance b^2 G^2 + W, with G = F^T F and W = F^T V F of `errors` (None: `noise_px`^2 G). Priors count as
    observations of the parameters, whose `values` (k,) are their residuals. What the last step of the solve left of the
    gradient is taken out of F^T r. b is the most likely one; 0 where it is no better than none, by `LEAST_LENS_RATIO`.
    `prior`: see `fit_correlated_errors`.
    """
    size, count = len(prior), 2 * LENS_NODES
    normal, mixed = np.diag(prior).astype(float), np.zeros((size, count))
    gram, middle, score = np.zeros((count, count)), np.zeros((size + count, size + count)), np.zeros(size + count)
    middle[:size, :size] = noise_px**2 * np.diag(prior)
    for pose in poses:
        free = _free_of_pose(pose, np.concatenate([pose.shared, _lens_columns(pose)], axis=2))
        shared, lens = free[:, :size], free[:, size:]
        normal += shared.T @ shared
        mixed += shared.T @ lens
        gram += lens.T @ lens
        score += free.T @ pose.residuals.ravel()
        if errors is None:
            middle += noise_px**2 * (free.T @ free)
        else:
            v = errors.covariance(pose.squares, pose.camera)
            middle += free.T @ (v @ free.reshape(len(v), -1)).reshape(free.shape)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    absorbed = np.linalg.solve(normal / np.outer(scale, scale), mixed / scale[:, None]) / scale[:, None]  # A^-1 J^T F
    take = np.concatenate([-absorbed, np.eye(count)])
    score[:size] -= prior * values
    gram, middle, score = gram - mixed.T @ absorbed, take.T @ middle @ take, take.T @ score
    size_px, axes = np.linalg.eigh(gram)
    shown = size_px > LEAST_SHOWN * float(size_px.max(initial=0.0))
    axes, size_px = axes[:, shown], size_px[shown]
    if not shown.any():
        return 0.0, np.zeros((size, size))
    # Of each independent part: what is seen, its variance by noise, and its share for b = 1
    seen = (axes.T @ score) / np.sqrt(size_px)
    noise = np.maximum(np.einsum("ji,jk,ki->i", axes, middle, axes) / size_px, 1e-300)

    def deviance(log_amplitude: float) -> float:
        variance = noise + np.exp(2.0 * log_amplitude) * size_px
        return float(np.sum(np.log(variance) + seen**2 / variance))

    largest = float(np.sqrt(np.max(seen**2 / size_px)))
    if not largest > 0.0:
        return 0.0, np.zeros((size, size))
    found = optimize.minimize_scalar(
        deviance, bounds=(np.log(largest) - LENS_RANGE, np.log(largest) + 1.0), method="bounded"
    )
    none = float(np.sum(np.log(noise) + seen**2 / noise))
    amplitude_px = float(np.exp(found.x)) if none - float(found.fun) > LEAST_LENS_RATIO else 0.0
    return amplitude_px, amplitude_px**2 * np.asarray(absorbed @ absorbed.T)


def _free_of_pose(pose: PoseErrors, columns: Array) -> Array:
    """Return displacements `columns` (n, 2, k) of the corners, as (2n, k), without the part that the pose takes up."""
    own = pose.by_pose.reshape(2 * len(pose.squares), 6)
    flat = columns.reshape(len(own), -1)
    return np.asarray(flat - own @ np.linalg.lstsq(own, flat, rcond=None)[0])


def sandwich_covariance(poses: Sequence[PoseErrors], errors: CorrelatedErrors, prior: Array) -> Array:
    """Return the covariance (k, k) of the shared parameters: A^-1 B A^-1.

    B is sum J^T V J of the fitted V, brought to the size of the scores s = J^T r of the poses, whose covariance under V
    is known. Their mean square over all directions gives its amount; their matrix, shrunk to that amount with
    `STIFFNESS` k degrees of freedom, gives the directions.
    """
    free, model = [], []
    for pose in poses:
        free.append(_free_of_pose(pose, pose.shared))
        model.append(errors.covariance(pose.squares, pose.camera))
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
    """Bring B (k, k) to the size of the scores, from `middle`, that of V, and the `scores` (poses, k). `leverage`
    (poses, k, k): A_p A^-1.

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
    """Group the poses in which the same corners were seen."""
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
    """Return -2 log of the restricted likelihood, with s^2 at its maximum, and that s^2:

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
