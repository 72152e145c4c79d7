"""The error of the camera model, from two halves of the views."""

from __future__ import annotations

import numpy as np

from lab.fit.geometry.bundle_adjustment import Solution
from lab.fit.geometry.calibration import MIN_VIEWS, Calibration, calibrate
from lab.fit.geometry.pinhole import NAMES
from lab.fit.geometry.projection_errors import Difference, difference
from lab.formats.results import CrossValidation

DIFFERENCE_SIGMA = 2.6  # significance of 1 %, above which two halves of the views don't follow one model


def cross_validation(calibration: Calibration) -> CrossValidation | None:
    """`halves_differ` as a result: the error of the model apart from that of the sampling."""
    found = halves_differ(calibration)
    if found is None:
        return None
    beyond = max(found.rms_px**2 - found.expected_px**2, 0.0) / 2.0
    sigma = found.significance_sigma
    return CrossValidation(
        difference_px=found.rms_px,
        expected_px=found.expected_px,
        significance_sigma=sigma,
        model_error_px=float(np.sqrt(beyond)) if sigma > DIFFERENCE_SIGMA else 0.0,
    )


def halves_differ(calibration: Calibration) -> Difference | None:
    """Difference of two cameras, each calibrated from every other view, at the places of the corners; None where the
    halves are too small.
    """
    views, coefficients = calibration.views, distortion_coefficients(calibration.solution)
    halves = [views[0::2], views[1::2]]
    if min(len(half) for half in halves) < MIN_VIEWS:
        return None
    one, two = (calibrate(half, calibration.shape, coefficients) for half in halves)
    if not (one.determined and two.determined):
        return None
    points = calibration.points
    points = points[:: max(1, len(points) // 300)]
    return difference(
        one.state.intrinsics[0], two.state.intrinsics[0], one.of_camera() + two.of_camera(), calibration.points, points
    )


def distortion_coefficients(solution: Solution) -> tuple[str, ...]:
    """Names of the distortion coefficients that were fitted."""
    return tuple(name for name, free in zip(NAMES[4:], solution.free[0, 4:], strict=True) if free)
