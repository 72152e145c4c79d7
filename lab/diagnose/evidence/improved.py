"""The improved model: the camera with what is named, what the used captures say of its parameters, and its rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.evidence.causes import Cause
from lab.diagnose.evidence.laws import UnnamedLaw
from lab.diagnose.evidence.side_table import SideTable, posterior_means, weighted_residual
from lab.diagnose.outcome.corrections import (
    Correction,
    correction_on,
    factor_along,
    nearest_form,
    place_for,
    scaled_curve,
    with_laws,
)
from lab.diagnose.outcome.model_posterior import lasting_means_of, model_posterior
from lab.diagnose.outcome.next_capture import NOTHING, WITH
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model, remarks_on_values
from lab.formats.model_posterior import NameInDoubt, RivalModel, StoredEffect
from lab.formats.results import FitResult
from lab.inference.model import scaled_columns
from lab.inference.search import FittedSet
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.spectra.curves import freed_curve
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.spectrum import FloatArray

#: The group whose law is a factor on the noise: it holds what the fit moved the gain by, too, as the camera keeps its.
SHOT_NOISE = "shot noise"
#: Least probability of a rival that a prediction is made for, and the most of them.
LEAST_RIVAL, MOST_RIVALS = 0.005, 4


@dataclass(frozen=True)
class Improved:
    """The set of what is named at its mode, the groups that are unlisted beside it, the camera, and what stands in it
    for these groups."""

    fit: FittedSet
    unlisted: frozenset[int]
    effects: tuple[Effect, ...]
    camera: CameraFile
    corrections: tuple[Correction, ...]


def improve(
    reading: SideTable,
    fit: FitResult | None,
    baseline: CameraFile | None,
    named: Sequence[Cause],
    without_name: Sequence[UnnamedLaw] = (),
) -> Improved:
    """Return the camera with the named effects, and a family's likeliest law, at the mode of their set; its sensitivity
    curves at the posterior mean of their nuisance parameters; and the laws without a name that a state of the camera
    has. Noise and levels are the fit's where there is one; `fit` is of the used captures."""
    laws = frozenset(cause.effect.name for cause in named)
    unlisted = frozenset(law.group for law in without_name)
    found = (reading.fit_of(laws) or _likeliest_with(reading, laws)).given(unlisted)
    effects = tuple(e for e in reading.effects_of(found.state) if e.name in laws)
    tau = found.likeliest.scales.mode(unlisted)
    disturbances = scaled_columns(reading.problem.groups, tau, len(reading.used.value))
    camera, corrections = _camera(reading, fit, baseline, effects, disturbances, without_name)
    gain_db = most_frequent_gain_db(reading.recordings.captures(FlatCapture, reading.side))
    is_corrected = any(one.kind == "noise" for one in corrections)
    posterior = model_posterior(
        reading.used, effects, camera.camera, None, gain_db, is_corrected, disturbances=disturbances
    )
    if posterior is not None and effects:
        doubts = tuple(_in_doubt(reading, effects, disturbances, cause) for cause in named)
        posterior = posterior.model_copy(update={"doubts": doubts})
    return Improved(found, unlisted, effects, replace(camera, posterior=posterior), corrections)


