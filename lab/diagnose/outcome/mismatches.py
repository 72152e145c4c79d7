"""Mismatches in words: where a measurement departs from the baseline, and what is left without a name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.discrepancy import Discrepancy
from lab.diagnose.inference.locate import Slice, describe
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.measurements.block import Block
from lab.diagnose.outcome.improved_model import Correction
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import Mismatch, Unexplained
from sim.camera import Side
from sim.effects.base import Effect

#: Words for a mismatch that no slice shows.
WHOLE_AXIS = "along the whole axis"
#: Rivals that are listed beside a candidate.
LISTED_RIVALS = 3


def located(side: Side, verdict: Verdict) -> list[Mismatch]:
    """The most significant slice of every measurement. Where only an effect's score shows a mismatch, the measurement
    that it changes most, with the significance of its log odds: sqrt(2 log odds)."""
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
    return list(found.values())


def shown_in(verdict: Verdict, candidate: Candidate, policy: DecisionPolicy) -> tuple[str, ...]:
    """Measurements in which an effect's change stands out of the noise; the strongest, where none does."""
    model = verdict.model
    changes = {
        b.measurement.name: _change_chi2(verdict, candidate.effect, b)
        for b in model.blocks
        if b.touched_by(type(candidate.effect))
    }
    least = max(policy.shown_chi2, policy.shown_share * max(changes.values(), default=0.0))
    return tuple(m for m, c in changes.items() if c > least) or (max(changes, key=lambda m: changes[m]),)


def _change_chi2(verdict: Verdict, effect: Effect, block: Block) -> float:
    others = tuple(e for e in verdict.effects if e.name != effect.name)
    return verdict.model.change_chi2(effect, others, verdict.model.blocks.index(block))


def unexplained(side: Side, verdict: Verdict, corrections: Sequence[Correction]) -> list[Unexplained]:
    """Every mismatch that is left: where, how its discrepancy looks, which effects come nearest, and chi2 with and
    without the discrepancy's covariance. `corrections` of the improved model, one for each."""
    model = verdict.model
    gaussian = model.gaussian(verdict.effects)
    found = []
    for one, correction in zip(verdict.discrepancies, corrections, strict=True):
        block, at = model.blocks[one.index], model.slices[one.index]
        part = next((s for s in verdict.after if s.block is block), None)
        index = np.arange(at.start, at.stop)[model.seen[at]]
        only = np.ix_(index, index)
        residual = (model.value - gaussian.mean)[index]
        with_kernel = gaussian.with_discrepancy(one.index, one.kernel)
        near = [c for c in verdict.abstained if block.touched_by(type(c.effect))]
        remarked = max((c for c in near if c.remark), key=lambda c: c.log_odds, default=None)
        found.append(
            Unexplained(
                side=side,
                measurement=block.measurement.name,
                axis=part.axis if part is not None else block.measurement.axis,
                where=describe(model, gaussian, part)[0] if part is not None else WHOLE_AXIS,
                shape=_shape(one, block, near),
                significance_sigma=_sigma(part),
                chi2_before=float(residual @ np.linalg.solve(gaussian.covariance[only], residual)),
                chi2_after=float(residual @ np.linalg.solve(with_kernel.covariance[only], residual)),
                n=len(index),
                correction=correction.said,
                check=f"The {side} camera looks {remarked.remark}: check what is stated of both." if remarked else "",
            )
        )
    return found


def _sigma(part: Slice | None) -> float:
    return round(part.significance_sigma, 2) if part is not None else 0.0


def _shape(one: Discrepancy, block: Block, near: Sequence[Candidate]) -> str:
    """How a discrepancy looks, and the effects that come nearest to it."""
    nearest = [
        f"{c.effect.name} ({100 * c.probability:.0f} %)"
        + "".join(f", {n} ({100 * p:.0f} %)" for n, p in c.rivals[:LISTED_RIVALS])
        for c in near
    ]
    family = (
        f"; nearest of the library, none of them likely enough to be named: {'; '.join(nearest)}" if nearest else ""
    )
    if one.log_odds > 0:
        return f"smooth over {one.length:.3g} {block.measurement.unit}, {one.grouping}, of relative size {one.amplitude:.2g}{family}"
    return f"irregular: no smooth discrepancy describes it{family}"
