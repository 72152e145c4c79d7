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


def test_poses_of_one_camera_alone_are_no_pairs(charuco_boards):
    left, right = fit_geometry(charuco_boards, "left"), fit_geometry(charuco_boards, "right")
    captures = [
        c if c.side == "left" else c.model_copy(update={"pose": f"other-{c.pose}"})
        for c in charuco_boards.manifest.captures
    ]
    apart = RecordingSet(
        charuco_boards.manifest.model_copy(update={"captures": tuple(captures)}),
        frames={c.frame: charuco_boards.frame(c) for c in captures},
    )
    with pytest.raises(NotDetermined, match="0 poses"):
        fit_stereo(apart, left, right)


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
