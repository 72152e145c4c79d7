"""Intrinsics of a camera from views of a board, with their uncertainty: the step on a recording set, and its result.

- `lab.observables.boards.corners`: corners of ChArUco boards or checkerboards in the raw frames, to hundredths of a
  pixel, found once for fits and diagnosis;
- `sim.scene.projection`: OpenCV's pinhole and fisheye and a splined stereographic projection, with their Jacobians;
- `lab.observables.boards.projection`: the uncertainty of the projection over the frame, and the difference of two
  calibrations;
- `lab.observables.boards.bundle_adjustment`: one least-squares solve for intrinsics, poses and the warp of the boards,
  whose Jacobian and residuals give the full covariance. Errors that neighbouring corners share are an error of the
  model, and part of it (`correlated_errors`);
- `lab.observables.boards.calibration`: outlying corners and views are left out, with the reason. Projection and
  distortion are chosen by views that their fits haven't used: a richer model is refused where it predicts them worse.
  Two halves of the views are calibrated separately; what they differ by beyond their uncertainties widens the
  covariance.

Lateral colour: the camera of each colour of a mosaic follows from where its corners lie beside those of the luminance
(`channel_geometry`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    BoardWarp,
    ChannelGeometry,
    CornerErrors,
    CrossValidation,
    GeometryFit,
    ProjectionUncertainty,
    Skipped,
    ViewResiduals,
)
from lab.formats.results.words import PROJECTION_NAMES
from lab.observables.boards.bundle_adjustment import Solution, warp_prior_mm
from lab.observables.boards.calibration import (
    DIFFERENCE_SIGMA,
    MIN_VIEWS,
    OUTLYING_CORNER_STD,
    Calibration,
    calibration_of,
    cross_validation,
    first_view_of_boards,
    widen_covariance,
)
from lab.observables.boards.corner_fits import CornerFits
from lab.observables.boards.corners import board_corners, channel_corners, plane_corners
from lab.observables.boards.projection import CameraGeometry, grid, grid_points
from lab.observables.boards.shift_fit import fit_shift
from lab.observables.boards.views import MIN_CORNERS, BoardView
from lab.one_blas_thread import one_blas_thread
from sim.camera import Side
from sim.scene.projection import COUNT

Array = NDArray[np.floating[Any]]
LARGEST_WARP_STD = 0.5  # of the standard deviation of the prior; above it, the views don't determine a warp


def channel_geometry(calibration: Calibration, corners: Sequence[dict[str, CornerFits]]) -> tuple[ChannelGeometry, ...]:
    """Fit the camera of each colour to its corners, one entry of `corners` for each view.

    Poses and boards are the same for all colours, so that only differences count: scale, principal point and the
    first two radial coefficients of each colour by least squares, dq = J dtheta. The radial shift of a colour is its
    own less that of green, against the distance from the principal point, positive outwards.
    """
    if not corners or "G" not in corners[0]:
        return ()
    camera, intrinsics = calibration.camera, calibration.intrinsics
    seen = np.concatenate([view.image_px for view in calibration.views])
    by_camera = camera.project_with_jacobian(camera.unproject(seen))[2]
    parameters = _colour_parameters(intrinsics)
    jacobian = by_camera @ parameters
    farthest = float(np.linalg.norm(seen - intrinsics[2:4], axis=1).max())
    radius = np.linspace(0.0, farthest, 16)
    channels = []
    for channel in corners[0]:
        trusted = np.concatenate([fits[channel].trusted & fits["G"].trusted for fits in corners])
        at = np.concatenate([fits[channel].points for fits in corners])
        green = np.concatenate([fits["G"].points for fits in corners])
        if trusted.sum() < 4 * MIN_CORNERS:
            continue
        shift_of_channel = fit_shift((at - seen)[trusted], jacobian[trusted])
        near = shift_of_channel.away_std < OUTLYING_CORNER_STD
        theta = CameraGeometry(camera.projection, intrinsics + parameters @ shift_of_channel.values)
        result = ChannelGeometry(
            channel=channel,
            camera_matrix=theta.matrix.tolist(),
            distortion=theta.distortion.tolist(),
            rms_px=shift_of_channel.std_px * float(np.sqrt(np.mean(shift_of_channel.away_std[near] ** 2))),
            corners=int(near.sum()),
        )
        if channel != "G":
            against_green = fit_shift((at - green)[trusted], jacobian[trusted])
            values, covariance = against_green.values, against_green.covariance
            # Along the diagonal of the frame; the radial part hardly depends on the direction
            along = np.array([0.8, 0.6])
            line = camera.unproject(intrinsics[2:4] + radius[:, None] * along)
            radial = np.einsum("i,nij->nj", along, camera.project_with_jacobian(line)[2] @ parameters)
            radial[:, 1:3] = 0.0  # a common shift of the frame isn't radial
            result = result.model_copy(
                update={
                    "centre_shift_px": tuple(values[1:3].tolist()),
                    "centre_shift_px_std": tuple(np.sqrt(np.diag(covariance)[1:3]).tolist()),
                    "radius_px": tuple(radius.tolist()),
                    "radial_shift_px": tuple((radial @ values).tolist()),
                    "radial_shift_px_std": tuple(
                        np.sqrt(np.einsum("ni,ij,nj->n", radial, covariance, radial)).tolist()
                    ),
                }
            )
        channels.append(result)
    return tuple(channels)


def _colour_parameters(intrinsics: Array) -> Array:
    """Return the directions (12, 5) of the intrinsics for scale, cx, cy and the first two radial coefficients."""
    parameters = np.zeros((COUNT, 5))
    parameters[0, 0], parameters[1, 0] = intrinsics[0], intrinsics[1]
    for column, row in ((1, 2), (2, 3), (3, 4), (4, 5)):
        parameters[row, column] = 1.0
    return parameters


@one_blas_thread
def fit_geometry(recordings: RecordingSet, side: Side) -> GeometryFit:
    """Fit the camera matrix and distortion of `side` to its `charuco` captures (plain checkerboards: see
    `lab.observables.boards.detection`). Raises `NotDetermined` as `calibration_of` does.
    """
    calibration, boards, cfa = (
        calibration_of(recordings, side),
        board_corners(recordings, side),
        recordings.camera(side).cfa,
    )
    channels: tuple[ChannelGeometry, ...] = ()
    if cfa != "MONO":
        corners_of_capture = boards.by_capture()
        corners = []
        for view in calibration.views:
            whole = corners_of_capture[view.capture.id]
            fits = channel_corners(plane_corners(recordings, whole), cfa)
            kept = np.isin(whole.index, view.index)
            corners.append({channel: fit.only(kept) for channel, fit in fits.items()})
        channels = channel_geometry(calibration, corners)
    return geometry_result(calibration, boards.missed, channels)


def geometry_result(
    calibration: Calibration,
    missed: Sequence[Skipped] = (),
    channels: tuple[ChannelGeometry, ...] = (),
) -> GeometryFit:
    """State a calibration with its errors as a result; `missed`: captures in which no board was found.

    `channels`: the cameras of the colours.
    """
    validation = cross_validation(calibration)
    calibration = widen_covariance(calibration, validation)
    solution = calibration.solution
    noises = [view.std_px for view in calibration.views if view.std_px is not None]
    of_pictures = float(np.sqrt(np.mean(np.concatenate(noises) ** 2))) if noises else None
    std = solution.std()
    intrinsics_count = int(solution.free.sum())
    warps = solution.covariance[intrinsics_count:, intrinsics_count:]
    fx, fy, cx, cy = (float(value) for value in std[:4])
    camera = calibration.camera
    distortion = camera.distortion
    return GeometryFit(
        lens_projection=camera.projection.kind,
        spline_angle_deg=camera.projection.spline_angle_deg,
        camera_matrix=camera.matrix.tolist(),
        camera_matrix_std=((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 0.0)),
        distortion=distortion.tolist(),
        distortion_std=camera.projection.distortion(std)[: len(distortion)].tolist(),
        rms_px=solution.rms_px,
        views=len(calibration.views),
        rejected=(*missed, *calibration.rejected),
        rejected_corners=calibration.rejected_corners,
        parameters=solution.names,
        covariance=solution.covariance.tolist(),
        corner_px_std=solution.noise_px,
        corner_noise_px=of_pictures,
        corner_errors=corner_errors(solution),
        board_warp=board_warps(calibration.views, solution.state.warps_mm, warps),
        distortion_models=calibration.models,
        cross_validation=validation,
        projection=projection_maps(calibration),
        channels=channels,
        residuals=view_residuals(calibration),
        remarks=(*_projection_remarks(calibration), *_remarks(solution, validation, of_pictures)),
    )


def corner_errors(solution: Solution) -> CornerErrors:
    """State the errors of the corners of a solve as a result: sampling and model apart."""
    errors = solution.errors
    return CornerErrors(
        noise_px=solution.noise_px if errors is None else errors.noise_px,
        model_error_px=solution.model_error_px,
        length_squares=None if errors is None else errors.length_squares,
        between_cameras=None if errors is None or len(solution.free) == 1 else errors.between_cameras,
        lens_px=solution.lens_px,
        sampling_std=np.sqrt(np.diag(solution.covariance_by_sampling)).tolist(),
    )


def projection_maps(calibration: Calibration) -> tuple[ProjectionUncertainty, ...]:
    """Map the standard deviation of the projection over the frame, at the median distance of the boards and at
    infinity.
    """
    x, y = grid(calibration.shape)
    image = grid_points(x, y)
    distances = (float(np.median(np.linalg.norm(calibration.points, axis=1))), None)
    maps = []
    for distance_mm in distances:
        std = calibration.projection_std(image, distance_mm).reshape(len(y), len(x))
        if not np.isfinite(std).all():  # where the distortion has no inverse
            std = np.where(np.isfinite(std), std, np.nanmax(std))
        rows = tuple(tuple(row.tolist()) for row in std)
        maps.append(
            ProjectionUncertainty(distance_mm=distance_mm, x_px=x.tolist(), y_px=y.tolist(), projection_px_std=rows)
        )
    return tuple(maps)


def board_warps(views: Sequence[BoardView], warps_mm: Array, covariance: Array) -> tuple[BoardWarp, ...]:
    """State the warps (boards, 3), mm, as results, with their joint `covariance`; None where the views don't determine
    them.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(-1, 3)
    warps = []
    for number, view in enumerate(first_view_of_boards(views)):
        capture = view.capture
        known = std[number] < LARGEST_WARP_STD * warp_prior_mm(view)
        fields: dict[str, float | None] = {}
        for k, field in enumerate(("bend_x_mm", "bend_y_mm", "twist_mm")):
            fields[field] = float(warps_mm[number, k]) if known[k] else None
            fields[f"{field}_std"] = float(std[number, k]) if known[k] else None
        name = f"{capture.squares[0]} x {capture.squares[1]} squares of {capture.square_mm:g} mm, {capture.dictionary}"
        warps.append(BoardWarp(board=name, **fields))
    return tuple(warps)


