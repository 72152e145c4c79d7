"""Bundle adjustment: cameras, the rig between two of them, the warp of the boards and their poses, by one
least-squares solve, whose covariance holds the errors that neighbouring corners share.

Minimised is sum |predicted - seen|^2 over all corners, in px, with weak priors on distortion and warp. Rotations are
updated locally, by a small rotation about the axes of the camera applied from the left, so that none is singular.
Poses are eliminated by the Schur complement: what is left is the normal matrix of the shared parameters. Its inverse
times the variance of a corner is their full covariance. See Triggs et al., "Bundle Adjustment: A Modern Synthesis"
(2000); the warp of the board follows mrcal (D. Kogan).

The warp of a board is z(x, y) = a (x^2 - 1/3) + b (y^2 - 1/3) + c x y mm, with x and y from -1 to 1 across the board:
a bend along each axis and a twist. A shift or a tilt would be a pose.

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
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize
from scipy.spatial.transform import Rotation

from lab.errors import NotDetermined
from lab.measure.board_detection import BoardView
from lab.measure.projection import CameraGeometry, cross_matrices
from sim.camera import ProjectionKind
from sim.scene.projection import COUNT, PINHOLE, WIDEST_DEG, Projection

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

RIG = ("turn_x_rad", "turn_y_rad", "turn_z_rad", "translation_x_mm", "translation_y_mm", "translation_z_mm")
WARP = ("bend_x_mm", "bend_y_mm", "twist_mm")
#: Standard deviation of the prior of each distortion term: share of the radius at the corner of the frame, and power of
#: the radius. Tens of px: it only keeps terms that no view determines from growing without bound.
DISTORTION_PRIOR: dict[ProjectionKind, dict[str, tuple[float, int]]] = {
    "pinhole": {
        "k1": (0.3, 2), "k2": (0.1, 4), "k3": (0.03, 6), "k4": (0.3, 2), "k5": (0.1, 4), "k6": (0.03, 6),
        "p1": (0.03, 1), "p2": (0.03, 1),
    },
    "equidistant": {"k1": (0.3, 2), "k2": (0.1, 4), "k3": (0.03, 6), "k4": (0.01, 8)},
    "splined_stereographic": {**{f"s{k}": (0.3, 0) for k in range(1, 7)}, "p1": (0.03, 1), "p2": (0.03, 1)},
}  # fmt: skip
WARP_PRIOR = 0.005  # standard deviation of the prior of a warp, of the diagonal of the board
FIRST_NOISE_PX = 0.1  # of a corner, for the weight of the priors in the first solve
MIN_POSE_CORNERS = 4  # that determine the pose of a plane
FOCAL_VIEWS = 6  # with which the first focal length of a fisheye is chosen
#: Trial focal lengths, of the longer side: half of it is 143 deg of an equidistant lens off its axis at 0.2 (a circular
#: fisheye of 180 deg has 0.32), and 14 deg at 2. Steps of 1.4: from twice the right one the solve still converges.
FOCAL_SHARES = (0.2, 0.28, 0.4, 0.56, 0.8, 1.1, 1.6, 2.2)
MAX_STEPS = 300  # a long lens of a small frame takes 60 to 200: its centre and its distortion trade with each other


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

    def covariance(self, pose: PoseErrors) -> Array:
        """Return the covariance V (n, n), px^2, of one coordinate of the corners of a pose."""
        shared = correlation(pose, self.length_squares, self.between_cameras)
        return np.asarray(self.amplitude_px**2 * shared + self.noise_px**2 * np.eye(len(shared)))


def correlation(pose: PoseErrors, length_squares: tuple[float, float], between_cameras: float) -> Array:
    """Return the correlations C K (n, n) of the corners of a pose."""
    at = pose.squares / np.array(length_squares)
    square = np.sum((at[:, None, :] - at[None, :, :]) ** 2, axis=2)
    same = pose.camera[:, None] == pose.camera[None, :]
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
            v = errors.covariance(pose)
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


def board_key(view: BoardView) -> tuple[object, ...]:
    """Return the properties of a board. Captures that agree in them show the same board."""
    capture = view.capture
    return capture.dictionary, capture.squares, capture.square_mm, capture.marker_mm


@dataclass(frozen=True)
class Observation:
    """A view: camera 0 or 1 saw pose number `pose` of board number `board`."""

    view: BoardView
    pose: int
    board: int = 0
    camera: int = 0


@dataclass(frozen=True)
class RigParameters:
    """All parameters.

    `projections`, `intrinsics` (cameras, 12): see `sim.scene.projection`. `rotation` (3, 3), `translation_mm` (3,):
    camera 0 to camera 1. `warps_mm` (boards, 3). `rotations` (poses, 3, 3), `translations_mm` (poses, 3): board to
    camera 0.
    """

    projections: tuple[Projection, ...]
    intrinsics: Array
    rotation: Array
    translation_mm: Array
    warps_mm: Array
    rotations: Array
    translations_mm: Array

    def camera(self, number: int = 0) -> CameraGeometry:
        """Return one of the cameras."""
        return CameraGeometry(self.projections[number], self.intrinsics[number])


@dataclass(frozen=True)
class Solution:
    """The end of a solve.

    `names` and `covariance` (n, n) are of the shared parameters, poses marginalised: the free intrinsics of each
    camera ("fx", or "left fx", "right fx" of two), rotation (about the axes of the second camera) and translation of
    the rig, and the warps. `free` (cameras, 12): which intrinsics were fitted. `residuals`: (n, 2) for each
    observation, seen less predicted, px. `noise_px`: standard deviation of one coordinate. `errors`: what neighbouring
    corners share, in `covariance`; None where corners are independent. `sampling_covariance` (n, n): by the independent
    part alone; None where this is `covariance`. `lens_px`: standard deviation, at the farthest corner, of the
    discrepancy of the lens from its projection, in `covariance`; 0 where the residuals show none.
    """

    state: RigParameters
    free: NDArray[np.bool_]
    names: tuple[str, ...]
    covariance: Array
    residuals: tuple[Array, ...]
    noise_px: float
    errors: CorrelatedErrors | None = None
    sampling_covariance: Array | None = None
    lens_px: float = 0.0

    @property
    def model_error_px(self) -> float:
        """Return the standard deviation of a coordinate beyond the independent noise of the corners; 0 where there is
        none.
        """
        own = 0.0 if self.errors is None else self.noise_px**2 - self.errors.noise_px**2
        return float(np.sqrt(max(own, 0.0)))

    @property
    def rms_px(self) -> float:
        """Return the root mean square of the distances of the corners from their predictions."""
        return rms_px(np.concatenate(self.residuals))

    @property
    def determined(self) -> bool:
        """Tell whether the covariance is finite and positive."""
        diagonal = np.diag(self.covariance)
        return bool(np.isfinite(diagonal).all() and (diagonal > 0).all())

    def std(self, camera: int = 0) -> Array:
        """Return the standard deviations (12,) of the intrinsics of a camera; 0 where they were held."""
        found = np.zeros(COUNT)
        found[self.free[camera]] = np.sqrt(np.diag(self.covariance)[self._of_camera(camera)])
        return found

    @property
    def covariance_by_sampling(self) -> Array:
        """Return the covariance (n, n) by the independent noise of the corners alone."""
        return self.covariance if self.sampling_covariance is None else self.sampling_covariance

    def of_camera(self, camera: int = 0, *, only_sampling: bool = False) -> Array:
        """Return the covariance (12, 12) of the intrinsics of a camera, 0 where they were held."""
        found = np.zeros((COUNT, COUNT))
        part = self._of_camera(camera)
        covariance = self.covariance_by_sampling if only_sampling else self.covariance
        found[np.ix_(self.free[camera], self.free[camera])] = covariance[part, part]
        return found

    def _of_camera(self, camera: int) -> slice:
        """Return the place of the intrinsics of a camera among the shared parameters."""
        start = int(self.free[:camera].sum())
        return slice(start, start + int(self.free[camera].sum()))


def rms_px(residuals: Array) -> float:
    """Return the root mean square of the length of vectors (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(np.square(residuals), axis=1))))


