"""What the commands write with `--json`: frozen, every number with its unit in its name, every fitted `x` with `x_std`.

`None` where the recordings don't determine a number; the reason then stands in `skipped`.
"""

from __future__ import annotations

from typing import Literal

from sim.camera import Side
from sim.parameters import Frozen


class Skipped(Frozen):
    """A step that wasn't done, and why, with the capture that would settle it."""

    step: str
    reason: str
    side: Side | None = None


class ChannelNoise(Frozen):
    """Photon transfer of one colour channel alone."""

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
    """Photon transfer, by the definitions of EMVA 1288 release 4.0; of the whole sensor (`channels` apart)."""

    #: Of a mono camera whose flats state `photons_per_pixel`: EMVA's total quantum efficiency.
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    quantum_efficiency_wavelength_nm: float | None = None
    #: Slope of the variance at zero signal, of the curve. `conversion_gain_dn_per_e` is this, or EMVA's line where the curve's
    #: bend isn't established against the scatter of the levels.
    conversion_gain_at_zero_dn_per_e: float | None = None
    conversion_gain_at_zero_dn_per_e_std: float | None = None
    #: Scatter of the temporal variances about their curve beyond sampling, percent of the variance; 0: none is seen.
    variance_model_error_percent: float | None = None
    #: At saturation, in percent: departure of the response from its slope at zero (from means); of the variance from its line at
    #: zero; the variance that is missing beyond what the response takes (brighter-fatter); the share of the shot noise's variance
    #: that a pixel has in common with its eight neighbours (where brighter-fatter puts what is missing).
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
    dark_current_temperature: DarkCurrentTemperature | None = None
    read_noise_distribution: ReadNoiseDistribution | None = None
    defects: PixelDefects | None = None
    channels: dict[str, ChannelNoise] = {}
    #: By plane of the mosaic (`R`, `G1`, `G2`, `B`, or `Y`), by the letter of the standard.
    emva1288: dict[str, Emva1288] = {}
    photon_transfer: PhotonTransfer | None = None
    #: What the recordings show of the rig, in sentences ("the lamp drifted by ...").
    remarks: tuple[str, ...] = ()


class DarkCurrentTemperature(Frozen):
    """Dark current at each temperature, and the laws through them: I = I_ref exp(-E / k (1/T - 1/T_ref)) (Arrhenius), and
    EMVA's I = I_ref 2^((T - T_ref) / T_d)."""

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
    """Temporal noise of single pixels in the dark, over `degrees_of_freedom` a pixel. `spread_percent`: standard deviation of
    the pixels' true variances over their mean, what the few repeats scatter taken out. `noisy_pixels`: beyond what chance gives
    any of them with 1 %."""

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
    row: int
    col: int
    dark_dn: float  # above its plane, in the longest dark
    dark_current_e_per_s: float | None = None  # above its plane


class PixelDefects(Frozen):
    """Pixels that stand out of their plane by more than 8 standard deviations: `hot` in the longest dark (above), `cold` (below).
    They are left out of everything but EMVA's own figures. `listed`: the strongest."""

    exposure_s: float
    hot: int
    cold: int
    listed: tuple[Defect, ...] = ()


class Emva1288(Frozen):
    """EMVA Standard 1288, release 4.0 (linear), of one plane: by its definitions, all pixels counted, no shading taken out."""

    #: Slope of the signal against photons, through the origin, to 70 % of saturation.
    responsivity_dn_per_photon: float | None = None
    responsivity_dn_per_photon_std: float | None = None
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    wavelength_nm: float | None = None
    #: Slope of the temporal variance against the signal, both less dark, through the origin, to 70 % of saturation.
    system_gain_dn_per_e: float
    system_gain_dn_per_e_std: float
    #: At zero exposure; `None` below 0.24 DN^2, where rounding hides it: then the limit 0.40 / K stands in `_limit_e`.
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
    dark_current_from_mean_e_per_s: float | None = None
    dark_current_from_mean_e_per_s_std: float | None = None
    dark_current_from_variance_e_per_s: float | None = None
    dark_current_from_variance_e_per_s_std: float | None = None
    points: Emva1288Points
    #: What isn't given, and why; where the recordings aren't what the standard asks for.
    remarks: tuple[str, ...] = ()


