"""Mismatches in words: where a measurement departs from the baseline, and what is left without a name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.discrepancy import Discrepancy
from lab.diagnose.inference.locate import Slice, describe
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.outlying import OutlyingLevel
from lab.diagnose.inference.shown_in_means import is_judged_in_means, shown_in_means
from lab.diagnose.inference.weigh import UNKNOWN, Candidate
from lab.diagnose.measurements.block import Block
from lab.diagnose.outcome.improved_model import Correction
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Mismatch, Unexplained, VetoedName
from lab.measure.gaussian import Gaussian, chi2
from sim.camera import Side
from sim.effects.base import Effect

#: Words for a mismatch that no slice shows.
WHOLE_AXIS = "along the whole axis"
#: Rivals that are listed beside a candidate.
LISTED_RIVALS = 3


def located(side: Side, verdict: Verdict) -> list[Mismatch]:
    """Return the most significant slice of every measurement. Where only an effect's score shows a mismatch, the
    measurement that it changes most, with the significance of its log odds: sqrt(2 log odds)."""
    model = verdict.model
    baseline = model.gaussian()
    found: dict[str, Mismatch] = {}
    for part in verdict.before:
        name = part.block.measurement.name
        if name not in found:
            where, captures = describe(model, baseline, part)
            sigma = round(part.significance_sigma, 2)
            found[name] = Mismatch(
                side=side, measurement=name, axis=part.axis, where=where, significance_sigma=sigma, captures=captures
            )
    for candidate in (*verdict.named, *verdict.abstained):
        changed = [b for b in model.blocks if b.touched_by(type(candidate.effect))]
        if changed and not any(b.measurement.name in found for b in changed):
            block = max(changed, key=lambda b: _change_chi2(verdict, candidate.effect, b))
            found[block.measurement.name] = Mismatch(
                side=side,
                measurement=block.measurement.name,
                axis=block.measurement.axis,
                where=f"{WHOLE_AXIS}, as {candidate.effect.name}",
                significance_sigma=round(float(np.sqrt(max(2.0 * candidate.log_odds, 0.0))), 2),
                captures=model.captures(False, model.mask(model.blocks.index(block))),
            )
    for part in verdict.held_out:
        name = part.block.measurement.name
        if name not in found:
            where, captures = describe(model, model.gaussian(verdict.effects), part)
            found[name] = Mismatch(
                side=side,
                measurement=name,
                axis=part.axis,
                where=f"{where}, in held-out captures",
                significance_sigma=_sigma(part),
                captures=captures,
            )
    return list(found.values())


def vetoed_names(side: Side, verdict: Verdict) -> list[VetoedName]:
    """Return the names that held-out captures contradict, in words."""
    return [
        VetoedName(
            side=side,
            name=one.candidate.told_name,
            probability=one.candidate.probability,
            captures=one.captures,
            chi2_before=one.chi2_without,
            chi2_after=one.chi2_with,
            n=one.n,
            statement=f"{one.candidate.told_name} is not named for the {side} camera: the captures that the choice "
            "used suggest it, but on "
            f"held-out captures chi2 rises by it from {one.chi2_without:.0f} to {one.chi2_with:.0f} for {one.n} "
            "numbers, more than chance allows"
            f"{', with a discrepancy beside its nearest law or in its place' if one.candidate.members else ''}.",
        )
        for one in verdict.vetoed
    ]


def held_by_families(verdict: Verdict, policy: DecisionPolicy) -> frozenset[str]:
    """Measurements whose remaining mismatch belongs to a named family: its nearest law shows there, and isn't exact."""
    return frozenset(m for c in verdict.named if c.holds_a_remainder for m in shown_in(verdict, c, policy))


def family_corrections(
    verdict: Verdict, candidate: Candidate, corrections: Sequence[Correction], policy: DecisionPolicy
) -> tuple[str, ...]:
    """Return what stands in the improved model beside a family's nearest law, in words."""
    if not candidate.holds_a_remainder:
        return ()
    shown = shown_in(verdict, candidate, policy)
    return tuple(one.said for one in corrections if one.measurement in shown)


