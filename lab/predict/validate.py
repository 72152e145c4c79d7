"""Validation: chart patches, MTFs of edges and point spread functions, predicted by the fitted camera and measured.

The model is the fitted camera, or a camera file with its effects. Nothing is fitted here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.fit.psf.screen_kernel import expected_kernel
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    CameraFit,
    Check,
    CurveComparison,
    DiagnosisResult,
    FitResult,
    KernelPair,
    PatchComparison,
    Skipped,
    ValidationResult,
)
from lab.observables.charts.patches import Patch as PatchLevel
from lab.observables.charts.patches import patch_covariance, patch_levels
from lab.observables.dataset import Dataset
from lab.observables.edges.measured import measure_edge
from lab.observables.edges.mtf import EdgeMtf, read_mtf
from lab.observables.gaussian import chi2
from lab.one_blas_thread import one_blas_thread
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.optics.illumination import relative_illumination
from sim.point import edge_profile, optical_transfer
from sim.scene.colorchecker import reflectances
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform, electron_rate

PASSED_QUANTILE = 0.999
# Standard deviations that the fits' uncertainties don't include.
LIGHT_STD = 0.01  # relative, of the light on the chart: radiometer and geometry
MTF_FREQUENCIES = np.arange(1, 26) * 0.02
MTF_FLOOR = 0.002  # of an MTF
CELL_PX = 4.0  # side of a screen's cell where the recordings don't state it
KERNEL_FLOOR = 0.002  # of a kernel's element, over the kernel's maximum
_Checking = Callable[
    [RecordingSet, Side, CameraFit, CameraModel, Sequence[Effect], Callable[[str], None]],
    list[Check],
]


@one_blas_thread
def validate(
    recordings: RecordingSet,
    fit: FitResult,
    models: Mapping[Side, CameraFile] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> ValidationResult:
    """Checks of every side: `colorchecker`, `mtf`, `psf`. `models`: camera files in place of the fitted cameras.

    A check passes where chi2 is below its 99.9 % quantile. Checks that the recordings don't determine are listed in
    `skipped`. `progress` is called before each edge and kernel with the step and the share (0..1) that is done; an
    exception that it raises ends the work."""
    kinds: tuple[tuple[str, _Checking], ...] = (("colorchecker", _charts), ("mtf", _edges), ("psf", _kernels))
    begun = 0
    checks: list[Check] = []
    skipped: list[Skipped] = []
    for side in recordings.sides:
        camera_fit = fit.cameras.get(side, CameraFit())
        improved = (models or {}).get(side)
        model = improved.camera if improved else camera_model(recordings, side, camera_fit)
        with_effects = improved.effects if improved else ()
        for name, check in kinds:
            share = begun / (len(kinds) * len(recordings.sides))
            begun += 1

            def tell(capture: str, name: str = name, side: Side = side, share: float = share) -> None:
                if progress is not None:
                    progress(f"{name}, {side}: {capture}" if capture else f"{name}, {side}", share)

            tell("")
            try:
                checks += check(recordings, side, camera_fit, model, with_effects, tell)
            except NotDetermined as refused:
                skipped.append(Skipped(step=f"validate {name}", reason=refused.reason, side=side))
    return ValidationResult(source=recordings.source, checks=tuple(checks), skipped=tuple(skipped))


def _check(
    name: str, side: Side, capture: str, residual: FloatArray, covariance: FloatArray, reference: FloatArray
) -> Check:
    value = chi2(residual, covariance)
    relative = residual / np.maximum(np.abs(reference), 1e-12)
    return Check.model_validate(
        {
            "name": name,
            "side": side,
            "capture": capture,
            "n": len(residual),
            "chi2": value,
            "rms_relative_percent": 100.0 * float(np.sqrt(np.mean(relative**2))),
            "passed": bool(value <= special.chdtri(len(residual), 1.0 - PASSED_QUANTILE)),
        }
    )


def _charts(
    recordings: RecordingSet,
    side: Side,
    fit: CameraFit,
    model: CameraModel,
    effects: Sequence[Effect],
    tell: Callable[[str], None],
) -> list[Check]:
    if fit.spectral is None:
        raise NotDetermined("colorchecker", "the sensitivities weren't fitted: capture narrowband light")
    if fit.noise is None or fit.noise.conversion_gain_dn_per_e is None:
        raise NotDetermined("colorchecker", "the conversion gain wasn't fitted: capture flats in repeats")
    dataset = Dataset(recordings, side, model, fitted=fit.noise)
    points = patch_levels(dataset)
    if not points:
        raise NotDetermined("colorchecker", "no unclipped patches of a ColorChecker24")
    by_capture: dict[tuple[str, ...], list[PatchLevel]] = {}
    for point in points:
        by_capture.setdefault(tuple(c.id for c in point.captures), []).append(point)
    checks = []
    for captures, members in by_capture.items():
        tell(captures[0])
        checks.append(_chart(dataset, side, model, effects, captures, members))
    return checks


def _chart(
    dataset: Dataset,
    side: Side,
    model: CameraModel,
    effects: Sequence[Effect],
    captures: tuple[str, ...],
    points: list[PatchLevel],
) -> Check:
    known = reflectances(points[0].captures[0].chart)
    exposure = points[0].captures[0].exposure_s
    light = dataset.spectrum(points[0].captures[0].radiance)
    gain, black = model.conversion_gain_dn_per_e, model.black_level_dn
    dark = model.dark_current_e_per_s * exposure
    predicted, spread = np.empty(len(points)), np.empty(len(points))
    for i, p in enumerate(points):
        fall_off = float(relative_illumination(model, p.row, p.col))
        rate = electron_rate(model, p.channel, light, effects, "chart", reflectance=known[p.name])
        electrons = np.asarray(rate * exposure * fall_off + p.tail / gain + dark)
        predicted[i] = float(Uniform(model, effects).response(electrons)) * gain
        spread[i] = _curve_std(model, p.channel, light.arrays[0]) * rate * exposure * fall_off * gain
    measured = np.array([p.level for p in points]) - black
    covariance = patch_covariance(dataset, points, np.maximum(measured - dark * gain, 0.1))
    channel = np.array([p.channel for p in points])
    # the error of a fitted curve is common to all patches of a channel, that of the light to all patches
    covariance += (channel[:, None] == channel) * np.outer(spread, spread) + LIGHT_STD**2 * np.outer(
        predicted, predicted
    )
    std = np.sqrt(np.diag(covariance))
    noise = np.sqrt(
        np.array(
            [
                (gain * max(m, 0.0) + dataset.noise.read_dn**2) / p.pixels / len(p.captures)
                for m, p in zip(measured, points, strict=True)
            ]
        )
    )
    check = _check("colorchecker", side, captures[0], measured - predicted, covariance, measured)
    patches = tuple(
        PatchComparison(
            patch=p.name, channel=p.channel, predicted_dn=float(predicted[i]), predicted_dn_std=float(std[i]),
            measured_dn=float(measured[i]), measured_dn_std=float(noise[i]),
        )
        for i, p in enumerate(points)
    )  # fmt: skip
    return check.model_copy(update={"patches": patches})


def _curve_std(model: CameraModel, channel: str, wavelength_nm: FloatArray) -> float:
    """Relative standard deviation of a channel's response to broadband light, with errors of the curve correlated over
    30 nm."""
    std, curve = model.quantum_efficiency_std.get(channel), model.quantum_efficiency[channel]
    if std is None:
        return 0.01
    grid = np.arange(380.0, 781.0, 30.0)
    total = float(np.sum(curve.at(grid)))
    return float(np.sqrt(np.sum(np.square(std.at(grid)))) / total) if total > 0 else 1.0


def _edges(
    recordings: RecordingSet,
    side: Side,
    fit: CameraFit,
    model: CameraModel,
    effects: Sequence[Effect],
    tell: Callable[[str], None],
) -> list[Check]:
    stated = recordings.camera(side)
    if stated.f_number is None or stated.pixel_pitch_um is None:
        raise NotDetermined("mtf", "f-number or pixel pitch isn't stated: no diffraction to predict the edges from")
    captures = recordings.captures(SlantedEdgeCapture, side)
    if not captures:
        raise NotDetermined("mtf", "no slanted-edge captures")
    settings: dict[object, list[SlantedEdgeCapture]] = {}
    for edge in captures:
        key = (edge.region, edge.angle_deg, edge.exposure_s, edge.gain_db, edge.light_radiance)
        settings.setdefault(key, []).append(edge)
    checks, reason = [], ""
    for repeats in settings.values():
        capture = repeats[0]
        tell(capture.id)
        curves, residuals, blocks, reference = [], [], [], []
        for channel in model.channels:
            try:
                measured = read_mtf(measure_edge(recordings, repeats, channel, fit.noise), MTF_FREQUENCIES)
            except NotDetermined as refused:
                reason = refused.reason
                continue
            predicted = _predict_mtf(recordings, capture, channel, measured, model, effects)
            residuals.append(measured.mtf - predicted)
            blocks.append(measured.covariance + np.diag(np.full(len(predicted), MTF_FLOOR**2)))
            reference.append(np.maximum(predicted, 0.1))
            curves.append(
                CurveComparison(
                    label=f"{capture.id}, {measured.angle_deg:.1f} deg", channel=channel,
                    axis="spatial frequency, cy/px",
                    x=tuple(MTF_FREQUENCIES.tolist()), predicted=tuple(predicted.tolist()),
                    measured=tuple(measured.mtf.tolist()),
                    measured_std=tuple(measured.mtf_std.tolist()),
                )
            )  # fmt: skip
        if curves:
            check = _check(
                "mtf", side, capture.id, np.concatenate(residuals), _diagonal(blocks), np.concatenate(reference)
            )
            checks.append(check.model_copy(update={"curves": tuple(curves)}))
    if not checks:
        raise NotDetermined("mtf", reason)
    return checks


def _predict_mtf(
    recordings: RecordingSet,
    capture: SlantedEdgeCapture,
    channel: str,
    measured: EdgeMtf,
    model: CameraModel,
    effects: Sequence[Effect],
) -> FloatArray:
    light = recordings.spectrum(capture.light_radiance) if capture.light_radiance else None
    return np.asarray(
        measured.predict(lambda distance: edge_profile(model, channel, light, measured.angle_deg, distance, effects))
    )


def _diagonal(blocks: Sequence[NDArray[Any]]) -> FloatArray:
    size = sum(len(b) for b in blocks)
    out = np.zeros((size, size))
    at = 0
    for block in blocks:
        out[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return out


def _kernels(
    recordings: RecordingSet,
    side: Side,
    fit: CameraFit,
    model: CameraModel,
    effects: Sequence[Effect],
    tell: Callable[[str], None],
) -> list[Check]:
    if not fit.psf:
        raise NotDetermined("psf", "no kernel was fitted")
    screens = {c.id: c.screen for c in recordings.captures(BernoulliCapture, side)}
    by_capture: dict[str, list[KernelPair]] = {}
    numbers: dict[str, list[tuple[FloatArray, FloatArray, FloatArray]]] = {}
    for psf in fit.psf:
        if psf.sample_pitch_px != 1.0:
            continue
        tell(psf.capture)
        screen = screens.get(psf.capture)
        light = recordings.spectrum(screen.radiance) if screen and screen.radiance else None
        cell_px = screen.cell_camera_px if screen else None
        measured, std = np.array(psf.psf), np.array(psf.psf_std)
        predicted: FloatArray = np.asarray(
            expected_kernel(
                lambda fx, fy, channel=psf.channel, light=light: optical_transfer(  # type: ignore[misc]
                    model, channel, light, fx, fy, effects, "bernoulli"
                ),
                len(measured),
                cell_px or CELL_PX,
            ),
            np.float64,
        )
        error = float(np.mean(np.square(measured - predicted)))
        peak = float(predicted.max())
        by_capture.setdefault(psf.capture, []).append(
            KernelPair(
                label=psf.capture, channel=psf.channel, predicted=_rows(predicted), measured=_rows(measured),
                psnr_peak_db=_psnr(peak, error), psnr_unit_db=_psnr(1.0, error),
            )
        )  # fmt: skip
        numbers.setdefault(psf.capture, []).append(
            (
                (measured - predicted).ravel(),
                std.ravel() ** 2 + (KERNEL_FLOOR * peak) ** 2,
                np.full(measured.size, peak),
            )
        )
    if not by_capture:
        raise NotDetermined("psf", "the kernels found aren't sampled at the sensor's pixels")
    checks = []
    for capture, pairs in by_capture.items():
        residual, variance, peaks = (np.concatenate(part) for part in zip(*numbers[capture], strict=True))
        check = _check("psf", side, capture, residual, np.diag(variance), peaks)
        checks.append(check.model_copy(update={"kernels": tuple(pairs)}))
    return checks


def _psnr(peak: float, mean_square_error: float) -> float:
    return float(10.0 * np.log10(peak**2 / max(mean_square_error, 1e-30)))


def _rows(table: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in table)


# ----------------------------------------------------------------------------------------------------------------------
# What the baseline and the improved model predict of the same recordings: checks, and sensitivities as a sweep shows
# them.


#: Of the curves of sensitivity (nm): the step, and half the base of the triangular line of light that shows them.
STEP_NM, LINE_NM = 5.0, 2.0


@dataclass(frozen=True)
class SensitivityCurve:
    """Quantum efficiency of one channel by both models, e/photon, at `wavelength_nm`."""

    wavelength_nm: tuple[float, ...]
    baseline: tuple[float, ...]
    improved: tuple[float, ...]


@dataclass(frozen=True)
class BothModels:
    """Predictions by the baseline and by the improved model, for the sides that were judged.

    baseline, improved : the checks of `lab.predict.validate`, the same in number and order; `improved` is empty where
    no effect was named sensitivity : curves by side and channel, over the wavelengths of the fitted ones
    """

    baseline: tuple[Check, ...]
    improved: tuple[Check, ...]
    sensitivity: Mapping[Side, Mapping[str, SensitivityCurve]]


def baseline_of(improved: CameraFile, always: CameraFile | None, maker: Mapping[str, Spectrum] | None) -> CameraFile:
    """Return the baseline that an improved camera was made from.

    always : the camera file that the diagnosis began with; None: the fitted camera, without effects
    maker : the maker's curves, where a discrepancy was put into the improved camera's; None: the improved camera's hold
    no effect"""
    camera = improved.camera if maker is None else improved.camera.model_copy(update={"quantum_efficiency": maker})
    return CameraFile("baseline", camera, always.effects if always is not None else ())


def predict_both(
    recordings: RecordingSet,
    fit: FitResult,
    improved: Mapping[Side, CameraFile],
    diagnosis: DiagnosisResult | None,
    always: Mapping[Side, CameraFile] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> BothModels | None:
    """Predict what can be checked by both models; None where no side was judged.

    improved : the cameras with the named effects, by side
    diagnosis : the result that names the effects
    always : camera files that the diagnosis began with, by side
    progress : called with the step and the share (0..1) that is done; an exception that it raises ends the work
    """
    if not improved or diagnosis is None:
        return None
    discrepant = {item.side for item in diagnosis.unexplained if item.corrects_curves}
    baseline: dict[Side, CameraFile] = {}
    for side, camera in improved.items():
        maker = camera_model(recordings, side, fit.cameras.get(side), maker_curves=True).quantum_efficiency
        baseline[side] = baseline_of(camera, (always or {}).get(side), maker if side in discrepant else None)
    is_other = discrepant or any(improved[side].effects != camera.effects for side, camera in baseline.items())

    def checks(models: Mapping[Side, CameraFile], name: str, begun: float) -> tuple[Check, ...]:
        def tell(what: str, share: float) -> None:
            if progress is not None:
                progress(f"{name}: {what}", begun + 0.5 * share)

        checks = validate(recordings, fit, models, tell).checks
        return tuple(check for check in checks if check.side in models)

    return BothModels(
        baseline=checks(baseline, "baseline", 0.0),
        improved=checks(improved, "improved model", 0.5) if is_other else (),
        sensitivity={side: _sensitivities(fit, side, baseline[side], improved[side]) for side in improved},
    )


def _sensitivities(
    fit: FitResult, side: Side, baseline: CameraFile, improved: CameraFile
) -> dict[str, SensitivityCurve]:
    """Curves of sensitivity over the wavelengths of the fitted ones, by channel; empty where none were fitted."""
    fitted = fit.cameras[side].spectral if side in fit.cameras else None
    if fitted is None or not fitted.quantum_efficiency:
        return {}
    at = np.arange(min(fitted.wavelength_nm), max(fitted.wavelength_nm) + 0.5 * STEP_NM, STEP_NM)
    return {
        channel: SensitivityCurve(
            tuple(at.tolist()),
            *(tuple(_apparent(camera, channel, float(w)) for w in at) for camera in (baseline, improved)),
        )
        for channel in fitted.quantum_efficiency
        if channel in baseline.camera.quantum_efficiency
    }


def _apparent(file: CameraFile, channel: str, wavelength_nm: float) -> float:
    """Return the quantum efficiency that a narrow line of light shows: the curve's, times what the effects make of the
    electrons."""
    line = Spectrum.of(
        np.array([wavelength_nm - LINE_NM, wavelength_nm, wavelength_nm + LINE_NM]), np.array([0.0, 1.0, 0.0])
    )
    efficiency = float(file.camera.quantum_efficiency[channel].at(wavelength_nm))
    if not file.effects:
        return efficiency
    plain = electron_rate(file.camera, channel, line)
    return (
        efficiency * electron_rate(file.camera, channel, line, file.effects, "narrowband") / plain
        if plain > 0.0
        else efficiency
    )
