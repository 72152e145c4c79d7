"""Predict the measured numbers of a session to come, with the covariance of their noise and of the model's parameters.

mean = m(effects) + J E(z),   covariance = S + J cov(z) J'

J is the Jacobian of the diagnosis's measurement model by nuisance parameters, effects' parameters and patches'
reflectances, z their posterior (`lab.formats.model_posterior`), S noise, floors and the laws' tolerances.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from lab.capture_kinds.base import Capture
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.outcome.model_posterior import coordinate_name, effect_jacobian, with_unnamed
from lab.errors import InputError, NotDetermined
from lab.fit import Step, fit_recording_set
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import PATCH, FirstEstimates, ModelPosterior
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Skipped
from lab.inference.coordinates import coordinates
from lab.observables.charts.chart import CHART
from lab.observables.charts.patches import reflectance_covariance
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.darks.level import DARK, added_dark_e_per_s
from lab.observables.dataset import Dataset
from lab.observables.edges.slanted_edge import ASIDE, SLANTED_EDGE
from lab.observables.flats.linearity import PHOTON_TRANSFER, misstated_levels
from lab.observables.flats.noise import GAIN_STD, NOISE, READ_STD, shot_variance
from lab.observables.noise.figures import BLACK_FLOOR_DN, USUAL_JITTER_DN, NoiseFigures
from lab.observables.noise.repeatability import USUAL_LAMP
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.one_blas_thread import one_blas_thread
from lab.twin.changes import Changes, apply_changes, doubling_std_c, reference_temperature_c
from lab.twin.relative_light import RelativeLight, rates_per_dose, relative_light
from lab.twin.sealed import PredictedName, PredictedNumber, PredictedRival, SealedPrediction, SidePrediction
from lab.twin.session import check_sensor, future_session
from sim.camera import CameraModel, Side
from sim.effects.base import Effects
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.model_discrepancy import ModelDiscrepancy
from sim.effects.other_f_number import OtherFNumber
from sim.sensor.electrons import dark_current_e_per_s, gain_dn_per_e
from sim.spectrum import FloatArray
from sim.stop_down import effects_at_f_number

#: The measurements that a twin predicts.
QUANTITIES = (CHART, NOISE, SLANTED_EDGE, DARK)
NYQUIST_CY_PER_PX = 0.5
#: Share of the full well from which on a pixel counts as clipped.
NEAR_FULL = 0.985
#: Share of saturation above which a level isn't predicted, as some of its pixels clip.
HIGHEST_SHARE = 0.95
#: Relative standard deviation of the sensitivities where the model has none.
CURVE_STD = 0.01
#: What is fitted of the recordings that levels are relative to.
NOISE_STEP: tuple[Step, ...] = ("noise",)
#: Step (C) of the difference by temperature.
STEP_C = 0.1


@one_blas_thread
def predict(
    models: Mapping[Side, CameraFile],
    plan: RecordingSet,
    changes: Changes,
    *,
    model: str = "",
    light_std: float = 0.003,
    fitted: RecordingSet | None = None,
) -> SealedPrediction:
    """Return the prediction for every side that plan and models have in common.

    light_std : relative standard deviation of the light to come, beside what the plan states
    fitted : the recordings that the models were fitted to. The means of flats are predicted relative to theirs, which
        needs no radiance: photon numbers, or one lamp at several exposures

    Raises InputError for a change that a model can't carry, before anything is computed, and where nothing can be
    predicted."""
    sides = [side for side in plan.sides if side in models]
    if not sides:
        raise InputError(f"{plan.source}: no camera that the model has; give the plan of the same cameras")
    changes.spectrum()
    checked = {side: (apply_changes(models[side], changes), posterior_of(models[side])) for side in sides}
    predicted = {}
    for side, (content, posterior) in checked.items():
        fitted_f_number = models[side].camera.lens.f_number
        predicted[side] = _side(content, posterior, fitted_f_number, plan, side, changes, light_std, fitted)
    return SealedPrediction(
        model=model, plan=plan.source, changes=changes, sides=predicted,
        cameras={side: content.camera.model_dump_json() for side, (content, _) in checked.items()},
    )  # fmt: skip


def posterior_of(content: CameraFile) -> ModelPosterior:
    """Return how well the model's parameters are known: its posterior, else one of independent parameters by the
    camera's `std`. Raises InputError where it states neither.

    >>> from lab.formats.camera_file import default_camera
    >>> try:
    ...     posterior_of(default_camera())
    ... except InputError as error:
    ...     print("no uncertainties" in str(error))
    True
    """
    if content.posterior is not None:
        return content.posterior
    camera = content.camera
    if not camera.std:
        raise InputError(
            f"{content.name}: the model states no uncertainties; take one that `diagnose --save` or `fit "
            "--write-cameras` wrote"
        )
    gain, std = camera.conversion_gain_dn_per_e, camera.std
    first = FirstEstimates(
        dark_temperature_c=camera.dark_current_reference_c,
        read_noise_dn=float(np.hypot(camera.read_noise_e * gain, 12.0**-0.5)),
        black_level_std_dn=std.get("black_level_dn", 0.1),
        dark_current_std_dn_per_s=max(std.get("dark_current_e_per_s", 0.1 * camera.dark_current_e_per_s) * gain, 1e-9),
        level_jitter_dn=USUAL_JITTER_DN,
        lamp_jitter=USUAL_LAMP,
    )
    known = {
        "gain": std.get("conversion_gain_dn_per_e", 0.01 * gain) / gain / GAIN_STD,
        "read": 2.0 * std.get("read_noise_e", 0.03 * camera.read_noise_e) / max(camera.read_noise_e, 1e-9) / READ_STD,
    }
    variances = np.square(list(known.values()))
    return ModelPosterior.of(first, tuple(known), np.zeros(len(known)), np.diag(variances))


def measure_blocks(
    dataset: Dataset, quantities: tuple[Measurement, ...] = QUANTITIES
) -> tuple[list[Observable], list[Skipped]]:
    """Return the blocks that the recordings determine, with the numbers that a twin predicts, and why others are
    missing."""
    blocks, skipped = [], []
    for measurement in quantities:
        try:
            blocks.append(measurement.make(dataset))
        except NotDetermined as refused:
            skipped.append(Skipped(step=f"twin {refused.step}", reason=refused.reason, side=dataset.side))
    return blocks, skipped


def is_predicted(block: Observable, label: Label) -> bool:
    """Return whether a twin predicts a block's number: transfer functions by their real parts up to Nyquist, all else
    wholly."""
    return block.measurement is not SLANTED_EDGE or (
        label.x <= NYQUIST_CY_PER_PX and not label.condition.endswith(ASIDE)
    )


def _side(
    content: CameraFile,
    posterior: ModelPosterior,
    fitted_f_number: float,
    plan: RecordingSet,
    side: Side,
    changes: Changes,
    light_std: float,
    fitted: RecordingSet | None,
) -> SidePrediction:
    light = None
    if fitted is not None:
        check_sensor(content, fitted.camera(side), fitted.source)
        noise_fit = fit_recording_set(fitted, steps=NOISE_STEP).cameras.get(side)
        misstated = frozenset(id for level in misstated_levels(noise_fit) for id in level.captures)
        light = relative_light(_dataset(content, posterior, fitted, side, misstated)[0], content.effects, posterior)
    session = future_session(content, plan, side, changes, dn_per_photon=None if light is None else light.dn_per_dose())
    captures = session.captures(side=side)
    dataset, growth_std = _dataset(content, posterior, session, side)
    blocks, skipped = measure_blocks(dataset, QUANTITIES if light is None else (*QUANTITIES, PHOTON_TRANSFER))
    if not blocks:
        raise InputError(
            f"{plan.source}: nothing can be predicted ({skipped[0].reason}); plan other captures or changes"
        )
    model = MeasurementModel(tuple(blocks), dataset.camera, gain_is_known=True, noise=dataset.noise)
    effects = content.effects
    for block in blocks:
        if light is not None and block.measurement is PHOTON_TRANSFER:
            light = light.about(rates_per_dose(dataset, block))
    unnamed = effects_at_f_number(with_unnamed(effects, posterior), fitted_f_number, content.camera.lens.f_number)
    mean, covariance = _distribution(model, dataset, effects, unnamed, posterior, growth_std, light_std, light)
    use = np.array([is_predicted(b, label) for b in blocks for label in b.labels])
    is_level = np.array([b.measurement.is_level for b in blocks for _ in b.labels])
    full = is_level & (mean > HIGHEST_SHARE * dataset.saturation_dn)
    if full.any():
        reason = (
            f"{full.sum()} levels are above {100 * HIGHEST_SHARE:g} % of saturation, {dataset.saturation_dn:.4g} DN: "
            "plan shorter exposures"
        )
        skipped.append(Skipped(step="twin saturation", reason=reason, side=side))
        use &= ~full
    names = _names(model, content, posterior, fitted_f_number, mean, use)
    kept = covariance[np.ix_(use, use)]
    numbers = [n for n, used in zip(_numbers(dataset, model, effects, mean, covariance), use, strict=True) if used]
    lens = content.camera.lens
    return SidePrediction(
        camera=session.camera(side),
        captures=tuple(captures),
        lens={"f_number": lens.f_number, "focal_length_mm": lens.focal_length_mm},
        numbers=tuple(numbers),
        covariance=tuple(float(f"{v:.9g}") for v in kept[np.tril_indices(len(kept))]),
        names=names,
        skipped=tuple(skipped),
    )


def _names(
    model: MeasurementModel,
    content: CameraFile,
    posterior: ModelPosterior,
    fitted_f_number: float,
    mean: FloatArray,
    use: np.ndarray,
) -> tuple[PredictedName, ...]:
    """Every name of the model with what its rivals predict of the numbers in `use` (n,), of `mean` (n,) with it. Of a
    model that knows no rivals: with nothing in its place."""
    base = model.mean(content.effects)
    columns = model.nuisance_jacobian(content.effects)
    for block, at in zip(model.blocks, model.slices, strict=True):
        if block.measurement is CHART:
            columns |= _patch_columns(block, at, len(mean))

    def numbers(acting: Effects, shift: Mapping[str, float]) -> tuple[float, ...]:
        moved = sum((value * columns[name] for name, value in shift.items() if name in columns), np.zeros_like(mean))
        return tuple(float(f"{v:.9g}") for v in (mean + model.mean(acting) - base + moved)[use])

    names = []
    for doubt in posterior.doubts:
        kept = tuple(e for e in content.effects if e.name not in doubt.named)
        rivals = [
            PredictedRival(
                name=rival.name,
                probability=rival.probability,
                numbers=numbers(
                    effects_at_f_number(
                        (*(e.effect() for e in rival.effects), *kept),
                        fitted_f_number,
                        content.camera.lens.f_number,
                    ),
                    rival.shift,
                ),
            )
            for rival in doubt.rivals
        ]
        names.append(
            PredictedName(effect=doubt.effect, told=doubt.told, probability=doubt.probability, rivals=tuple(rivals))
        )
    doubtful = {doubt.effect for doubt in posterior.doubts}
    for i, effect in enumerate(content.effects):
        if effect.name not in doubtful and not isinstance(effect, ModelDiscrepancy | EmpiricalLaw | OtherFNumber):
            rest = (*content.effects[:i], *content.effects[i + 1 :])
            absent = PredictedRival(name="", probability=0.0, numbers=numbers(rest, {}))
            names.append(PredictedName(effect=effect.name, told=effect.name, probability=1.0, rivals=(absent,)))
    return tuple(names)


def _dataset(
    content: CameraFile,
    posterior: ModelPosterior,
    session: RecordingSet,
    side: Side,
    misstated: frozenset[str] = frozenset(),
) -> tuple[Dataset, float]:
    """Return the dataset of the session to come, whose figures are the model's; and the relative standard deviation of
    its dark current by the camera's own doubling temperature."""
    camera, first = content.camera, posterior.first
    captures: list[Capture] = session.captures(side=side)
    gain = gain_dn_per_e(camera, captures[0].gain_db or 0.0)
    amplified = gain / camera.conversion_gain_dn_per_e
    reference_c = reference_temperature_c(content)
    warm = [c.temperature_c for c in captures if c.temperature_c is not None]
    now_c = float(np.median(warm)) if warm else None
    if reference_c is not None:
        camera = camera.model_copy(update={"dark_current_reference_c": reference_c})
    dark = dark_current_e_per_s(camera, now_c)
    growth = dark / camera.dark_current_e_per_s if camera.dark_current_e_per_s > 0 else 1.0
    growth_std = 0.0
    if now_c is not None and reference_c is not None and camera.dark_current_doubling_c is not None:
        rise = now_c - reference_c
        growth_std = abs(np.log(2.0) * rise / camera.dark_current_doubling_c**2) * doubling_std_c(content)
    rounding_dn2 = QUANTISATION_DN2 * first.code_step_dn**2
    noise = NoiseFigures(
        black=camera.black_level_dn, dark_dn_per_s=dark * gain, dark_c=reference_c, gain=gain, gain_is_known=True,
        read_dn=float(np.sqrt(max(first.read_noise_dn**2 - rounding_dn2, 0.0) * amplified**2 + rounding_dn2)),
        prnu=0.01 * camera.prnu_percent, jitter_dn=max(first.level_jitter_dn, BLACK_FLOOR_DN), jitter_dn2_std=0.0,
        jitter_lamp=first.lamp_jitter, black_std=first.black_level_std_dn,
        dark_std=first.dark_current_std_dn_per_s * amplified * growth, step_dn=first.code_step_dn,
    )  # fmt: skip
    seen: CameraModel = camera.model_copy(
        update={
            "conversion_gain_dn_per_e": gain,
            "dark_current_e_per_s": dark,
            "dark_current_doubling_c": None,
            "read_noise_e": noise.read_dn / gain,
        }
    )
    clipped = camera.black_level_dn + NEAR_FULL * camera.full_well_e * gain
    return Dataset(session, side, seen, clipped, misstated, noise=noise), growth_std


