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


class NoiseFit(Frozen):
    """Photon transfer, by the definitions of EMVA 1288 release 4.0; of the whole sensor (`channels` apart)."""

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
    #: Of a mono camera whose flats state `photons_per_pixel`: EMVA's total quantum efficiency.
    quantum_efficiency: float | None = None
    quantum_efficiency_std: float | None = None
    quantum_efficiency_wavelength_nm: float | None = None
    photon_transfer: PhotonTransfer | None = None
    #: What the recordings show of the rig, in sentences ("the lamp drifted by ...").
    remarks: tuple[str, ...] = ()


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


class SpectralFit(Frozen):
    """Absolute quantum efficiency per channel, electrons a photon, of the camera behind its lens: the lens's stated
    transmittance is divided out."""

    wavelength_nm: tuple[float, ...]
    quantum_efficiency: dict[str, tuple[float, ...]]
    quantum_efficiency_std: dict[str, tuple[float, ...]]
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


class PsfKernel(Frozen):
    """Normalised to a sum of 1; rows and columns are the camera's."""

    capture: str
    channel: str
    field_mm: tuple[float, float] | None = None
    sample_pitch_px: float
    psf: tuple[tuple[float, ...], ...]
    psf_std: tuple[tuple[float, ...], ...]


class GeometryFit(Frozen):
    """OpenCV's pinhole and distortion (`k1 k2 p1 p2 k3`); px."""

    camera_matrix: tuple[tuple[float, float, float], ...]
    camera_matrix_std: tuple[tuple[float, float, float], ...] | None = None
    distortion: tuple[float, ...]
    distortion_std: tuple[float, ...] | None = None
    rms_px: float
    views: int | None = None
    rejected: tuple[Skipped, ...] = ()


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


class CameraFit(Frozen):
    noise: NoiseFit | None = None
    spectral: SpectralFit | None = None
    mtf: tuple[MtfCurve, ...] = ()
    psf: tuple[PsfKernel, ...] = ()
    geometry: GeometryFit | None = None


class FitResult(Frozen):
    format: Literal["calibench-fit"] = "calibench-fit"
    version: Literal[1] = 1
    source: str
    cameras: dict[Side, CameraFit]
    stereo: StereoFit | None = None
    skipped: tuple[Skipped, ...] = ()


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


class HeldOut(Frozen):
    """Captures that no part of the effects' fit or choice has seen."""

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
    measured: tuple[float, ...]
    measured_std: tuple[float, ...]
    before: tuple[float, ...]  # prediction of the baseline
    after: tuple[float, ...]  # prediction with the named effects
    held_out: bool


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
    threshold: float | None = None
    false_alarm_rate: float | None = None
    curves: tuple[ResidualCurve, ...] = ()
    skipped: tuple[Skipped, ...] = ()
    summary: tuple[str, ...] = ()  # the diagnosis in sentences
