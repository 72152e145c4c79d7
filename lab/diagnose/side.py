"""The diagnosis of one side: its metadata, its measurement model, the decision (`inference/decide.py`), and the
findings.

`SideFindings` can be sent between processes; a measurement model, which holds functions, can't.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lab.capture_kinds.base import Equipment
from lab.diagnose.discovery import Superseded, discover, law_of, superseded, told
from lab.diagnose.inference.bootstrap import healthy_draws, image_threshold
from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import size_covariance
from lab.diagnose.inference.side_model import dataset_of, measurement_model
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.metadata import misstatements, unchecked
from lab.diagnose.metadata.stated_light import impossible_efficiency, misstated_light
from lab.diagnose.outcome.corrections import with_laws
from lab.diagnose.outcome.determined import combinations
from lab.diagnose.outcome.goodness_of_fit import (
    detectability,
    held_out,
    measurement_fits,
    places,
    residual_curves,
    side_models,
)
from lab.diagnose.outcome.improved_model import improved_model
from lab.diagnose.outcome.mismatches import (
    board_departure,
    corrected_by_laws,
    described,
    family_corrections,
    in_light_of_laws,
    left_to_smooth,
    located,
    shown_in,
    unexplained,
    vetoed_names,
)
from lab.diagnose.outcome.names_in_doubt import names_in_doubt
from lab.diagnose.outcome.next_capture import Doubt
from lab.diagnose.outcome.residual_pictures import residual_pictures
from lab.diagnose.outcome.rivals_in_doubt import doubt_of
from lab.diagnose.outcome.settling_capture import settling_sentence
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Combination, DiagnosisLists, FitResult, HeldOut, Mismatch, Skipped
from lab.observables.dataset import Dataset
from lab.observables.flats.linearity import PHOTON_TRANSFER
from lab.workers import Workers
from sim.camera import Side
from sim.effects.base import Effect
from sim.memory import return_freed_memory

#: Called with the current step in words.
Report = Callable[[str], None]
#: Seed of the draws behind the threshold: the same recordings give the same diagnosis.
SEED = 1288
MOST_WITHDRAWN = 2  # rounds in which laws that no effect has may take the place of names


@dataclass(frozen=True)
class NamedCandidate:
    """A named effect or family."""

    candidate: Candidate
    shown_in: tuple[str, ...]  # measurements in which its change exceeds the noise
    corrections: tuple[str, ...] = ()  # corrections of the improved model beside a family's nearest law, in words
    combinations: tuple[Combination, ...] = ()  # determined, of parameters that aren't by themselves


@dataclass(frozen=True)
class SideFindings:
    """The findings on one side.

    lists  what the result lists of this side
    is_judged  whether any measurement is determined
    gain_is_known  whether a conversion gain is stated or measured; else electrons are those of 1 DN/e
    threshold  of an effect's score; None where no effect acts on the measurements
    improved   the improved model
    doubt      rivals that are left, and the captures that would tell them apart
    settling   what to capture for a mismatch without a name, as a sentence
    """

    side: Side
    lists: DiagnosisLists
    is_judged: bool = False
    gain_is_known: bool = True
    threshold: float | None = None
    named: tuple[NamedCandidate, ...] = ()
    abstained: tuple[Candidate, ...] = ()
    held_out: HeldOut | None = None
    improved: CameraFile | None = None
    doubt: Doubt | None = None
    settling: str | None = None


def _measure(
    recordings: RecordingSet, side: Side, fit: FitResult | None, baseline: CameraFile | None
) -> tuple[Dataset, MeasurementModel | None, tuple[Skipped, ...]]:
    """Measure a side and free the frames, as the search looks at none. Returns the dataset, the measurement model (None
    where nothing can be measured), and the measurements that the recordings don't determine."""
    dataset = dataset_of(recordings, side, fit, baseline)
    model, skipped = measurement_model(recordings, side, fit, baseline, dataset)
    skipped = (*skipped, *unchecked(recordings, side))
    for one in (recordings, dataset.recordings):
        one.let_go()
    return_freed_memory()
    return dataset, model, skipped


