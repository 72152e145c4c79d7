"""What the baseline and the improved model predict of the same recordings: checks, and sensitivities as a sweep shows
them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Check, DiagnosisResult, FitResult
from lab.predict.validate import validate
from sim.camera import Side
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

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
    is_other = discrepant or any(improved[side].effects != one.effects for side, one in baseline.items())

    def checks(models: Mapping[Side, CameraFile], name: str, begun: float) -> tuple[Check, ...]:
        def tell(what: str, share: float) -> None:
            if progress is not None:
                progress(f"{name}: {what}", begun + 0.5 * share)

        found = validate(recordings, fit, models, tell).checks
        return tuple(check for check in found if check.side in models)

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
    own = float(file.camera.quantum_efficiency[channel].at(wavelength_nm))
    if not file.effects:
        return own
    plain = electron_rate(file.camera, channel, line)
    return own * electron_rate(file.camera, channel, line, file.effects, "narrowband") / plain if plain > 0.0 else own
