"""Extrinsics against boards drawn with a known rig, and on the public stereo pairs."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.capture_kinds.charuco import CharucoCapture
from lab.errors import NotDetermined
from lab.fit.geometry import fit_geometry, geometry_result
from lab.fit.stereo import fit_pairs, fit_stereo, rectification_maps
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.observables.boards.calibration import calibrate_robustly
from lab.observables.boards.pairs import StereoPair
from lab.observables.boards.views import board_points
from tests.lab.fit.projected import SHAPE, poses, seen

PAIRS = Path(__file__).parents[3].parent / "shared" / "data" / "opencv_stereo"


def test_rig_is_recovered_within_its_uncertainty(charuco_boards, charuco_fits, truth):
    fit = fit_stereo(charuco_boards, charuco_fits["left"], charuco_fits["right"])
    assert fit.pairs == 8
    assert abs(fit.baseline_mm / truth.baseline_mm - 1) < 0.005  # the goal of the mock bench
    assert abs(fit.baseline_mm - truth.baseline_mm) < 4 * fit.baseline_mm_std
    gap = np.array(fit.translation_mm) - truth.translation_mm
    assert np.all(np.abs(gap) < 4 * np.array(fit.translation_mm_std))
    turn = cv2.Rodrigues(np.array(fit.rotation) @ truth.rotation.T)[0].ravel()
    assert np.all(np.abs(turn) < 4 * np.array(fit.rotation_std_rad))
    assert fit.rms_px < 0.1


def test_poses_of_one_camera_alone_are_no_pairs(charuco_boards, charuco_fits):
    captures = [
        c if c.side == "left" else c.model_copy(update={"pose": f"other-{c.pose}"})
        for c in charuco_boards.manifest.captures
    ]
    apart = RecordingSet(
        charuco_boards.manifest.model_copy(update={"captures": tuple(captures)}),
        frames={c.frame: charuco_boards.frame(c) for c in captures},
    )
    with pytest.raises(NotDetermined, match="0 poses"):
        fit_stereo(apart, charuco_fits["left"], charuco_fits["right"])


@functools.cache
def drawn_pairs(noise_px: float = 0.1):
    """Views of both cameras of `projected`, and their fits."""
    rng, at = np.random.default_rng(0), poses(10)
    sides = [seen(rng, at, noise_px=noise_px, side=side) for side in ("left", "right")]
    calibrations = [calibrate_robustly(views, SHAPE) for views in sides]
    pairs = [StereoPair(one, two) for one, two in zip(calibrations[0].views, calibrations[1].views, strict=True)]
    return pairs, *[geometry_result(calibration) for calibration in calibrations]


def test_depth_of_the_map_is_that_of_the_formula():
    """Two parallel cameras: sigma_Z = Z^2 / (f B) times the disparity's uncertainty, sqrt 2 of a corner's, plus
    calibration.
    """
    pairs, left, right = drawn_pairs()
    fit = fit_pairs(pairs, left, right, (SHAPE, SHAPE), depths_mm=(500.0, 1000.0))
    for depth in fit.depth:
        total = np.array(depth.total_mm_std, dtype=float)
        own = np.array(depth.calibration_mm_std, dtype=float)
        matching = np.sqrt(total**2 - own**2)[9, 12]  # the middle of the frame
        formula = depth.depth_mm**2 / (1400.0 * fit.baseline_mm) * np.sqrt(2) * fit.corner_px_std
        assert matching == pytest.approx(formula, rel=0.1)
        assert own[9, 12] > 0
    # what the right camera doesn't see isn't stated
    assert np.isnan(np.array(fit.depth[0].total_mm_std, dtype=float)).any()


def test_rectified_pairs_have_equal_rows():
    """Maps from the fit, applied to both cameras' corners: rows agree to the corners' noise, and columns differ by f B
    / Z.
    """
    pairs, left, right = drawn_pairs(noise_px=0.05)
    fit = fit_pairs(pairs, left, right, (SHAPE, SHAPE))
    # rows differ by sqrt 2 of a corner's noise, magnified by about the ratio of focal lengths
    assert fit.rectification.row_rms_px == pytest.approx(np.sqrt(2) * 0.05, rel=0.15)
    maps = rectification_maps(fit, SHAPE)
    x, y = maps["left"]
    assert x.shape == y.shape == SHAPE and x.dtype == np.float32
    # a pixel of the rectified left picture, back to the left picture and forward again
    at = (480, 640)
    points = np.array([[[x[at], y[at]]]], dtype=float)
    own = fit.rectification
    back = cv2.undistortPoints(
        points, np.array(fit.camera_matrix_left), np.array(fit.distortion_left),
        R=np.array(own.rotation_left), P=np.array(own.projection_left),
    )  # fmt: skip
    np.testing.assert_allclose(back.ravel(), at[::-1], atol=0.02)


def test_a_mirrored_camera_makes_no_rig():
    pairs, left, right = drawn_pairs()
    mirrored = [replace(p.right, image_px=np.array([SHAPE[1] - 1.0, 0.0]) + p.right.image_px * [-1, 1]) for p in pairs]
    with pytest.raises(NotDetermined, match="no rig explains the pairs"):
        fit_pairs([StereoPair(p.left, m) for p, m in zip(pairs, mirrored, strict=True)], left, right, (SHAPE, SHAPE))


def test_a_refusal_names_the_worst_pair():
    pairs, left, right = drawn_pairs()
    mirrored = [replace(p.right, image_px=np.array([SHAPE[1] - 1.0, 0.0]) + p.right.image_px * [-1, 1]) for p in pairs]
    with pytest.raises(NotDetermined, match=r"worst: pose pose-\d, "):
        fit_pairs([StereoPair(p.left, m) for p, m in zip(pairs, mirrored, strict=True)], left, right, (SHAPE, SHAPE))


def test_a_pair_that_is_not_one_is_left_out():
    """One pose under another's name."""
    pairs, left, right = drawn_pairs()
    wrong = StereoPair(pairs[3].left, replace(pairs[3].right, image_px=pairs[3].right.image_px + np.array([4.0, 1.0])))
    fit = fit_pairs([*pairs[:3], wrong, *pairs[4:]], left, right, (SHAPE, SHAPE))
    assert fit.pairs == len(pairs) - 1
    assert [item.step for item in fit.rejected] == ["pose pose-3"]


