"""Intrinsics from recordings of boards drawn with known cameras: recovered, rejected views, refusals, results.

Corners of a checkerboard are found where they are. Lateral colour of drawn corners, and of a camera without it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.special import erf

from lab.errors import NotDetermined
from lab.fit.geometry import board_warps, channel_geometry, fit_geometry, geometry_result
from lab.formats.recording_set import RecordingSet
from lab.formats.results import GeometryFit
from lab.observables.boards.calibration import calibrate_robustly
from lab.observables.boards.corner_fits import CornerFits, fit_corners
from lab.observables.boards.detection import find_board, luminance
from lab.observables.boards.shift_fit import fit_shift
from tests.lab.fit.projected import SHAPE, TRUTH, poses, seen


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
    std_px = np.std(found)
    # noise / (contrast slope) over about 4 window-lengths of edge pixels: 0.02 / 0.4 / sqrt(36) = 0.008 px
    assert std_px < 0.012
    assert np.abs(np.mean(found, axis=0)).max() < 4 * std_px / np.sqrt(60)


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
    view = find_board(luminance(charuco_boards.frame(capture)), capture)
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


def test_lateral_colour_of_drawn_corners():
    """Red is magnified by 0.03 % and displaced by (0.02, -0.01) px against green."""
    rng = np.random.default_rng(6)
    calibration = calibrate_robustly(seen(rng, poses(12), noise_px=0.02), SHAPE)
    corners = []
    for view in calibration.views:
        grown = view.image_px + 3e-4 * (view.image_px - calibration.intrinsics[2:4]) + [0.02, -0.01]
        noise = [rng.normal(0, 0.02, grown.shape) for _ in range(2)]
        sure, std = np.ones(len(grown), bool), np.full(len(grown), 0.02)
        corners.append(
            {"R": CornerFits(grown + noise[0], sure, std), "G": CornerFits(view.image_px + noise[1], sure, std)}
        )
    red, green = channel_geometry(calibration, corners)
    gap = np.array(red.radial_shift_px) - 3e-4 * np.array(red.radius_px)
    assert np.all(np.abs(gap) < 4 * np.array(red.radial_shift_px_std) + 1e-6)
    assert red.radial_shift_px[-1] > 10 * red.radial_shift_px_std[-1]
    for k, true in enumerate((0.02, -0.01)):
        assert abs(red.centre_shift_px[k] - true) < 4 * red.centre_shift_px_std[k]
    assert red.camera_matrix[0][0] / green.camera_matrix[0][0] == pytest.approx(1.0003, abs=1e-4)


def test_colours_of_a_camera_without_lateral_colour_agree(charuco_fits):
    """Corners on each colour's own pixels: no channel may be displaced, whatever its place in the mosaic."""
    fit = charuco_fits["left"]
    assert [channel.channel for channel in fit.channels] == ["R", "G", "B"]
    for channel in fit.channels:
        if channel.channel != "G":
            assert np.all(np.abs(channel.centre_shift_px) < 5 * np.array(channel.centre_shift_px_std))
            assert np.abs(channel.centre_shift_px).max() < 0.02
            assert abs(channel.radial_shift_px[-1]) < 5 * channel.radial_shift_px_std[-1]


def test_corners_with_large_errors_move_the_shift_by_no_more_than_its_uncertainty():
    """A quarter of the corners has errors of 0.05 +- 0.02 px to the right, the same in every session, as demosaicing
    makes them.

    From session to session only noise of 0.007 px is new. Over 60 sessions, a standard deviation is known to 1 /
    sqrt(120) = 9 %: 3 sigma is 28 %.
    """
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1, 1, (2, 300))
    jacobian = np.zeros((300, 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 0, 1], jacobian[:, 1, 2] = x, y, 1.0, 1.0
    same = np.zeros((300, 2))
    same[:75, 0] = rng.normal(0.05, 0.02, 75)
    fits = [fit_shift(same + rng.normal(0, 0.007, (300, 2)), jacobian) for _ in range(60)]
    spread = np.std([fit.values for fit in fits], axis=0, ddof=1)
    assert np.all(spread < 1.28 * np.mean([np.sqrt(np.diag(fit.covariance)) for fit in fits], axis=0))
