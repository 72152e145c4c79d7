"""Results of the geometry fits: intrinsics, distortion, stereo."""

from __future__ import annotations

from lab.formats.results.skipped import Skipped
from sim.parameters import Frozen

Rows = tuple[tuple[float, ...], ...]


class BoardWarp(Frozen):
    """Departure of a board from a plane: z = bend_x (x^2 - 1/3) + bend_y (y^2 - 1/3) + twist x y.

    x and y run from -1 to 1 across the board; z points away from the camera. None where the views don't determine it;
    the other uncertainties include it nevertheless.
    """

    board: str
    bend_x_mm: float | None = None
    bend_x_mm_std: float | None = None
    bend_y_mm: float | None = None
    bend_y_mm_std: float | None = None
    twist_mm: float | None = None
    twist_mm_std: float | None = None


class DistortionModel(Frozen):
    """One of the distortion models that were tried, and its error on views that its fit hasn't used."""

    coefficients: tuple[str, ...]
    held_out_rms_px: float
    chosen: bool
    reason: str


class CrossValidation(Frozen):
    """Comparison of two calibrations, each from one half of the views.

    `difference_px`: rms difference of their projections over the frame, after the implied motion is removed.
    `expected_px`: the same from all that `corner_errors` knows of. `sampling_px`: from the independent noise of the
    corners alone. `significance_sigma`: of the difference beyond `expected_px`. Above 2.6 (1 %) the covariance of the
    fit has been multiplied by (difference_px / expected_px)^2.
    """

    difference_px: float
    expected_px: float
    sampling_px: float | None = None
    significance_sigma: float
    #: The error of the model in the projection of one half: what `expected_px`, or the difference where it is
    #: significant, has beyond `sampling_px`. It is in the standard deviations of the fit.
    model_error_px: float


class CornerErrors(Frozen):
    """Departure of the corners from the model, px, as standard deviations of one coordinate, in two parts.

    `noise_px`: independent from corner to corner, the sampling error. `model_error_px`: correlated between neighbouring
    corners (board, print, lens, motion), the error of the model; 0 where it isn't significant. Both are in
    `covariance`."""

    noise_px: float
    model_error_px: float
    #: Along the rows and the columns of the board; None without a model error.
    length_squares: tuple[float, float] | None = None
    #: Of a pair: correlation of the model error in the left frame with that in the right.
    between_cameras: float | None = None
    #: Standard deviations of `parameters` by the sampling error alone.
    sampling_std: tuple[float, ...] = ()


class ViewResiduals(Frozen):
    """Corners of one view, numbered row by row: measured places, residuals (measured less predicted) and depths.

    `noise_px`: standard deviation of a coordinate by the noise of the view's picture, rms over its corners; None where
    it isn't known."""

    capture: str
    corner: tuple[int, ...]
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    dx_px: tuple[float, ...]
    dy_px: tuple[float, ...]
    depth_mm: tuple[float, ...]
    noise_px: float | None = None


class ProjectionUncertainty(Frozen):
    """Standard uncertainty (px) of the projection of a point, in its worst direction, on a grid over the frame (rows,
    columns).

    The part that equals a motion of the camera is removed.
    """

    distance_mm: float | None  # None: at infinity
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    projection_px_std: Rows


class ChannelGeometry(Frozen):
    """The geometry of one channel, and its radial shift from green (lateral chromatic aberration) over the distance to
    the axis."""

    channel: str
    camera_matrix: tuple[tuple[float, float, float], ...]
    distortion: tuple[float, ...]
    centre_shift_px: tuple[float, float] = (0.0, 0.0)
    centre_shift_px_std: tuple[float, float] | None = None
    radius_px: tuple[float, ...] = ()
    radial_shift_px: tuple[float, ...] = ()
    radial_shift_px_std: tuple[float, ...] = ()
    rms_px: float
    corners: int


class GeometryFit(Frozen):
    """OpenCV's pinhole model and distortion (`k1 k2 p1 p2 k3`), px."""

    camera_matrix: tuple[tuple[float, float, float], ...]
    camera_matrix_std: tuple[tuple[float, float, float], ...] | None = None
    distortion: tuple[float, ...]
    distortion_std: tuple[float, ...] | None = None
    rms_px: float
    views: int | None = None
    rejected: tuple[Skipped, ...] = ()
    #: Corners that were left out of views that were kept; `step` names the view.
    rejected_corners: tuple[Skipped, ...] = ()
    #: Rows and columns of `covariance`: the fitted intrinsics ("fx"), then the boards' warps.
    parameters: tuple[str, ...] = ()
    covariance: Rows | None = None
    #: Standard deviation of one coordinate of a corner: from the residuals, and from the frames' noise alone.
    corner_px_std: float | None = None
    corner_noise_px: float | None = None
    #: `corner_px_std`, in its two parts.
    corner_errors: CornerErrors | None = None
    board_warp: tuple[BoardWarp, ...] = ()
    distortion_models: tuple[DistortionModel, ...] = ()
    cross_validation: CrossValidation | None = None
    projection: tuple[ProjectionUncertainty, ...] = ()
    channels: tuple[ChannelGeometry, ...] = ()
    residuals: tuple[ViewResiduals, ...] = ()
    remarks: tuple[str, ...] = ()


class DepthUncertainty(Frozen):
    """Standard uncertainty of a triangulated depth over the left camera's frame (rows, columns).

    None where the right camera doesn't see the point. `calibration`: from the calibration alone, common to all frames;
    `total`: with the matching error of the board's corners added.
    """

    depth_mm: float
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    calibration_mm_std: tuple[tuple[float | None, ...], ...]
    total_mm_std: tuple[tuple[float | None, ...], ...]


class Rectification(Frozen):
    """OpenCV's rectification of the pair: rotations and projections, from which `lab.fit.stereo.rectification_maps`
    makes maps.

    `row_rms_px`: rms difference of the rows of the same corner in the rectified pair.
    """

    rotation_left: tuple[tuple[float, float, float], ...]
    rotation_right: tuple[tuple[float, float, float], ...]
    projection_left: Rows
    projection_right: Rows
    disparity_to_depth: Rows
    row_rms_px: float


class StereoFit(Frozen):
    """The pose of one camera to the other: x_right = rotation x_left + translation_mm."""

    rotation: tuple[tuple[float, float, float], ...]
    rotation_std_rad: tuple[float, float, float] | None = None
    translation_mm: tuple[float, float, float]
    translation_mm_std: tuple[float, float, float] | None = None
    baseline_mm: float
    baseline_mm_std: float | None = None
    rms_px: float
    pairs: int
    #: Intrinsics fitted jointly with the pose of the cameras, over the views of both.
    camera_matrix_left: tuple[tuple[float, float, float], ...] | None = None
    distortion_left: tuple[float, ...] | None = None
    camera_matrix_right: tuple[tuple[float, float, float], ...] | None = None
    distortion_right: tuple[float, ...] | None = None
    #: Rows and columns of `covariance`: "left fx" .., "right fx" .., the rotation about the right camera's axes, the
    #: translation, the boards' warps.
    parameters: tuple[str, ...] = ()
    covariance: Rows | None = None
    corner_px_std: float | None = None
    corner_errors: CornerErrors | None = None
    rejected: tuple[Skipped, ...] = ()
    rectification: Rectification | None = None
    depth: tuple[DepthUncertainty, ...] = ()
