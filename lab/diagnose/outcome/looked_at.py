"""What was looked at and how well it fits: chi2 of every place and measurement, before and after; what could have been seen there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import optimize, special

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.evidence import chi2, conditional
from lab.diagnose.inference.locate import look
from lab.diagnose.inference.score import signatures
from lab.formats.results import MeasurementFit, Place, Visibility
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import effects as library
from sim.spectrum import FloatArray

#: Of a number's variance: how well matrices are inverted.
ROUNDING = 1e-9
#: What could have been seen: so often it would have been.
SEEN_RATE = 0.9


def places(side: Side, verdict: Verdict) -> Iterator[Place]:
    """Every slice of every measurement, under the baseline and with the named effects; significances allow for the number of slices."""
    evidence = verdict.evidence
    before = look(evidence, evidence.gaussian())
    after = {(id(s.block), s.axis, s.where): s for s in look(evidence, evidence.gaussian(verdict.effects))}
    for one in before:
        now = after[id(one.block), one.axis, one.where]
        yield Place(
            side=side,
            measurement=one.block.measurement,
            axis=one.axis,
            where=one.where,
            n=one.n,
            chi2_before=one.chi2,
            chi2_after=now.chi2,
            sigma_before=round(one.significance_sigma, 2),
            sigma_after=round(now.significance_sigma, 2),
        )


def measurement_fits(side: Side, verdict: Verdict) -> Iterator[MeasurementFit]:
    """chi2 of every measurement as a whole: of what choice and fit saw, and of what was held out, given that."""
    evidence, seen = verdict.evidence, verdict.evidence.seen
    found = []
    for effects, processes in (((), {}), (verdict.effects, verdict.processes)):
        model = evidence.gaussian(effects)
        residual = evidence.value - model.mean - evidence.discrepant(effects, processes)
        left, covariance = (
            conditional(residual, model.covariance, ~seen, seen) if (~seen).any() else (np.zeros(0), np.zeros((0, 0)))
        )
        # what the seen numbers tell of the others to the last digit leaves a variance of rounding, which may be below 0
        covariance = 0.5 * (covariance + covariance.T)
        covariance += np.diag(ROUNDING * np.diag(model.covariance)[~seen])
        numbers = []
        for at in evidence.slices:
            mine = np.zeros(len(seen), bool)
            mine[at] = True
            inside, outside = mine & seen, mine[~seen]
            numbers.append(
                (
                    chi2(residual[inside], model.covariance[np.ix_(inside, inside)]),
                    chi2(left[outside], covariance[np.ix_(outside, outside)]) if outside.any() else 0.0,
                )
            )
        found.append(numbers)
    for block, at, before, after in zip(evidence.blocks, evidence.slices, *found, strict=True):
        yield MeasurementFit(
            side=side,
            measurement=block.measurement,
            n=int(seen[at].sum()),
            chi2_before=before[0],
            chi2_after=after[0],
            held_out_n=int((~seen[at]).sum()),
            held_out_before=before[1],
            held_out_after=after[1],
        )


def detectable(threshold: float, rate: float = SEEN_RATE) -> float:
    """Non-centrality of an effect whose score exceeds the threshold with that probability: P(chi2_1(lambda) > threshold) = rate."""
    return float(
        optimize.brentq(lambda x: 1.0 - special.chndtr(threshold, 1, x) - rate, 1e-6, 10.0 * threshold + 100.0)
    )


def visibility(side: Side, verdict: Verdict) -> Iterator[Visibility]:
    """For every effect that acts on what was recorded: the size from which it would have been seen, and its nearest rival.

    A signature's non-centrality |L^-1 dm|^2 grows as the square of the slope coordinate, so that the size follows from one small
    instance. Rivals of cosine rho are told apart with probability Phi(1/2 sqrt(lambda (1 - rho^2))).
    """
    evidence = verdict.evidence
    if not np.isfinite(verdict.threshold):
        return
    known = [e for e in library().values() if e.shown_by]
    sets: dict[str, list[tuple[tuple[Effect, ...], FloatArray]]] = {}
    for effect, prototypes, table in signatures(evidence, evidence.camera, (), known).columns:
        sets.setdefault(effect.name, []).append((prototypes, table))
    unit = {
        name: np.concatenate([t / np.maximum(np.linalg.norm(t, axis=0), 1e-300) for _, t in members], axis=1)
        for name, members in sets.items()
    }
    need = detectable(verdict.threshold)
    for name, members in sets.items():
        rivals = {other: float(np.abs(unit[name].T @ unit[other]).max()) for other in unit if other != name}
        nearest = max(rivals, key=lambda other: rivals[other], default=None)
        cosine = min(rivals[nearest], 1.0) if nearest is not None else 0.0
        yield Visibility(
            side=side,
            effect=name,
            smallest=_smallest(library()[name], members, need),
            nearest=nearest,
            cosine=cosine,
            told_apart=float(special.ndtr(0.5 * np.sqrt(need * (1.0 - cosine**2)))),
        )


def _smallest(
    effect: type[Effect], members: list[tuple[tuple[Effect, ...], FloatArray]], need: float
) -> dict[str, float]:
    """By parameter the least departure from absent that reaches a non-centrality; nothing of effects that aren't small anywhere."""
    found: dict[str, float] = {}
    if effect.shapes:
        return found
    for prototypes, table in members:
        for prototype, column in zip(prototypes, table.T, strict=True):
            size = float(np.linalg.norm(column))
            moved = {f: q for f, q in effect.quantities().items() if getattr(prototype, f) != (q.absent or 0.0)}
            if size <= 0 or len(moved) != 1:
                continue
            ((field, quantity),) = moved.items()
            away = abs(float(getattr(prototype, field)) - (quantity.absent or 0.0))
            least = away * (np.sqrt(need) / size) ** (1.0 / quantity.slope_power)
            found[field] = min(found.get(field, np.inf), float(least))
    return {field: value for field, value in found.items() if np.isfinite(value)}