def warp_shape(view: BoardView) -> Array:
    """Return the height (n, 3) of the corners of a view, mm per mm of each of the three warp parameters."""
    rows, cols = view.capture.squares
    x = 2.0 * view.board_mm[:, 0] / (cols * view.capture.square_mm) - 1.0
    y = 2.0 * view.board_mm[:, 1] / (rows * view.capture.square_mm) - 1.0
    return np.column_stack([x * x - 1.0 / 3.0, y * y - 1.0 / 3.0, x * y])


def warp_prior_mm(view: BoardView) -> float:
    """Return the standard deviation of the prior of the warp of a board, mm."""
    return WARP_PRIOR * view.capture.square_mm * float(np.hypot(*view.capture.squares))


class BundleAdjustment:
    """The problem: `observations` in frames of `shape` (rows, cols); `free` (cameras, 12) says which intrinsics are
    fitted.

    `only_poses`: fit the poses alone, with everything else held; this shows how well a given camera predicts views.
    `boards`: their number, where not all of them are seen.
    """

    def __init__(
        self,
        observations: Sequence[Observation],
        free: NDArray[np.bool_],
        shape: tuple[int, int],
        *,
        only_poses: bool = False,
        boards: int = 0,
    ) -> None:
        self.observations = list(observations)
        self.free = free
        self.cameras = len(free)
        self.boards = max(boards, 1 + max(observation.board for observation in observations))
        self.poses = 1 + max(observation.pose for observation in observations)
        self.only_poses = only_poses
        ends = np.cumsum([len(observation.view.index) for observation in observations])
        self.parts = [
            slice(end - len(observation.view.index), end) for end, observation in zip(ends, observations, strict=True)
        ]
        self.flat = np.concatenate([observation.view.board_mm for observation in observations]).astype(float)
        self.shapes = np.concatenate([warp_shape(observation.view) for observation in observations])
        self.seen = np.concatenate([observation.view.image_px for observation in observations]).astype(float)
        self.of_camera = np.concatenate([np.full(len(s.view.index), s.camera) for s in observations])
        counts = [int(mask.sum()) for mask in free]
        self.at_rig = int(sum(counts))
        self.at_warp = self.at_rig + (6 if self.cameras > 1 else 0)
        self.size = 0 if only_poses else self.at_warp + 3 * self.boards
        self.prior_std = np.full(self.size, np.inf)
        if not only_poses:
            self._set_warp_priors(shape)

    def _set_warp_priors(self, shape: tuple[int, int]) -> None:
        """Set the priors of the warps of all boards."""
        self.half_diagonal_px = 0.5 * float(np.hypot(*shape))
        for number in range(self.boards):
            seen = [observation.view for observation in self.observations if observation.board == number] or [
                self.observations[0].view
            ]
            at = self.at_warp + 3 * number
            self.prior_std[at : at + 3] = warp_prior_mm(seen[0])

    def _set_distortion_prior(self, start: RigParameters) -> None:
        """Set the priors of the distortion terms, which need the focal length of the start: the radius of the corner of
        the frame follows from it.
        """
        at = 0
        for camera, mask in enumerate(self.free):
            radius = self.half_diagonal_px / float(start.intrinsics[camera, 0])
            std, projection = np.full(COUNT, np.inf), start.projections[camera]
            for name, (share, power) in DISTORTION_PRIOR[projection.kind].items():
                std[projection.names.index(name)] = share / radius**power
            count = int(mask.sum())
            self.prior_std[at : at + count] = std[mask]
            at += count

    def names(self, projections: Sequence[Projection]) -> tuple[str, ...]:
        """Return the names of the shared parameters, in their order."""
        if self.only_poses:
            return ()
        sides = [""] if self.cameras == 1 else ["left ", "right "]
        found = [
            side + name
            for side, mask, projection in zip(sides, self.free, projections, strict=True)
            for name, one in zip(projection.names, mask, strict=True)
            if one
        ]
        found += RIG if self.cameras > 1 else ()
        several = self.boards > 1
        return (*found, *(f"board {k + 1} {name}" if several else name for k in range(self.boards) for name in WARP))

    def _place_corners(self, state: RigParameters) -> tuple[Array, Array, Array]:
        """Place all corners (n, 3): in the frame of their camera; rotated into that of camera 0; and placed in it."""
        rotated, placed = np.empty_like(self.flat), np.empty_like(self.flat)
        for observation, part in zip(self.observations, self.parts, strict=True):
            on_board = self.flat[part].copy()
            on_board[:, 2] += self.shapes[part] @ state.warps_mm[observation.board]
            rotated[part] = on_board @ state.rotations[observation.pose].T
            placed[part] = rotated[part] + state.translations_mm[observation.pose]
        own = placed
        if self.cameras > 1:
            second = self.of_camera == 1
            own = placed.copy()
            own[second] = placed[second] @ state.rotation.T + state.translation_mm
        return own, rotated, placed

    def residuals(self, state: RigParameters) -> Array:
        """Return the residuals, seen less predicted (n, 2), px; infinite where a corner would be
        outside of what the projection is defined for."""
        own = self._place_corners(state)[0]
        predicted = np.empty_like(self.seen)
        for number in range(self.cameras):
            its, camera = self.of_camera == number, state.camera(number)
            if not (np.isfinite(own[its]).all() and camera.projection.sees(own[its]).all()):
                return np.full_like(self.seen, np.inf)
            predicted[its] = camera.project(own[its])
        return self.seen - predicted

    def jacobian(self, state: RigParameters) -> tuple[Array, Array]:
        """Return the Jacobian of the predictions by the shared parameters (n, 2, shared) and by the pose (n, 2, 6)."""
        own, rotated, placed = self._place_corners(state)
        count = len(own)
        shared = np.zeros((count, 2, self.size))
        by_point = np.empty((count, 2, 3))
        at = 0
        for camera, mask in enumerate(self.free):
            its = self.of_camera == camera
            _, point_jacobian, by_camera = state.camera(camera).project_with_jacobian(own[its])
            by_point[its] = point_jacobian
            if not self.only_poses:
                shared[its, :, at : at + int(mask.sum())] = by_camera[:, :, mask]
                at += int(mask.sum())
        in_first = by_point
        if self.cameras > 1:
            second = self.of_camera == 1
            if not self.only_poses:
                lever = placed[second] @ state.rotation.T
                shared[second, :, self.at_rig : self.at_rig + 3] = -by_point[second] @ cross_matrices(lever)
                shared[second, :, self.at_rig + 3 : self.at_rig + 6] = by_point[second]
            in_first = by_point.copy()
            in_first[second] = by_point[second] @ state.rotation
        if not self.only_poses:
            for observation, part in zip(self.observations, self.parts, strict=True):
                lift = in_first[part] @ state.rotations[observation.pose][:, 2]
                column = self.at_warp + 3 * observation.board
                shared[part, :, column : column + 3] = lift[:, :, None] * self.shapes[part][:, None, :]
        by_pose = np.concatenate([-in_first @ cross_matrices(rotated), in_first], axis=2)
        return shared, by_pose

    def _prior_values(self, state: RigParameters) -> Array:
        """Return the shared parameters that have priors; 0 for the rig."""
        if self.only_poses:
            return np.zeros(0)
        free = [state.intrinsics[camera][mask] for camera, mask in enumerate(self.free)]
        rig = np.zeros(6 if self.cameras > 1 else 0)
        return np.concatenate([*free, rig, state.warps_mm.ravel()])

    def _move(self, state: RigParameters, shared: Array, poses: Array) -> RigParameters:
        """Return the state after steps of the shared parameters (shared,) and of the poses (poses, 6)."""
        intrinsics, rotation, translation, warps = (
            state.intrinsics,
            state.rotation,
            state.translation_mm,
            state.warps_mm,
        )
        if not self.only_poses:
            intrinsics = intrinsics.copy()
            at = 0
            for camera, mask in enumerate(self.free):
                intrinsics[camera, mask] += shared[at : at + int(mask.sum())]
                at += int(mask.sum())
            if self.cameras > 1:
                rotation = _rotation(shared[at : at + 3]) @ rotation
                translation = translation + shared[at + 3 : at + 6]
            warps = warps + shared[self.at_warp :].reshape(-1, 3)
        turns = _rotation(poses[:, :3])
        rotations = np.array([turn @ before for turn, before in zip(turns, state.rotations, strict=True)])
        return RigParameters(
            state.projections, intrinsics, rotation, translation, warps, rotations,
            state.translations_mm + poses[:, 3:],
        )  # fmt: skip

    def _normal(self, state: RigParameters, residual: Array, noise_px: float) -> tuple[Array, ...]:
        """Return the normal matrices of the shared parameters, shared x pose, and pose, and the right-hand sides.

        `residual` (n, 2), px; `noise_px`: standard deviation of a coordinate, for the weight of the priors.
        """
        shared, by_pose = self.jacobian(state)
        size, prior = self.size, (noise_px / self.prior_std) ** 2
        flat = shared.reshape(2 * len(shared), size)
        matrix = flat.T @ flat + np.diag(prior)
        right = flat.T @ residual.ravel() - prior * self._prior_values(state)
        mixed, own = np.zeros((self.poses, size, 6)), np.zeros((self.poses, 6, 6))
        own_right = np.zeros((self.poses, 6))
        for observation, part in zip(self.observations, self.parts, strict=True):
            pose = by_pose[part].reshape(-1, 6)
            one = shared[part].reshape(len(pose), size)
            mixed[observation.pose] += one.T @ pose
            own[observation.pose] += pose.T @ pose
            own_right[observation.pose] += pose.T @ residual[part].ravel()
        return matrix, mixed, own, right, own_right

    def _cost(self, state: RigParameters, residual: Array, noise_px: float) -> float:
        """Return the sum of squares of residuals and priors, px^2."""
        if not np.isfinite(residual).all():
            return np.inf
        prior = float(np.sum((self._prior_values(state) * noise_px / self.prior_std) ** 2))
        return float(np.sum(residual**2)) + prior

    def solve(self, start: RigParameters, noise_px: float = FIRST_NOISE_PX) -> Solution:
        """Solve by the method of Levenberg and Marquardt, from `start`."""
        if not self.only_poses:
            self._set_distortion_prior(start)
        state, residual = start, self.residuals(start)
        cost, damping = self._cost(start, residual, noise_px), 1e-4
        for _ in range(MAX_STEPS):
            parts = self._normal(state, residual, noise_px)
            converged = False
            while damping < 1e10:
                shared, poses = _step(parts, damping)
                tried = self._move(state, shared, poses)
                new = self.residuals(tried)
                new_cost = self._cost(tried, new, noise_px)
                if new_cost <= cost:
                    converged = cost - new_cost < 1e-9 * cost
                    state, residual, cost = tried, new, new_cost
                    damping = max(damping * 0.1, 1e-12)
                    break
                damping *= 10.0
            else:
                break
            if converged:
                break
        freedom = residual.size - self.size - 6 * self.poses
        noise = float(np.sqrt(np.sum(residual**2) / max(freedom, 1)))
        return Solution(
            state=state,
            free=self.free,
            names=self.names(state.projections),
            covariance=self._covariance(state, residual, max(noise, 1e-9)),
            residuals=tuple(residual[part] for part in self.parts),
            noise_px=noise,
        )

    def with_correlated_errors(self, solution: Solution, errors: CorrelatedErrors | None = None) -> Solution:
        """Return the solution with a covariance that holds the errors which neighbouring corners share, those given, or
        those that its residuals show, and the discrepancy of the lens, unless errors are given. The same solution where
        the residuals show none.
        """
        if not solution.determined:
            return solution
        poses, prior = self._pose_errors(solution), (solution.noise_px / self.prior_std) ** 2
        of_all, lens_px, of_lens = errors is None, 0.0, np.zeros_like(solution.covariance)
        errors = fit_correlated_errors(poses, prior) if errors is None else errors
        if of_all:  # parts of the views share the lens: it isn't among what they may differ by
            lens_px, of_lens = fit_lens_error(
                poses, errors, solution.noise_px, prior, self._prior_values(solution.state)
            )
        if errors is None and not lens_px:
            return solution
        share = 1.0 if errors is None else (errors.noise_px / max(solution.noise_px, 1e-9)) ** 2
        covariance = solution.covariance if errors is None else sandwich_covariance(poses, errors, prior)
        return replace(
            solution,
            covariance=covariance + of_lens,
            sampling_covariance=share * solution.covariance,
            errors=errors,
            lens_px=lens_px,
        )

    def _pose_errors(self, solution: Solution) -> list[PoseErrors]:
        """Collect the residuals and Jacobians of each pose at the end of a solve."""
        self._set_distortion_prior(solution.state)
        shared, by_pose = self.jacobian(solution.state)
        squares = np.concatenate(
            [one.view.board_mm[:, :2] / one.view.capture.square_mm for one in self.observations]
        ).astype(float)
        residuals = np.concatenate(solution.residuals)
        # where the corners are predicted: measured places would bring the noise of the residuals into what they are
        # compared with
        predicted = self.seen - residuals
        away = predicted - solution.state.intrinsics[self.of_camera, 2:4]
        for camera in range(self.cameras):
            its = self.of_camera == camera
            away[its] /= np.linalg.norm(away[its], axis=1).max(initial=1e-9)
        pose = np.concatenate([np.full(len(one.view.index), one.pose) for one in self.observations])
        return [
            PoseErrors(squares[at], self.of_camera[at], residuals[at], shared[at], by_pose[at], away[at])
            for at in (np.flatnonzero(pose == number) for number in np.unique(pose))
        ]

    def _covariance(self, state: RigParameters, residual: Array, noise_px: float) -> Array:
        """Return the covariance of the shared parameters for independent corners; infinite where it is singular."""
        if self.only_poses:
            return np.zeros((0, 0))
        matrix, mixed, own, _, _ = self._normal(state, residual, noise_px)
        reduced = _eliminate_poses(matrix, mixed, own)[0]
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        try:
            inverse = np.linalg.inv(reduced / np.outer(scale, scale))
        except np.linalg.LinAlgError:
            return np.full_like(reduced, np.inf)
        return noise_px**2 * 0.5 * (inverse + inverse.T) / np.outer(scale, scale)