def shown_in(verdict: Verdict, candidate: Candidate, policy: DecisionPolicy) -> tuple[str, ...]:
    """Measurements in which an effect's change stands out of the noise, the strongest change first; only that, where
    none does."""
    model = verdict.model
    changes = {
        b.measurement.name: _change_chi2(verdict, candidate.effect, b)
        for b in model.blocks
        if b.touched_by(type(candidate.effect))
    }
    least = max(policy.shown_chi2, policy.shown_share * max(changes.values(), default=0.0))
    strongest = sorted(changes, key=lambda m: -changes[m])
    return tuple(m for m in strongest if changes[m] > least) or (strongest[0],)


def _change_chi2(verdict: Verdict, effect: Effect, block: Block) -> float:
    others = tuple(e for e in verdict.effects if e.name != effect.name)
    return verdict.model.change_chi2(effect, others, verdict.model.blocks.index(block))


def unexplained(
    recordings: RecordingSet,
    side: Side,
    verdict: Verdict,
    corrections: Sequence[Correction],
    policy: DecisionPolicy,
) -> list[Unexplained]:
    """Every mismatch that no name explains: where it is, the shape of its discrepancy, the nearest law, captures, and
    what to check.

    chi2 is of the seen numbers, without and with the discrepancy's covariance; of a mismatch that only held-out
    captures show, it is theirs. `corrections`: one for each discrepancy. What the nearest law of a named family leaves
    isn't listed."""
    model = verdict.model
    gaussian = model.gaussian(verdict.effects)
    held = held_by_families(verdict, policy)
    found = []
    for one, correction in zip(verdict.discrepancies, corrections, strict=True):
        if correction.measurement in held:
            continue
        block, at = model.blocks[one.index], model.slices[one.index]
        part = next((s for s in (*verdict.after, *verdict.held_out) if s.block is block), None)
        is_held_out = part is not None and part in verdict.held_out
        index = np.arange(at.start, at.stop)[model.seen[at]]
        before = _seen_chi2(model, gaussian, index)
        after = _seen_chi2(model, gaussian.with_discrepancy(one.index, one.kernel), index)
        if is_held_out and part is not None:
            before = after = part.chi2 * (1.0 + policy.covariance_slack) ** 2
        where, captures = (
            describe(model, gaussian, part)
            if part is not None
            else (WHOLE_AXIS, model.captures(False, model.mask(one.index)))
        )
        outlying = verdict.outlying.get(one.index, ())
        if outlying:
            captures = tuple(sorted({name for level in outlying for name in level.captures}))
        checks = [_level_check(recordings, level) for level in outlying]
        near = [] if is_held_out or outlying else [c for c in verdict.abstained if block.touched_by(type(c.effect))]
        remarked = max((c for c in near if c.remark), key=lambda c: c.log_odds, default=None)
        if remarked is not None:
            checks.append(f"The {side} camera looks {remarked.remark}: check what is stated of both.")
        found.append(
            Unexplained(
                side=side,
                measurement=block.measurement.name,
                axis=part.axis if part is not None else block.measurement.axis,
                where=where,
                shape=_shape(one, verdict, near, before, outlying, policy)
                if not is_held_out
                else _held_out_shape(outlying),
                significance_sigma=_sigma(part),
                chi2_before=before,
                chi2_after=after,
                n=part.n if is_held_out and part is not None else len(index),
                captures=captures,
                correction=correction.said,
                check=" ".join(checks),
            )
        )
    return found


def _sigma(part: Slice | None) -> float:
    return round(part.significance_sigma, 2) if part is not None else 0.0


def _seen_chi2(model: MeasurementModel, gaussian: Gaussian, index: np.ndarray) -> float:
    return chi2((model.value - gaussian.mean)[index], gaussian.covariance[np.ix_(index, index)])