def _distribution(
    model: MeasurementModel,
    dataset: Dataset,
    effects: Effects,
    acting: Effects,
    posterior: ModelPosterior,
    growth_std: float,
    light_std: float,
    light: RelativeLight | None,
) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) of all numbers. `acting`: the effects and, at none, those that nobody named."""
    columns = {k: v for k, v in model.nuisance_jacobian(effects).items() if k != "warmth"}
    coords = coordinates(acting, model.camera)
    by_effect = effect_jacobian(model, acting, coords).T
    columns |= {
        name: column
        for c, column in zip(coords, by_effect, strict=True)
        if (name := coordinate_name(acting, c)) in posterior.names
    }
    bare = MeasurementModel(tuple(_without_nuisances(b) for b in model.blocks), model.camera)
    covariance = bare.gaussian(effects).covariance - _forms(bare, effects)
    for block, at in zip(model.blocks, model.slices, strict=True):
        if block.measurement is DARK and model.noise is not None:
            # shot noise of the dark charge, which the scatter of the fitted session's frames needn't have
            camera, black = model.camera, model.noise.black
            charge_dn = np.maximum(model.mean(effects)[at] - black, 0.0)
            variance = (model.noise.gain * charge_dn + model.noise.read_dn**2) / (camera.rows * camera.cols)
            covariance[at, at] += np.diag(variance)
        if block.measurement is NOISE:
            _hold_what_is_corrected(columns, at, block, model, dataset, acting, len(effects))
            variance = model.mean(effects)[at]
            signal_e = np.array([label.x for label in block.labels]) / model.camera.conversion_gain_dn_per_e
            for correction in _corrections(effects):
                covariance[at, at] += correction_covariance(correction, signal_e) * np.outer(variance, variance)
        if block.measurement is CHART:
            covariance[at, at] += light_std**2 * np.outer(block.scale, block.scale)
            patches = _patch_columns(block, at, len(covariance))
            if set(patches) & set(posterior.names):
                kept = np.array([f"{PATCH}{la.condition}:{la.channel}" in posterior.names for la in block.labels])
                names, channel = (np.array([getattr(la, of) for la in block.labels]) for of in ("condition", "channel"))
                tolerance = reflectance_covariance(names, channel, block.scale)
                covariance[at, at] -= tolerance * np.outer(kept, kept)
                columns |= {name: column for name, column in patches.items() if name in posterior.names}
    shift = np.zeros(len(covariance))
    mean_columns = dict(columns)
    if light is not None:
        rates = np.column_stack([columns.pop(name) for name in light.per_dose])
        mean_columns = dict(columns)
        shift += rates @ light.value
        covariance += rates @ light.covariance @ rates.T
        for name, by in zip(light.parameters, light.by.T, strict=True):
            columns[name] = columns.get(name, 0.0) + rates @ by
    jacobian = np.column_stack([*columns.values(), np.zeros((len(covariance), 0))])
    mean, known = posterior.select(list(columns))
    covariance += jacobian @ known @ jacobian.T
    shift += sum((mean[k] * mean_columns[name] for k, name in enumerate(columns) if name in mean_columns), shift * 0.0)
    if growth_std:
        for block, at in zip(model.blocks, model.slices, strict=True):
            if "dark" in columns and block.measurement is DARK and model.noise is not None:
                change = columns["dark"][at] / model.noise.dark_std * model.noise.dark_dn_per_s * growth_std
                covariance[at, at] += np.outer(change, change)
    return np.asarray(model.mean(effects) + shift), np.asarray(0.5 * (covariance + covariance.T))


def _corrections(effects: Effects) -> list[ModelDiscrepancy]:
    """Return the corrections of temporal variances."""
    return [e for e in effects if isinstance(e, ModelDiscrepancy) and e.along == "variance_signal_e"]


def _hold_what_is_corrected(
    columns: dict[str, FloatArray],
    at: slice,
    block: Observable,
    model: MeasurementModel,
    dataset: Dataset,
    acting: Effects,
    named: int,
) -> None:
    """Take from `columns`, the derivatives by the laws beyond the first `named` of `acting`, what a correction of the
    variances holds of them already: it was read from variances in which they acted. What is left is their change from
    the nearest level that it knows."""
    gain = dataset.noise.gain
    signal_dn = np.array([label.x for label in block.labels])
    for correction in _corrections(acting):
        nearest_dn = np.clip(signal_dn, gain * correction.at[0], gain * correction.at[-1])

        def there(effects: Effects, dn: FloatArray = nearest_dn) -> Prediction:
            shot_dn2 = shot_variance(dataset, dn, np.full(len(dn), gain), effects)
            return Prediction(shot_dn2 + dataset.noise.read_dn**2, {})

        held = MeasurementModel((replace(block, predict=there),), dataset.camera)
        coords = [c for c in coordinates(acting, model.camera) if c.index >= named]
        share = model.mean(acting)[at] / held.mean(acting)
        for c, column in zip(coords, effect_jacobian(held, acting, coords).T, strict=True):
            name = coordinate_name(acting, c)
            if name in columns:
                columns[name] = columns[name].copy()
                columns[name][at] -= share * column


def correction_covariance(correction: ModelDiscrepancy, x: FloatArray) -> FloatArray:
    """Return the covariance (n, n) of what a correction's factor is wrong by.

    correction : with factors at k places of its axis
    x : places (n,) for which it is wanted

    Its factors scatter from place to place, and drift, and both go on between and beyond them. With g(d) half the mean
    squared difference of factors that are d apart, c + b d by least squares, and w (n, k) the weights by which the
    correction is drawn through its k factors, the error f - w f_k has the covariance

        w g(k, n) + g(n, k) w' - g(n, n) - w g(k, k) w'

    (N. Cressie, Statistics for Spatial Data, 1993, section 3.1). Every place departs by itself: none of the session to
    come is one of those that were fitted.
    """
    at = np.array(correction.at)
    lag, half = np.abs(np.subtract.outer(at, at)), 0.5 * np.subtract.outer(correction.factor, correction.factor) ** 2
    near = np.triu(lag <= 0.5 * np.ptp(at), 1)
    (alone, drift), _ = nnls(np.column_stack([np.ones(near.sum()), lag[near]]), half[near])
    weights = np.array([np.interp(x, at, unit) for unit in np.eye(len(at))]).T

    def apart(places: FloatArray) -> FloatArray:
        return drift * np.abs(np.subtract.outer(places, places)) + alone * (1.0 - np.eye(len(places)))

    across = weights @ (alone + drift * np.abs(np.subtract.outer(at, x)))
    return np.asarray(correction.strength**2 * (across + across.T - apart(x) - weights @ apart(at) @ weights.T))


def _forms(model: MeasurementModel, effects: Effects) -> FloatArray:
    """Return the part (n, n) of a bare model's covariance by other forms of the laws, which the posterior knows
    better."""
    columns = [*model.nuisance_jacobian(effects).values()]
    return np.asarray(sum((np.outer(c, c) for c in columns), np.zeros((len(model.value),) * 2)))


def _without_nuisances(block: Observable) -> Observable:
    def bare(effects: Effects) -> Prediction:
        return Prediction(block.predict(effects).mean, {})

    return replace(block, predict=bare)


def _patch_columns(block: Observable, at: slice, size: int) -> dict[str, FloatArray]:
    """Derivatives (size,) of all numbers by the patches' relative reflectances, by name."""
    columns: dict[str, FloatArray] = {}
    for row, label in enumerate(block.labels):
        column = columns.setdefault(f"{PATCH}{label.condition}:{label.channel}", np.zeros(size))
        column[at.start + row] = block.scale[row]
    return columns