def test_pairs_numbered_from_opposite_ends_are_left_out_and_named():
    """A checkerboard of 9 x 12 squares rotated by 180 deg: corner k is corner 87 - k."""
    pairs, left, right = drawn_pairs()
    turned = []
    for k, pair in enumerate(pairs):
        index = 87 - pair.right.index if k in (1, 4, 6) else pair.right.index
        view = replace(pair.right, index=index, board_mm=board_points(pair.right.capture, index))
        turned.append(StereoPair(pair.left, view))
    fit = fit_pairs(turned, left, right, (SHAPE, SHAPE))
    assert [item.step for item in fit.rejected] == [f"pose {pairs[k].left.capture.pose}" for k in (1, 4, 6)]
    assert all("opposite ends" in item.reason for item in fit.rejected)
    clean = fit_pairs([p for k, p in enumerate(pairs) if k not in (1, 4, 6)], left, right, (SHAPE, SHAPE))
    assert fit.baseline_mm == pytest.approx(clean.baseline_mm, rel=1e-9)


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the public stereo pairs aren't here")
def test_public_stereo_pairs():
    """13 pairs of a plain checkerboard (6 x 9 inner corners), as pictures: the goal is an rms of 0.2 px."""
    frames, captures = {}, []
    for side in ("left", "right"):
        for file in sorted(PAIRS.glob(f"{side}[0-9]*.jpg")):
            path = f"frames/{file.stem}.npy"
            frames[path] = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(np.uint16)
            captures.append(
                CharucoCapture(
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
    camera = DataSheet(rows=480, cols=640, pixel_pitch_um=6.0, fill_factor=1.0, cfa="MONO", bit_depth=8)
    recordings = RecordingSet(
        Manifest(cameras={"left": camera, "right": camera}, captures=tuple(captures)), frames=frames
    )
    left, right = fit_geometry(recordings, "left"), fit_geometry(recordings, "right")
    assert left.views == right.views == 13
    fit = fit_stereo(recordings, left, right)
    assert fit.pairs == 13
    assert fit.rms_px < 0.2
    assert fit.rectification.row_rms_px < 0.2
    # both cameras saw one board, and find the same bend of it, each by itself
    bends = [camera.board_warp[0] for camera in (left, right)]
    assert abs(bends[0].bend_y_mm - bends[1].bend_y_mm) < 4 * np.hypot(bends[0].bend_y_mm_std, bends[1].bend_y_mm_std)
    assert bends[0].bend_y_mm > 5 * bends[0].bend_y_mm_std
    # the board ripples: both cameras see the same, and neighbouring corners are displaced alike
    assert fit.corner_errors.between_cameras > 0.8
    for errors in (left.corner_errors, right.corner_errors, fit.corner_errors):
        assert errors.model_error_px > errors.noise_px
    # each camera alone and in the pair, from the same corners: two estimates with a common part differ by less than the
    # larger standard deviation in two of three cases, by less than twice of it in 95 %
    for alone, matrix in ((left, fit.camera_matrix_left), (right, fit.camera_matrix_right)):
        gap = np.abs(np.array(alone.camera_matrix) - matrix)
        assert np.all(gap <= 2 * np.array(alone.camera_matrix_std))
    # OpenCV's own focal length of these pairs, 534.8 px, was found with one focal length for both cameras
    assert left.camera_matrix[0][0] == pytest.approx(534.8, rel=0.01)


def test_an_exchanged_pair_is_reported_and_nothing_is_changed():
    """The right camera of `projected` stands 80 mm right of the left one."""
    pairs, left, right = drawn_pairs()
    assert fit_pairs(pairs, left, right, (SHAPE, SHAPE)).remarks == ()
    exchanged = [StereoPair(pair.right, pair.left) for pair in pairs]
    fit = fit_pairs(exchanged, right, left, (SHAPE, SHAPE))
    assert fit.translation_mm[0] == pytest.approx(80.0, abs=3 * fit.translation_mm_std[0] + 5.0)
    assert len(fit.remarks) == 1
    assert "mm left of the left one" in fit.remarks[0] and "exchanged" in fit.remarks[0]


def test_cameras_above_each_other_have_no_wrong_side():
    """Turned by 90 deg about the axis, each picture of the same rig has the second camera above or below the first."""

    def turned(view):
        x, y = view.image_px.T
        return replace(view, image_px=np.column_stack([SHAPE[0] - 1.0 - y, x]))

    pairs, _, _ = drawn_pairs()
    sides = [[turned(getattr(pair, side)) for pair in pairs] for side in ("left", "right")]
    shape = SHAPE[::-1]
    fits = [geometry_result(calibrate_robustly(views, shape)) for views in sides]
    both = [StereoPair(one, two) for one, two in zip(*sides, strict=True)]
    assert fit_pairs(both, *fits, (shape, shape)).remarks == ()
    assert fit_pairs([StereoPair(p.right, p.left) for p in both], *fits[::-1], (shape, shape)).remarks == ()


@pytest.mark.parametrize(("late", "name"), [(1, "next"), (-1, "previous")])
def test_pictures_one_pose_off_are_named(late, name):
    pairs, left, right = drawn_pairs()
    off = [StereoPair(pair.left, pairs[(k - late) % len(pairs)].right) for k, pair in enumerate(pairs)]
    with pytest.raises(NotDetermined, match=f"fits the right one of the {name} pose"):
        fit_pairs(off, left, right, (SHAPE, SHAPE))
