"""What a result says in numbers: goodness of fit of each slice and measurement, the sets of effects that may hold,
and the smallest size of each effect that would be seen."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from scipy import special

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.held_out import held_out_residual
from lab.diagnose.inference.locate import chi2_by_slice
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.search import ModelSet
from lab.diagnose.outcome.detectability import detectable, smallest_sizes, told_as
from lab.diagnose.outcome.residual_curves import curves_of
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import (
    EffectSet,
    ExaminedPlace,
    HeldOut,
    IncludedEffect,
    MeasurementFit,
    NamedEffect,
    ResidualCurve,
    SideModels,
    Unexplained,
    Visibility,
)
from lab.observables.gaussian import chi2
from sim.camera import Side
from sim.effects.base import Effect, Effects
from sim.effects.library import candidates, list_changes
from sim.effects.library import effects as library
from sim.spectrum import FloatArray

# --- Goodness of fit of each slice and each measurement, with the baseline and with what was found --------------------


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
    yield from curves_of(model, side, before, after, held_out_apart=True)


# --- The smallest detectable size of each effect in these recordings, and the effect that is most like it -------------


def detectability(side: Side, verdict: Verdict, policy: DecisionPolicy) -> Iterator[Visibility]:
    """For every effect that acts on what was recorded: the smallest detectable size of each parameter, and the nearest
    effect.

    The non-centrality |L^-1 dm|^2 of a signature grows as the square of the coordinate u, so that the size follows from
    one instance. Two effects of cosine rho are told apart with probability Phi(1/2 sqrt(lambda (1 - rho^2))).
    """
    model = verdict.model
    if not np.isfinite(verdict.threshold):
        return
    sets: dict[str, list[tuple[tuple[Effect, ...], FloatArray]]] = {}
    for effect, prototypes, table in signatures(model, model.camera, (), candidates()).columns:
        sets.setdefault(effect.name, []).append((prototypes, table))
    unit = {
        name: np.concatenate([t / np.maximum(np.linalg.norm(t, axis=0), 1e-300) for _, t in members], axis=1)
        for name, members in sets.items()
    }
    needed = detectable(verdict.threshold, policy.detection_probability)
    for name, members in sets.items():
        cosines = {other: float(np.abs(unit[name].T @ unit[other]).max()) for other in unit if other != name}
        nearest = max(cosines, key=lambda other: cosines[other], default=None)
        cosine = min(cosines[nearest], 1.0) if nearest is not None else 0.0
        yield Visibility(
            side=side,
            effect=name,
            smallest={
                told_as(field, library()[name].quantities()[field], gain_is_known=model.gain_is_known)[0]: size
                for field, size in smallest_sizes(library()[name], members, needed).items()
            },
            nearest=nearest,
            cosine=cosine,
            told_apart=float(special.ndtr(0.5 * np.sqrt(needed * (1.0 - cosine**2)))),
        )


# --- The credible sets of effects that the search found, as a result and in sentences ---------------------------------


#: Sets that a sentence lists.
LISTED_SETS = 5


def side_models(side: Side, found: ModelSet, policy: DecisionPolicy) -> SideModels:
    """Return the sets of effects of one side, as a result."""
    return SideModels(
        side=side,
        share=policy.model_set_share,
        sets=tuple(EffectSet(effects=m.effects, probability=m.probability, refitted=m.refitted) for m in found.models),
        inclusion=tuple(IncludedEffect(name=n, probability=p) for n, p in found.inclusion),
        not_weighed=found.not_weighed,
    )


def set_sentences(
    models: Sequence[SideModels],
    effects: Sequence[NamedEffect],
    unexplained: Sequence[Unexplained],
    policy: DecisionPolicy,
) -> Iterator[str]:
    """Sentences about effects that may be present, though they are neither named nor rivals of a name; and about sets
    that the budget left unweighed.

    The former are given only where the names explain everything: listed effects fit an unlisted cause badly.
    """
    for one in models:
        named = [e for e in effects if one.side in e.sides]
        told = {n for e in named for n in (e.name, *e.alternatives)}
        is_whole = named and all(u.side != one.side for u in unexplained)
        untold = {n for s in one.sets for n in s.effects} - told
        if is_whole and any(sum(s.probability for s in one.sets if n in s.effects) > 1.0 - one.share for n in untold):
            sets = ", ".join(f"{_words(s.effects)} ({100 * s.probability:.0f} %)" for s in one.sets[:LISTED_SETS])
            more = f" and {len(one.sets) - LISTED_SETS} more" if len(one.sets) > LISTED_SETS else ""
            yield (
                f"For the {one.side} camera, if every cause is a listed effect, these sets of effects hold "
                f"{100 * one.share:.0f} % together: "
                f"{sets}{more}."
            )
        if one.not_weighed:
            sets = "; ".join(_words(s) for s in one.not_weighed[:LISTED_SETS])
            more = f"; and {len(one.not_weighed) - LISTED_SETS} more" if len(one.not_weighed) > LISTED_SETS else ""
            yield (
                f"The search for the {one.side} camera ended when its {policy.search_cpu_s:g} s of CPU time were "
                f"spent. Not weighed: {sets}{more}; "
                "a name may have rivals among these."
            )


def _words(effects: Sequence[str]) -> str:
    return " with ".join(effects) if effects else "none"
