"""What fits find: noise, geometry, spectral response, blur; with what was skipped."""

from __future__ import annotations

from typing import Literal

from lab.shown import Tabular
from sim.camera import ProjectionKind, Side
from sim.parameters import Frozen


class Skipped(Frozen):
    """A step that wasn't done. `reason`: why, and which capture would make it possible."""

    step: str
    reason: str
    side: Side | None = None


class ChannelNoise(Frozen):
    """Photon transfer of one colour channel."""

    conversion_gain_dn_per_e: float | None = None
    conversion_gain_dn_per_e_std: float | None = None
    read_noise_e: float | None = None
    read_noise_e_std: float | None = None
    black_level_dn: float | None = None
    black_level_dn_std: float | None = None
    dark_current_e_per_s: float | None = None
    dark_current_e_per_s_std: float | None = None
    dsnu_e: float | None = None
    dsnu_e_std: float | None = None
    prnu_percent: float | None = None
    prnu_percent_std: float | None = None
    full_well_e: float | None = None
    full_well_e_std: float | None = None
    linearity_error_percent: float | None = None
    linearity_error_percent_std: float | None = None


class NoiseFit(ChannelNoise):
    """Photon transfer of the whole sensor by the definitions of EMVA 1288 release 4.0; `channels`: of each channel."""

    #: EMVA's total quantum efficiency, of a mono camera whose flats state `photons_per_pixel`, or have a photodiode's
    #: irradiance. `_systematic_std`: by the photodiode's calibration, apart from `_std`.
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    quantum_efficiency_systematic_std: float | None = None
    quantum_efficiency_wavelength_nm: float | None = None
    #: Slope at zero signal of the curve of variance against mean. `conversion_gain_dn_per_e` is this slope, or that of
    #: EMVA's line where the bend of the curve isn't significant.
    conversion_gain_at_zero_dn_per_e: float | None = None
    conversion_gain_at_zero_dn_per_e_std: float | None = None
    #: Standard deviation of the temporal variances about their curve beyond the sampling error, percent of the
    #: variance.
    variance_model_error_percent: float | None = None
    #: At saturation, in percent. `response_bend`: departure of the mean from its tangent at zero. `variance_bend`:
    #: departure of the variance from its tangent at zero. `brighter_fatter`: the part of the variance's bend that the
    #: response doesn't explain. `neighbour_covariance`: covariance with the eight neighbours over the shot noise's
    #: variance, where brighter-fatter puts it.
    response_bend_percent: float | None = None
    response_bend_percent_std: float | None = None
    variance_bend_percent: float | None = None
    variance_bend_percent_std: float | None = None
    brighter_fatter_percent: float | None = None
    brighter_fatter_percent_std: float | None = None
    neighbour_covariance_percent: float | None = None
    neighbour_covariance_percent_std: float | None = None
    #: From the growth of the dark variance with exposure.
    dark_current_from_variance_e_per_s: float | None = None
    dark_current_from_variance_e_per_s_std: float | None = None
    #: Sensor temperature at which the dark currents were measured: the mean over the darks, weighted by exposure.
    dark_temperature_c: float | None = None
    dark_current_temperature: DarkCurrentLaws | None = None
    read_noise_distribution: ReadNoiseDistribution | None = None
    defects: PixelDefects | None = None
    #: Flats whose stated light contradicts the others: left out of responsivity, linearity and gain.
    inconsistent_levels: tuple[InconsistentLevel, ...] = ()
    #: Standard deviation of the levels' means about a smooth response beyond noise, percent of the signal; 0 where
    #: noise explains them. It is part of the uncertainties of responsivity, quantum efficiency and linearity.
    response_scatter_percent: float | None = None
    channels: dict[str, ChannelNoise] = {}
    #: By plane of the mosaic (`R`, `G1`, `G2`, `B`, or `Y`), as specified in the standard.
    emva1288: dict[str, Emva1288] = {}
    #: Amplification at which flats and darks were recorded; `conversion_gain_dn_per_e` is given for 0 dB.
    gain_db: float | None = None
    photon_transfer: PhotonTransfer | None = None
    #: What the recordings show of the bench, in sentences ("the lamp drifted by ...").
    remarks: tuple[str, ...] = ()


