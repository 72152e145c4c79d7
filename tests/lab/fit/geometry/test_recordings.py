"""Intrinsics from recordings of boards drawn with known cameras: recovered, rejected views, refusals, results."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.geometry.board_detection import find_board, luminance
from lab.fit.geometry.calibration import calibrate_robustly
from lab.fit.geometry.recordings import board_warps, fit_geometry, geometry_result
from lab.formats.recording_set import RecordingSet
from lab.formats.results import GeometryFit
from tests.lab.fit.projected import SHAPE, TRUTH, poses, seen


def test_intrinsics_of_a_bayer_camera_are_recovered_within_their_uncertainty(charuco_fits, truth):
    for side, matrix in (("left", truth.left), ("right", truth.right)):
        fit = charuco_fits[side]
        gap = np.array(fit.camera_matrix) - matrix
        std = np.array(fit.camera_matrix_std)
        for at in ((0, 0), (1, 1), (0, 2), (1, 2)):
            assert abs(gap[at]) < 4 * std[at]
        assert std[0, 0] < 0.005 * matrix[0, 0]
        assert abs(fit.distortion[0] - truth.distortion[0]) < 4 * fit.distortion_std[0]
        assert fit.rms_px < 0.1
        assert fit.views == 8
        assert fit.rejected == ()


def test_corners_on_the_mosaic_are_not_biased(charuco_boards, truth):
    """Against the projection of the board by the true camera: the mean error, in px, of all corners of a frame."""
    capture = charuco_boards.captures("charuco", "left")[0]
    view = find_board(luminance(charuco_boards.frame(capture), "RGGB"), capture)
    half = np.array([8, 6, 0.0]) * 12.0
    turn = np.array([0.1, -0.08, 0.07])  # the first pose
    translation = np.array([30.0, 0, 420]) - cv2.Rodrigues(turn)[0] @ half
    expected, _ = cv2.projectPoints(view.board_mm.astype(float), turn, translation, truth.left, truth.distortion)
    gap = view.image_px - expected[:, 0]
    assert len(gap) == 35
    assert np.abs(gap.mean(axis=0)).max() < 0.02
    assert gap.std() < 0.06


def test_a_plain_checkerboard_is_a_charuco_without_dictionary(boards, truth):
    recordings = boards(dictionary="none", squares=(6, 9), cfa="MONO", poses=6, sides=("left",))
    fit = fit_geometry(recordings, "left")
    assert fit.views == 6
    assert abs(fit.camera_matrix[0][0] - truth.left[0, 0]) < 4 * fit.camera_matrix_std[0][0]
    assert fit.rms_px < 0.06


def test_a_frame_without_board_is_rejected_and_said_so(boards):
    recordings = boards(poses=5, sides=("left",))
    capture = recordings.captures("charuco", "left")[2]
    recordings._files.frames[capture.frame] = np.full((300, 400), 700, np.uint16)
    fit = fit_geometry(recordings, "left")
    assert fit.views == 4
    assert [item.step for item in fit.rejected] == [capture.id]


def test_a_displaced_view_is_left_out(boards):
    recordings = boards(poses=6, sides=("left",))
    capture = recordings.captures("charuco", "left")[3]
    frame = recordings._files.frames[capture.frame].copy()
    # the lower half of the frame slips by 4 px: a rolling shutter over a moving board
    frame[150:] = np.roll(frame[150:], 4, axis=1)
    recordings._files.frames[capture.frame] = frame
    fit = fit_geometry(recordings, "left")
    assert fit.views == 5
    assert fit.rejected[0].step == capture.id
    assert "rms" in fit.rejected[0].reason


def test_too_few_views_are_not_determined(boards):
    with pytest.raises(NotDetermined, match="2 views of the board can be used, 3 are needed"):
        fit_geometry(boards(poses=2, sides=("left",)), "left")


def edited(recordings: RecordingSet, frames=None, **keys) -> RecordingSet:
    """The same recordings with other metadata of the board, or other frames."""
    captures = tuple(capture.model_copy(update=keys) for capture in recordings.manifest.captures)
    pictures = {
        c.frame: recordings.frame(c) if frames is None else np.ascontiguousarray(frames(recordings.frame(c)))
        for c in recordings.manifest.captures
    }
    return RecordingSet(recordings.manifest.model_copy(update={"captures": captures}), frames=pictures)


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"squares": (8, 6)}, "check that it has 8 x 6 squares"),
        ({"dictionary": "DICT_6X6_250"}, "its dictionary is DICT_6X6_250"),
        ({"dictionary": "DICT_NO"}, "OpenCV knows no dictionary"),
    ],
)
def test_wrong_metadata_of_the_board_are_refused(boards, keys, reason):
    with pytest.raises(NotDetermined, match=reason):
        fit_geometry(edited(boards(poses=1, sides=("left",)), **keys), "left")


def test_a_mirrored_picture_is_recognised(boards):
    mirrored = edited(boards(poses=1, sides=("left",)), frames=lambda frame: frame[:, ::-1])
    with pytest.raises(NotDetermined, match="mirrored"):
        fit_geometry(mirrored, "left")


def test_a_flat_board_is_found_flat():
    flat = calibrate_robustly(seen(np.random.default_rng(5), poses(12), replace(TRUTH, warp_mm=(0, 0, 0))), SHAPE)
    warp = geometry_result(flat).board_warp[0]
    assert abs(warp.bend_x_mm) < 4 * warp.bend_x_mm_std
    assert warp.bend_x_mm_std < 0.1


def test_a_warp_that_the_views_say_nothing_about_is_not_stated():
    """The prior's standard deviation is 0.5 % of the board's diagonal, 375 mm: 1.9 mm; half of it has to be gained."""
    views = seen(np.random.default_rng(5), poses(1))
    (warp,) = board_warps(views, np.array([[0.3, 0.2, 0.1]]), np.diag([0.1, 1.5, 0.9]) ** 2)
    assert (warp.bend_x_mm, warp.bend_x_mm_std) == (0.3, pytest.approx(0.1))
    assert (warp.bend_y_mm, warp.bend_y_mm_std) == (None, None)
    assert warp.twist_mm == 0.1


def test_result_says_what_it_rests_on(charuco_fits):
    fit = charuco_fits["left"]
    assert fit.parameters == (
        "fx",
        "fy",
        "cx",
        "cy",
        "k1",
        "k2",
        "p1",
        "p2",
        "k3",
        "bend_x_mm",
        "bend_y_mm",
        "twist_mm",
    )
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance))[0], fit.camera_matrix_std[0][0])
    assert len(fit.residuals) == 8
    rms = np.sqrt(np.mean(np.concatenate([np.square(v.dx_px) + np.square(v.dy_px) for v in fit.residuals])))
    assert rms == pytest.approx(fit.rms_px, rel=1e-3)
    near, far = fit.projection
    assert near.distance_mm == pytest.approx(400, rel=0.15) and far.distance_mm is None
    assert np.shape(near.projection_px_std) == (len(near.y_px), len(near.x_px))
    assert GeometryFit.model_validate_json(fit.model_dump_json()) == fit