def view_residuals(calibration: Calibration) -> tuple[ViewResiduals, ...]:
    """List where the corners of each view were seen, and their distances from the predictions."""
    state = calibration.solution.state
    views = []
    for k, (view, rest) in enumerate(zip(calibration.views, calibration.solution.residuals, strict=True)):
        depth = (view.board_mm @ state.rotations[k].T + state.translations_mm[k])[:, 2]
        views.append(
            ViewResiduals(
                capture=view.capture.id,
                corner=tuple(int(index) for index in view.index),
                x_px=np.round(view.image_px[:, 0], 5).tolist(),
                y_px=np.round(view.image_px[:, 1], 5).tolist(),
                dx_px=np.round(rest[:, 0], 5).tolist(),
                dy_px=np.round(rest[:, 1], 5).tolist(),
                depth_mm=np.round(depth, 3).tolist(),
                noise_px=None if view.std_px is None else float(np.sqrt(np.mean(view.std_px**2))),
            )
        )
    return tuple(views)


def _projection_remarks(calibration: Calibration) -> list[str]:
    """Say that another projection than a pinhole was chosen and why, and what a lens departs from its projection by."""
    kind = calibration.camera.projection.kind
    name = PROJECTION_NAMES[kind]
    remarks = []
    if kind != "pinhole":
        held_out = {model.lens_projection: model.held_out_rms_px for model in calibration.models if model.chosen}
        pinhole = [model.held_out_rms_px for model in calibration.models if model.lens_projection == "pinhole"]
        beside = f", with the best pinhole {min(pinhole):.3f} px" if pinhole else "; no pinhole fits"
        remarks.append(
            f"The lens projects as {name}: views that the fit hasn't used are predicted to {held_out[kind]:.3f} px rms"
            f"{beside}. Its distortion is {' '.join(calibration.camera.projection.coefficients)}."
        )
    if calibration.solution.lens_px > 0.0:
        remarks.append(
            f"The lens departs from {name} by about {calibration.solution.lens_px:.3f} px (standard deviation, along "
            "the radius at the farthest corner). The standard uncertainties include it."
        )
    return remarks