class InconsistentLevel(Frozen):
    """A flat level whose stated light contradicts the other levels; signals are above dark, means over the planes.

    `light`: as stated, in `light_unit`; `expected_light`: at which the others have its signal; `expected_signal_dn`:
    that they have at its stated light, at most saturation.
    """

    captures: tuple[str, ...]
    exposure_s: float
    light: float
    light_unit: Literal["photons", "s"]
    expected_light: float
    signal_dn: float
    expected_signal_dn: float


class DarkCurrentLaws(Frozen):
    """Dark current at each temperature, and two laws fitted to it.

    Arrhenius: I = I_ref exp(-E / k (1/T - 1/T_ref)). EMVA 1288: I = I_ref 2^((T - T_ref) / T_d).
    """

    temperature_c: tuple[float, ...]
    dark_current_e_per_s: tuple[float, ...]
    dark_current_e_per_s_std: tuple[float, ...]
    doubling_temperature_c: float | None = None
    doubling_temperature_c_std: float | None = None
    activation_energy_ev: float | None = None
    activation_energy_ev_std: float | None = None
    reference_temperature_c: float | None = None
    reference_current_e_per_s: float | None = None
    reference_current_e_per_s_std: float | None = None


class ReadNoiseDistribution(Frozen):
    """Temporal noise of single pixels in the dark, with `degrees_of_freedom` per pixel.

    `spread_percent`: standard deviation of the pixels' variances over their mean, less the sampling error of the few
    repeats. `noisy_pixels`: number of pixels above the level that chance exceeds anywhere on the sensor with 1 %."""

    degrees_of_freedom: int
    rms_e: float
    median_e: float
    percentile_95_e: float
    percentile_99_e: float
    spread_percent: float
    spread_percent_std: float
    noisy_pixels: int
    noise_e: tuple[float, ...]  # edges of the histogram's bins
    pixels: tuple[int, ...]


class Defect(Frozen):
    """One defective pixel."""

    row: int
    col: int
    dark_dn: float  # above the mean of its plane, in the longest dark
    dark_current_e_per_s: float | None = None  # above the mean of its plane


class PixelDefects(Frozen):
    """Defective pixels: more than 8 standard deviations above (`hot`) or below (`cold`) their plane in the longest
    dark.

    All fits leave them out; EMVA's own figures include them. `listed`: the strongest.
    """

    exposure_s: float
    hot: int
    cold: int
    listed: tuple[Defect, ...] = ()


