"""The bundle adjustment against known cameras: what it finds, and whether its covariance is that of repeated solves.

Errors that neighbouring corners share: found where they exist, absent where they don't, and of the stated size.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lab.fit.geometry import geometry_result
from lab.fit.stereo import rig_observations, solve_rig
from lab.formats.importers import read_checkerboard_pairs
from lab.observables.boards.bundle_adjustment import BundleAdjustment, Observation, RigParameters, Solution
from lab.observables.boards.calibration import MODELS, calibrate, calibrate_robustly, free_intrinsics, with_model_error
from lab.observables.boards.corners import board_corners
from lab.observables.boards.first_state import first_camera, first_state
from lab.observables.boards.pairs import StereoPair
from lab.observables.boards.projection import CameraGeometry
from sim.scene.projection import PINHOLE
from tests.lab.fit.projected import SHAPE, TRUTH, poses, seen

AT = poses(10)

PAIRS = Path(__file__).parents[4].parent / "shared" / "data" / "opencv_stereo"
FRAME = (480, 640)  # of the public pairs
AT_EIGHT = poses(8)
NOISE_PX, RIPPLE_PX, LENGTH_SQUARES = 0.05, 0.12, 2.0


def test_without_noise_the_truth_comes_back():
    views = seen(np.random.default_rng(0), AT, noise_px=0.0)
    found = calibrate(views, SHAPE)
    # priors pull by their weight, (0.1 px / prior)^2: far below these
    np.testing.assert_allclose(found.state.intrinsics[0, :4], TRUTH.intrinsics_left[:4], atol=2e-3)
    np.testing.assert_allclose(found.state.intrinsics[0, 4:9], TRUTH.intrinsics_left[4:], atol=2e-3)
    np.testing.assert_allclose(found.state.warps_mm[0], TRUTH.warp_mm, atol=1e-3)
    assert found.rms_px < 1e-3


def test_a_flat_model_of_a_bent_board_is_worse():
    """What OpenCV's calibration, which takes boards as flat, leaves of the same corners."""
    views = seen(np.random.default_rng(0), AT)
    boards, points = zip(*[(v.board_mm.astype(np.float32), v.image_px.astype(np.float32)) for v in views], strict=True)
    flat_rms, *_ = cv2.calibrateCamera(boards, points, SHAPE[::-1], None, None)
    assert calibrate(views, SHAPE).rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    assert flat_rms > 1.2 * 0.1 * np.sqrt(2)


def test_jacobian_is_that_of_the_residuals():
    """Central differences in every shared parameter and the first pose, of a pair."""
    views = [*seen(np.random.default_rng(1), AT[:2]), *seen(np.random.default_rng(2), AT[:2], side="right")]
    sights = [Observation(view, pose=k % 2, camera=k // 2) for k, view in enumerate(views)]
    free = np.array([free_intrinsics(MODELS[-1])] * 2)
    problem = BundleAdjustment(sights, free, SHAPE)
    start = first_state(views[:2], first_camera(views[:2], SHAPE))
    state = RigParameters(
        projections=(PINHOLE, PINHOLE),
        intrinsics=np.repeat(start.intrinsics, 2, axis=0), rotation=TRUTH.rotation, translation_mm=TRUTH.translation_mm,
        warps_mm=np.array([[0.1, 0.2, 0.3]]), rotations=start.rotations, translations_mm=start.translations_mm,
    )  # fmt: skip
    shared, by_pose = problem.jacobian(state)
    nothing, none = np.zeros(problem.size), np.zeros((2, 6))

    def at(k: int, step: float) -> np.ndarray:
        move, poses_move = nothing.copy(), none.copy()
        if k < problem.size:
            move[k] = step
        else:
            poses_move[0, k - problem.size] = step
        return -problem.residuals(problem._move(state, move, poses_move))

    first = np.concatenate([np.full(len(v.index), k % 2 == 0) for k, v in enumerate(views)])
    for k in range(problem.size + 6):
        numeric = (at(k, 1e-5) - at(k, -1e-5)) / 2e-5
        exact = shared[:, :, k] if k < problem.size else by_pose[:, :, k - problem.size] * first[:, None]
        np.testing.assert_allclose(exact, numeric, atol=1e-5 * max(1.0, np.abs(exact).max()))


def test_covariance_of_a_pair_is_that_of_repeated_solves():
    """30 sets of corners; the rig and the first camera's focal length and centre."""
    runs, stated = [], []
    free = np.array([free_intrinsics(MODELS[1])] * 2)
    matrices = [
        np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *d[:4], *np.zeros(4)])
        for m, d in ((TRUTH.left, TRUTH.distortion_left), (TRUTH.right, TRUTH.distortion_right))
    ]
    truth = replace(TRUTH, distortion_left=matrices[0][4:8], distortion_right=matrices[1][4:8])
    for draw in range(30):
        rng = np.random.default_rng([3, draw])
        sides = [seen(rng, AT, truth, side=side) for side in ("left", "right")]
        sights = [
            Observation(view, pose=k, camera=camera)
            for camera, views in enumerate(sides)
            for k, view in enumerate(views)
        ]
        start = RigParameters(
            (PINHOLE, PINHOLE), np.array(matrices), truth.rotation, truth.translation_mm, np.array([truth.warp_mm]),
            np.array([turn for turn, _ in AT]), np.array([shift for _, shift in AT]),
        )  # fmt: skip
        found = BundleAdjustment(sights, free, SHAPE).solve(start)
        turn = cv2.Rodrigues(found.state.rotation @ truth.rotation.T)[0].ravel()
        runs.append(
            [
                *turn,
                *(found.state.translation_mm - truth.translation_mm),
                *(found.state.intrinsics[0, :4] - matrices[0][:4]),
            ]
        )
        std = np.sqrt(np.diag(found.covariance))
        stated.append([*std[16:22], *std[:4]])
    assert found.names[16] == "turn_x_rad"
    ratio = np.std(runs, axis=0, ddof=1) / np.mean(stated, axis=0)
    # a standard deviation of 30 values is uncertain by 1 / sqrt(58) = 13 %; four of these, for ten figures
    np.testing.assert_allclose(ratio, 1.0, atol=0.52)
    assert np.all(np.abs(np.mean(runs, axis=0)) < 4 * np.mean(stated, axis=0) / np.sqrt(30))


