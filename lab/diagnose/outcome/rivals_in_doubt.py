"""What a verdict leaves in doubt: a name and its rivals, each fitted in its place."""

from __future__ import annotations

import numpy as np

from lab.capture_kinds.base import Equipment
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import displaced, refit
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.outcome.candidate_captures import Hypothesis, candidate_captures
from lab.diagnose.outcome.next_capture import Doubt, OpenCapture
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.observables.spectra.curves import freed_curve
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import effects as library


def doubt_of(
    recordings: RecordingSet, side: Side, verdict: Verdict, policy: DecisionPolicy, station: Equipment | None = None
) -> Doubt | None:
    """Return what a verdict leaves in doubt, and the captures that could be taken, by the sequences of `station`; None
    where no rivals are left."""
    rivals = _rivals(verdict, policy)
    if len(rivals) < 2:
        return None
    total = sum(p for p, _ in rivals)
    hypotheses = [h for _, h in rivals]
    captures = [
        OpenCapture(candidate.words, candidate.forecast(hypotheses), candidate.plan, candidate.needs)
        for candidate in candidate_captures(recordings, side, verdict.model, station)
    ]
    return Doubt(side, tuple(h.name for h in hypotheses), tuple(p / total for p, _ in rivals), tuple(captures))


def _rivals(verdict: Verdict, policy: DecisionPolicy) -> list[tuple[float, Hypothesis]]:
    """Return the effect whose rivals are likeliest, and these rivals, each fitted in its place: as many as together
    hold `next_capture_share`; with their probabilities."""
    model, least = verdict.model, policy.least_rival_probability

    def rival_probability(candidate: Candidate) -> float:
        return sum(p for name, p in candidate.alternatives if name in library() and p >= least)

    candidates = [c for c in (*verdict.named, *verdict.abstained) if rival_probability(c) > 0]
    if not candidates:
        return []
    chosen = max(candidates, key=rival_probability)
    beside = tuple(e for e in verdict.effects if e.name != chosen.effect.name)
    own = dict(chosen.members).get(chosen.effect.name, chosen.probability)
    found = [(own, _hypothesis(model, (*beside, chosen.effect)))]
    held = [
        (own, chosen.effect.name),
        *((p, name) for name, p in chosen.alternatives if name in library()),
    ]
    before = np.cumsum([0.0, *(p for p, _ in held)]) / sum(p for p, _ in held)
    for (p, name), reached in list(zip(held, before, strict=False))[1 : policy.next_capture_rivals]:
        if p < least or (reached > policy.next_capture_share and len(found) > 1):
            break
        scores = signatures(model, model.camera, beside, [library()[name]]).scores()
        if scores:
            fit = refit(model, (*beside, scores[0].start), policy, passes=2)
            found.append((p, _hypothesis(model, fit.effects)))
    return found


def _hypothesis(model: MeasurementModel, effects: tuple[Effect, ...]) -> Hypothesis:
    """Return the rival that is the last of `effects`, beside the others."""
    estimates = model.nuisance_estimates(effects)
    curves = {c: freed_curve(q, c, estimates) for c, q in model.camera.quantum_efficiency.items()}
    camera = model.camera.model_copy(update={"quantum_efficiency": curves})
    return Hypothesis(
        effects[-1].name,
        (*model.always, *effects),
        camera,
        tuple((*model.always, *moved) for moved in displaced(model, effects, len(effects) - 1)),
        (*model.always, *effects[:-1]),
        effects[-1].form_tolerance,
    )
