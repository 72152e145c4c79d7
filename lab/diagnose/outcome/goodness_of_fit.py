"""Goodness of fit of each slice and each measurement, with the baseline and with what was found."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.held_out import held_out_residual
from lab.diagnose.inference.locate import chi2_by_slice
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import ExaminedPlace, HeldOut, MeasurementFit, ResidualCurve
from lab.measure.gaussian import chi2
from sim.camera import Side
from sim.effects.base import Effects
from sim.effects.library import list_changes
from sim.spectrum import FloatArray


def places(side: Side, verdict: Verdict, policy: DecisionPolicy) -> Iterator[ExaminedPlace]:
    """Every slice of every measurement, before and after; significances are corrected for the number of slices."""
    model = verdict.model
    before = chi2_by_slice(model, model.gaussian(), policy)
    with_effects = chi2_by_slice(model, model.gaussian(verdict.effects), policy)
    after = {(id(s.block), s.axis, s.where): s for s in with_effects}
    for one in before:
        now = after[id(one.block), one.axis, one.where]
        yield ExaminedPlace(
            side=side,
            measurement=one.block.measurement.name,
            axis=one.axis,
            where=one.where,
            n=one.n,
            chi2_before=one.chi2,
            chi2_after=now.chi2,
            sigma_before=round(one.significance_sigma, 2),
            sigma_after=round(now.significance_sigma, 2),
        )


def measurement_fits(side: Side, verdict: Verdict) -> Iterator[MeasurementFit]:
    """chi2 of every measurement: of its seen numbers, and of its held-out ones given all that was seen."""
    model = verdict.model
    before = _chi2_by_block(verdict, (), {})
    after = _chi2_by_block(verdict, verdict.effects, verdict.kernels)
    for block, at, b, a in zip(model.blocks, model.slices, before, after, strict=True):
        yield MeasurementFit(
            side=side,
            measurement=block.measurement.name,
            n=int(model.seen[at].sum()),
            chi2_before=b[0],
            chi2_after=a[0],
            held_out_n=int((~model.seen[at]).sum()),
            held_out_before=b[1],
            held_out_after=a[1],
        )


def _chi2_by_block(
    verdict: Verdict, effects: Effects, discrepancies: Mapping[int, FloatArray]
) -> list[tuple[float, float]]:
    """(seen, held out) of every block."""
    model, seen = verdict.model, verdict.model.seen
    gaussian = model.gaussian(effects)
    residual = model.value - gaussian.mean - model.discrepancy_mean(effects, discrepancies)
    left, covariance = held_out_residual(model, effects, discrepancies)
    found = []
    for index in range(len(model.blocks)):
        mine = model.mask(index)
        inside, outside = mine & seen, mine[~seen]
        found.append(
            (
                chi2(residual[inside], gaussian.covariance[np.ix_(inside, inside)]),
                chi2(left[outside], covariance[np.ix_(outside, outside)]) if outside.any() else 0.0,
            )
        )
    return found


def held_out(verdict: Verdict, laws: Effects = (), described: Collection[int] = ()) -> HeldOut | None:
    """chi2 of held-out numbers in the measurements that a named effect, a discrepancy or a discovered law acts on; in
    all, where nothing was found or nothing of those is held out. `described`: blocks in which laws stand in the place
    of discrepancies."""
    model, effects, kernels = verdict.model, verdict.effects, verdict.kernels
    found = [model.affected(type(e)) for e in effects] + [model.mask(i) for i in kernels]
    found += [model.mask(i) for law in laws for i, block in enumerate(model.blocks) if block.reads & list_changes(law)]
    where = np.any(found, axis=0) if found else None
    if where is not None and model.seen[where].all():
        where = None
    before, n = model.held_out((), where)
    after, _ = model.held_out(effects, where, kernels)
    beside = {i: kernel for i, kernel in kernels.items() if i not in described}
    discovered = model.held_out((*effects, *laws), where, beside)[0] if laws else None
    if n == 0:
        return None
    captures = model.captures(True, where)
    return HeldOut(captures=captures, chi2_before=before, chi2_after=after, chi2_discovered=discovered, n=n)


def residual_curves(side: Side, verdict: Verdict) -> Iterator[ResidualCurve]:
    """Curves of every measurement by condition and channel, seen and held out apart: measured values, and predictions
    before and after.

    Before is the stated baseline at the nuisance parameters that were fitted with the effects. Levels are limited to
    0..white level."""
    model = verdict.model
    before = model.stated_mean(model.nuisance_estimates(verdict.effects, verdict.kernels))
    after = model.fitted_mean(verdict.effects, verdict.kernels)
    white_dn = float(model.camera.white_level_dn)
    for block, at in zip(model.blocks, model.slices, strict=True):
        std = np.sqrt(np.diag(block.covariance))
        stated = np.clip(before[at], 0.0, white_dn) if block.measurement.is_level else before[at]
        groups: dict[tuple[str, str, bool], list[int]] = {}
        for i, label in enumerate(block.labels):
            condition = label.condition if block.measurement.conditions else ""
            groups.setdefault((condition, label.channel, label.held_out), []).append(i)
        for (condition, channel, is_held_out), members in groups.items():
            order = sorted(members, key=lambda i: block.labels[i].x)
            yield ResidualCurve(
                side=side,
                measurement=block.measurement.name,
                label=condition or block.measurement.name,
                channel=channel,
                axis=block.measurement.places
                or f"{block.measurement.axis.replace('_', ' ')}, {block.measurement.unit}",
                quantity=block.measurement.quantity,
                names=tuple(block.labels[i].condition for i in order) if block.measurement.places else (),
                x=tuple(block.labels[i].x for i in order),
                measured=tuple(float(block.value[i]) for i in order),
                measured_std=tuple(float(std[i]) for i in order),
                before=tuple(float(stated[i]) for i in order),
                after=tuple(float(after[at][i]) for i in order),
                held_out=is_held_out,
            )
