"""Lateral colour of drawn corners, and of a camera without it."""

from __future__ import annotations

import numpy as np
import pytest

from lab.fit.geometry.calibration import calibrate_robustly
from lab.fit.geometry.corners import CornerFits
from lab.fit.geometry.lateral_colour import _fitted_shift, channel_geometry
from tests.lab.fit.projected import SHAPE, poses, seen


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
    """A quarter of the corners has errors of 0.05 +- 0.02 px to the right, the same in every session, as demosaicing makes them.

    From session to session only noise of 0.007 px is new. Over 60 sessions, a standard deviation is known to 1 / sqrt(120) = 9 %: 3 sigma is 28 %.
    """
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1, 1, (2, 300))
    jacobian = np.zeros((300, 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 0], jacobian[:, 0, 1], jacobian[:, 1, 2] = x, y, 1.0, 1.0
    same = np.zeros((300, 2))
    same[:75, 0] = rng.normal(0.05, 0.02, 75)
    fits = [_fitted_shift(same + rng.normal(0, 0.007, (300, 2)), jacobian, np.ones(300, bool)) for _ in range(60)]
    spread = np.std([fit[0] for fit in fits], axis=0, ddof=1)
    assert np.all(spread < 1.28 * np.mean([np.sqrt(np.diag(fit[1])) for fit in fits], axis=0))
