"""One side's diagnosis: the chain of `decide.py` on its evidence, and what is told of it. What is told can be sent between
processes; evidence, which holds functions, can't."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lab.diagnose.inference.bootstrap import healthy_draws, image_threshold
from lab.diagnose.inference.decide import FALSE_ALARM_RATE, Candidate, Verdict, decide
from lab.diagnose.inference.evidence import Evidence
from lab.diagnose.inference.locate import describe
from lab.diagnose.measurements.blocks import evidence_of
from lab.diagnose.measurements.summaries import Block
from lab.diagnose.outcome.improved import Correction, improved_model
from lab.diagnose.outcome.looked_at import measurement_fits, places, visibility
from lab.diagnose.outcome.next_capture import Proposal, proposals
from lab.diagnose.outcome.pictures import residual_pictures
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    FitResult,
    HeldOut,
    MeasurementFit,
    Mismatch,
    Place,
    ResidualCurve,
    ResidualPicture,
    Skipped,
    Unexplained,
    Visibility,
)
from sim.camera import Side
from sim.effects.base import Effect

#: Called with what is being done.
Report = Callable[[str], None]
SEED = 1288  # of the bootstrap behind the threshold: the same recordings give the same diagnosis


@dataclass(frozen=True)
class Named:
    """A named effect, and the measurements in which its change stands out of the noise."""

    candidate: Candidate
    shown_in: tuple[str, ...]


@dataclass(frozen=True)
class SideFindings:
    """What one side shows."""

    side: Side
    skipped: tuple[Skipped, ...]
    is_judged: bool = False  # whether anything could be looked at
    threshold: float | None = None  # None: no effect acts on what was looked at
    mismatches: tuple[Mismatch, ...] = ()
    named: tuple[Named, ...] = ()
    abstained: tuple[Candidate, ...] = ()
    unexplained: tuple[Unexplained, ...] = ()
    held_out: HeldOut | None = None
    curves: tuple[ResidualCurve, ...] = ()
    improved: CameraFile | None = None  # the model with what was found
    proposals: tuple[Proposal, ...] = ()  # what to capture next
    places: tuple[Place, ...] = ()
    measurements: tuple[MeasurementFit, ...] = ()
    visibility: tuple[Visibility, ...] = ()
    pictures: tuple[ResidualPicture, ...] = ()


def diagnose_side(
    recordings: RecordingSet,
    side: Side,
    fit: FitResult | None,
    baseline: CameraFile | None,
    report: Report,
    *,
    pictures: bool = False,
    bootstrap: int = 0,
) -> SideFindings:
    """Everything that is told of one side. `pictures`: residual pictures, too, which take the forward model some seconds.
    `bootstrap`: healthy recording sets that are drawn frame by frame for the threshold, each as long as summarising takes."""
    report("summarising the recordings")
    evidence, skipped = evidence_of(recordings, side, fit, baseline)
    if evidence is None:
        return SideFindings(side, skipped)
    rng = np.random.default_rng(SEED)
    least = 0.0
    if bootstrap:
        report(f"drawing {bootstrap} healthy cameras")
        draws = healthy_draws(recordings, side, evidence, bootstrap, rng, fit, baseline)
        least = image_threshold(draws, FALSE_ALARM_RATE)
    report("scoring the effects")
    verdict = decide(evidence, rng, report, least_threshold=least)
    report("looking for the next capture")
    improved, corrections = improved_model(recordings, side, fit, baseline, evidence, verdict.effects, verdict.unknown)
    return SideFindings(
        side=side,
        skipped=skipped,
        is_judged=True,
        threshold=verdict.threshold if np.isfinite(verdict.threshold) else None,
        mismatches=tuple(_mismatches(side, verdict)),
        named=tuple(Named(c, _shown_in(verdict, c)) for c in verdict.named),
        abstained=verdict.abstained,
        unexplained=tuple(_unexplained(side, verdict, corrections)),
        held_out=_held_out(verdict),
        curves=tuple(_curves(side, verdict)),
        improved=improved,
        proposals=proposals(recordings, side, verdict),
        places=tuple(places(side, verdict)),
        measurements=tuple(measurement_fits(side, verdict)),
        visibility=tuple(visibility(side, verdict)),
        pictures=tuple(residual_pictures(recordings, side, evidence, improved)) if pictures else (),
    )


def _mismatches(side: Side, verdict: Verdict) -> list[Mismatch]:
    """The most significant slice of every measurement; where only an effect's score tells, the measurement that shows it most."""
    evidence = verdict.evidence
    baseline = evidence.gaussian()
    found, seen = [], set()
    for part in verdict.before:
        if part.block.measurement in seen:
            continue
        seen.add(part.block.measurement)
        where, captures = describe(evidence, baseline, part)
        found.append(
            Mismatch(
                side=side,
                measurement=part.block.measurement,
                axis=part.axis,
                where=where,
                significance_sigma=round(part.significance_sigma, 2),
                captures=captures,
            )
        )
    for candidate in (*verdict.named, *verdict.abstained):
        touched = [b for b in evidence.blocks if b.touched_by(type(candidate.effect))]
        if touched and not any(b.measurement in seen for b in touched):
            block = max(touched, key=lambda b: _pull(evidence, verdict, candidate.effect, b))
            seen.add(block.measurement)
            at = evidence.slices[evidence.blocks.index(block)]
            found.append(
                Mismatch(
                    side=side,
                    measurement=block.measurement,
                    axis=block.axis,
                    where=f"along the whole axis, as {candidate.effect.name}",
                    significance_sigma=round(float(np.sqrt(max(2.0 * candidate.gain, 0.0))), 2),
                    captures=evidence.captures(False, _mask(evidence, at)),
                )
            )
    return found