class Emva1288Points(Frozen):
    """One entry a level; dark values at the level's exposure. `light`: photons a pixel, or exposure (s) where the flats don't
    state photons (`light_unit`)."""

    light_unit: Literal["photons", "s"]
    light: tuple[float, ...]
    exposure_s: tuple[float, ...]
    mean_dn: tuple[float, ...]
    variance_dn2: tuple[float, ...]
    dark_mean_dn: tuple[float, ...]
    dark_variance_dn2: tuple[float, ...]
    linearity_deviation_percent: tuple[float | None, ...]
    dark_exposure_s: tuple[float, ...] = ()
    dark_exposure_mean_dn: tuple[float, ...] = ()
    dark_exposure_variance_dn2: tuple[float, ...] = ()
    #: The pair of stacks that the spatial figures come from, and how many images each has.
    stack_dark_exposure_s: float | None = None
    stack_dark_images: int | None = None
    stack_light: float | None = None
    stack_exposure_s: float | None = None
    stack_images: int | None = None


class PhotonTransfer(Frozen):
    """The points of the photon-transfer and linearity plots, one per level, means over the channel named."""

    channel: tuple[str, ...]
    exposure_s: tuple[float, ...]
    signal_dn: tuple[float, ...]  # mean less dark
    signal_dn_std: tuple[float, ...]
    variance_dn2: tuple[float, ...]  # temporal, less dark
    variance_dn2_std: tuple[float, ...]
    used: tuple[bool, ...]
    linearity_residual_percent: tuple[float | None, ...]


class MakerDeparture(Frozen):
    """A band in which a fitted sensitivity parts from the maker's curve times `maker_scale`: the mean difference over the band in
    electrons a photon, fitted less stated, and its significance, allowed for the number of bands that were tested."""

    channel: str
    from_nm: float
    to_nm: float
    difference: float
    difference_std: float
    difference_percent: float | None  # of the scaled maker's mean over the band
    significance_sigma: float


class SpectralFit(Frozen):
    """Absolute quantum efficiency per channel, electrons a photon, of the camera behind its lens: the lens's stated
    transmittance is divided out."""

    wavelength_nm: tuple[float, ...]
    quantum_efficiency: dict[str, tuple[float, ...]]
    quantum_efficiency_std: dict[str, tuple[float, ...]]
    #: The highest value of all channels set to 1: without the uncertainty of the scale, nor of what the channels share.
    relative_sensitivity: dict[str, tuple[float, ...]] = {}
    relative_sensitivity_std: dict[str, tuple[float, ...]] = {}
    #: Bands (first, last) by channel in which no light tells the curve: what stands there is the prior, with its band.
    not_determined_nm: dict[str, tuple[tuple[float, float], ...]] = {}
    #: One factor between the fitted curves and the maker's, and where they part beyond it. None: there are none to compare, or
    #: the fit leans on them.
    maker_scale: float | None = None
    maker_departures: tuple[MakerDeparture, ...] = ()
    #: Times the standard uncertainty: a band of about 95 %.
    coverage_factor: float = 2.0
    #: What the curve rests on where light is missing, and what was taken as known, in sentences.
    remarks: tuple[str, ...] = ()


class MtfCurve(Frozen):
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
    #: Where the edge lies in the frame (row0, col0, row1, col1, end excluded): the capture's own, or as it was found.
    region: tuple[int, int, int, int] | None = None


class PsfKernel(Frozen):
    """Normalised to a sum of 1; rows and columns are the camera's."""

    capture: str
    channel: str
    field_mm: tuple[float, float] | None = None
    sample_pitch_px: float
    psf: tuple[tuple[float, ...], ...]
    psf_std: tuple[tuple[float, ...], ...]


Rows = tuple[tuple[float, ...], ...]


class BoardWarp(Frozen):
    """How far a board is from flat: z = bend_x (x^2 - 1/3) + bend_y (y^2 - 1/3) + twist x y, x and y from -1 to 1 across the
    board, z away from the camera. None where the views don't determine it: it is in the other uncertainties nevertheless."""

    board: str
    bend_x_mm: float | None = None
    bend_x_mm_std: float | None = None
    bend_y_mm: float | None = None
    bend_y_mm_std: float | None = None
    twist_mm: float | None = None
    twist_mm_std: float | None = None


class DistortionModel(Frozen):
    """One of the models that were tried: how well it predicts views that its fit has not seen."""

    coefficients: tuple[str, ...]
    held_out_rms_px: float
    chosen: bool
    reason: str


class CrossValidation(Frozen):
    """Two halves of the views, each calibrated by itself: by how much they differ over the frame, the implied motion taken
    out, and by how much the noise of the corners lets them. What exceeds that is the model's error, not the sampling's."""

    difference_px: float
    expected_px: float
    significance_sigma: float
    #: Of one half, beyond the noise; 0 where the halves agree.
    model_error_px: float


