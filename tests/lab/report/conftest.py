"""Results as two cameras would give them, made up, for the report's tests."""

from collections.abc import Callable

import numpy as np
import pytest

from lab.formats.results import (
    CameraFit,
    Check,
    CurveComparison,
    DiagnosisResult,
    FitResult,
    GeometryFit,
    HeldOut,
    KernelPair,
    Mismatch,
    MtfCurve,
    NamedEffect,
    NoiseFit,
    ParameterValue,
    PatchComparison,
    PhotonTransfer,
    ResidualCurve,
    Rival,
    Skipped,
    SpectralFit,
    StereoFit,
    ValidationResult,
)
from sim.camera import Side

Results = tuple[FitResult, ValidationResult, DiagnosisResult]
PATCHES = [
    "dark skin",
    "light skin",
    "blue sky",
    "foliage",
    "blue flower",
    "bluish green",
    "orange",
    "purplish blue",
    "moderate red",
    "purple",
    "yellow green",
    "orange yellow",
    "blue",
    "green",
    "red",
    "yellow",
    "magenta",
    "cyan",
    "white 9.5",
    "neutral 8",
    "neutral 6.5",
    "neutral 5",
    "neutral 3.5",
    "black 2",
]
EDGES = [f"edge-{k} {where}" for k in range(1, 5) for where in ("centre", "mid", "corner")]


def _noise(rng: np.random.Generator) -> NoiseFit:
    gain, read, channels = 0.42, 2.6, ("R", "G", "B")
    level = np.linspace(0.02, 1.0, 14)
    points = [(c, t, 3600 * t * share) for c, share in zip(channels, (0.62, 1.0, 0.71), strict=True) for t in level]
    signal = np.array([point[2] for point in points])
    variance = gain * signal * (1 + 0.004 * rng.normal(size=signal.size))
    return NoiseFit(
        conversion_gain_dn_per_e=gain,
        conversion_gain_dn_per_e_std=0.0009,
        read_noise_e=read,
        read_noise_e_std=0.031,
        black_level_dn=64.02,
        black_level_dn_std=0.004,
        dark_current_e_per_s=4.1,
        dark_current_e_per_s_std=0.12,
        dsnu_e=1.3,
        dsnu_e_std=0.05,
        prnu_percent=0.81,
        prnu_percent_std=0.003,
        full_well_e=9120.0,
        full_well_e_std=21.0,
        linearity_error_percent=0.11,
        linearity_error_percent_std=0.01,
        photon_transfer=PhotonTransfer(
            channel=tuple(point[0] for point in points),
            exposure_s=tuple(0.02 * point[1] for point in points),
            signal_dn=tuple(signal.tolist()),
            signal_dn_std=tuple((0.02 + 1e-4 * signal).tolist()),
            variance_dn2=tuple(variance.tolist()),
            variance_dn2_std=tuple((0.004 * variance + 0.1).tolist()),
            used=tuple(bool(value < 3400) for value in signal),
            linearity_residual_percent=tuple((0.1 * rng.normal(size=signal.size)).tolist()),
        ),
        remarks=("the lamp drifted by 0.08 % between repeats",),
    )


def _spectral(rng: np.random.Generator) -> SpectralFit:
    wavelength_nm = np.arange(400.0, 721.0, 10.0)
    peaks = {"R": (610, 45, 0.38), "G": (535, 42, 0.47), "B": (460, 35, 0.42)}
    cut = 1 / (1 + np.exp((wavelength_nm - 655) / 6))
    curves = {c: h * np.exp(-0.5 * ((wavelength_nm - m) / s) ** 2) * cut for c, (m, s, h) in peaks.items()}
    return SpectralFit(
        wavelength_nm=tuple(wavelength_nm.tolist()),
        quantum_efficiency={c: tuple((v + 0.002 * rng.normal(size=v.size)).tolist()) for c, v in curves.items()},
        quantum_efficiency_std={c: tuple((0.004 + 0.01 * v).tolist()) for c, v in curves.items()},
        coverage_factor=2.0,
    )


