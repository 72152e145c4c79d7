"""The diagnosis of one side by the evidence: measure, search, read the table.

`EvidenceFindings` can be sent between processes; a reading, which holds functions, can't."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from lab.capture_kinds.base import Equipment
from lab.diagnose.evidence.causes import Cause, causes_of
from lab.diagnose.evidence.doubt import doubt_of
from lab.diagnose.evidence.improved import Improved, improve
from lab.diagnose.evidence.laws import laws_of
from lab.diagnose.evidence.places import (
    contradicted,
    detectability,
    examine_places,
    examined,
    held_out_of,
    measurement_fits,
    mismatches_of,
    residual_curves,
    unlisted_of,
    unresolved,
)
from lab.diagnose.evidence.side_table import SideTable, predict_by_baseline
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.metadata import unchecked
from lab.diagnose.metadata.stated_light import impossible_efficiency, misstated_light
from lab.diagnose.outcome.mismatches import board_departure
from lab.diagnose.outcome.next_capture import Doubt
from lab.diagnose.outcome.residual_pictures import residual_pictures
from lab.diagnose.outcome.settling_capture import settling_sentence
from lab.diagnose.policy import DEFAULT_POLICY
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    DiagnosisLists,
    EffectSet,
    FitResult,
    HeldOut,
    IncludedEffect,
    Mismatch,
    SideModels,
    Skipped,
    Unexplained,
)
from lab.inference.check import check_held_out, passes
from lab.inference.posterior import NAMED, Verdict, healthy_nothing, read_table, verdict
from lab.inference.restated import Searched, examine_side
from lab.observables.flats.linearity import PHOTON_TRANSFER
from sim.camera import Side

#: Share of healthy cameras that are reported with a mismatch, and draws behind the threshold of p(nothing).
FALSE_ALARM_RATE, DRAWS = 0.01, 100
#: Probability that the listed sets hold together, and the most of them.
SHARE, MOST_SETS = 0.95, 40
#: Sets of less probability are left out of what sides tell each other.
LEAST_ROW = 1e-6
#: Seed of the draws: the same recordings give the same diagnosis.
SEED = 1288

#: Called with the current step in words.
Report = Callable[[str], None]
#: Fits the captures that aren't held out.
Refit = Callable[[RecordingSet], FitResult]


@dataclass(frozen=True)
class SetRow:
    """A set of hypotheses, the states that have unlisted physics beside it, and its probability by one side."""

    members: frozenset[str]
    unlisted: frozenset[str]
    probability: float


@dataclass(frozen=True)
class EvidenceFindings:
    """The findings on one side.

    lists : what the result lists of this side
    is_judged : whether any measurement is determined
    gain_is_known : whether a conversion gain is stated or measured; else electrons are those of 1 DN/e
    said : the side's verdict by itself
    boards_depart : whether corners depart from the fitted geometry by more than their noise
    check_passed : whether no observable of the held-out captures contradicts the prediction
    nothing, least_nothing : probability that no effect and nothing unlisted acts, and the value that
        `FALSE_ALARM_RATE` of the cameras without any fall short of
    calm : whether every state is less likely than not to have unlisted physics
    is_undecided : whether more than 1 % of the probability belongs to sets that had to be refitted and never were
    causes : effects and families that are probable enough to be described, likeliest first
    inclusion : prior and posterior inclusion probability of every effect and family, by name
    rows : the sets of the table with their probabilities: members, states with unlisted physics
    metadata : statements that the recordings contradict
    improved : the improved model
    doubt : the sets that remain, and the captures that would separate them
    settling : what to capture for a mismatch without a name, as a sentence
    """

    side: Side
    lists: DiagnosisLists
    is_judged: bool = False
    gain_is_known: bool = True
    said: Verdict = "unexplained"
    boards_depart: bool = False
    check_passed: bool = True
    nothing: float = 0.0
    least_nothing: float = 0.0
    calm: bool = True
    is_undecided: bool = False
    causes: tuple[Cause, ...] = ()
    inclusion: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rows: tuple[SetRow, ...] = ()
    metadata: tuple[Unexplained, ...] = ()
    held_out: HeldOut | None = None
    improved: CameraFile | None = None
    doubt: Doubt | None = None
    settling: str | None = None


def diagnose_side_by_evidence(
    recordings: RecordingSet,
    side: Side,
    refit: Refit | None,
    baseline: CameraFile | None,
    report: Report,
    *,
    pictures: bool = False,
    station: Equipment | None = None,
) -> EvidenceFindings:
    """Diagnose one side by the table of sets. `refit` fits the captures that aren't held out; None: the data sheet is
    the baseline. Other arguments as of `lab.diagnose.examine`."""
    report("summarising the recordings")
    fits: list[FitResult] = []

    def fitted(used: RecordingSet) -> FitResult:
        assert refit is not None
        fits.append(refit(used))
        return fits[-1]

    examined = examine_side(recordings, side, None if refit is None else fitted, baseline, report)
    measured, searched = examined.recordings, examined.searched
    metadata = tuple(one.told(side) for one in examined.wrong)
    remarks = tuple(unchecked(measured, side))
    fit = fits[-1] if fits else None
    if searched is None:
        _, lacking = measurement_model(measured, side, fit, baseline)
        lists = DiagnosisLists(skipped=(*lacking, *remarks), unexplained=metadata)
        return EvidenceFindings(side, lists, metadata=metadata)
    report("reading the table")
    reading = _read(measured, side, searched)
    return _findings(reading, fit, baseline, metadata, remarks, pictures=pictures, station=station)


def _read(recordings: RecordingSet, side: Side, searched: Searched) -> SideTable:
    problem, search, table = searched.problem, searched.search, searched.table
    return SideTable(
        recordings=recordings,
        side=side,
        problem=problem,
        search=search,
        table=table,
        posterior=read_table(table, search.hypotheses),
        checked=check_held_out(problem, search, table),
        unchanged=predict_by_baseline(problem),
        least_nothing=healthy_nothing(search, DRAWS, FALSE_ALARM_RATE, np.random.default_rng(SEED)),
    )


def _findings(
    reading: SideTable,
    fit: FitResult | None,
    baseline: CameraFile | None,
    metadata: tuple[Unexplained, ...],
    remarks: tuple[Skipped, ...],
    *,
    pictures: bool,
    station: Equipment | None,
) -> EvidenceFindings:
    side, posterior = reading.side, reading.posterior
    causes = causes_of(reading)
    named = [cause for cause in causes if cause.probability >= NAMED]
    passed = passes(reading.checked)
    said = verdict(posterior, reading.least_nothing, passed)
    laws = laws_of(reading)
    improved = improve(reading, fit, baseline, named, laws)
    after = reading.gaussian(improved.fit, improved.unlisted)
    before = examine_places(reading.used, reading.baseline)
    departs = said != "no_mismatch"
    mismatches = mismatches_of(reading, before, named) if departs else []
    unlisted, without_name = unlisted_of(reading)
    left = [*_corrected(without_name, improved), *contradicted(reading)]
    if departs and not named and not left:
        left += unresolved(reading, before, mismatches)
    fitted = fit.cameras.get(side) if fit is not None else None
    has_levels = any(b.measurement is PHOTON_TRANSFER for b in reading.used.blocks)
    shape = (reading.used.camera.rows, reading.used.camera.cols)
    departure = board_departure(side, fitted.geometry if fitted is not None else None, shape, DEFAULT_POLICY)
    if departure is not None:
        left.append(departure)
        mismatches.append(Mismatch(**departure.model_dump(include=set(Mismatch.model_fields))))
    stated = (
        *metadata,
        *misstated_light(side, fitted, levels_are_judged=has_levels),
        *impossible_efficiency(side, fitted),
    )
    return EvidenceFindings(
        side=side,
        lists=DiagnosisLists(
            skipped=(*reading.problem.skipped, *remarks),
            mismatches=tuple(mismatches),
            unexplained=(*stated, *left),
            unlisted=tuple(unlisted),
            discovered=tuple(law.told for law in laws),
            models=(_models(reading),),
            places=tuple(examined(reading, before, after)),
            measurements=tuple(measurement_fits(reading, after)),
            visibility=tuple(detectability(reading)),
            pictures=tuple(residual_pictures(reading.recordings, side, reading.whole, improved.camera))
            if pictures
            else (),
            curves=tuple(residual_curves(reading, improved.fit, improved.unlisted)),
        ),
        is_judged=True,
        gain_is_known=reading.used.gain_is_known,
        said=said,
        boards_depart=departure is not None,
        check_passed=passed,
        nothing=posterior.nothing,
        least_nothing=reading.least_nothing,
        calm=not any(f.kind == "unlisted" and f.probability >= 0.5 for f in posterior.findings),
        is_undecided=posterior.is_undecided,
        causes=causes,
        inclusion=_inclusion(reading),
        rows=tuple(
            SetRow(row.members, frozenset(reading.table.groups[g] for g in row.unlisted), row.probability)
            for row in reading.table.rows
            if row.probability > LEAST_ROW
        ),
        metadata=stated,
        held_out=held_out_of(reading),
        improved=improved.camera,
        doubt=doubt_of(reading, station),
        settling=settling_sentence(reading.recordings, side, (*stated, *left)),
    )


def _corrected(left: list[Unexplained], improved: Improved) -> list[Unexplained]:
    """Return mismatches without a name with what stands in the improved model for them."""
    said = {one.measurement: one.said for one in improved.corrections}
    return [
        item.model_copy(update={"correction": next((text for state, text in said.items() if state in item.shape), "")})
        for item in left
    ]


def _models(reading: SideTable) -> SideModels:
    """Return the table: the fewest sets that hold `SHARE`, each with what is unlisted beside it."""
    table, listed, held = reading.table, list[EffectSet](), 0.0
    for row in table.rows:
        if held >= SHARE or len(listed) == MOST_SETS:
            break
        held += row.probability
        listed.append(
            EffectSet(
                effects=tuple(sorted(row.members)),
                probability=row.probability,
                refitted=row.refitted,
                unlisted=table.states(row.unlisted),
            )
        )
    included = [f for f in reading.posterior.findings if f.kind == "effect" and f.probability >= 0.001]
    return SideModels(
        side=reading.side,
        share=SHARE,
        sets=tuple(listed),
        inclusion=tuple(IncludedEffect(name=f.name, probability=f.probability) for f in included),
        never_refitted=table.left,
        closed_form=table.closed_form,
    )


def _inclusion(reading: SideTable) -> dict[str, tuple[float, float]]:
    prior = reading.inclusion_prior
    families: dict[str, float] = {}
    for name, p in prior.items():
        families[reading.family_of(name)] = families.get(reading.family_of(name), 0.0) + p
    found = {f.name: f.probability for f in reading.posterior.findings if f.kind in ("effect", "family")}
    return {name: (p, found.get(name, 0.0)) for name, p in {**families, **prior}.items()}
