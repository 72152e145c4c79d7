"""The error of the camera model, from two halves of the views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lab.fit.geometry.bundle_adjustment import Solution
from lab.fit.geometry.calibration import MIN_VIEWS, Calibration, calibrate, with_model_error
from lab.fit.geometry.pinhole import NAMES
from lab.fit.geometry.projection_errors import Difference, difference
from lab.formats.results import CrossValidation

DIFFERENCE_SIGMA = 2.6  # significance of 1 %, above which two halves of the views differ beyond their uncertainties


def cross_validation(calibration: Calibration) -> CrossValidation | None:
    """`halves_differ` as a result: the error of the model apart from that of the sampling."""
    found = halves_differ(calibration)
    if found is None:
        return None
    whole, sampling_px = found
    explained = whole.rms_px if whole.significance_sigma > DIFFERENCE_SIGMA else 0.0
    beyond = max(explained, whole.expected_px) ** 2 - sampling_px**2
    return CrossValidation(
        difference_px=whole.rms_px,
        expected_px=whole.expected_px,
        sampling_px=sampling_px,
        significance_sigma=whole.significance_sigma,
        model_error_px=float(np.sqrt(max(beyond, 0.0) / 2.0)),
    )


def halves_differ(calibration: Calibration) -> tuple[Difference, float] | None:
    """Difference of two cameras, each calibrated from every other view, at the places of the corners, and its expected
    rms, px, by the independent noise of the corners alone; None where the halves are too small.

    The errors that neighbouring corners share are those of all views.
    """
    views, coefficients = calibration.views, distortion_coefficients(calibration.solution)
    halves = [views[0::2], views[1::2]]
    if min(len(half) for half in halves) < MIN_VIEWS:
        return None
    solved = [calibrate(half, calibration.shape, coefficients) for half in halves]
    if not all(one.determined for one in solved):
        return None
    errors = calibration.solution.errors
    if errors is not None:
        solved = [
            with_model_error(half, calibration.shape, one, errors) for half, one in zip(halves, solved, strict=True)
        ]
    one, two = solved
    points = calibration.points
    points = points[:: max(1, len(points) // 300)]
    covariances = (
        one.of_camera() + two.of_camera(),
        one.of_camera(only_sampling=True) + two.of_camera(only_sampling=True),
    )
    whole, sampling = (
        difference(one.state.intrinsics[0], two.state.intrinsics[0], covariance, calibration.points, points)
        for covariance in covariances
    )
    return whole, sampling.expected_px


def widened(calibration: Calibration, validation: CrossValidation | None) -> Calibration:
    """The calibration, with its covariance multiplied by the square of what its halves differ by beyond their
    uncertainties; as it is where they agree.
    """
    if validation is None or validation.significance_sigma <= DIFFERENCE_SIGMA:
        return calibration
    factor = max(1.0, validation.difference_px / validation.expected_px)
    solution = calibration.solution
    return replace(
        calibration,
        solution=replace(
            solution,
            covariance=factor**2 * solution.covariance,
            sampling_covariance=solution.covariance_by_sampling,
        ),
    )


def distortion_coefficients(solution: Solution) -> tuple[str, ...]:
    """Names of the distortion coefficients that were fitted."""
    return tuple(name for name, free in zip(NAMES[4:], solution.free[0, 4:], strict=True) if free)