def _eliminate_poses(matrix: Array, mixed: Array, own: Array) -> tuple[Array, Array]:
    """Return the Schur complement of the poses, and mixed own^-1.

    `matrix` (shared, shared), `mixed` (poses, shared, 6), `own` (poses, 6, 6): see `BundleAdjustment._normal`.
    """
    ridge = 1e-12 * np.einsum("pkk->pk", own)
    gain = np.linalg.solve(own + ridge[:, :, None] * np.eye(6), np.swapaxes(mixed, 1, 2))  # (poses, 6, shared)
    return matrix - np.einsum("psk,pkt->st", mixed, gain), np.swapaxes(gain, 1, 2)


def _step(parts: tuple[Array, ...], damping: float) -> tuple[Array, Array]:
    """Solve for the steps of the shared parameters and of the poses.

    `parts`: see `BundleAdjustment._normal`; `damping`: share of the diagonals that is added to them.
    """
    matrix, mixed, own, right, own_right = parts
    damped_own = own + damping * np.einsum("pkk->pk", own)[:, :, None] * np.eye(6)
    if not len(right):
        return right, np.linalg.solve(damped_own, own_right[:, :, None])[:, :, 0]
    damped = matrix + damping * np.diag(np.diag(matrix))
    reduced, gain = _eliminate_poses(damped, mixed, damped_own)
    scale = np.sqrt(np.maximum(np.diag(damped), 1e-300))
    reduced_right = right - np.einsum("psk,pk->s", gain, own_right)
    shared = np.linalg.lstsq(reduced / np.outer(scale, scale), reduced_right / scale, rcond=1e-14)[0] / scale
    rest = own_right - np.einsum("psk,s->pk", mixed, shared)
    return shared, np.linalg.solve(damped_own, rest[:, :, None])[:, :, 0]


