"""The improved model: the camera with what the diagnosis found, as a camera file that simulates and predicts like any
other."""

from __future__ import annotations

from collections.abc import Sequence

from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.inference.discrepancy import Discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.outcome.corrections import (
    Applied,
    Correction,
    correction_on,
    factor_along,
    multiplied_curve,
    nearest_form,
    place_for,
    scaled_curve,
)
from lab.diagnose.outcome.model_posterior import model_posterior
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model, remarks_on_values
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult
from lab.formats.results.diagnosis import IN_CURVES
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.spectra.curves import freed_curve
from sim.camera import Side
from sim.effects.base import Effect
from sim.spectrum import FloatArray


def improved_model(
    recordings: RecordingSet,
    side: Side,
    fit: FitResult | None,
    baseline: CameraFile | None,
    model: MeasurementModel,
    effects: Sequence[Effect],
    discrepancies: Sequence[Discrepancy],
) -> tuple[CameraFile, tuple[Correction, ...]]:
    """Return the baseline with the named effects, with the maker's sensitivity curves at the posterior mean of their
    nuisance parameters, and with a correction for each discrepancy that a stage of the model can hold. Noise and levels
    are the fit's where there is one.

    Returns the camera and one `Correction` for each discrepancy.
    """
    always = baseline.effects if baseline is not None else ()
    taken = baseline.camera if baseline is not None else None
    camera = taken or camera_model(recordings, side, fit.cameras.get(side) if fit else None, maker_curves=True)
    if fit is None and baseline is None:
        camera = model.camera
    applied, kernels = _applied(model, discrepancies)
    estimates = model.nuisance_estimates(effects, kernels)
    discrepancy = model.discrepancy_mean(effects, kernels)
    # electrons times gain are measured: where the fit has another gain, the curves take up the difference
    share = model.camera.conversion_gain_dn_per_e / camera.conversion_gain_dn_per_e
    curves = {
        channel: scaled_curve(freed, share if freed is not curve else 1.0)
        for channel, curve in camera.quantum_efficiency.items()
        for freed in (freed_curve(curve, channel, estimates),)
    }
    corrections: list[Correction] = []
    acting: list[Effect] = [*always, *(nearest_form(e, estimates) for e in effects)]
    for one, (kind, why) in zip(discrepancies, applied, strict=True):
        block = model.blocks[one.index]
        name = block.measurement.title
        if kind is None:
            said = f"{name}: no correction in the improved model; {why}"
            corrections.append(Correction(block.measurement.name, None, said))
            continue
        at = model.slices[one.index]
        fitted = model.fitted_mean(effects, kernels)[at]
        if kind == "noise":  # the camera keeps its gain: the correction holds what the fit moved that by, too
            stated = model.mean(effects)[at]
            x, factor, each = factor_along(block, fitted - stated, stated)
        else:
            x, factor, each = factor_along(block, discrepancy[at], model.fitted_mean(effects)[at])
        if kind == "sensitivity":
            for channel, (wavelength_nm, by) in each.items():
                if channel in curves:
                    curves[channel] = multiplied_curve(curves[channel], wavelength_nm, by)
            said = f"{name}: {IN_CURVES}, by wavelength and channel"
        else:
            acting.append(correction_on(kind, block, x, factor, camera))
            is_shared = one.grouping == "shared"
            said = f"{name}: a factor on the {kind}" + ("" if is_shared else f"; the mean of what goes {one.grouping}")
        corrections.append(Correction(block.measurement.name, kind, said))
    improved = camera.model_copy(update={"quantum_efficiency": curves})
    unknown = "" if model.gain_is_known else ", conversion gain unknown: electrons of 1 DN/e are DN"
    name = f"{recordings.manifest.name} {side}{unknown}".strip()
    gain_db = most_frequent_gain_db(recordings.captures(FlatCapture, side))
    is_corrected = any(one.kind == "noise" for one in corrections)
    posterior = model_posterior(model, effects, improved, kernels, gain_db, is_corrected)
    of_side = fit.cameras.get(side) if fit else None
    remarks = () if taken else remarks_on_values(recordings.camera(side), of_side, camera)
    return CameraFile(name, improved, tuple(acting), posterior=posterior, remarks=remarks), tuple(corrections)


def _applied(
    model: MeasurementModel, discrepancies: Sequence[Discrepancy]
) -> tuple[list[tuple[Applied | None, str]], dict[int, FloatArray]]:
    """Return the stage that each discrepancy is applied to, or None and why; and the kernels of those that are, by
    block."""
    kernels: dict[int, FloatArray] = {}
    found: list[tuple[Applied | None, str]] = []
    for one in discrepancies:
        kind = place_for(model.blocks[one.index])
        if one.log_odds <= 0:
            found.append((None, "no smooth discrepancy describes it"))
        elif kind is None:
            found.append((None, "the model has no place for one there"))
        elif any(kind == other for other, _ in found):
            found.append((None, "another correction acts there already"))
        else:
            found.append((kind, ""))
            kernels[one.index] = one.kernel
    return found, kernels