class Emva1288(Frozen):
    """Figures of EMVA 1288 release 4.0 (linear) of one plane of the mosaic: all pixels counted, shading not removed."""

    #: Slope of the signal against photons, through the origin, up to 70 % of saturation.
    responsivity_dn_per_photon: float | None = None
    responsivity_dn_per_photon_std: float | None = None
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    #: By the calibration of the photodiode that measured the irradiance, apart from `_std`: a factor common to every
    #: figure in photons, `photons_systematic_std_percent` of it. `None` where the numbers of photons are stated.
    quantum_efficiency_systematic_std: float | None = None
    photons_systematic_std_percent: float | None = None
    wavelength_nm: float | None = None
    #: Slope of the temporal variance against the signal, both less dark, through the origin, up to 70 % of saturation.
    system_gain_dn_per_e: float
    system_gain_dn_per_e_std: float
    #: At zero exposure. `None` below 0.24 DN^2, where quantisation hides it; `_limit_e` is then the upper limit 0.40 /
    #: K.
    temporal_dark_noise_dn: float | None = None
    temporal_dark_noise_dn_std: float | None = None
    temporal_dark_noise_e: float | None = None
    temporal_dark_noise_e_std: float | None = None
    temporal_dark_noise_limit_e: float | None = None
    #: Signal at which SNR is 1: sqrt(sigma_y.dark^2 / K^2 + 1/4) + 1/2.
    sensitivity_threshold_e: float | None = None
    sensitivity_threshold_e_std: float | None = None
    sensitivity_threshold_photons: float | None = None
    sensitivity_threshold_photons_std: float | None = None
    #: At the level of the largest temporal variance.
    saturation_capacity_e: float | None = None
    saturation_capacity_e_std: float | None = None
    saturation_capacity_photons: float | None = None
    saturation_capacity_photons_std: float | None = None
    snr_max: float | None = None
    snr_max_std: float | None = None
    dynamic_range: float | None = None
    dynamic_range_std: float | None = None
    linearity_error_percent: float | None = None
    linearity_error_percent_std: float | None = None
    dsnu_e: float | None = None
    dsnu_e_std: float | None = None
    dsnu_row_e: float | None = None
    dsnu_row_e_std: float | None = None
    dsnu_column_e: float | None = None
    dsnu_column_e_std: float | None = None
    dsnu_pixel_e: float | None = None
    dsnu_pixel_e_std: float | None = None
    prnu_percent: float | None = None
    prnu_percent_std: float | None = None
    prnu_row_percent: float | None = None
    prnu_row_percent_std: float | None = None
    prnu_column_percent: float | None = None
    prnu_column_percent_std: float | None = None
    prnu_pixel_percent: float | None = None
    prnu_pixel_percent_std: float | None = None
    #: Of the same stacks, with the smooth surface (degree 6 in rows and columns) apart: highest less lowest light over
    #: the mean (the standard asks for 3 % at most), standard deviation of the surface, and what rows and columns share
    #: without it.
    light_nonuniformity_percent: float | None = None
    light_nonuniformity_percent_std: float | None = None
    shading_percent: float | None = None
    shading_percent_std: float | None = None
    row_gain_percent: float | None = None
    row_gain_percent_std: float | None = None
    column_gain_percent: float | None = None
    column_gain_percent_std: float | None = None
    dark_current_from_mean_e_per_s: float | None = None
    dark_current_from_mean_e_per_s_std: float | None = None
    dark_current_from_variance_e_per_s: float | None = None
    dark_current_from_variance_e_per_s_std: float | None = None
    points: Emva1288Points
    #: Figures that are missing, and why; where the recordings differ from what the standard asks for.
    remarks: tuple[str, ...] = ()


class Emva1288Points(Tabular, Frozen):
    """The measured points, one entry per level; dark values are at the level's exposure. Empty standard uncertainties:
    of a result of an earlier version.

    `signal_dn_std`, `excess_variance_dn2_std`: of mean and variance less dark. `light` is in `light_unit`: photons per
    pixel, or the exposure where the flats don't state photons.
    """

    light_unit: Literal["photons", "s"]
    light: tuple[float, ...]
    exposure_s: tuple[float, ...]
    mean_dn: tuple[float, ...]
    variance_dn2: tuple[float, ...]
    dark_mean_dn: tuple[float, ...]
    dark_variance_dn2: tuple[float, ...]
    linearity_deviation_percent: tuple[float | None, ...]
    signal_dn_std: tuple[float, ...] = ()
    excess_variance_dn2_std: tuple[float, ...] = ()
    dark_exposure_s: tuple[float, ...] = ()
    dark_exposure_mean_dn: tuple[float, ...] = ()
    dark_exposure_mean_dn_std: tuple[float, ...] = ()
    dark_exposure_variance_dn2: tuple[float, ...] = ()
    dark_exposure_variance_dn2_std: tuple[float, ...] = ()
    #: The pair of stacks that the spatial figures come from, and how many images each has.
    stack_dark_exposure_s: float | None = None
    stack_dark_images: int | None = None
    stack_light: float | None = None
    stack_exposure_s: float | None = None
    stack_images: int | None = None


