"""How well the seen numbers determine the parameters of an improved model, all together.

With A the Jacobian (n, k) by all parameters, P their prior covariance, C that of the n seen numbers with everything
marginalised:

    mean = P A' C^-1 (y - m),   covariance = P - P A' C^-1 A P

(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, eq. 2.25, 2.26)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.formats.model_posterior import PATCH, FirstEstimates, ModelPosterior
from lab.inference.coordinates import EffectCoordinate, coordinate_prior, coordinates, moved
from lab.observables.charts.chart import CHART
from lab.observables.charts.patches import reflectance_covariance
from lab.observables.flats.noise import GAIN_STD, NOISE
from lab.observables.noise.figures import NoiseFigures
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.effects.nonlinearity import Nonlinearity
from sim.sensor.electrons import gain_dn_per_e
from sim.spectrum import FloatArray

#: Nuisance parameters, and beginnings of their names, that stay with the camera and its place before the chart from
#: session to session. Others belong to one session: its edges' light, its lamp's flicker.
LASTING = ("gain", "read", "black", "dark", "chart:scale", "chart:x", "chart:y")
LASTING_PREFIXES = ("curve:", "read:", "level:", "form ")
#: Step of a difference by an effect's parameter, as a share of its typical size.
STEP = 0.02
#: Prior standard deviation of a coordinate without one, in typical sizes.
WIDE = 100.0
#: Laws that every camera follows a little: where none is named, their size is what the recordings leave open, so that
#: a level beyond those that were fitted is told with its doubt.
EVERYWHERE: tuple[Effect, ...] = (Nonlinearity(),)


def model_posterior(
    model: MeasurementModel,
    effects: Sequence[Effect],
    camera: CameraModel,
    discrepancies: Mapping[int, FloatArray] | None = None,
    gain_db: float = 0.0,
    is_corrected: bool = False,
    disturbances: FloatArray | None = None,
) -> ModelPosterior | None:
    """Return the posterior of the parameters of `model` with `effects`, about `camera`, the improved model.

    discrepancies : covariances of model discrepancies by block, which stand beside the effects
    disturbances : columns (n, r) of small physics, of unit variance, which are marginalised
    is_corrected : whether the improved model has a correction of the noise, which holds what gain and read noise were
    moved by gain_db : amplification for which the estimates of `model` hold

    Returns None for a model without first estimates.
    """
    if model.noise is None:
        return None
    given = discrepancies or {}
    seen = model.seen
    nuisance = {
        name: column[seen]
        for name, column in model.nuisance_jacobian(effects).items()
        if name in LASTING or name.startswith(LASTING_PREFIXES)
    }
    everywhere = tuple(e for e in EVERYWHERE if e.name not in {one.name for one in effects})
    acting = (*effects, *(e for e in everywhere if model.affected(type(e)).any()))
    coords = coordinates(acting, model.camera)
    by_effects = effect_jacobian(model, acting, coords)[seen]
    patch_names, by_patches, patch_prior = _patches(model)
    _, wide = coordinate_prior(coords) if coords else (np.zeros(0), np.zeros(0))
    typical = np.array([c.typical(float(getattr(acting[c.index], c.name))) for c in coords])
    width = np.where(np.isfinite(wide), wide, WIDE * typical)
    names = (*nuisance, *(coordinate_name(acting, c) for c in coords), *patch_names)
    size = len(nuisance)
    prior = np.zeros((len(names), len(names)))
    prior[:size, :size] = np.eye(size)
    at_effects = np.arange(size, size + len(coords))
    prior[at_effects, at_effects] = width**2
    prior[size + len(coords) :, size + len(coords) :] = patch_prior
    columns = [np.column_stack([*nuisance.values(), np.zeros((seen.sum(), 0))]), by_effects, by_patches[seen]]
    jacobian = np.column_stack(columns) @ prior

    def projected(kernels: Mapping[int, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Posterior mean (k,) and covariance (k, k) beside these discrepancies."""
        gaussian = model.seen_gaussian(effects)
        for index, kernel in kernels.items():
            inside = seen[model.slices[index]]
            gaussian = gaussian.with_discrepancy(index, kernel[np.ix_(inside, inside)])
        small = np.zeros((int(seen.sum()), 0)) if disturbances is None else disturbances[seen]
        with_effects = np.column_stack([gaussian.shared_jacobian, small, by_effects * width])
        gaussian = replace(gaussian, shared_jacobian=with_effects)
        white = gaussian.whiten(np.column_stack([jacobian, model.seen_value - gaussian.mean]))
        return white[:, :-1].T @ white[:, -1], prior - white[:, :-1].T @ white[:, :-1]

    mean, covariance = projected(given)
    if is_corrected:  # with the correction that the file has, the noise tells the gain as ever
        noise = {i for i in given if model.blocks[i].measurement is NOISE}
        covariance = projected({i: kernel for i, kernel in given.items() if i not in noise})[1]
    stated = np.array([c.index < len(effects) for c in coords], bool)
    mean[at_effects[stated]] = 0.0  # the file states them at their best values
    if np.any(np.abs(mean[at_effects[~stated]]) > width[~stated]):  # it stands in for something else
        mean[at_effects[~stated]] = 0.0
    moves = _from_first(model.noise, camera, gain_db)
    for i, name in enumerate(names):
        if name.startswith("curve:") or (is_corrected and (name in ("gain", "read") or name.startswith("read:"))):
            mean[i] = 0.0  # the file's curves, and its correction of the noise, have taken it up
        mean[i] += moves.get(name, 0.0)
    return ModelPosterior.of(_first(model.noise), names, mean, covariance)