def rippled(rng: np.random.Generator, side: str = "left", shift=None):
    """Views whose neighbouring corners are displaced alike, anew in each view, by a Gaussian field on the board."""
    views = []
    for view in seen(rng, AT_EIGHT, noise_px=NOISE_PX, side=side):
        drawn = field(rng) if shift is None else shift[len(views)]
        views.append(replace(view, image_px=view.image_px + drawn[view.index]))
    return views


@functools.cache
def factor() -> np.ndarray:
    at = np.array([(k % 11, k // 11) for k in range(88)], dtype=float) / LENGTH_SQUARES
    square = np.sum((at[:, None] - at[None]) ** 2, axis=2)
    return np.linalg.cholesky(np.exp(-0.5 * square) + 1e-9 * np.eye(88))


def field(rng: np.random.Generator) -> np.ndarray:
    return RIPPLE_PX * factor() @ rng.normal(size=(88, 2))


def pulls(draw: int, *, with_ripple: bool) -> tuple[np.ndarray, np.ndarray]:
    """Errors of fx, fy, cx, cy over their standard deviations: as stated, and by independent corners."""
    rng = np.random.default_rng([17, draw])
    views = rippled(rng) if with_ripple else seen(rng, AT_EIGHT, noise_px=NOISE_PX)
    alone = calibrate(views, SHAPE)
    whole = with_model_error(views, SHAPE, alone)
    error = (alone.state.intrinsics[0] - CameraGeometry.of(TRUTH.left, TRUTH.distortion_left).intrinsics)[:4]
    return error / whole.std()[:4], error / alone.std()[:4]


def test_stated_uncertainties_hold_the_error_that_neighbours_share():
    """24 draws x 4 figures that are correlated in pairs: 48 independent squares have a mean of 1 +- 0.20; three of
    these.
    """
    whole, alone = (np.array(one) for one in zip(*(pulls(draw, with_ripple=True) for draw in range(24)), strict=True))
    assert np.mean(whole**2) == pytest.approx(1.0, abs=0.6)
    assert np.mean(alone**2) > 2.0  # corners taken as independent


def test_independent_corners_have_no_model_error_and_the_same_uncertainty():
    """The threshold is passed once in 1000 calibrations: none of 12 seeded ones."""
    for draw in range(12):
        whole, alone = pulls(draw, with_ripple=False)
        np.testing.assert_array_equal(whole, alone)
    fit = geometry_result(calibrate_robustly(seen(np.random.default_rng(0), AT_EIGHT, noise_px=NOISE_PX), SHAPE))
    assert fit.corner_errors.model_error_px == 0.0
    assert fit.corner_errors.length_squares is None
    np.testing.assert_allclose(fit.corner_errors.sampling_std, np.sqrt(np.diag(fit.covariance)))


def test_noise_and_model_error_are_told_apart():
    """704 corners know their noise to 3 % or so; the length is known to some 10 %."""
    fit = geometry_result(calibrate_robustly(rippled(np.random.default_rng(4)), SHAPE))
    errors = fit.corner_errors
    assert errors.noise_px == pytest.approx(NOISE_PX, rel=0.12)
    # poses and intrinsics take up a part of the ripple
    assert 0.5 * RIPPLE_PX < errors.model_error_px < 1.1 * RIPPLE_PX
    assert fit.corner_px_std == pytest.approx(np.hypot(errors.noise_px, errors.model_error_px))
    np.testing.assert_allclose(errors.length_squares, LENGTH_SQUARES, rtol=0.4)
    assert errors.sampling_std[0] < 0.6 * fit.camera_matrix_std[0][0]
    assert fit.cross_validation.sampling_px < 0.6 * fit.cross_validation.expected_px
    assert fit.cross_validation.model_error_px > 0.0
    assert any("Corners depart from the model together" in remark for remark in fit.remarks)


def test_a_ripple_that_both_cameras_see_is_found_common():
    rng = np.random.default_rng(6)
    shift = [field(rng) for _ in AT_EIGHT]
    sides = [rippled(rng, side, shift) for side in ("left", "right")]
    fits = [geometry_result(calibrate_robustly(views, SHAPE)) for views in sides]
    pairs = [StereoPair(one, two) for one, two in zip(*sides, strict=True)]
    alone = solve_rig(pairs, *fits, SHAPE)
    whole = BundleAdjustment(rig_observations(pairs), alone.free, SHAPE).with_correlated_errors(alone)
    assert whole.errors.between_cameras > 0.95
    assert whole.errors.noise_px == pytest.approx(NOISE_PX, rel=0.1)
    assert np.all(np.diag(whole.covariance) > np.diag(whole.sampling_covariance))


@functools.cache
def public_views():
    """The corners of the 13 public pairs, by side."""
    recordings = read_checkerboard_pairs(PAIRS, (6, 9), 25.0)
    return {side: list(board_corners(recordings, side).views) for side in ("left", "right")}


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the public stereo pairs aren't here")
def test_halves_of_the_public_boards_differ_by_what_is_stated():
    """Random halves (6 and 7 views) of the 13 boards of both cameras: the mean square of the pulls of nine intrinsics.

    8 splits are 8 degrees of freedom for each direction in which the intrinsics differ, about four a camera (focal
    lengths; centre and p, twice; k). The stated variances have 9 + 3 from the fitted V and 5 from the scores of 6
    boards, so that the mean of an F distribution is expected: 17 / 15 = 1.13, +- 1.13 sqrt(2 / 64) = 0.20; three of
    these.
    """
    rng = np.random.default_rng(1)
    whole, alone = [], []
    for _ in range(8):
        order = rng.permutation(13)
        for views in public_views().values():
            halves = [[views[k] for k in part] for part in (order[:6], order[6:])]
            plain = [calibrate(half, FRAME) for half in halves]
            stated = [with_model_error(half, FRAME, one) for half, one in zip(halves, plain, strict=True)]
            gap = np.subtract(*(one.state.intrinsics[0] for one in plain))[:9]
            alone.append(gap / np.hypot(*(one.std()[:9] for one in plain)))
            whole.append(gap / np.hypot(*(one.std()[:9] for one in stated)))
    assert np.mean(np.square(whole)) == pytest.approx(1.13, abs=0.6)
    assert np.mean(np.square(alone)) > 5.0  # corners taken as independent


@pytest.mark.slow
@pytest.mark.skipif(not PAIRS.is_dir(), reason="the public stereo pairs aren't here")
def test_many_halves_of_the_public_boards() -> None:
    """40 splits, each camera alone and the pair: the pulls of every parameter, for the eye; their mean square,
    judged.
    """
    rng, views = np.random.default_rng(1), public_views()
    fits = [geometry_result(calibrate_robustly(views[side], FRAME)) for side in ("left", "right")]
    pulls_of: dict[str, list[np.ndarray]] = {"left": [], "right": [], "pair": []}
    for _ in range(40):
        order = rng.permutation(13)
        found: dict[str, list[Solution]] = {name: [] for name in pulls_of}
        for part in (order[:6], order[6:]):
            for side in ("left", "right"):
                half = [views[side][k] for k in part]
                found[side].append(with_model_error(half, FRAME, calibrate(half, FRAME)))
            pairs = [StereoPair(views["left"][k], views["right"][k]) for k in part]
            alone = solve_rig(pairs, *fits, FRAME)
            problem = BundleAdjustment(rig_observations(pairs), alone.free, FRAME)
            found["pair"].append(problem.with_correlated_errors(alone))
        for name, halves in found.items():
            pulls_of[name].append(np.subtract(*map(values, halves)) / np.hypot(*map(stds, halves)))
    for name, pulls in pulls_of.items():
        print(f"\n{name}: rms of the pulls {np.sqrt(np.mean(np.square(pulls), axis=0)).round(2)}")
        print(f"{name}: pull variance {np.mean(np.square(pulls)):.2f}")
        # 12 degrees of freedom for each of four directions of a camera: 1.13 +- 0.23; three of these
        assert np.mean(np.square(pulls)) == pytest.approx(1.13, abs=0.69)


def values(solution: Solution) -> np.ndarray:
    """Nine intrinsics of each camera, then the rig's rotation and translation."""
    state = solution.state
    rig = [Rotation.from_matrix(state.rotation).as_rotvec(), state.translation_mm] if len(state.intrinsics) > 1 else []
    return np.concatenate([*state.intrinsics[:, :9], *rig])


def stds(solution: Solution) -> np.ndarray:
    return np.sqrt(np.diag(solution.covariance))[: len(values(solution))]
