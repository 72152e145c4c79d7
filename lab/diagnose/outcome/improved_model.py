"""The improved model: the camera with what the diagnosis found, as a camera file that simulates and predicts like any
other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture
from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.diagnose.inference.discrepancy import Discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel, form_name
from lab.diagnose.outcome.model_posterior import model_posterior
from lab.errors import NotDetermined
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model, remarks_on_values
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult, ResidualPicture
from lab.formats.results.diagnosis import IN_CURVES
from lab.observables.charts.patches import PATCH_COLOUR_STD, PATCH_STD, patch_boxes
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.observable import Observable
from lab.observables.spectra.curves import freed_curve
from lab.predict.replay import Replay
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum

Applied = Literal["transfer", "sensitivity", "illumination", "response", "noise"]
#: Stages on which a smooth factor can act: the stage, the axis of the measurement, and the quantity of the stages that
#: changes it.
PLACES: tuple[tuple[Applied, str, str], ...] = (
    ("transfer", "spatial_frequency", "image.transfer"),
    ("sensitivity", "wavelength", "image.transmittance"),
    ("illumination", "field", "image.shading"),
    ("noise", "level", "charge.variance_e2"),
    ("response", "level", "signal.response"),
)
#: Share of the largest signal below which the discrepancy's relative size isn't known.
LEAST_CONTRAST = 0.05
#: Limits of the factors: a Gaussian process doesn't know that a quantity is positive.
LOWEST, HIGHEST = 0.05, 3.0


@dataclass(frozen=True)
class Correction:
    """The correction of the improved model for one unexplained mismatch."""

    measurement: str
    kind: Applied | None  # the stage that it acts on; None: there is no correction
    said: str  # in words


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


def nearest_form(effect: Effect, estimates: Mapping[str, float]) -> Effect:
    """Return the effect by that form of its law whose coefficient in `estimates` is nearest to 1, if it is nearer to 1
    than to 0."""
    found = {number: estimates.get(form_name(effect, number), 0.0) for number in range(len(effect.other_forms()))}
    near = min(found, key=lambda number: abs(found[number] - 1.0), default=None)
    return effect if near is None or found[near] < 0.5 else effect.other_forms()[near]


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


def place_for(block: Observable) -> Applied | None:
    """Return the stage that a smooth factor along the measurement's axis can act on."""
    if block.measurement.places:
        return None
    return next(
        (kind for kind, axis, quantity in PLACES if block.measurement.axis == axis and quantity in block.reads), None
    )


def factor_along(
    block: Observable, mean: FloatArray, predicted: FloatArray
) -> tuple[FloatArray, FloatArray, dict[str, tuple[FloatArray, FloatArray]]]:
    """x and the factor on the prediction there, averaged over channels and conditions; and the same by channel. `mean`:
    the posterior mean of the discrepancy (m,). The factor is relative to the block's scale where that varies, else to
    the prediction."""
    whole = block.scale if np.ptp(block.scale) > 0 else predicted
    usable = whole > LEAST_CONTRAST * float(np.max(whole))
    x = np.array([label.x for label in block.labels])
    channel = np.array([label.channel for label in block.labels])

    def along(members: np.ndarray) -> tuple[FloatArray, FloatArray]:
        places, which = np.unique(np.round(x[members], 6), return_inverse=True)
        weight = np.square(whole[members])
        ratio = np.bincount(which, weight * (1.0 + mean[members] / whole[members])) / np.bincount(which, weight)
        return places, np.clip(ratio, LOWEST, HIGHEST)

    places, factor = along(usable)
    return places, factor, {str(c): along(usable & (channel == c)) for c in np.unique(channel[usable])}


def correction_on(
    kind: Applied, block: Observable, x: FloatArray, factor: FloatArray, camera: CameraModel
) -> ModelDiscrepancy:
    """Return the factor on its stage, in that stage's unit."""
    gain = camera.conversion_gain_dn_per_e
    if kind == "transfer":
        from_zero = x > 0.0  # where a transfer function is 1
        at = np.append(0.0, x[from_zero] / camera.pixel_pitch_um)
        return _of("frequency_cy_per_um", at, np.append(1.0, factor[from_zero]))
    if kind == "illumination":
        return _of("radius_um", x * 1e3, factor)
    if kind == "noise":
        return _of("variance_signal_e", x / gain, factor)
    return _of("signal_e", (x - camera.black_level_dn) / gain, factor)


def _of(
    along: Literal["frequency_cy_per_um", "radius_um", "signal_e", "variance_signal_e"],
    x: FloatArray,
    factor: FloatArray,
) -> ModelDiscrepancy:
    return ModelDiscrepancy(along=along, at=tuple(x.tolist()), factor=tuple(factor.tolist()), strength=1.0)


def scaled_curve(curve: Spectrum, factor: float) -> Spectrum:
    return (
        curve if factor == 1.0 else Spectrum.of(curve.wavelength_nm, np.clip(factor * np.array(curve.value), 0.0, 1.0))
    )


def multiplied_curve(curve: Spectrum, at: FloatArray, factor: FloatArray) -> Spectrum:
    """Return a curve times a factor that is held beyond its ends."""
    grid = np.union1d(np.array(curve.wavelength_nm), at)
    grid = grid[(grid >= curve.wavelength_nm[0]) & (grid <= curve.wavelength_nm[-1])]
    return Spectrum.of(grid, np.clip(curve.at(grid) * np.interp(grid, at, factor), 0.0, 1.0))


