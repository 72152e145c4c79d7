"""The improved model: the camera with what is named, what the used captures say of its parameters, and its rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.evidence.causes import Cause
from lab.diagnose.evidence.side_table import SideTable, posterior_means, weighted_residual
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
from lab.diagnose.outcome.model_posterior import lasting_means_of, model_posterior
from lab.diagnose.outcome.next_capture import NOTHING, WITH
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import camera_model, remarks_on_values
from lab.formats.model_posterior import NameInDoubt, RivalModel, StoredEffect
from lab.formats.results import FitResult
from lab.formats.results.diagnosis import IN_CURVES
from lab.inference.model import scaled_columns
from lab.inference.posterior import LIKELIER
from lab.inference.search import FittedSet
from lab.observables.flats.stated_light import most_frequent_gain_db
from lab.observables.spectra.curves import freed_curve
from sim.effects.base import Effect
from sim.spectrum import FloatArray

#: Groups of small physics that a factor on a stage of the camera can stand for.
STAGES: dict[str, Applied] = {
    "transfer": "transfer",
    "field": "illumination",
    "spectral": "sensitivity",
    "response": "response",
    "shot noise": "noise",
}
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


def improve(reading: SideTable, fit: FitResult | None, baseline: CameraFile | None, named: Sequence[Cause]) -> Improved:
    """Return the camera with the named effects, and a family's likeliest law, at the mode of their set; its sensitivity
    curves at the posterior mean of their nuisance parameters; and a factor for each unlisted group that a stage can
    hold. Noise and levels are the fit's where there is one; `fit` is of the used captures."""
    laws = frozenset(cause.effect.name for cause in named)
    found = reading.fit_of(laws) or _likeliest_with(reading, laws)
    effects = tuple(e for e in reading.effects_of(found.state) if e.name in laws)
    unlisted = frozenset(
        reading.table.groups.index(f.name)
        for f in reading.posterior.findings
        if f.kind == "unlisted" and f.probability >= LIKELIER
    )
    tau = found.likeliest.scales.mode(unlisted)
    disturbances = scaled_columns(reading.problem.groups, tau, len(reading.used.value))
    camera, corrections = _camera(reading, fit, baseline, effects, unlisted, disturbances)
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
    unlisted: frozenset[int],
    disturbances: FloatArray,
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
    by_group = _changes(reading, effects, disturbances)
    jacobian = model.nuisance_jacobian(effects)
    moved = sum((estimates[n] * c for n, c in jacobian.items()), np.zeros(len(model.value)))
    stated = model.mean(effects)
    for g in sorted(unlisted):
        name = reading.problem.groups[g].name
        kind = STAGES.get(name)
        index = None if kind is None else _block_of(reading, by_group[g], kind)
        if kind is None or index is None:
            said = f"{name}: no correction in the improved model; it has no place for one there"
            corrections.append(Correction(name, None, said))
            continue
        block, at = model.blocks[index], model.slices[index]
        if kind == "noise":  # the camera keeps its gain: the correction holds what the fit moved that by, too
            x, factor, each = factor_along(block, (moved + change)[at], stated[at])
        else:
            x, factor, each = factor_along(block, by_group[g][at], (stated + moved)[at])
        if kind == "sensitivity":
            for channel in each.keys() & curves.keys():
                curves[channel] = multiplied_curve(curves[channel], *each[channel])
            said = f"{name}: {IN_CURVES}, by wavelength and channel"
        else:
            acting.append(correction_on(kind, block, x, factor, camera))
            said = f"{name}: a factor on the {kind}"
        corrections.append(Correction(name, kind, said))
    unknown = "" if model.gain_is_known else ", conversion gain unknown: electrons of 1 DN/e are DN"
    title = f"{reading.recordings.manifest.name} {side}{unknown}".strip()
    remarks = () if taken else remarks_on_values(reading.recordings.camera(side), of_side, camera)
    improved = camera.model_copy(update={"quantum_efficiency": curves})
    return CameraFile(title, improved, tuple(acting), remarks=remarks), tuple(corrections)


def _likeliest_with(reading: SideTable, laws: frozenset[str]) -> FittedSet:
    """Return the likeliest refitted set that holds all of these effects, else the empty one."""
    rows = [row for row in reading.table.rows if row.refitted and laws <= row.members]
    return reading.table.fits[rows[0].members if rows else frozenset[str]()]


def _changes(reading: SideTable, effects: tuple[Effect, ...], disturbances: FloatArray) -> list[FloatArray]:
    """Return the posterior mean change (n,) of the used numbers by each group of small physics."""
    weighted = weighted_residual(reading.used, effects, disturbances)
    ends = np.cumsum([g.columns.shape[1] for g in reading.problem.groups])
    found = []
    for group, end in zip(reading.problem.groups, ends, strict=True):
        own = disturbances[:, end - group.columns.shape[1] : end]
        found.append(own @ (own.T @ weighted))
    return found


def _block_of(reading: SideTable, change: FloatArray, kind: Applied) -> int | None:
    """Return the block along whose axis a factor on a stage can act, the one that a change shows most in."""
    model = reading.used
    size = {
        k: float(np.sum(np.square(change[at]) / np.diag(block.covariance)))
        for k, (block, at) in enumerate(zip(model.blocks, model.slices, strict=True))
        if place_for(block) == kind
    }
    return max(size, key=lambda k: size[k], default=None)


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