class PhotonTransfer(Tabular, Frozen):
    """The points of the photon-transfer and linearity plots, one per level: means over the channel."""

    channel: tuple[str, ...]
    exposure_s: tuple[float, ...]
    signal_dn: tuple[float, ...]  # mean less dark
    signal_dn_std: tuple[float, ...]
    variance_dn2: tuple[float, ...]  # temporal, less dark
    variance_dn2_std: tuple[float, ...]
    used: tuple[bool, ...]
    linearity_residual_percent: tuple[float | None, ...]


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
    lens_projection: ProjectionKind = "pinhole"
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
    corners (board, print, lens, motion), the error of the model; 0 where it isn't significant. Both and `lens_px` are
    in `covariance`."""

    noise_px: float
    model_error_px: float
    #: Along the rows and the columns of the board; None without a model error.
    length_squares: tuple[float, float] | None = None
    #: Of a pair: correlation of the model error in the left frame with that in the right.
    between_cameras: float | None = None
    #: Standard deviation, at the farthest corner, of the radial displacement by which the lens departs from its
    #: projection, in every view alike; 0 where it isn't significant.
    lens_px: float = 0.0
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
    """Camera matrix, px, and distortion of a projection (`sim.scene.projection`).

    `distortion` of a pinhole: OpenCV's `k1 k2 p1 p2 k3`; of an equidistant projection: `k1 k2 k3 k4` of OpenCV's
    fisheye; of a splined stereographic one: `s1 s2 p1 p2 s3 s4 s5 s6`, its spline up to `spline_angle_deg` off the
    axis.
    """

    lens_projection: ProjectionKind = "pinhole"
    spline_angle_deg: float | None = None
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
    row_rms_px: float | None


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
    lens_projection_left: ProjectionKind = "pinhole"
    spline_angle_deg_left: float | None = None
    camera_matrix_left: tuple[tuple[float, float, float], ...] | None = None
    distortion_left: tuple[float, ...] | None = None
    lens_projection_right: ProjectionKind = "pinhole"
    spline_angle_deg_right: float | None = None
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
    remarks: tuple[str, ...] = ()
    depth: tuple[DepthUncertainty, ...] = ()


class MakerDeparture(Frozen):
    """A band in which the fitted quantum efficiency differs from the data sheet's curve times `maker_scale`.

    `difference`: mean of fitted less stated over the band, electrons per photon. `significance_sigma`: corrected for
    the number of bands tested.
    """

    channel: str
    from_nm: float
    to_nm: float
    difference: float
    difference_std: float
    difference_percent: float | None  # of the mean of the scaled data-sheet curve over the band
    significance_sigma: float


class SpectralFit(Tabular, Frozen):
    """Absolute quantum efficiency per channel, electrons per photon; the lens's stated transmittance is divided out.
    Empty where no scale is known, as of a table of means: `relative_sensitivity` stands then."""

    wavelength_nm: tuple[float, ...]
    quantum_efficiency: dict[str, tuple[float, ...]]
    quantum_efficiency_std: dict[str, tuple[float, ...]]
    #: Scaled so that the highest value of all channels is 1; its uncertainty excludes that of the common scale.
    relative_sensitivity: dict[str, tuple[float, ...]] = {}
    relative_sensitivity_std: dict[str, tuple[float, ...]] = {}
    #: Integral of the quantum efficiency over `wavelength_nm`, by channel: the sensitivity to light that has as many
    #: photons at each. Errors of single lights average out in it.
    integrated_efficiency_nm: dict[str, float] = {}
    integrated_efficiency_nm_std: dict[str, float] = {}
    #: Bands (first, last) by channel without light: the curve and its uncertainty there are the prior's.
    not_determined_nm: dict[str, tuple[tuple[float, float], ...]] = {}
    #: Factor from the data sheet's curves to the fitted ones, and the bands in which they differ beyond it. None: the
    #: data sheet has no curves, or the fit uses them.
    maker_scale: float | None = None
    maker_departures: tuple[MakerDeparture, ...] = ()
    #: Times the standard uncertainty: an interval of about 95 %.
    coverage_factor: float = 2.0
    #: Assumptions of the fit, in sentences.
    remarks: tuple[str, ...] = ()


class MtfCurve(Tabular, Frozen):
    """Modulation transfer function of one edge in one channel (ISO 12233)."""

    capture: str
    channel: str
    angle_deg: float
    angle_deg_std: float | None = None
    field_mm: tuple[float, float] | None = None
    frequency_cy_per_px: tuple[float, ...]
    mtf: tuple[float, ...]
    mtf_std: tuple[float, ...]
    mtf50_cy_per_px: float | None = None
    mtf50_cy_per_px_std: float | None = None
    mtf10_cy_per_px: float | None = None
    mtf10_cy_per_px_std: float | None = None
    #: The edge's region in the frame (row0, col0, row1, col1, end excluded): the manifest's, or as it was found.
    region: tuple[int, int, int, int] | None = None


class PsfKernel(Frozen):
    """Point-spread function, normalised to a sum of 1; rows and columns are those of the frame."""

    capture: str
    channel: str
    field_mm: tuple[float, float] | None = None
    sample_pitch_px: float
    psf: tuple[tuple[float, ...], ...]
    psf_std: tuple[tuple[float, ...], ...]


class PsfSymmetry(Frozen):
    """Test of the rotational symmetry of the blur about the optical axis, on the second moments of kernels over the
    field.

    The symmetric model: radial variance a0 + a r^2, tangential variance a0 + b r^2, mixed moment 0, with r = 1 at the
    kernel that is farthest from the axis.
    """

    kernels: int
    chi2: float
    degrees_of_freedom: int
    probability: float  # of a chi2 at least as large, if the lens is symmetric
    symmetric: bool  # chi2 within its 99.9 % quantile
    variance_on_axis_px2: float
    radial_growth_px2: float
    tangential_growth_px2: float
    largest_mixed_sigma: float  # largest mixed moment over its standard uncertainty


DriftShape = Literal["trend", "decay", "warm_up", "step"]


class RepeatDrift(Frozen):
    """What the means of repeated frames show over time beyond white scatter; how it is found:
    `lab.observables.noise.repeats`.

    `kind`: of the captures; `captures`: all repeats of the setting in order, `changing`: those in which the curve
    changes. `amplitude_dn`: change of the curve from the first of these to the last. `time_constant_s`, or `_frames`
    where captures state no time: of a decay or warm-up; `steady_dn`: the value that it approaches. `p_value`:
    probability by chance, for the number of settings of this kind. `scatter_dn`: standard deviation about the curve;
    `noise_dn`: that by the noise of pixels. `level_dn_std`: standard uncertainty of the setting's mean by the drift.
    `elapsed_s`, `mean_dn`, `curve_dn`, `curve_dn_std`: of each of `captures`; of a trend that several settings have in
    common, departures from each setting's mean by number of the repeat.
    """

    shape: DriftShape
    kind: str
    setting: str
    captures: tuple[str, ...]
    changing: tuple[str, ...]
    amplitude_dn: float
    amplitude_dn_std: float
    time_constant_s: float | None = None
    time_constant_s_std: float | None = None
    time_constant_frames: float | None = None
    time_constant_frames_std: float | None = None
    steady_dn: float | None = None
    steady_dn_std: float | None = None
    p_value: float
    scatter_dn: float
    noise_dn: float
    level_dn_std: float
    elapsed_s: tuple[float, ...] | None = None
    mean_dn: tuple[float, ...]
    curve_dn: tuple[float, ...]
    curve_dn_std: tuple[float, ...]
    statement: str = ""

    @property
    def is_of_one_setting(self) -> bool:
        """Whether the numbers are of the repeats of one setting, not departures that several have in common."""
        return len(self.mean_dn) == len(self.captures)


class CameraFit(Frozen):
    """All that was fitted of one camera; None and empty: see `FitResult.skipped`."""

    noise: NoiseFit | None = None
    spectral: SpectralFit | None = None
    mtf: tuple[MtfCurve, ...] = ()
    psf: tuple[PsfKernel, ...] = ()
    #: Kernels of parts of the pattern, centre to edge, in the green (or only) channel, and the test of their symmetry.
    psf_field: tuple[PsfKernel, ...] = ()
    psf_symmetry: PsfSymmetry | None = None
    geometry: GeometryFit | None = None
    #: Repeats that change over time, of every capture kind.
    repeat_drifts: tuple[RepeatDrift, ...] = ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the recordings show beside the figures: repeats that drift first, then what the fits report."""
        parts = (part.remarks for part in (self.noise, self.spectral, self.geometry) if part is not None)
        return (
            *(drift.statement for drift in self.repeat_drifts),
            *(remark for remarks in parts for remark in remarks),
        )


class FitResult(Tabular, Frozen):
    """All fits of a recording set."""

    format: Literal["calibench-fit"] = "calibench-fit"
    version: Literal[1] = 1
    source: str
    cameras: dict[Side, CameraFit]
    stereo: StereoFit | None = None
    skipped: tuple[Skipped, ...] = ()
    #: Figures and stated lengths outside the range of working cameras, a line each: quantity, value, limit, remedy.
    warnings: tuple[str, ...] = ()