class ViewResiduals(Frozen):
    """Corners of one view, numbered row by row, as they were seen; `dx_px`, `dy_px` are seen less predicted; and their depth."""

    capture: str
    corner: tuple[int, ...]
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    dx_px: tuple[float, ...]
    dy_px: tuple[float, ...]
    depth_mm: tuple[float, ...]


class ProjectionUncertainty(Frozen):
    """Standard uncertainty of where a point projects, px, in its worst direction, on a grid over the frame, rows by columns. A
    motion of the camera that the same corners can't tell from a change of its intrinsics is taken out."""

    distance_mm: float | None  # None: at infinity
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    projection_px_std: Rows


class ChannelGeometry(Frozen):
    """The geometry of one colour, and how far it lies outside of green (lateral colour) over the distance to the axis."""

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


class PsfSymmetry(Frozen):
    """Test of radial symmetry on kernels over the field: their second moments against a lens that looks the same all around
    its axis, a0 + a r^2 radially, a0 + b r^2 tangentially, nothing mixed; r = 1 at the kernel farthest from the axis."""

    kernels: int
    chi2: float
    degrees_of_freedom: int
    probability: float  # of so large a chi2 if the lens is symmetric
    symmetric: bool  # chi2 within its 99.9 % quantile
    variance_on_axis_px2: float
    radial_growth_px2: float
    tangential_growth_px2: float
    largest_mixed_sigma: float  # the mixed moment that is farthest from nil, in its standard uncertainties


class GeometryFit(Frozen):
    """OpenCV's pinhole and distortion (`k1 k2 p1 p2 k3`); px."""

    camera_matrix: tuple[tuple[float, float, float], ...]
    camera_matrix_std: tuple[tuple[float, float, float], ...] | None = None
    distortion: tuple[float, ...]
    distortion_std: tuple[float, ...] | None = None
    rms_px: float
    views: int | None = None
    rejected: tuple[Skipped, ...] = ()
    #: Single corners that were left out of views that were kept; `step` names the view.
    rejected_corners: tuple[Skipped, ...] = ()
    #: Of `covariance`: intrinsics that were fitted ("fx"), then the boards' warps.
    parameters: tuple[str, ...] = ()
    covariance: Rows | None = None
    #: Standard deviation of one coordinate of a corner: by the residuals, and by what the pictures' own noise explains.
    corner_px_std: float | None = None
    corner_noise_px: float | None = None
    board_warp: tuple[BoardWarp, ...] = ()
    distortion_models: tuple[DistortionModel, ...] = ()
    cross_validation: CrossValidation | None = None
    projection: tuple[ProjectionUncertainty, ...] = ()
    channels: tuple[ChannelGeometry, ...] = ()
    residuals: tuple[ViewResiduals, ...] = ()
    remarks: tuple[str, ...] = ()


class DepthUncertainty(Frozen):
    """Standard uncertainty of a triangulated depth over the left camera's frame, rows by columns; None where the right camera
    doesn't see the point. `calibration`: by the calibration alone, the same for every picture; `total`: with corners matched
    as well as the board's were."""

    depth_mm: float
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    calibration_mm_std: tuple[tuple[float | None, ...], ...]
    total_mm_std: tuple[tuple[float | None, ...], ...]


class Rectification(Frozen):
    """OpenCV's rectification of the pair: turns and new projections, from which `lab.fit.stereo.rectification_maps` makes maps.
    `row_rms_px`: by how much the rows of the same corner differ in the rectified pair."""

    rotation_left: tuple[tuple[float, float, float], ...]
    rotation_right: tuple[tuple[float, float, float], ...]
    projection_left: Rows
    projection_right: Rows
    disparity_to_depth: Rows
    row_rms_px: float


class StereoFit(Frozen):
    """x_right = rotation x_left + translation_mm."""

    rotation: tuple[tuple[float, float, float], ...]
    rotation_std_rad: tuple[float, float, float] | None = None
    translation_mm: tuple[float, float, float]
    translation_mm_std: tuple[float, float, float] | None = None
    baseline_mm: float
    baseline_mm_std: float | None = None
    rms_px: float
    pairs: int
    #: The intrinsics that belong to this rig: fitted jointly with it, over the views of both cameras.
    camera_matrix_left: tuple[tuple[float, float, float], ...] | None = None
    distortion_left: tuple[float, ...] | None = None
    camera_matrix_right: tuple[tuple[float, float, float], ...] | None = None
    distortion_right: tuple[float, ...] | None = None
    #: Of `covariance`: "left fx" .., "right fx" .., the turn about the right camera's axes, the translation, the boards' warps.
    parameters: tuple[str, ...] = ()
    covariance: Rows | None = None
    corner_px_std: float | None = None
    rejected: tuple[Skipped, ...] = ()
    rectification: Rectification | None = None
    depth: tuple[DepthUncertainty, ...] = ()