# --- Residual pictures: a held-out frame of each kind, measured less predicted, before and after the named effects ----
# The forward model draws the mean frame (`lab.predict.replay`); the light's level, a nuisance parameter, is fitted
# channel by channel. A cell of a picture is the sum of its pixels' residuals over its standard deviation, sqrt(sum
# variance), with shot noise, read noise, PRNU and rounding: of noise alone, cells have variance 1.


KINDS = ("flat", "slanted_edge", "chart")
#: Largest number of cells of a picture.
ROWS, COLS = 48, 64


def residual_pictures(
    recordings: RecordingSet, side: Side, model: MeasurementModel, improved: CameraFile
) -> Iterator[ResidualPicture]:
    """One picture of each kind that was captured and that can be replayed, held out where possible. Before: with the
    baseline's own effects."""
    replay = Replay(recordings, side, improved.camera)
    held_out = set(model.captures(True))
    both = model.always, tuple(improved.effects)
    for kind in KINDS:
        captures = [c for c in replay.captures if c.kind == kind]
        if not captures:
            continue
        capture = max(captures, key=lambda c: (c.id in held_out, _brightness(recordings, c, improved.camera)))
        try:
            drawn = {effects: _residual(recordings, replay, capture, effects) for effects in {*both}}
        except (NotDetermined, ValueError):
            continue
        before, after = (drawn[effects] for effects in both)
        yield ResidualPicture(
            side=side, kind=kind, capture=capture.id, held_out=capture.id in held_out, before=_rows(before),
            after=_rows(after)
        )  # fmt: skip


def _brightness(recordings: RecordingSet, capture: Capture, camera: CameraModel) -> float:
    """Return a frame's 99.9 % quantile (DN); -1 where it is clipped."""
    high = float(np.quantile(recordings.frame(capture), 0.999))
    return -1.0 if high >= 0.97 * camera.white_level_dn else high


def _residual(recordings: RecordingSet, replay: Replay, capture: Capture, effects: Sequence[Effect]) -> FloatArray:
    """Cells of the frame less its prediction under the effects, each channel scaled to the frame's level."""
    camera = replay.camera
    frame = recordings.frame(capture).astype(float)
    offset = camera.black_level_dn + camera.conversion_gain_dn_per_e * camera.dark_current_e_per_s * capture.exposure_s
    predicted = replay.expected(capture, effects) - offset
    judged = _judged(capture, frame.shape)
    step = mosaic.step(camera.cfa)
    for phases in mosaic.phases(camera.cfa).values():
        parts = [(slice(r, None, step), slice(c, None, step)) for r, c in phases]
        lit = sum(float(predicted[part][judged[part]].sum()) for part in parts)
        seen = sum(float((frame[part] - offset)[judged[part]].sum()) for part in parts)
        for part in parts:
            predicted[part] *= seen / lit if lit > 0 else 1.0
    gain = camera.conversion_gain_dn_per_e
    signal = np.maximum(predicted, 0.0)
    variance = (
        gain * signal + (gain * camera.read_noise_e) ** 2 + (camera.prnu_percent / 100.0 * signal) ** 2 + 1.0 / 12.0
    )
    region = _region(capture, frame.shape)
    patch_std = np.hypot(PATCH_STD, PATCH_COLOUR_STD) if isinstance(capture, ChartCapture) else 0.0
    return _cells(
        np.where(judged, frame - offset - predicted, 0.0)[region],
        np.where(judged, variance, 0.0)[region],
        np.where(judged, patch_std * signal, 0.0)[region],
    )


def _judged(capture: Capture, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mask of the pixels that the model predicts: an edge's region, the inner halves of a chart's patches, else all."""
    inside = np.zeros(shape, bool)
    if isinstance(capture, ChartCapture):
        for _, rows, cols, *_ in patch_boxes(capture):
            inside[slice(*rows), slice(*cols)] = True
    else:
        row0, col0, row1, col1 = (isinstance(capture, SlantedEdgeCapture) and capture.region) or (0, 0, *shape)
        inside[row0:row1, col0:col1] = True
    return inside


def _region(capture: Capture, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the middle of an edge, pixel by pixel; else the whole frame."""
    if not isinstance(capture, SlantedEdgeCapture):
        return slice(None), slice(None)
    row0, col0, row1, col1 = capture.region or (0, 0, *shape)
    row, col = (row0 + row1) // 2, (col0 + col1) // 2
    high, wide = min(ROWS, row1 - row0) // 2, min(COLS, col1 - col0) // 2
    return slice(row - high, row + high), slice(col - wide, col + wide)


def _cells(residual: FloatArray, variance: FloatArray, common_std: FloatArray) -> FloatArray:
    """Sums over cells of whole mosaics, over sqrt(sum variance + (sum common_std)^2); 0 of empty cells. `common_std`:
    the standard deviation of an error that the pixels of a cell share."""
    high = max(-(-residual.shape[0] // ROWS), 1)
    wide = max(-(-residual.shape[1] // COLS), 1)
    high, wide = (size + size % 2 if size > 1 else size for size in (high, wide))
    rows, cols = residual.shape[0] // high, residual.shape[1] // wide

    def total(table: FloatArray) -> FloatArray:
        cut = table[: rows * high, : cols * wide]
        return np.asarray(cut.reshape(rows, high, cols, wide).sum(axis=(1, 3)))

    std = np.sqrt(total(variance) + np.square(total(common_std)))
    return np.asarray(total(residual) / np.where(std > 0, std, np.inf))


def _rows(table: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(v), 2) for v in row) for row in table)
