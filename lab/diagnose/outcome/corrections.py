"""Corrections of an improved model for what no effect of the library describes: factors on stages of the chain and on
the sensitivity curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lab.diagnose.inference.measurement_model import form_name
from lab.formats.camera_file import CameraFile
from lab.observables.observable import Observable
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.model_discrepancy import ModelDiscrepancy
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


def nearest_form(effect: Effect, estimates: Mapping[str, float]) -> Effect:
    """Return the effect by that form of its law whose coefficient in `estimates` is nearest to 1, if it is nearer to 1
    than to 0."""
    found = {number: estimates.get(form_name(effect, number), 0.0) for number in range(len(effect.other_forms()))}
    near = min(found, key=lambda number: abs(found[number] - 1.0), default=None)
    return effect if near is None or found[near] < 0.5 else effect.other_forms()[near]


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


def with_laws(improved: CameraFile, laws: Sequence[Effect]) -> CameraFile:
    """Return the improved model with discovered laws; what they add to the dark noise, its read noise loses."""
    noise = [law for law in laws if isinstance(law, EmpiricalLaw) and (law.stage, law.of) == ("signal", "variance")]
    added_e2 = sum(float(np.mean(law.table)) for law in noise)
    read_e = float(np.sqrt(max(improved.camera.read_noise_e**2 - added_e2, 0.0)))
    camera = improved.camera.model_copy(update={"read_noise_e": read_e}) if added_e2 else improved.camera
    return replace(improved, camera=camera, effects=(*improved.effects, *laws))


def scaled_curve(curve: Spectrum, factor: float) -> Spectrum:
    return (
        curve if factor == 1.0 else Spectrum.of(curve.wavelength_nm, np.clip(factor * np.array(curve.value), 0.0, 1.0))
    )


def multiplied_curve(curve: Spectrum, at: FloatArray, factor: FloatArray) -> Spectrum:
    """Return a curve times a factor that is held beyond its ends."""
    grid = np.union1d(np.array(curve.wavelength_nm), at)
    grid = grid[(grid >= curve.wavelength_nm[0]) & (grid <= curve.wavelength_nm[-1])]
    return Spectrum.of(grid, np.clip(curve.at(grid) * np.interp(grid, at, factor), 0.0, 1.0))
