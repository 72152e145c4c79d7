"""The temporal variance of dark frames by exposure and temperature."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from lab.errors import NotDetermined
from lab.observables.darks.frames import (
    DEFECTS,
    DarkCondition,
    captures_of,
    contrast_weights,
    dark_frames,
    too_coarse,
)
from lab.observables.darks.level import added_dark_e_per_s
from lab.observables.dataset import Dataset
from lab.observables.flats.noise import GAIN_STD
from lab.observables.noise.robust import CLIP
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES, PARTICLES, acting
from sim.effects.base import Effects
from sim.sensor.reading_order import ReadOutNoise
from sim.spectrum import FloatArray
from sim.uniform import Uniform

CARRIED_STD = 0.3  # relative prior standard deviation of what frames before leave: the mean level measures it
LEAST_NOISE_DN = 0.4  # of codes of a step of 1 DN; below, codes are too coarse to measure temporal noise


def measure_dark_noise(dataset: Dataset) -> Observable:
    """Temporal variance of dark frames by exposure and temperature, DN^2. It grows with the dark signal (shot noise),
    not with an offset.

    Nuisance parameters: read noise, dark current, gain, charge that frames before leave. Raises NotDetermined without
    repeats, and where codes are too coarse."""
    frames = dataset.once(dark_frames)
    points = [(f, out, c) for f in frames for out, c in f.changing.items()]
    if not points:
        raise NotDetermined("dark_noise", "no two dark frames of the same exposure and temperature")
    value = np.array([c.variance_dn2 for *_, c in points])
    least_dn = LEAST_NOISE_DN * dataset.step_dn
    if np.sqrt(value.min()) < least_dn:
        raise NotDetermined("dark_noise", too_coarse([f for f, *_ in points], least_dn))
    size = dataset.camera.rows * dataset.camera.cols
    noise = dataset.noise
    exposures = np.array([f.condition.exposure_s for f, *_ in points])
    count = np.array([c.contrasts for *_, c in points])
    lines = np.array(
        [
            c.line_dn2["rows"] ** 2 / dataset.camera.rows + c.line_dn2["columns"] ** 2 / dataset.camera.cols
            for *_, c in points
        ]
    )
    # noise of less than about half a code: rounding changes its variance, by the level's place between two codes
    step_dn2 = noise.step_dn**2
    bare = np.maximum(value - noise.quantisation_dn2, 0.0) / step_dn2
    coarse = step_dn2 * (4.0 * bare + 0.1) * np.exp(-2.0 * np.pi**2 * bare)
    covariance = np.diag(2.0 * value**2 / (size * count) + 2.0 * lines / count + coarse**2)
    dark = noise.gain * noise.dark_dn_per_s * exposures
    shortest = float(value[int(np.argmin(exposures))])
    base = shortest + dark - float(dark.min())
    # relative prior standard deviation of the gain: measured by flats, stated, or unknown
    flats = len(dataset.flat_levels()) > 1
    gain_std = GAIN_STD if flats else 0.3 if dataset.stated.conversion_gain_dn_per_e is not None else 10.0

    def predict(effects: Effects) -> Prediction:
        mean = base.copy()
        shot, carried = dark.copy(), np.zeros(len(points))
        model = Uniform(dataset.camera, effects)
        more_at = added_dark_e_per_s(dataset, effects)
        lines = sum((one.variance_e2(()) for one in model.lines), 0.0)
        lines += sum((one.variance_e2(()) for one in model.reading_order), 0.0)
        for i, (f, out, _) in enumerate(points):
            t, temperature = f.condition.exposure_s, f.condition.temperature_c
            carried[i] = noise.gain**2 * _carried_e(dataset, effects, f.condition, out)
            shot[i] += noise.gain**2 * more_at(temperature) * t + carried[i]
            mean[i] += shot[i] - dark[i]
            mean[i] += _defect_variance(model, noise.gain, t, float(value[i])) + noise.gain**2 * lines
            mean[i] += _particle_variance(dataset, model, f.condition, out, float(value[i]))
        if model.changes_shot_noise:  # as flats have it, by which the gain is known
            e = np.maximum(shot, 0.0) / noise.gain**2
            kept = noise.gain**2 * model.shot_e2(e, dataset.usual_gain_db)
            mean, shot = mean + kept - shot, kept
        jacobian = {
            "dark_read": np.full(len(points), 0.5 * shortest + 0.1),
            "dark": noise.gain * exposures * noise.dark_std,
        }
        slow_dn2 = noise.gain**2 * sum((_slow_scatter_e2(dataset, one) for one in model.reading_order), 0.0)
        if slow_dn2 > 0.0:
            for i, contrasts in enumerate(count):
                jacobian[f"dark_noise:slow:{i}"] = np.where(
                    np.arange(len(points)) == i, slow_dn2 / np.sqrt(contrasts), 0.0
                )
        if np.any(carried):
            jacobian["dark_noise:carried"] = CARRIED_STD * carried
        jacobian["gain" if flats else "dark_gain"] = gain_std * shot
        return Prediction(mean, jacobian)

    return Observable(
        measurement=DARK_NOISE, reach=float(max(np.ptp(exposures), 1e-3)), value=value,
        covariance=covariance,
        labels=tuple(Label(f.condition.exposure_s, "all", f.condition.name, captures_of(f, out), out) for f, out,
        _ in points),
        reads=DEFECTS | DARK_CURRENT | LAG | LINES | PARTICLES | {"charge.excess", "charge.variance_e2"},
        predict=predict, scale=value,
    )  # fmt: skip


def _slow_scatter_e2(dataset: Dataset, one: ReadOutNoise) -> float:
    """Standard deviation of a frame's variance by the rows' few slow waves: sqrt(2 sum P^2) / pixels, P their power."""
    shape = dataset.camera.rows, dataset.camera.cols
    down = np.arange(1, shape[0]) / shape[0]
    power = one.plane_e2(shape, np.zeros(len(down)), down)
    return float(np.sqrt(2.0 * np.sum(np.square(power)))) / (shape[0] * shape[1])


def _carried_e(dataset: Dataset, effects: Effects, condition: DarkCondition, held_out: bool) -> float:
    """Return the mean electrons that frames before leave in the contrasts of one part of a condition, whose shot noise
    is theirs: contrast k has k / (k + 1) (e_k + <e_0 .. e_(k-1)> / k)."""
    if not acting(effects, LAG):
        return 0.0
    carried = dataset.carried_mean_e(effects)
    e = np.array([carried(c) for c in condition.captures])
    k = np.arange(1.0, len(e))
    contrasts = k / (k + 1.0) * (e[1:] + np.cumsum(e)[:-1] / k**2)
    part = contrasts[len(condition.seen) - 1 :] if held_out else contrasts[: len(condition.seen) - 1]
    return float(part.mean())


def _defect_variance(model: Uniform, gain: float, exposure_s: float, variance_dn2: float) -> float:
    """Return what defective pixels add to the mean variance (DN^2) of contrasts that are clipped at `CLIP` standard
    deviations."""
    cut = CLIP * np.sqrt(variance_dn2)
    more = 0.0
    for hot in model.hot:
        share, excess_e_per_s = hot.nodes()
        noisy = variance_dn2 + gain**2 * excess_e_per_s * exposure_s
        more += float(share @ (_cut_square(np.zeros_like(noisy), noisy, cut) - variance_dn2))
    for jumps in model.telegraph:
        share, distance_e = jumps.nodes()
        # probability that of two frames one is high and the other low
        differ = 2.0 * jumps.high_share * (1.0 - jumps.high_share)
        apart = gain * distance_e / np.sqrt(2.0)
        still = np.full_like(apart, variance_dn2)
        apart_square = _cut_square(apart, still, cut)
        more += float(share @ (differ * (apart_square - variance_dn2)))
    return more


def _particle_variance(
    dataset: Dataset, model: Uniform, condition: DarkCondition, held_out: bool, variance_dn2: float
) -> float:
    """Return what particles add to the mean variance (DN^2) of a part's contrasts, which are clipped."""
    pitch_um, more = dataset.camera.pixel_pitch_um, 0.0
    for law in model.particles:
        number, charge_e = law.pixels_e(pitch_um)
        hit = law.expected_number(1, pitch_um, condition.exposure_s) * number
        for weight in contrast_weights(condition, held_out):
            apart = dataset.noise.gain * np.outer(weight, charge_e)
            still = np.full_like(apart, variance_dn2)
            more += float(np.sum(hit * (_cut_square(apart, still, CLIP * np.sqrt(variance_dn2)) - variance_dn2)))
    return more / max(len(contrast_weights(condition, held_out)), 1)


def _cut_square(mean: FloatArray, variance: FloatArray, cut: float) -> FloatArray:
    """Mean square of a normal variable that is clipped to -cut..cut."""
    s = np.sqrt(variance)
    a, b = (-cut - mean) / s, (cut - mean) / s
    pa, pb = (np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) for x in (a, b))
    inside = ndtr(b) - ndtr(a)
    square = (mean**2 + variance) * inside + 2.0 * mean * s * (pa - pb) + variance * (a * pa - b * pb)
    return np.asarray(square + cut**2 * (1.0 - inside))


DARK_NOISE = Measurement(
    "dark_noise",
    title="temporal noise of dark frames",
    order=120,
    axis="exposure",
    unit="s",
    make=measure_dark_noise,
    quantity="temporal variance, DN²",
    of_variances=True,
    conditions="exposure and temperature",
)
