"""Extrinsics against boards drawn with a known rig, and on the public stereo pairs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.geometry import fit_geometry
from lab.fit.stereo import fit_stereo
from lab.recording import Camera, Charuco, Manifest, RecordingSet

PAIRS = Path(__file__).parents[3].parent / "shared" / "data" / "opencv_stereo"


def test_rig_is_recovered_within_its_uncertainty(charuco_boards, truth):
    left, right = fit_geometry(charuco_boards, "left"), fit_geometry(charuco_boards, "right")
    fit = fit_stereo(charuco_boards, left, right)
    assert fit.pairs == 8
    assert abs(fit.baseline_mm / truth.baseline_mm - 1) < 0.005  # the goal of the mock bench
    assert abs(fit.baseline_mm - truth.baseline_mm) < 4 * fit.baseline_mm_std
    gap = np.array(fit.translation_mm) - truth.translation_mm
    assert np.all(np.abs(gap) < 4 * np.array(fit.translation_mm_std))
    turn = cv2.Rodrigues(np.array(fit.rotation) @ truth.rotation.T)[0].ravel()
    assert np.all(np.abs(turn) < 4 * np.array(fit.rotation_std_rad))
    assert fit.rms_px < 0.1


def test_uncertainty_is_the_scatter_of_repeated_calibrations(truth):
    """20 sets of corners with Gaussian noise: the standard deviations of the rig against the predicted ones."""
    from lab.fit.geometry import BoardView, calibrate
    from lab.fit.stereo import solve_rig
    from lab.results import GeometryFit

    rng = np.random.default_rng(3)
    index = np.arange(35)
    board = np.zeros((35, 3), dtype=np.float32)
    board[:, 0], board[:, 1] = (index % 7 + 1) * 24.0, (index // 7 + 1) * 24.0
    turns = rng.normal(0, 0.3, (10, 3)) * [1, 1, 0.3]
    capture = Charuco(
        id="c", kind="charuco", side="left", frame="c.npy", exposure_s=0.01, dictionary="none", squares=(6, 8),
        square_mm=24.0, pose="p",
    )  # fmt: skip
    shifts = np.array([30, 0, 400]) + rng.normal(0, 20, (10, 3))
    runs = []
    for _ in range(20):
        sides = {}
        for side, matrix in (("left", truth.left), ("right", truth.right)):
            views = []
            for turn, middle in zip(turns, shifts, strict=True):
                rotation = cv2.Rodrigues(turn)[0]
                shift = middle - rotation @ [96, 72, 0]
                if side == "right":
                    rotation, shift = truth.rotation @ rotation, truth.rotation @ shift + truth.translation_mm
                points, _ = cv2.projectPoints(
                    board.astype(float), cv2.Rodrigues(rotation)[0], shift, matrix, truth.distortion
                )
                views.append(BoardView(capture, index, board, points[:, 0] + rng.normal(0, 0.1, (35, 2))))
            rms, found, distortion, _, _ = calibrate(views, (300, 400))
            fit = GeometryFit(
                camera_matrix=tuple(map(tuple, found.tolist())), distortion=tuple(distortion.tolist()), rms_px=rms
            )
            sides[side] = (views, fit)
        pairs = list(zip(sides["left"][0], sides["right"][0], strict=True))
        rig = solve_rig(pairs, sides["left"][1], sides["right"][1])
        runs.append((np.concatenate([rig.turn, rig.translation_mm]), np.sqrt(np.diag(rig.covariance))))
    values, predicted = np.array([r[0] for r in runs]), np.array([r[1] for r in runs]).mean(axis=0)
    # A standard deviation from 20 values scatters by 1 / sqrt(38) = 16 %; three of these
    np.testing.assert_allclose(values.std(axis=0, ddof=1) / predicted, 1.0, atol=0.5)
    true = np.concatenate([cv2.Rodrigues(truth.rotation)[0].ravel(), truth.translation_mm])
    assert np.all(np.abs(values.mean(axis=0) - true) < 4 * predicted / np.sqrt(20))


def test_poses_of_one_camera_alone_are_no_pairs(charuco_boards):
    left = fit_geometry(charuco_boards, "left")
    captures = [
        c if c.side == "left" else c.model_copy(update={"pose": f"other-{c.pose}"})
        for c in charuco_boards.manifest.captures
    ]
    apart = RecordingSet(
        charuco_boards.manifest.model_copy(update={"captures": tuple(captures)}),
        frames={c.frame: charuco_boards.frame(c) for c in captures},
    )
    with pytest.raises(NotDetermined, match="0 poses"):
        fit_stereo(apart, left, left)


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the public stereo pairs aren't here")
def test_public_stereo_pairs():
    """13 pairs of a plain checkerboard (6 x 9 inner corners), as pictures: the goal is an rms of 0.2 px."""
    frames, captures = {}, []
    for side in ("left", "right"):
        for file in sorted(PAIRS.glob(f"{side}[0-9]*.jpg")):
            path = f"frames/{file.stem}.npy"
            frames[path] = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(np.uint16)
            captures.append(
                Charuco(
                    id=file.stem,
                    kind="charuco",
                    side=side,
                    frame=path,
                    exposure_s=0.01,
                    dictionary="none",
                    squares=(7, 10),
                    square_mm=25.0,
                    pose=file.stem[-2:],
                )
            )
    camera = Camera(rows=480, cols=640, pixel_pitch_um=6.0, fill_factor=1.0, cfa="MONO", bit_depth=8)
    recordings = RecordingSet(
        Manifest(cameras={"left": camera, "right": camera}, captures=tuple(captures)), frames=frames
    )
    left, right = fit_geometry(recordings, "left"), fit_geometry(recordings, "right")
    assert left.views == right.views == 13
    fit = fit_stereo(recordings, left, right)
    assert fit.pairs == 13
    assert fit.rms_px < 0.2
    # OpenCV's own focal length of these pairs, 534.8 px, was found with one focal length for both cameras
    assert left.camera_matrix[0][0] == pytest.approx(534.8, rel=0.01)
