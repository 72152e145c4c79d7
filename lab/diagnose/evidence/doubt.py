"""The sets that remain, and the captures that would separate them: read off the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from lab.capture_kinds.base import Equipment
from lab.diagnose.evidence.side_table import SideTable
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.outcome.candidate_captures import Hypothesis, candidate_captures
from lab.diagnose.outcome.next_capture import NOTHING, WITH, Doubt, OpenCapture
from lab.inference.hypotheses import moved, stacked
from lab.inference.search import FittedSet
from lab.observables.spectra.curves import freed_curve
from sim.effects.base import Effect

#: Sets that a next capture is to separate: the likeliest that hold `SHARE` of the probability together, each with
#: `LEAST` at least, `MOST` of them at most.
SHARE, LEAST, MOST = 0.9, 0.05, 4


def doubt_of(reading: SideTable, station: Equipment | None = None) -> Doubt | None:
    """Return the sets that remain on a side with their probabilities, and the captures that could be taken, by the
    sequences of `station`; None where one set holds nearly all of the probability.

    Sets that differ by unlisted physics alone are one: no law predicts what that does to another capture."""
    rivals = list(_rivals(reading))
    if len(rivals) < 2:
        return None
    common = frozenset.intersection(*(fit.members for fit, _ in rivals))
    hypotheses = [_hypothesis(reading, fit, common) for fit, _ in rivals]
    total = sum(p for _, p in rivals)
    captures = tuple(
        OpenCapture(candidate.words, candidate.forecast(hypotheses), candidate.plan, candidate.needs)
        for candidate in candidate_captures(
            reading.recordings, reading.side, _with_form_errors(reading, rivals), station
        )
    )
    odds = tuple(p / total for _, p in rivals)
    return Doubt(reading.side, tuple(h.name for h in hypotheses), odds, captures)


def _rivals(reading: SideTable) -> Iterator[tuple[FittedSet, float]]:
    """Yield the sets that remain, each refitted, with their probabilities."""
    held = 0.0
    for members, probability in list(reading.sets.items())[:MOST]:
        if probability < LEAST or held > SHARE:
            return
        held += probability
        if members & reading.statements:  # no other capture is predicted by what is stated of these
            continue
        fit = reading.fit_of(members)
        if fit is not None:
            yield fit, probability


def _hypothesis(reading: SideTable, fit: FittedSet, common: frozenset[str]) -> Hypothesis:
    """Return a set as one of several rivals, which have the effects `common` all together."""
    effects = reading.effects_of(fit.state)
    own = tuple(e for e in effects if e.name not in common)
    always = reading.used.always
    estimates = reading.used.nuisance_estimates(effects)
    curves = {c: freed_curve(q, c, estimates) for c, q in reading.used.camera.quantum_efficiency.items()}
    return Hypothesis(
        name=WITH.join(e.name for e in own) or NOTHING,
        effects=(*always, *effects),
        camera=reading.used.camera.model_copy(update={"quantum_efficiency": curves}),
        displaced=tuple((*always, *one) for one in _displaced(reading, fit)),
        law_stds={e.name: e.form_tolerance for e in effects},
    )


def _with_form_errors(reading: SideTable, rivals: Sequence[tuple[FittedSet, float]]) -> MeasurementModel:
    """Return the model of the used numbers with the form errors of the likeliest rival's laws in their covariance: two
    sets that fit the same numbers as well as their laws allow don't differ by what these leave."""
    fit = max(rivals, key=lambda rival: rival[1])[0]
    gaussian = reading.model.gaussian(fit.state, 1.0)
    blocks = tuple(
        replace(block, covariance=own.covariance)
        for block, own in zip(reading.used.blocks, gaussian.blocks, strict=True)
    )
    return replace(reading.used, blocks=blocks, _predictions={}, _covariances={}, _numbers={})


def _displaced(reading: SideTable, fit: FittedSet) -> Iterator[tuple[Effect, ...]]:
    """Yield the effects of a set with their parameters one posterior standard deviation away along each principal
    direction, within their bounds."""
    u = stacked(fit.state)
    if not len(u):
        return
    variance, directions = np.linalg.eigh(fit.laplace.covariance)
    low, high = (np.array([getattr(c, end) for c in fit.coordinates]) for end in ("lower", "upper"))
    for size, direction in zip(np.sqrt(np.maximum(variance, 0.0)), directions.T, strict=True):
        if size > 0.0:
            at = np.clip(u + size * direction, low, high)
            yield reading.effects_of(moved(fit.state, at))