def diagnose_side(
    recordings: RecordingSet,
    side: Side,
    fit: FitResult | None,
    baseline: CameraFile | None,
    report: Report,
    *,
    policy: DecisionPolicy | None = None,
    pictures: bool = False,
    bootstrap: int = 0,
    workers: Workers | None = None,
    station: Equipment | None = None,
) -> SideFindings:
    """Diagnose one side; arguments as of `lab.diagnose.examine`. Residual pictures take some seconds. Each draw of the
    bootstrap takes as long as summarising the recordings."""
    policy = policy or DecisionPolicy()
    report("checking what is stated")
    given = recordings
    recordings, misstated = misstatements(recordings, side, policy)
    wrong = tuple(one.told(side) for one in misstated)
    if fit is not None and recordings.camera(side).cfa != given.camera(side).cfa:  # its planes were mixed
        fit = fit.model_copy(update={"cameras": {s: c for s, c in fit.cameras.items() if s != side}})
    report("summarising the recordings")
    if recordings is not given:
        given.let_go()
    dataset, model, skipped = _measure(recordings, side, fit, baseline)
    if model is None:
        return SideFindings(side, DiagnosisLists(skipped=skipped, unexplained=wrong))
    rng = np.random.default_rng(SEED)
    least = 0.0
    if bootstrap:
        drawing = f"drawing {bootstrap} healthy cameras"
        report(drawing)
        draws = healthy_draws(
            recordings, side, model, bootstrap, rng, fit, baseline, workers,
            lambda done: report(f"{drawing}: {done} done"),
        )  # fmt: skip
        least = image_threshold(draws, policy.false_alarm_rate)
    report("scoring the effects")
    verdict = decide(model, rng, policy, report, least_threshold=least)
    withdrawn: dict[str, Superseded] = {}
    report("looking for laws that no effect has")
    discovered = discover(dataset, (*model.always, *verdict.effects), policy, verdict)
    for _ in range(MOST_WITHDRAWN):
        lost = superseded(dataset, verdict, discovered, policy)
        if not lost:
            break
        withdrawn |= lost
        names = tuple(name for one in withdrawn.values() for name in one.names)
        verdict = decide(model, rng, policy, report, least_threshold=least, without=names)
        discovered = discover(dataset, (*model.always, *verdict.effects), policy, verdict)
    report("looking for the next capture")
    laws = tuple(law_of(one, dataset) for one in discovered)
    by_laws = described(verdict, discovered, laws, policy)
    smooth = left_to_smooth(verdict, by_laws)
    improved, corrections = improved_model(recordings, side, fit, baseline, model, verdict.effects, smooth)
    corrections = corrected_by_laws(verdict, corrections, by_laws)
    if improved.posterior is not None and verdict.named:
        doubts = names_in_doubt(verdict, policy)
        improved = replace(improved, posterior=improved.posterior.model_copy(update={"doubts": doubts}))
    improved = with_laws(improved, laws)
    fitted = fit.cameras.get(side) if fit is not None else None
    shape = (model.camera.rows, model.camera.cols)
    departure = board_departure(side, fitted.geometry if fitted is not None else None, shape, policy)
    found = located(side, verdict)
    if departure is not None and all(m.measurement != departure.measurement for m in found):
        found.append(Mismatch(**departure.model_dump(include=set(Mismatch.model_fields))))
    left = (
        *wrong,
        *in_light_of_laws(
            recordings, side, verdict, unexplained(recordings, side, verdict, corrections, policy), by_laws
        ),
        *misstated_light(
            side,
            fitted,
            levels_are_judged=any(b.measurement is PHOTON_TRANSFER for b in model.blocks),
        ),
        *impossible_efficiency(side, fitted),
        *(() if departure is None else (departure,)),
    )
    models = side_models(side, verdict.models, policy)
    return SideFindings(
        side=side,
        lists=DiagnosisLists(
            skipped=skipped,
            mismatches=tuple(found),
            unexplained=left,
            vetoed=(*vetoed_names(side, verdict), *(one.told(side, model) for one in withdrawn.values())),
            discovered=told(side, dataset, discovered),
            models=() if models is None else (models,),
            places=tuple(places(side, verdict, policy)),
            measurements=tuple(measurement_fits(side, verdict)),
            visibility=tuple(detectability(side, verdict, policy)),
            pictures=tuple(residual_pictures(recordings, side, model, improved)) if pictures else (),
            curves=tuple(residual_curves(side, verdict)),
        ),
        is_judged=True,
        gain_is_known=model.gain_is_known,
        threshold=verdict.threshold if np.isfinite(verdict.threshold) else None,
        named=tuple(
            NamedCandidate(
                c,
                shown_in(verdict, c, policy),
                family_corrections(verdict, c, corrections, policy),
                _combined_sizes(side, model, verdict.effects, c.effect),
            )
            for c in verdict.named
        ),
        abstained=verdict.abstained,
        held_out=held_out(verdict, laws, by_laws),
        improved=improved,
        doubt=doubt_of(recordings, side, verdict, policy, station),
        settling=settling_sentence(recordings, side, left),
    )


def _combined_sizes(
    side: Side, model: MeasurementModel, effects: tuple[Effect, ...], effect: Effect
) -> tuple[Combination, ...]:
    """Return what the recordings determine of the sizes of one of `effects`, where they can't tell these apart."""
    if effect not in effects:
        return ()
    coords, from_absence, covariance = size_covariance(model, effects, effects.index(effect))
    parameters = [(c.name, c.quantity) for c in coords]
    return combinations(side, parameters, from_absence, covariance, gain_is_known=model.gain_is_known)