def _transfer(f: np.ndarray, blur: float, oblique: bool = False) -> np.ndarray:
    return np.exp(-2 * (blur * f) ** 2) * np.abs(np.cos(np.pi * f * (0.75 if oblique else 1.05) * (blur > 0.8)))


def _kernel(width: float, split: float) -> np.ndarray:
    y, x = np.mgrid[-7:8, -7:8]
    spots = sum(
        np.exp(-0.5 * ((x - dx) ** 2 + (y - dy) ** 2) / width**2) for dx in (-split, split) for dy in (-split, split)
    )
    return spots / spots.sum()


def _made_up(seed: int = 3, verdict: str = "explained", sides: tuple[Side, ...] = ("left", "right")) -> Results:
    rng = np.random.default_rng(seed)
    frequency = np.arange(0, 0.8, 0.02)
    cameras, checks, curves = {}, [], []
    for side in sides:
        concealed = verdict != "no_mismatch" and side == "left"
        mtf = []
        kernels = []
        for edge in EDGES:
            overlays = []
            for channel, blur in (("R", 0.85), ("G", 0.8), ("B", 0.75)):
                truth = _transfer(frequency, blur + 0.1 * concealed, "2" in edge)
                seen = truth + 0.006 * rng.normal(size=frequency.size)
                baseline = np.exp(-2 * (blur * frequency) ** 2) if concealed else truth
                std = np.full(frequency.size, 0.006)
                overlays.append(
                    CurveComparison(
                        label=edge,
                        channel=channel,
                        axis="spatial frequency, cy/px",
                        x=tuple(frequency),
                        predicted=tuple(baseline),
                        measured=tuple(seen),
                        measured_std=tuple(std),
                    )
                )
                mtf.append(
                    MtfCurve(
                        capture=edge,
                        channel=channel,
                        angle_deg=5.0,
                        frequency_cy_per_px=tuple(frequency),
                        mtf=tuple(seen),
                        mtf_std=tuple(std),
                        mtf50_cy_per_px=0.31 + 0.01 * rng.random(),
                        mtf50_cy_per_px_std=0.001,
                    )
                )
                if concealed:
                    curves.append(
                        ResidualCurve(
                            side=side,
                            measurement="slanted_edge",
                            label=edge,
                            channel=channel,
                            axis="spatial frequency, cy/px",
                            x=tuple(frequency),
                            measured=tuple(seen),
                            measured_std=tuple(std),
                            before=tuple(baseline),
                            after=tuple(truth),
                            held_out="corner" in edge,
                        )
                    )
            checks.append(
                Check(
                    name="mtf",
                    side=side,
                    capture=edge,
                    n=120,
                    chi2=2400.0 if concealed else 118.0,
                    rms_relative_percent=9.1 if concealed else 0.6,
                    passed=not concealed,
                    curves=tuple(overlays),
                )
            )
        for pose in ("p0", "p1"):
            for channel in "RGB":
                seen_kernel = _kernel(0.9, 1.0 if concealed else 0.05) + 2e-4 * rng.normal(size=(15, 15))
                kernels.append(
                    KernelPair(
                        label=f"Bernoulli, {pose}",
                        channel=channel,
                        predicted=tuple(map(tuple, _kernel(0.9, 0.05))),
                        measured=tuple(map(tuple, seen_kernel)),
                        psnr_peak_db=22.0 if concealed else 41.0,
                        psnr_unit_db=41.2,
                    )
                )
        checks.append(
            Check(
                name="psf", side=side, capture="noise-1", n=675, chi2=9000.0 if concealed else 680.0,
                rms_relative_percent=12.0, passed=not concealed, kernels=tuple(kernels),
            )
        )  # fmt: skip
        reflectance = np.clip(rng.random((24, 3)), 0.05, 0.9)
        reflectance[18:] = np.array([0.9, 0.59, 0.36, 0.19, 0.09, 0.031])[:, None]
        patches = [
            PatchComparison(
                patch=name,
                channel=channel,
                predicted_dn=2000 * reflectance[k, j],
                predicted_dn_std=20 * reflectance[k, j],
                measured_dn=2000
                * reflectance[k, j]
                * (0.93 if concealed and channel == "R" else 1 + 0.008 * rng.normal()),
                measured_dn_std=2.0,
            )
            for k, name in enumerate(PATCHES)
            for j, channel in enumerate("RGB")
        ]
        checks.append(
            Check(
                name="colorchecker",
                side=side,
                capture="chart-1",
                n=72,
                chi2=70.1,
                rms_relative_percent=1.2,
                passed=True,
                patches=tuple(patches),
            )
        )
        cameras[side] = CameraFit(
            noise=_noise(rng),
            spectral=_spectral(rng),
            mtf=tuple(mtf),
            geometry=GeometryFit(
                camera_matrix=((2003.1, 0, 320.4), (0, 2003.4, 239.1), (0, 0, 1)),
                camera_matrix_std=((0.4, 0, 0.5), (0, 0.4, 0.5), (0, 0, 0)),
                distortion=(-0.11, 0.08, 1e-4, -2e-4, 0.0),
                distortion_std=(0.001, 0.004, 1e-5, 1e-5, 0.01),
                rms_px=0.094,
                views=12,
            ),
        )
    skipped = (Skipped(step="psf", reason="no bernoulli captures of pose p2; capture one", side="left"),)
    fit = FitResult(
        source="made up",
        cameras=cameras,
        stereo=StereoFit(
            rotation=((1, 0, 0.01), (0, 1, 0), (-0.01, 0, 1)),
            rotation_std_rad=(1e-5, 1e-5, 1e-5),
            translation_mm=(-60.02, 0.11, 0.2),
            translation_mm_std=(0.02, 0.02, 0.05),
            baseline_mm=60.02,
            baseline_mm_std=0.021,
            rms_px=0.11,
            pairs=12,
        )
        if len(sides) == 2
        else None,
        skipped=skipped,
    )
    validation = ValidationResult(source="made up", checks=tuple(checks))
    if verdict == "no_mismatch":
        return (
            fit,
            validation,
            DiagnosisResult(source="made up", verdict="no_mismatch", threshold=4.4, false_alarm_rate=0.01),
        )
    diagnosis = DiagnosisResult(
        source="made up",
        verdict="explained",
        threshold=4.4,
        false_alarm_rate=0.01,
        mismatches=(
            Mismatch(side="left", measurement="slanted_edge", axis="spatial_frequency", where="0.18..0.41 cy/px, all "
                "channels", significance_sigma=54.2, captures=("edge-1", "edge-2")),
            Mismatch(side="left", measurement="narrowband", axis="wavelength", where="640..700 nm, R",
            significance_sigma=31.0, captures=("nb-640",)),
            Mismatch(side="left", measurement="chart", axis="patch", where="red, orange", significance_sigma=6.8,
            captures=("chart-1",)),
        ),
        effects=(
            NamedEffect(
                name="optical_low_pass_filter", family="isotropic_contrast_loss", law="exact", probability=0.994,
                sides=("left",), rivals=(Rival(name="defocus", probability=0.006),),
                parameters={"displacement_x_um": ParameterValue(value=2.104, std=0.051, unit="um"),
                "displacement_y_um": ParameterValue(value=2.08, std=0.05, unit="um")},
                statement="A birefringent plate before the sensor splits each ray in two; contrast falls as the "
                    "cosine of the displacement.",
                reference="Greivenkamp, Appl. Opt. 29, 676 (1990)",
            ),
            NamedEffect(
                name="infrared_cut_filter", family="spectral_filter", law="exact", probability=0.999, sides=("left",),
                parameters={"cut_nm": ParameterValue(value=655.2, std=0.8, unit="nm")},
                statement="A filter cuts off the long waves.",
            ),
        ),
        held_out=HeldOut(captures=("edge-3", "edge-4"), chi2_before=9120.0, chi2_after=480.0, n=468),
        curves=tuple(curves),
        next_capture="Nothing is left to tell apart.",
    )  # fmt: skip
    return fit, validation, diagnosis


@pytest.fixture
def made_up() -> Callable[..., Results]:
    """`made_up(seed=3, verdict="explained", sides=("left", "right"))`: fit, validation, diagnosis."""
    return _made_up