def _remarks(solution: Solution, validation: CrossValidation | None, of_pictures: float | None) -> list[str]:
    """Say where corners depart from the model together, or by more than the pictures' noise, and what two halves of the
    views tell.
    """
    remarks = []
    if solution.errors is not None:
        along_x, along_y = solution.errors.length_squares
        remarks.append(
            f"Corners depart from the model together: {solution.model_error_px:.3f} px (standard deviation) over "
            f"about {along_x:.1f} x {along_y:.1f} squares of a view, beside {solution.errors.noise_px:.3f} px of each "
            "by itself. The standard uncertainties include it, as an error that is new in every view."
        )
    if of_pictures is not None and solution.noise_px > 2.0 * max(of_pictures, 1e-3):
        remarks.append(
            f"The corners depart from the model by {solution.noise_px:.3f} px (standard deviation), where the "
            "pictures' noise accounts for "
            f"{of_pictures:.3f} px: the rest is the board's print and shape, motion, or the lens model."
        )
    if validation is None:
        remarks.append(f"Fewer than {2 * MIN_VIEWS} views: the model's own error can't be told from the sampling's.")
    elif validation.significance_sigma > DIFFERENCE_SIGMA:
        remarks.append(
            f"Two halves of the views differ by {validation.difference_px:.3f} px over the frame, where the corners "
            f"let them differ by {validation.expected_px:.3f} px: the model is off by about "
            f"{validation.model_error_px:.3f} px. The standard uncertainties are widened by as much."
        )
    return remarks
