"""Views and corners that don't fit are left out; views that don't determine a camera are refused.

The choice of the distortion model, and the error of the model from two halves of the views.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.formats.results import DistortionModel
from lab.observables.boards.calibration import Calibration, calibrate_robustly, cross_validation
from tests.lab.fit.projected import SHAPE, Truth, poses, seen


def test_parallel_views_do_not_determine_the_focal_length():
    facing = [(np.eye(3), np.array([-150.0 + 40 * k, -100.0 + 15 * k, 700.0])) for k in range(3)]
    with pytest.raises(NotDetermined, match="all views are parallel"):
        calibrate_robustly(seen(np.random.default_rng(0), facing), SHAPE)


def test_corners_that_no_camera_explains_are_refused():
    views = seen(np.random.default_rng(0), poses(6))
    rng = np.random.default_rng(1)
    scrambled = [replace(view, image_px=rng.permutation(view.image_px)) for view in views]
    with pytest.raises(NotDetermined, match=r"no camera explains the corners|no pose of the board fits"):
        calibrate_robustly(scrambled, SHAPE)


def test_single_stray_corners_are_left_out_and_named():
    views = seen(np.random.default_rng(0), poses(8))
    away = views[2].image_px.copy()
    away[[5, 40]] += [[2.0, -1.0], [0.0, 3.0]]
    stray = [*views[:2], replace(views[2], image_px=away), *views[3:]]
    found = calibrate_robustly(stray, SHAPE)
    assert [item.step for item in found.rejected_corners] == [views[2].capture.id]
    named = found.rejected_corners[0].reason
    assert f"{views[2].index[5]} (" in named and f"{views[2].index[40]} (" in named
    assert found.rejected == ()
    clean = calibrate_robustly([*views[:2], views[2].only(~np.isin(np.arange(88), [5, 40])), *views[3:]], SHAPE)
    np.testing.assert_allclose(found.intrinsics, clean.intrinsics, rtol=1e-5)


def test_a_view_of_something_else_is_left_out_and_named():
    views = seen(np.random.default_rng(0), poses(8))
    other = replace(
        views[3], image_px=views[3].image_px + np.random.default_rng(1).normal(0, 3, views[3].image_px.shape)
    )
    found = calibrate_robustly([*views[:3], other, *views[4:]], SHAPE)
    assert [item.step for item in found.rejected] == [views[3].capture.id]


def test_a_decentred_long_lens_is_solved_to_the_noise_of_its_corners():
    """Tangential distortion of 10 px at the corner of 10 half diagonals' focal length: an off centre of k1 alone looks
    like it.
    """
    lens = Truth(
        left=np.array([[8070.0, 0, 642.0], [0, 8070.0, 475.0], [0, 0, 1]]),
        distortion_left=np.array([0.03, 0.0, 0.027, 0.2, 0.0]),
        warp_mm=(0.0, 0.0, 0.0),
    )
    tilts_deg = [(0, 0), (35, 0), (-35, 0), (0, 35), (0, -35), (25, 25), (-25, 25), (25, -25), (-25, -25), (10, -15)]
    at = []
    for k, (x, y) in enumerate(tilts_deg):
        turn = cv2.Rodrigues(np.deg2rad([x, y, 2.0 * (k % 4)]))[0]
        middle = np.array([15.0 * ((k * 7) % 5 - 2), 12.0 * ((k * 3) % 5 - 2), 2600.0 * (1 + 0.03 * (k % 4))])
        at.append((turn, middle - turn @ [150.0, 112.5, 0]))
    found = calibrate_robustly(seen(np.random.default_rng(3), at, lens, noise_px=0.05), SHAPE)
    # both coordinates: 0.05 sqrt(2) px, known to 2 % by 900 corners
    assert found.solution.rms_px == pytest.approx(0.05 * np.sqrt(2.0), rel=0.08)
    std = np.sqrt(np.diag(found.covariance))
    assert std[0] < 0.01 * 8070.0
    assert abs(found.intrinsics[0] - 8070.0) < 4.0 * std[0]


def pinholes(calibration: Calibration) -> list[DistortionModel]:
    """The models of a pinhole, from the simplest."""
    return [model for model in calibration.models if model.lens_projection == "pinhole"]


def test_a_model_that_overfits_is_refused():
    """Six views of twelve noisy corners in the middle of the frame: the coefficients beyond k1 predict unseen views
    worse.
    """
    refused = 0
    for draw in range(2):
        views = seen(np.random.default_rng(draw), poses(6, squares=(4, 5)), noise_px=0.3, squares=(4, 5))
        models = pinholes(calibrate_robustly(views, SHAPE))
        chosen = next(model for model in models if model.chosen)
        richest = models[-1]
        assert chosen.held_out_rms_px <= 1.03 * min(model.held_out_rms_px for model in models[:1])
        if richest is not chosen:
            refused += 1
            assert richest.reason.startswith("refused")
            assert richest.held_out_rms_px > chosen.held_out_rms_px
    assert refused


def test_a_model_that_is_too_simple_is_not_chosen():
    models = pinholes(calibrate_robustly(seen(np.random.default_rng(0), poses(12)), SHAPE))
    assert not models[0].chosen  # the truth has k2, p1 and p2
    assert models[0].held_out_rms_px > 1.03 * models[-1].held_out_rms_px


def test_an_error_of_the_model_is_told_from_the_samplings():
    """A board that takes another shape in every view: the halves differ by more than the corners' noise lets them, and
    by no more than is stated.
    """
    rng = np.random.default_rng(3)
    at = poses(14)
    floppy = [tuple(rng.normal(0, 2.0, 3)) for _ in at]
    wrong = cross_validation(calibrate_robustly(seen(rng, at, noise_px=0.03, warps_mm=floppy), SHAPE))
    right = cross_validation(calibrate_robustly(seen(rng, at, noise_px=0.03), SHAPE))
    assert right.model_error_px == 0.0 or right.significance_sigma < 3.3  # 1 in 1000
    assert wrong.difference_px > 2 * right.difference_px
    assert wrong.difference_px > 3 * wrong.sampling_px
    assert wrong.significance_sigma < 3.3
    assert right.expected_px == pytest.approx(right.sampling_px)
    assert wrong.model_error_px > 3 * right.expected_px