def _level_check(recordings: RecordingSet, level: OutlyingLevel) -> str:
    """Return the exposure, or the light, that a level out of line with its statement would fit, as a sentence."""
    stated = {c.id: c.exposure_s for c in recordings.captures() if c.id in level.captures}
    exposure_s = float(np.mean(list(stated.values())))
    many = len(level.captures) > 1
    return (
        f"Capture{'s' if many else ''} {', '.join(level.captures)}: stated with {exposure_s:.6g} s, but "
        f"{'their' if many else 'its'} level is "
        f"that of {exposure_s * level.factor:.6g} ± {exposure_s * level.factor_std:.2g} s, or of {level.factor:.4f} ± "
        f"{level.factor_std:.1g} "
        "times the stated light: check both."
    )


def _held_out_shape(outlying: Sequence[OutlyingLevel]) -> str:
    """Return the shape of a mismatch that only held-out captures show, in words."""
    if outlying:
        return "single captures aren't in line with the others"
    return "held-out captures contradict the other captures"


def _shape(
    one: Discrepancy,
    verdict: Verdict,
    near: Sequence[Candidate],
    chi2_without: float,
    outlying: Sequence[OutlyingLevel],
    policy: DecisionPolicy,
) -> str:
    """Return the shape of a discrepancy, and the law nearest to it, in words."""
    if outlying:
        return _held_out_shape(outlying)
    block = verdict.model.blocks[one.index]
    nearest = _nearest(one, verdict, near, chi2_without, policy)
    law = f"; {nearest}" if nearest else ""
    if one.log_odds > 0:
        unit = block.measurement.unit
        kind = f"smooth over {one.length:.3g} {unit}, {one.grouping}" if one.length > 0 else one.grouping
        return f"a model discrepancy, {kind}, of relative size {one.amplitude:.2g}{law}"
    return f"irregular: no smooth discrepancy predicts captures that it hasn't seen{law}"


def _nearest(
    one: Discrepancy, verdict: Verdict, near: Sequence[Candidate], chi2_without: float, policy: DecisionPolicy
) -> str:
    """Return the nearest law of the library, and why it isn't named, in words: it leaves too much, or others fit as
    well. Empty where no law explains `near_share` of the excess of chi2 here."""
    model, at = verdict.model, verdict.model.slices[one.index]
    nearest = max(near, key=lambda c: c.log_odds, default=None)
    if nearest is None:
        return ""
    name = nearest.effect.name
    index = np.arange(at.start, at.stop)[model.seen[at]]
    others = tuple(e for e in verdict.effects if e.name != name)
    if not shown_in_means(model, nearest.effect, (*others, nearest.effect), others, policy):
        why = (
            "and these don't show it"
            if is_judged_in_means(model, type(nearest.effect))
            else "and no light of theirs is stated: state the flats' radiance or photons"
        )
        return f"the nearest law is {name}, which has to show in mean levels, {why}"
    left = _seen_chi2(model, model.gaussian((*others, nearest.effect)), index)
    if chi2_without - left < policy.near_share * (chi2_without - len(index)):
        return ""
    least = float(chdtri(len(index), policy.slice_false_alarm_rate)) * (1.0 + policy.covariance_slack) ** 2
    if left > least:
        told = f"chi2 is {left:.0f} with it, {chi2_without:.0f} without, {len(index)} are expected"
        return f"the nearest law is {name}, and it doesn't hold exactly: {told}"
    rivals = [
        f"{n} ({100 * p:.0f} %)"
        for n, p in nearest.rivals[:LISTED_RIVALS]
        if n != UNKNOWN and p >= policy.told_rival_probability
    ]
    if rivals:
        return (
            f"the nearest law is {name} ({100 * nearest.probability:.0f} %), which these recordings can't tell from "
            f"{', '.join(rivals)}"
        )
    return (
        f"the nearest law is {name}; what it leaves beside it in the same captures has no name, so that both may be "
        "one unknown cause"
    )
