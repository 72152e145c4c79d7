"""The bundle adjustment against known cameras: what it finds, and whether its covariance is that of repeated solves."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lab.fit.geometry.bundle_adjustment import (
    BundleAdjustment,
    Observation,
    RigParameters,
    first_intrinsics,
    first_state,
)
from lab.fit.geometry.calibration import calibrate
from lab.fit.geometry.distortion_model import MODELS, free_intrinsics
from tests.lab.fit.projected import SHAPE, TRUTH, poses, seen

AT = poses(10)


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
    start = first_state(views[:2], first_intrinsics(views[:2], SHAPE))
    state = RigParameters(
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
        return -problem.residuals(problem._moved(state, move, poses_move))

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
            np.array(matrices), truth.rotation, truth.translation_mm, np.array([truth.warp_mm]),
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
