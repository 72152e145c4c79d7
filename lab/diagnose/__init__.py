"""Diagnosis: where recordings and the baseline part, what physics was left out, and what the named effects gain.

`diagnose` runs the chain on every side of a recording set by itself and merges what it finds. See `decide.py` for the chain.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from lab.diagnose.decide import FALSE_ALARM_RATE, Candidate, Verdict, decide
from lab.diagnose.edges import edge_block
from lab.diagnose.evidence import Evidence
from lab.diagnose.locate import describe
from lab.diagnose.patches import chart_block, screen_block
from lab.diagnose.summaries import Block, Study
from lab.diagnose.uniform import dark_block, linearity_block, narrowband_block, shading_block, variance_block
from lab.diagnose.unknown import with_discrepancy
from lab.errors import NotDetermined
from lab.predict import assumptions, camera_model
from lab.recording import RecordingSet
from lab.results import (
    CameraFit,
    DiagnosisResult,
    FitResult,
    HeldOut,
    Mismatch,
    NamedEffect,
    ParameterValue,
    ResidualCurve,
    Rival,
    Skipped,
    Unexplained,
)
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import effects as library

#: Called with what is being done and the share of the work that is done, 0..1.
Progress = Callable[[str, float], None]
SEED = 1288  # of the bootstrap behind the threshold: the same recordings give the same diagnosis
SMALLEST_RIVAL = 0.005
WORKERS = 2  # sides at the same time; each needs about half a GB

#: What is looked at; a block that a recording set doesn't allow is left out with a reason.
BLOCKS: tuple[Callable[[Study], Block], ...] = (
    dark_block, linearity_block, variance_block, shading_block, narrowband_block, chart_block, edge_block, screen_block,
)  # fmt: skip

#: Measurements whose points are numbered, not placed on their axis.
NUMBERED = {"chart": "patch, 0 dark skin .. 23 black", "screen": "number of the pattern and channel"}

#: The capture that tells two effects apart where one depends on a thing and the other doesn't.
SETTLING = {
    "f_number": "the slanted edges again at twice the f-number",
    "wavelength": "slanted edges in narrowband light, at 450 and at 650 nm",
    "orientation": "slanted edges at four orientations, 5, 50, 95 and 140 degrees from the vertical",
    "exposure": "the same captures at a quarter of the exposure and four times the light",
    "level": "the same captures at a quarter of the light",
    "field": "the same captures at the corners of the field",
    "time": "the same captures again, in the reverse order",
}


@dataclass(frozen=True)
class _SideResult:
    side: Side
    verdict: Verdict


def diagnose(
    recordings: RecordingSet, fit: FitResult | None = None, progress: Progress | None = None
) -> DiagnosisResult:
    """Diagnose every side. `fit` gives the geometry and, where the maker states no curves, the sensitivities; None: neither.

    Noise and levels are taken from the recordings anew, as free quantities of the same model. What the recordings don't
    determine is not judged, and stands in `skipped`.
    """
    sides = recordings.sides
    shares = dict.fromkeys(sides, 0.0)
    lock = threading.Lock()

    def work(side: Side) -> tuple[_SideResult | None, list[Skipped]]:
        def report(text: str) -> None:
            with lock:
                shares[side] = 1.0 - 0.8 * (1.0 - shares[side])
                if progress is not None:
                    progress(f"{text} ({side})", sum(shares.values()) / len(sides))

        report("summarising the recordings")
        evidence, skipped = _evidence(recordings, side, fit)
        if evidence is None:
            return None, skipped
        report("scoring the effects")
        return _SideResult(side, decide(evidence, np.random.default_rng(SEED), report)), skipped

    with ThreadPoolExecutor(WORKERS, thread_name_prefix="diagnose") as pool:
        done = list(pool.map(work, sides))
    found = [result for result, _ in done if result is not None]
    skipped = tuple(item for _, items in done for item in items)
    if progress is not None:
        progress("done", 1.0)
    return _merged(recordings.source, found, skipped)


def _evidence(recordings: RecordingSet, side: Side, fit: FitResult | None) -> tuple[Evidence | None, list[Skipped]]:
    camera_fit = fit.cameras.get(side) if fit is not None else None
    camera = camera_model(recordings, side, camera_fit, maker_curves=True)
    skipped = [
        Skipped(step=f"diagnose {a.quantity}", reason=f"neither stated nor fitted; taken as {a.value}", side=side)
        for a in assumptions(recordings.camera(side))
    ]
    study = Study(recordings, side, camera, _saturation_dn(camera_fit))
    blocks = []
    for make in BLOCKS:
        try:
            blocks.append(make(study))
        except NotDetermined as refused:
            skipped.append(Skipped(step=f"diagnose {refused.step}", reason=refused.reason, side=side))
    blocks = [b for b in blocks if any(not label.held_out for label in b.labels)]
    return (Evidence(tuple(blocks), study.camera) if blocks else None), skipped


#: Of the full well: from here on pixels of a noisy level are cut off.
_NEAR_FULL = 0.985


def _saturation_dn(fit: CameraFit | None) -> float | None:
    noise = fit.noise if fit is not None else None
    if noise is None or noise.full_well_e is None or noise.conversion_gain_dn_per_e is None:
        return None
    return (noise.black_level_dn or 0.0) + _NEAR_FULL * noise.full_well_e * noise.conversion_gain_dn_per_e


# --- from verdicts to the result -----------------------------------------------------------------------------------------


def _merged(source: str, found: list[_SideResult], skipped: tuple[Skipped, ...]) -> DiagnosisResult:
    mismatches = [m for r in found for m in _mismatches(r)]
    effects = _named(found)
    unexplained = [u for r in found for u in _unexplained(r)]
    if not effects and not unexplained and not mismatches:
        verdict = "no_mismatch"
    elif effects and not unexplained:
        verdict = "explained"
    elif effects:
        verdict = "partly_explained"
    else:
        verdict = "unexplained"
    held_out = _held_out(found)
    return DiagnosisResult(
        source=source,
        verdict=verdict,  # type: ignore[arg-type]
        mismatches=tuple(mismatches),
        effects=tuple(effects),
        unexplained=tuple(unexplained),
        held_out=held_out,
        next_capture=_next_capture(found, effects),
        threshold=max((r.verdict.threshold for r in found), default=None),
        false_alarm_rate=FALSE_ALARM_RATE if found else None,
        curves=tuple(c for r in found for c in _curves(r)),
        skipped=skipped,
        summary=tuple(_summary(verdict, mismatches, effects, unexplained, held_out)),
    )


def _mismatches(result: _SideResult) -> list[Mismatch]:
    """The most significant slice of every measurement; where only an effect's score tells, the measurement that shows it most."""
    evidence, verdict = result.verdict.evidence, result.verdict
    baseline = evidence.gaussian()
    found, seen = [], set()
    for part in verdict.before:
        if part.block.measurement in seen:
            continue
        seen.add(part.block.measurement)
        where, captures = describe(evidence, baseline, part)
        found.append(
            Mismatch(
                side=result.side,
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
                    side=result.side,
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
    at = evidence.slices[evidence.blocks.index(block)]
    others = tuple(e for e in verdict.effects if e.name != effect.name)
    change = (evidence.mean((*others, effect)) - evidence.mean(others))[at]
    return float(np.sum(np.square(change) / np.diag(block.covariance)))


def _named(found: list[_SideResult]) -> list[NamedEffect]:
    by_name: dict[str, list[tuple[_SideResult, Candidate]]] = {}
    for result in found:
        for candidate in result.verdict.named:
            by_name.setdefault(candidate.effect.name, []).append((result, candidate))
    named = []
    for name, members in by_name.items():
        kind = library()[name]
        first = members[0][1]
        rivals: dict[str, float] = {}
        for _, c in members:
            for rival, probability in c.rivals:
                if probability >= SMALLEST_RIVAL:
                    rivals[rival] = max(rivals.get(rival, 0.0), probability)
        parameters = {}
        for field, quantity in kind.quantities().items():
            value, std = _mean([(float(getattr(c.effect, field)), c.std.get(field)) for _, c in members])
            parameters[field] = ParameterValue(value=value, std=std, unit=quantity.unit)
        shown = sorted({m for r, c in members for m in _shown_by(r, c)})
        values = ", ".join(
            f"{f.removesuffix('_' + p.unit).replace('_', ' ')} {_number(p)}" for f, p in parameters.items()
        )
        sides = tuple(r.side for r, _ in members)
        statement = f"{kind.sentence} Seen in {' and '.join(shown)} of the {' and '.join(sides)} camera: {values}."
        named.append(
            NamedEffect(
                name=name,
                probability=min(c.probability for _, c in members),
                sides=sides,
                parameters=parameters,
                rivals=tuple(Rival(name=n, probability=p) for n, p in sorted(rivals.items(), key=lambda r: -r[1])),
                statement=statement,
                reference=first.effect.reference,
            )
        )
    return named


def _number(parameter: ParameterValue) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    if parameter.std is None:
        return f"{parameter.value:.4g}{unit}"
    digits = max(0, min(6, 1 - int(np.floor(np.log10(max(parameter.std, 1e-6))))))
    return f"{parameter.value:.{digits}f} ± {parameter.std:.{digits}f}{unit}"


def _mean(values: list[tuple[float, float | None]]) -> tuple[float, float | None]:
    """Weighted by the variances where all are known."""
    known = [(v, s) for v, s in values if s]
    if len(known) != len(values) or len(values) == 1:
        return values[0]
    weight = np.array([1.0 / s**2 for _, s in known])
    return float(np.sum(weight * np.array([v for v, _ in known])) / weight.sum()), float(1.0 / np.sqrt(weight.sum()))


def _shown_by(result: _SideResult, candidate: Candidate) -> list[str]:
    """Measurements in which the effect's change stands out of the noise."""
    evidence, verdict = result.verdict.evidence, result.verdict
    pulls = {
        b.measurement: _pull(evidence, verdict, candidate.effect, b)
        for b in evidence.blocks
        if b.touched_by(type(candidate.effect))
    }
    strongest = max(pulls.values(), default=0.0)
    return [m.replace("_", " ") for m, p in pulls.items() if p > 25.0 and p > 0.02 * strongest] or [
        max(pulls, key=lambda m: pulls[m]).replace("_", " ")
    ]


def _unexplained(result: _SideResult) -> list[Unexplained]:
    evidence, verdict = result.verdict.evidence, result.verdict
    model = evidence.gaussian(verdict.effects)
    found = []
    for gap in verdict.unknown:
        block, at = evidence.blocks[gap.index], evidence.slices[gap.index]
        part = next((s for s in verdict.after if s.block is block), None)
        index = np.arange(at.start, at.stop)[evidence.seen[at]]
        only = np.ix_(index, index)
        residual = (evidence.value - model.mean)[index]
        before = float(residual @ np.linalg.solve(model.covariance[only], residual))
        after = float(residual @ np.linalg.solve(with_discrepancy(evidence, model, gap).covariance[only], residual))
        where = describe(evidence, model, part)[0] if part is not None else "along the whole axis"
        families = [
            f"{c.effect.name} ({100 * c.probability:.0f} %)"
            + "".join(f", {n} ({100 * p:.0f} %)" for n, p in c.rivals[:3])
            for c in verdict.abstained
            if block.touched_by(type(c.effect))
        ]
        family = (
            f"; nearest of the library, none of them likely enough to be named: {'; '.join(families)}"
            if families
            else ""
        )
        found.append(
            Unexplained(
                side=result.side,
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
            )
        )
    return found


def _held_out(found: list[_SideResult]) -> HeldOut | None:
    """Over the measurements that the named effects act on; over all where none is named."""
    captures: list[str] = []
    before = after = 0.0
    n = 0
    anything = any(r.verdict.effects for r in found)
    for result in found:
        evidence, effects = result.verdict.evidence, result.verdict.effects
        if anything and not effects:
            continue
        where = np.any([evidence.touched(type(e)) for e in effects], axis=0) if effects else None
        chi2_before, count = evidence.held_out((), where)
        chi2_after, _ = evidence.held_out(effects, where)
        before, after, n = before + chi2_before, after + chi2_after, n + count
        captures += evidence.captures(True, where)
    return HeldOut(captures=tuple(captures), chi2_before=before, chi2_after=after, n=n) if n else None


def _next_capture(found: list[_SideResult], effects: list[NamedEffect]) -> str | None:
    """What tells the nearest rivals apart: something that one of them depends on and the other doesn't."""
    pairs = [
        (c.effect.name, name, p)
        for r in found
        for c in (*r.verdict.named, *r.verdict.abstained)
        for name, p in c.rivals
        if p >= SMALLEST_RIVAL
    ]
    pairs = [p for p in pairs if p[1] in library()]
    if not pairs:
        open_ends = [u for r in found for u in r.verdict.unknown]
        return (
            "Repeat the captures that are off at another exposure and another f-number: what the mismatch follows says where it arises."
            if open_ends
            else None
        )
    one, other, _ = max(pairs, key=lambda p: p[2])
    differs = library()[one].invariances ^ library()[other].invariances
    for thing, capture in SETTLING.items():
        if thing in differs:
            steady = one if thing in library()[one].invariances else other
            return f"{capture[0].upper()}{capture[1:]} would tell {one} from {other}: only {steady} stays the same."
    return f"More repeats of the captures that show it would tell {one} from {other}: both depend on the same things."


def _curves(result: _SideResult) -> list[ResidualCurve]:
    evidence, verdict = result.verdict.evidence, result.verdict
    before, after = evidence.levelled(), evidence.levelled(verdict.effects)
    found = []
    for block, at in zip(evidence.blocks, evidence.slices, strict=True):
        std = np.sqrt(np.diag(block.covariance))
        groups: dict[tuple[str, str, bool], list[int]] = {}
        for i, label in enumerate(block.labels):
            condition = label.condition if block.measurement in {"slanted_edge", "screen"} else ""
            groups.setdefault((condition, label.channel, label.held_out), []).append(i)
        for (condition, channel, held_out), members in groups.items():
            order = sorted(members, key=lambda i: block.labels[i].x)
            found.append(
                ResidualCurve(
                    side=result.side,
                    measurement=block.measurement,
                    label=condition or block.measurement,
                    channel=channel,
                    axis=NUMBERED.get(block.measurement, f"{block.axis.replace('_', ' ')}, {block.unit}"),
                    x=tuple(block.labels[i].x for i in order),
                    measured=tuple(float(block.value[i]) for i in order),
                    measured_std=tuple(float(std[i]) for i in order),
                    before=tuple(float(before[at][i]) for i in order),
                    after=tuple(float(after[at][i]) for i in order),
                    held_out=held_out,
                )
            )
    return found


def _summary(
    verdict: str,
    mismatches: list[Mismatch],
    effects: list[NamedEffect],
    unexplained: list[Unexplained],
    held_out: HeldOut | None,
) -> list[str]:
    lines = []
    if verdict == "no_mismatch":
        lines.append(f"The baseline explains everything, at a false-alarm rate of {100 * FALSE_ALARM_RATE:.0f} %.")
    lines += [
        f"{m.measurement.replace('_', ' ')} of the {m.side} camera departs from the baseline: {m.where} ({m.significance_sigma:.1f} sigma)."
        for m in mismatches
    ]
    lines += [e.statement for e in effects]
    lines += [
        f"Not explained: {u.measurement.replace('_', ' ')} of the {u.side} camera, {u.where}: {u.shape}."
        for u in unexplained
    ]
    if held_out is not None and effects:
        lines.append(
            f"On captures that neither choice nor fit has seen, chi2 falls from {held_out.chi2_before:.0f} to {held_out.chi2_after:.0f} for {held_out.n} numbers."
        )
    return lines