class CameraFit(Frozen):
    noise: NoiseFit | None = None
    spectral: SpectralFit | None = None
    mtf: tuple[MtfCurve, ...] = ()
    psf: tuple[PsfKernel, ...] = ()
    #: Of parts of the pattern, centre to edge, in the green (or only) channel; and whether they are symmetric about the axis.
    psf_field: tuple[PsfKernel, ...] = ()
    psf_symmetry: PsfSymmetry | None = None
    geometry: GeometryFit | None = None


class FitResult(Frozen):
    format: Literal["calibench-fit"] = "calibench-fit"
    version: Literal[1] = 1
    source: str
    cameras: dict[Side, CameraFit]
    stereo: StereoFit | None = None
    skipped: tuple[Skipped, ...] = ()


class Change(Frozen):
    """One fitted number of two calibrations, or the point of a curve (of `n` points) at which they differ most; `difference` is B less
    A. `significance_sigma`: of a normal distribution, two-sided, the other points of the curve allowed for."""

    name: str
    side: Side | None = None
    where: str = ""
    n: int = 1
    a: float
    a_std: float
    b: float
    b_std: float
    difference: float
    difference_std: float
    significance_sigma: float
    changed: bool


class ProjectionChange(Frozen):
    """How two calibrations of one camera project otherwise, px over the corners that both rest on: as the numbers stand, and after the
    motion that they imply is taken out. `vectors_px` [row][column] (x, y) on a grid over the frame, motion taken out."""

    side: Side
    as_stated_px: float
    implied_turn_mrad: tuple[float, float, float]
    implied_shift_mm: tuple[float, float, float]
    difference_px: float
    expected_px: float  # by the uncertainties alone
    significance_sigma: float
    changed: bool
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    vectors_px: tuple[tuple[tuple[float, float], ...], ...]