def _camera(
    reading: SideTable,
    fit: FitResult | None,
    baseline: CameraFile | None,
    effects: tuple[Effect, ...],
    disturbances: FloatArray,
    without_name: Sequence[UnnamedLaw],
) -> tuple[CameraFile, tuple[Correction, ...]]:
    """Return the camera with these effects and its corrections, and these in words."""
    side, model = reading.side, reading.used
    taken = baseline.camera if baseline is not None else None
    of_side = fit.cameras.get(side) if fit else None
    camera = taken or camera_model(reading.recordings, side, of_side, maker_curves=True)
    if fit is None and baseline is None:
        camera = model.camera
    estimates, change = posterior_means(model, effects, disturbances)
    # electrons times gain are measured: where the fit has another gain, the curves take up the difference
    share = model.camera.conversion_gain_dn_per_e / camera.conversion_gain_dn_per_e
    curves = {
        channel: scaled_curve(freed, share if freed is not curve else 1.0)
        for channel, curve in camera.quantum_efficiency.items()
        for freed in (freed_curve(curve, channel, estimates),)
    }
    always = baseline.effects if baseline is not None else ()
    acting: list[Effect] = [*always, *(nearest_form(e, estimates) for e in effects)]
    corrections: list[Correction] = []
    laws: list[Effect] = []
    for name in dict.fromkeys(law.told.state for law in without_name):
        mine = [law for law in without_name if law.told.state == name]
        factor = _noise_factor(reading, effects, estimates, change, camera) if name == SHOT_NOISE else None
        own = [law.effect for law in mine if law.effect is not None] if factor is None else [factor]
        laws += own
        indices = " and ".join(dict.fromkeys(law.told.along for law in mine if law.effect is not None))
        said = f"a law by {indices}" if own else "no correction in the improved model; it has no place for one there"
        corrections.append(Correction(name, None if factor is None else "noise", f"{name}: {said}"))
    unknown = "" if model.gain_is_known else ", conversion gain unknown: electrons of 1 DN/e are DN"
    title = f"{reading.recordings.manifest.name} {side}{unknown}".strip()
    remarks = () if taken else remarks_on_values(reading.recordings.camera(side), of_side, camera)
    improved = camera.model_copy(update={"quantum_efficiency": curves})
    return with_laws(CameraFile(title, improved, tuple(acting), remarks=remarks), laws), tuple(corrections)


def _likeliest_with(reading: SideTable, laws: frozenset[str]) -> FittedSet:
    """Return the likeliest refitted set that holds all of these effects, else the empty one."""
    rows = [row for row in reading.table.rows if row.refitted and laws <= row.members]
    return reading.table.fits[rows[0].members if rows else frozenset[str]()]


def _noise_factor(
    reading: SideTable,
    effects: tuple[Effect, ...],
    estimates: Mapping[str, float],
    change: FloatArray,
    camera: CameraModel,
) -> Effect | None:
    """Return the factor on the noise of flats by level; None where no flats show it. The camera keeps its gain: the
    factor holds what the fit moved that by, too."""
    model = reading.used
    size = {
        k: float(np.sum(np.square(change[at]) / np.diag(block.covariance)))
        for k, (block, at) in enumerate(zip(model.blocks, model.slices, strict=True))
        if place_for(block) == "noise"
    }
    if not size:
        return None
    index = max(size, key=lambda k: size[k])
    block, at = model.blocks[index], model.slices[index]
    jacobian = model.nuisance_jacobian(effects)
    moved = sum((estimates[n] * c for n, c in jacobian.items()), np.zeros(len(model.value)))
    x, factor, _ = factor_along(block, (moved + change)[at], model.mean(effects)[at])
    return correction_on("noise", block, x, factor, camera)


def _in_doubt(reading: SideTable, effects: tuple[Effect, ...], disturbances: FloatArray, cause: Cause) -> NameInDoubt:
    """Return a name with the camera without it, and with what stands in its place in the sets that haven't got it."""
    named = _lasting(reading, effects, disturbances)
    law = cause.effect.name

    def rival(name: str, probability: float, acting: tuple[Effect, ...]) -> RivalModel:
        means = _lasting(reading, acting, disturbances)
        shift = {key: float(f"{means.get(key, 0.0) - value:.6g}") for key, value in named.items()}
        return RivalModel(
            name=name, probability=probability, effects=tuple(map(StoredEffect.of, acting)), shift=shift
        )  # fmt: skip

    rivals = [rival("", _without_anything(cause), tuple(e for e in effects if e.name != law))]
    for members, probability in reading.sets.items():
        fit = reading.table.fits.get(members)
        instead = sorted(members - {e.name for e in effects})
        if law in members or fit is None or not instead or probability < LEAST_RIVAL or len(rivals) > MOST_RIVALS:
            continue
        rivals.append(rival(WITH.join(instead), probability, reading.effects_of(fit.state)))
    own = dict(cause.members).get(law, cause.probability)
    return NameInDoubt(
        effect=law, told=cause.name, probability=own, named=tuple(e.name for e in effects), rivals=tuple(rivals)
    )


def _without_anything(cause: Cause) -> float:
    return float(dict(cause.rivals).get(NOTHING, 0.0))


def _lasting(reading: SideTable, effects: tuple[Effect, ...], disturbances: FloatArray) -> Mapping[str, float]:
    return lasting_means_of(reading.used, effects, weighted_residual(reading.used, effects, disturbances))
