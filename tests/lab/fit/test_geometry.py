"""Intrinsics against boards drawn with known cameras, and on the public stereo pairs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.special import erf

from lab.errors import NotDetermined
from lab.fit.board import find_board, fit_corners, luminance
from lab.fit.geometry import fit_geometry


def test_corner_is_found_where_it_is():
    """A corner drawn as the product of two blurred edges, skewed, shaded and noisy."""
    rng = np.random.default_rng(1)
    y, x = np.indices((41, 41), dtype=float)
    found = []
    for place in rng.uniform(-0.5, 0.5, (60, 2)):
        dx, dy = x - 20 - place[0], y - 20 - place[1]
        edges = [erf((np.cos(a) * dx + np.sin(a) * dy) / (0.8 * np.sqrt(2))) for a in (0.2, 1.9)]
        picture = 0.5 + 0.003 * dx + 0.4 * edges[0] * edges[1] + rng.normal(0, 0.02, dx.shape)
        points, trusted, _ = fit_corners(
            picture,
            np.array([[20.0, 20.0]]),
            across=np.array([[-np.sin(0.2), np.cos(0.2)]]),
            down=np.array([[-np.sin(1.9), np.cos(1.9)]]),
            half_px=np.array([9.0]),
        )
        assert trusted[0]
        found.append(points[0] - 20 - place)
    scatter = np.std(found)
    # noise / (contrast slope) over about 4 window-lengths of edge pixels: 0.02 / 0.4 / sqrt(36) = 0.008 px
    assert scatter < 0.012
    assert np.abs(np.mean(found, axis=0)).max() < 4 * scatter / np.sqrt(60)


def test_intrinsics_of_a_bayer_camera_are_recovered_within_their_uncertainty(charuco_boards, truth):
    for side, matrix in (("left", truth.left), ("right", truth.right)):
        fit = fit_geometry(charuco_boards, side)
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
    recordings._store.frames[capture.frame] = np.full((300, 400), 700, np.uint16)
    fit = fit_geometry(recordings, "left")
    assert fit.views == 4
    assert [item.step for item in fit.rejected] == [capture.id]


def test_a_displaced_view_is_left_out(boards):
    recordings = boards(poses=6, sides=("left",))
    capture = recordings.captures("charuco", "left")[3]
    frame = recordings._store.frames[capture.frame].copy()
    # the lower half of the frame slips by 4 px: a rolling shutter over a moving board
    frame[150:] = np.roll(frame[150:], 4, axis=1)
    recordings._store.frames[capture.frame] = frame
    fit = fit_geometry(recordings, "left")
    assert fit.views == 5
    assert fit.rejected[0].step == capture.id
    assert "rms" in fit.rejected[0].reason


def test_too_few_views_are_not_determined(boards):
    with pytest.raises(NotDetermined, match="3 are needed"):
        fit_geometry(boards(poses=2, sides=("left",)), "left")