class ComparisonResult(Frozen):
    format: Literal["calibench-comparison"] = "calibench-comparison"
    version: Literal[1] = 1
    a: str
    b: str
    #: Chance that two calibrations of one unchanged camera show any change at all, and the limit that follows for one number.
    false_alarm_rate: float
    threshold_sigma: float
    changes: tuple[Change, ...]
    projection: tuple[ProjectionChange, ...] = ()
    skipped: tuple[Skipped, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether anything changed beyond its uncertainty."""
        return any(item.changed for item in self.changes) or any(item.changed for item in self.projection)


class Patch(Frozen):
    """One chart patch in one channel, predicted and measured; DN above black."""

    patch: str
    channel: str
    predicted_dn: float
    predicted_dn_std: float
    measured_dn: float
    measured_dn_std: float


class Curve(Frozen):
    """A predicted and a measured curve on one axis."""

    label: str
    channel: str
    axis: str  # name and unit: "spatial frequency, cy/px"
    x: tuple[float, ...]
    predicted: tuple[float, ...]
    measured: tuple[float, ...]
    measured_std: tuple[float, ...]


class KernelPair(Frozen):
    label: str
    channel: str
    predicted: tuple[tuple[float, ...], ...]
    measured: tuple[tuple[float, ...], ...]
    psnr_peak_db: float  # peak = maximum of the predicted kernel
    psnr_unit_db: float  # peak = 1


class Check(Frozen):
    """Predicted against measured for one measurement the fit didn't use. `passed`: chi2 within its 99.9 % quantile."""

    name: Literal["colorchecker", "mtf", "psf"]
    side: Side
    capture: str
    n: int
    chi2: float
    rms_relative_percent: float
    passed: bool
    patches: tuple[Patch, ...] = ()
    curves: tuple[Curve, ...] = ()
    kernels: tuple[KernelPair, ...] = ()


class ValidationResult(Frozen):
    format: Literal["calibench-validation"] = "calibench-validation"
    version: Literal[1] = 1
    source: str
    checks: tuple[Check, ...]
    skipped: tuple[Skipped, ...] = ()


class Mismatch(Frozen):
    side: Side
    measurement: str
    axis: str
    where: str
    significance_sigma: float
    captures: tuple[str, ...]


class ParameterValue(Frozen):
    value: float
    std: float | None
    unit: str


class Rival(Frozen):
    name: str
    probability: float


class NamedEffect(Frozen):
    name: str
    probability: float
    sides: tuple[Side, ...]
    parameters: dict[str, ParameterValue]
    rivals: tuple[Rival, ...] = ()
    statement: str
    #: Declared captures and conditions, for the report: what the same recordings could have told apart.
    reference: str | None = None


class Unexplained(Frozen):
    """A mismatch that no effect in the library accounts for: described, and modelled without a name."""

    side: Side
    measurement: str
    axis: str
    where: str
    shape: str
    significance_sigma: float
    chi2_before: float
    chi2_after: float
    n: int
    correction: str = ""  # what stands for it in the improved model, in words
    check: str = ""  # what is stated of the camera that the recordings speak against, as a sentence


class HeldOut(Frozen):
    """chi2 of captures that no part of a fit or choice has seen, by the baseline, and with the named effects and the processes of what
    has no name, which predict by their means alone."""

    captures: tuple[str, ...]
    chi2_before: float
    chi2_after: float
    n: int


class ResidualCurve(Frozen):
    """Whitened residuals of one measurement before and after the named effects, for the report's pictures."""

    side: Side
    measurement: str
    label: str
    channel: str
    axis: str
    x: tuple[float, ...]
    names: tuple[str, ...] = ()  # of the points, where x only numbers them
    measured: tuple[float, ...]
    measured_std: tuple[float, ...]
    before: tuple[float, ...]  # prediction of the baseline
    after: tuple[float, ...]  # prediction with the named effects, and the processes of what has no name
    held_out: bool


class NextCapture(Frozen):
    """A capture that could be taken, and how far it would bring the two nearest rivals apart: `distance` D = 1/2 of their predictions'
    squared distance in standard deviations of what scatters there, `told_apart` the probability Phi(sqrt(D / 2)) to decide rightly."""

    side: Side
    capture: str
    rivals: tuple[str, str]
    distance: float
    told_apart: float


class Place(Frozen):
    """A part of one measurement that was looked at: chi2 under the baseline and with the named effects, and how significant that is once
    the number of places is allowed for."""

    side: Side
    measurement: str
    axis: str
    where: str
    n: int
    chi2_before: float
    chi2_after: float
    sigma_before: float
    sigma_after: float


class MeasurementFit(Frozen):
    """chi2 of one measurement as a whole, before and after (the named effects, and the processes of what has no name): of what choice and fit saw, and of what was held out."""

    side: Side
    measurement: str
    n: int
    chi2_before: float
    chi2_after: float
    held_out_n: int
    held_out_before: float
    held_out_after: float


class Visibility(Frozen):
    """What could have been seen of one effect: the smallest size of each of its parameters that would have been, in 90 % of all cases (none
    where it isn't small anywhere); the effect most like it with the cosine of their signatures, and how often these would be told apart."""

    side: Side
    effect: str
    smallest: dict[str, float]
    nearest: str | None
    cosine: float
    told_apart: float


class ResidualPicture(Frozen):
    """A frame less its prediction by cells, in standard deviations of a cell, under the baseline and with what was found."""

    side: Side
    kind: str
    capture: str
    held_out: bool
    before: tuple[tuple[float, ...], ...]
    after: tuple[tuple[float, ...], ...]


class Resolution(Frozen):
    """One capture that `run --resolve` took: what it is, the session that holds its frames, and the diagnosis before it."""

    capture: str
    session: str
    verdict_before: Literal["no_mismatch", "explained", "partly_explained", "unexplained"]
    effects_before: tuple[NamedEffect, ...]


class PolicyRule(Frozen):
    """One number by which a diagnosis decided (`lab.diagnose.policy.DecisionPolicy` declares them)."""

    name: str
    group: str
    value: float
    unit: str
    meaning: str


class DiagnosisResult(Frozen):
    format: Literal["calibench-diagnosis"] = "calibench-diagnosis"
    version: Literal[1] = 1
    source: str
    verdict: Literal["no_mismatch", "explained", "partly_explained", "unexplained"]
    mismatches: tuple[Mismatch, ...] = ()
    effects: tuple[NamedEffect, ...] = ()
    unexplained: tuple[Unexplained, ...] = ()
    held_out: HeldOut | None = None
    next_capture: str | None = None
    next_captures: tuple[NextCapture, ...] = ()  # best first, side by side
    resolutions: tuple[Resolution, ...] = ()  # in the order in which they were taken
    places: tuple[Place, ...] = ()
    measurements: tuple[MeasurementFit, ...] = ()
    visibility: tuple[Visibility, ...] = ()
    pictures: tuple[ResidualPicture, ...] = ()
    threshold: float | None = None
    false_alarm_rate: float | None = None
    curves: tuple[ResidualCurve, ...] = ()
    skipped: tuple[Skipped, ...] = ()
    summary: tuple[str, ...] = ()  # the diagnosis in sentences
    policy: tuple[PolicyRule, ...] = ()  # the rules of decision