def _mask(evidence: Evidence, at: slice) -> np.ndarray:
    mask = np.zeros(len(evidence.value), bool)
    mask[at] = True
    return mask


def _pull(evidence: Evidence, verdict: Verdict, effect: Effect, block: Block) -> float:
    others = tuple(e for e in verdict.effects if e.name != effect.name)
    return evidence.shown(effect, others, evidence.blocks.index(block))


def _shown_in(verdict: Verdict, candidate: Candidate) -> tuple[str, ...]:
    """Measurements in which the effect's change stands out of the noise."""
    evidence = verdict.evidence
    pulls = {
        b.measurement: _pull(evidence, verdict, candidate.effect, b)
        for b in evidence.blocks
        if b.touched_by(type(candidate.effect))
    }
    strongest = max(pulls.values(), default=0.0)
    strong = tuple(m for m, p in pulls.items() if p > 25.0 and p > 0.02 * strongest)
    return strong or (max(pulls, key=lambda m: pulls[m]),)


def _unexplained(side: Side, verdict: Verdict, corrections: Sequence[Correction]) -> list[Unexplained]:
    evidence = verdict.evidence
    model = evidence.gaussian(verdict.effects)
    found = []
    for gap, correction in zip(verdict.unknown, corrections, strict=True):
        block, at = evidence.blocks[gap.index], evidence.slices[gap.index]
        part = next((s for s in verdict.after if s.block is block), None)
        index = np.arange(at.start, at.stop)[evidence.seen[at]]
        only = np.ix_(index, index)
        residual = (evidence.value - model.mean)[index]
        before = float(residual @ np.linalg.solve(model.covariance[only], residual))
        after = float(residual @ np.linalg.solve(model.plus(gap.index, gap.kernel).covariance[only], residual))
        where = describe(evidence, model, part)[0] if part is not None else "along the whole axis"
        near = [c for c in verdict.abstained if block.touched_by(type(c.effect))]
        families = [
            f"{c.effect.name} ({100 * c.probability:.0f} %)"
            + "".join(f", {n} ({100 * p:.0f} %)" for n, p in c.rivals[:3])
            for c in near
        ]
        family = (
            f"; nearest of the library, none of them likely enough to be named: {'; '.join(families)}"
            if families
            else ""
        )
        remarked = max((c for c in near if c.remark), key=lambda c: c.gain, default=None)
        found.append(
            Unexplained(
                side=side,
                measurement=block.measurement,
                axis=part.axis if part is not None else block.axis,
                where=where,
                shape=f"smooth over {gap.reach:.3g} {block.unit}, {gap.kinship}, of relative size {gap.amplitude:.2g}{family}"
                if gap.gain > 0
                else f"irregular: no smooth process describes it{family}",
                significance_sigma=round(part.significance_sigma, 2) if part is not None else 0.0,
                chi2_before=before,
                chi2_after=after,
                n=len(index),
                correction=correction.said,
                check=f"The {side} camera looks {remarked.remark}: check what is stated of both."
                if remarked is not None
                else "",
            )
        )
    return found


def _held_out(verdict: Verdict) -> HeldOut | None:
    """Over the measurements that something was added for, by a name or without; over all where nothing was, or nothing is held out."""
    evidence, effects, processes = verdict.evidence, verdict.effects, verdict.processes
    added = [evidence.touched(type(e)) for e in effects] + [_mask(evidence, evidence.slices[i]) for i in processes]
    where = np.any(added, axis=0) if added else None
    if where is not None and evidence.seen[where].all():
        where = None
    before, n = evidence.held_out((), where)
    after, _ = evidence.held_out(effects, where, processes)
    return HeldOut(captures=evidence.captures(True, where), chi2_before=before, chi2_after=after, n=n) if n else None


def _curves(side: Side, verdict: Verdict) -> list[ResidualCurve]:
    evidence = verdict.evidence
    before, after = evidence.levelled(), evidence.levelled(verdict.effects, verdict.processes)
    found = []
    for block, at in zip(evidence.blocks, evidence.slices, strict=True):
        std = np.sqrt(np.diag(block.covariance))
        groups: dict[tuple[str, str, bool], list[int]] = {}
        for i, label in enumerate(block.labels):
            condition = label.condition if block.conditions else ""
            groups.setdefault((condition, label.channel, label.held_out), []).append(i)
        for (condition, channel, held_out), members in groups.items():
            order = sorted(members, key=lambda i: block.labels[i].x)
            found.append(
                ResidualCurve(
                    side=side,
                    measurement=block.measurement,
                    label=condition or block.measurement,
                    channel=channel,
                    axis=block.places or f"{block.axis.replace('_', ' ')}, {block.unit}",
                    names=tuple(block.labels[i].condition for i in order) if block.places else (),
                    x=tuple(block.labels[i].x for i in order),
                    measured=tuple(float(block.value[i]) for i in order),
                    measured_std=tuple(float(std[i]) for i in order),
                    before=tuple(float(before[at][i]) for i in order),
                    after=tuple(float(after[at][i]) for i in order),
                    held_out=held_out,
                )
            )
    return found