def _numbers(
    dataset: Dataset, model: MeasurementModel, effects: Effects, mean: FloatArray, covariance: FloatArray
) -> list[PredictedNumber]:
    """Every number, with how it follows exposure, temperature and level."""
    noise, more, offset = dataset.noise, added_dark_e_per_s(dataset, effects), dataset.offset(effects)
    numbers = []
    for block, at in zip(model.blocks, model.slices, strict=True):
        name = block.measurement.name
        levels = np.array([label.x for label in block.labels])
        slope = np.zeros(len(levels))
        bare = block.predict(()).mean if block.measurement is SLANTED_EDGE else None
        if block.measurement is NOISE:
            gains, step = np.full(len(levels), noise.gain), 0.01 * levels
            ends = [shot_variance(dataset, levels + sign * step, gains, effects) for sign in (1.0, -1.0)]
            slope = (ends[0] - ends[1]) / (2.0 * step)
        for k, label in enumerate(block.labels):
            value, std = float(mean[at][k]), float(np.sqrt(covariance[at.start + k, at.start + k]))
            capture = dataset.recordings.capture(label.captures[0])
            update: dict[str, float | None] = {"fixed": value}
            if bare is not None:
                update |= {"without_effects": float(bare[k])}
            if block.measurement is NOISE:
                update |= {"level_dn": float(levels[k]), "level_slope": float(slope[k])}
            elif block.measurement in (DARK, CHART, PHOTON_TRANSFER):
                temperature = capture.temperature_c
                rate = noise.dark_dn_per_s + noise.gain * more(temperature)
                later = rate if temperature is None else noise.dark_dn_per_s + noise.gain * more(temperature + STEP_C)
                warmth = float(np.log(later / rate)) / STEP_C if rate > 0 and later > 0 else 0.0
                update |= {
                    "fixed": noise.black + offset(capture),
                    "dark": rate * capture.exposure_s,
                    "warmth_per_c": warmth,
                }
            numbers.append(
                PredictedNumber.model_validate(
                    {
                        "quantity": name, "captures": label.captures, "channel": label.channel,
                        "where": label.condition,
                        "x": label.x, "predicted": value, "std": std, **update,
                    }
                )
            )  # fmt: skip
    return numbers