def lasting_means(
    model: MeasurementModel, effects: Sequence[Effect], discrepancies: Mapping[int, FloatArray]
) -> dict[str, float]:
    """Posterior means of the nuisance parameters that stay, and of the patches' reflectances, with other effects."""
    return lasting_means_of(model, effects, model.weighted_residual(effects, discrepancies))


def lasting_means_of(model: MeasurementModel, effects: Sequence[Effect], weighted: FloatArray) -> dict[str, float]:
    """Return the same, given the weighted residual C^-1 (y - m), (n,)."""
    found = {
        name: float(column @ weighted)
        for name, column in model.nuisance_jacobian(effects).items()
        if name in LASTING or name.startswith(LASTING_PREFIXES)
    }
    names, by_patches, prior = _patches(model)
    return found | dict(zip(names, (prior @ (by_patches.T @ weighted)).tolist(), strict=True))


def _first(noise: NoiseFigures) -> FirstEstimates:
    return FirstEstimates(
        dark_temperature_c=noise.dark_c,
        read_noise_dn=noise.read_dn,
        code_step_dn=noise.step_dn,
        black_level_std_dn=noise.black_std,
        dark_current_std_dn_per_s=noise.dark_std,
        level_jitter_dn=noise.jitter_dn,
        lamp_jitter=noise.jitter_lamp,
    )


def _from_first(noise: NoiseFigures, camera: CameraModel, gain_db: float) -> dict[str, float]:
    """Return what the first estimates differ by from what `camera` states, in prior standard deviations, by the
    nuisance parameter's name."""
    gain = gain_dn_per_e(camera, gain_db)
    return {
        "gain": (noise.gain / gain - 1.0) / GAIN_STD,
        "black": (noise.black - camera.black_level_dn) / noise.black_std,
        "dark": (noise.dark_dn_per_s - camera.dark_current_e_per_s * gain) / noise.dark_std,
    }


def with_unnamed(effects: Sequence[Effect], posterior: ModelPosterior) -> tuple[Effect, ...]:
    """Return the effects, and those that nobody named whose sizes a posterior knows, at none."""
    there = {e.name for e in effects}
    more = dict.fromkeys(name.partition(".")[0] for name in posterior.names if "." in name)
    return (*effects, *(library()[name]() for name in more if name in library() and name not in there))


def coordinate_name(effects: Sequence[Effect], coordinate: EffectCoordinate) -> str:
    """Return how a posterior calls the parameter of an effect."""
    return f"{effects[coordinate.index].name}.{coordinate.name}"


def effect_jacobian(
    model: MeasurementModel, effects: Sequence[Effect], coords: Sequence[EffectCoordinate]
) -> FloatArray:
    """Derivatives (n, p) of the predicted numbers by the coordinates of the effects' parameters, by differences within
    the bounds."""
    columns = [np.zeros((len(model.value), 0))]
    for c in coords:
        value = float(getattr(effects[c.index], c.name))
        u, (low, high) = c.to_u(value), c.bounds
        step = max(STEP * c.typical(value), c.quantity.smooth_over)
        ends = np.clip([u - step, u + step], low, high)
        below, above = (model.mean(moved(effects, [c], np.array([end]))) for end in ends)
        columns.append(((above - below) / (ends[1] - ends[0]))[:, None])
    return np.column_stack(columns)


def _patches(model: MeasurementModel) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Names (q,) of the chart's reflectances, the Jacobian (n, q) by their relative errors, and the prior covariance
    (q, q) of these."""
    for block, at in zip(model.blocks, model.slices, strict=True):
        if block.measurement is CHART:
            key = [f"{PATCH}{label.condition}:{label.channel}" for label in block.labels]
            first = {name: i for i, name in reversed(list(enumerate(key)))}
            jacobian = np.zeros((len(model.value), len(first)))
            for row, name in enumerate(key):
                jacobian[at.start + row, list(first).index(name)] = block.scale[row]
            rows = list(first.values())
            names, channel = (np.array([getattr(block.labels[i], of) for i in rows]) for of in ("condition", "channel"))
            signal = block.scale[rows]
            return tuple(first), jacobian, reflectance_covariance(names, channel, signal) / np.outer(signal, signal)
    return (), np.zeros((len(model.value), 0)), np.zeros((0, 0))