def _rotation(rotation_vector: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad."""
    return np.asarray(Rotation.from_rotvec(rotation_vector).as_matrix())


def board_pose(view: BoardView, camera: CameraGeometry) -> tuple[Array, Array]:
    """Find the rotation (3, 3) and translation (3,), mm, from the flat board to a camera, from one view. Raises
    `NotDetermined` where none fits.

    The rays of the corners are turned about their mean and seen by an ideal pinhole along it, so that a board far from
    the axis of a wide lens has a pose, too.
    """
    rays = camera.unproject(view.image_px.astype(float))
    there = np.isfinite(rays).all(axis=1)
    rays, points = rays[there], view.board_mm[there].astype(float)
    rotation, translation = np.eye(3), np.zeros(3)
    found = False
    if len(rays) >= MIN_POSE_CORNERS:
        turn = _towards_axis(rays.mean(axis=0))
        ahead = rays @ turn.T
        try:
            found, rotation_vector, of_board = cv2.solvePnP(
                points, ahead[:, :2] / ahead[:, 2:], np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
            )
        except cv2.error:
            found = False
        if found:
            rotation = turn.T @ np.asarray(cv2.Rodrigues(rotation_vector)[0])
            translation = turn.T @ np.asarray(of_board).ravel()
    placed = view.board_mm.astype(float) @ rotation.T + translation
    if not (found and camera.projection.sees(placed).all()):
        raise NotDetermined(
            "geometry", "no pose of the board fits its corners: check what the capture says of the board"
        )
    return rotation, translation


def _towards_axis(direction: Array) -> Array:
    """Return the smallest rotation (3, 3) that turns a direction (3,) to the axis of the camera."""
    axis = np.cross(direction, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, direction[2]))
    return _rotation(axis * (angle / length) if length > 0.0 else np.zeros(3))


def first_camera(
    views: Sequence[BoardView], shape: tuple[int, int], projection: Projection = PINHOLE
) -> CameraGeometry:
    """Return a camera without distortion to begin with. `shape`: (rows, cols) of the frames.

    The focal length of a pinhole is that of Zhang, or the width of the frame where the views determine none. That of
    another projection is the one with which the poses of a few views fit best.
    """
    middle = (shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0

    def camera(focal: float) -> CameraGeometry:
        return CameraGeometry.of([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]], (), projection)

    boards = [view.board_mm.astype(np.float32) for view in views]
    points = [view.image_px.astype(np.float32) for view in views]
    try:
        focal = float(cv2.initCameraMatrix2D(boards, points, shape[::-1], 1.0)[0, 0])
    except cv2.error:
        focal = np.nan
    if not 0.2 * max(shape) < focal < 50.0 * max(shape):
        focal = float(max(shape))
    if projection.kind == "pinhole":
        return camera(focal)
    few = views[:: max(1, len(views) // FOCAL_VIEWS)]
    trials = [camera(one) for one in (focal, *(share * max(shape) for share in FOCAL_SHARES))]
    return min(trials, key=lambda one: sum(_pose_square(view, one) for view in few))


def _pose_square(view: BoardView, camera: CameraGeometry) -> float:
    """Return the sum of squared residuals, px^2, of a view at its pose by `board_pose`; infinite without one."""
    try:
        rotation, translation = board_pose(view, camera)
    except NotDetermined:
        return np.inf
    return float(np.sum((camera.project(view.board_mm @ rotation.T + translation) - view.image_px) ** 2))


def splined(camera: CameraGeometry, shape: tuple[int, int]) -> CameraGeometry:
    """Return a camera with a splined stereographic projection that projects as `camera` does, an equidistant one. The
    spline ends at the corner of the frame that is farthest from the axis. `shape`: (rows, cols) of the frame.
    """
    ends = np.array([(x, y) for x in (0.0, shape[1] - 1.0) for y in (0.0, shape[0] - 1.0)])
    z = camera.unproject(ends)[:, 2]
    widest = float(np.rad2deg(np.arccos(np.clip(z[np.isfinite(z)].min(initial=1.0), -1.0, 1.0))))
    if not np.isfinite(z).all():  # the polynomial has no inverse there: as without distortion
        widest = float(np.rad2deg(np.max(np.linalg.norm(ends - camera.intrinsics[2:4], axis=1)) / camera.intrinsics[0]))
    projection = Projection("splined_stereographic", float(np.clip(widest, 1.0, WIDEST_DEG)))
    assert projection.spline_angle_deg is not None
    angle = np.linspace(0.0, np.deg2rad(projection.spline_angle_deg), 200)[1:]
    points = np.column_stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)])
    start = np.concatenate([camera.intrinsics[:4], np.zeros(COUNT - 4)])
    wanted = camera.project(points)[:, 0] - projection.project(points, start)[:, 0]
    by_camera = projection.project_with_jacobian(points, start)[2][:, 0]
    radial = [projection.names.index(name) for name in projection.coefficients if name.startswith("s")]
    start[radial] = np.linalg.lstsq(by_camera[:, radial], wanted, rcond=1e-9)[0]
    return CameraGeometry(projection, start)


def first_state(views: Sequence[BoardView], camera: CameraGeometry) -> RigParameters:
    """Return the parameters of one camera to begin with, each view with a pose of its own."""
    poses = [board_pose(view, camera) for view in views]
    return RigParameters(
        projections=(camera.projection,),
        intrinsics=camera.intrinsics[None, :],
        rotation=np.eye(3),
        translation_mm=np.zeros(3),
        warps_mm=np.zeros((1, 3)),
        rotations=np.array([rotation for rotation, _ in poses]),
        translations_mm=np.array([translation for _, translation in poses]),
    )


def with_boards(state: RigParameters, boards: int) -> RigParameters:
    """Return the state with `boards` flat boards."""
    return replace(state, warps_mm=np.zeros((boards, 3)))
