"""Bundle adjustment: cameras, the rig between two of them, the warp of the boards and their poses, by one
least-squares solve, whose covariance holds the errors that neighbouring corners share (`correlated_errors`).

Minimised is sum |predicted - seen|^2 over all corners, in px, with weak priors on distortion and warp. Rotations are
updated locally, by a small rotation about the axes of the camera applied from the left, so that none is singular.
Poses are eliminated by the Schur complement: what is left is the normal matrix of the shared parameters. Its inverse
times the variance of a corner is their full covariance. See Triggs et al., "Bundle Adjustment: A Modern Synthesis"
(2000); the warp of the board follows mrcal (D. Kogan).

The warp of a board is z(x, y) = a (x^2 - 1/3) + b (y^2 - 1/3) + c x y mm, with x and y from -1 to 1 across the board:
a bend along each axis and a twist. A shift or a tilt would be a pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lab.observables.boards.correlated_errors import (
    CorrelatedErrors,
    PoseErrors,
    fit_correlated_errors,
    fit_lens_error,
    sandwich_covariance,
)
from lab.observables.boards.projection import CameraGeometry, cross_matrices
from lab.observables.boards.views import BoardView
from sim.camera import ProjectionKind
from sim.scene.projection import COUNT, Projection

Array = NDArray[np.floating[Any]]


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
MAX_STEPS = 300  # a long lens of a small frame takes 60 to 200: its centre and its distortion trade with each other


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
        squares = np.concatenate([one.view.squares for one in self.observations])
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
