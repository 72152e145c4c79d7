"""The capture that would best tell rivals apart.

Every capture that could be taken is predicted under each rival, at the parameters that the recordings give it. The best
capture c is the one in which the two nearest rivals k, l lie furthest apart:

    argmax over c of min over k, l of D,   D = 1/2 |L^-1 (m_k(c) - m_l(c))|^2,   L L' = covariance of m(c)

The covariance holds noise, floors and nuisance parameters. Two rivals are then told apart with
probability Phi(sqrt(D / 2)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import ndtr

from lab.capture.plan import CapturePlan
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.refit import refit
from lab.diagnose.inference.score import signatures
from lab.diagnose.inference.weigh import Candidate
from lab.diagnose.measurements.curves import freed_curve
from lab.diagnose.outcome.candidate_captures import Hypothesis, candidate_captures
from lab.diagnose.policy import DecisionPolicy
from lab.diagnose.visibility import visibility
from lab.formats.recording_set import RecordingSet
from lab.formats.results import NextCapture
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.library import effects as library

#: What to vary where no predicted capture tells two effects apart, but one depends on a condition and the other
#: doesn't; and the kind of capture in which it has to show (None: any; `LIT`: any with light).
LIT = "light"
SETTLING: dict[str, tuple[str, str | None]] = {
    "f_number": ("the slanted edges again at twice the f-number", "slanted_edge"),
    "wavelength": ("slanted edges in narrowband light, at 450 and at 650 nm", "slanted_edge"),
    "orientation": (
        "slanted edges at four orientations, 5, 50, 95 and 140 degrees from the vertical",
        "slanted_edge",
    ),
    "exposure": ("the same captures at a quarter of the exposure and four times the light", LIT),
    "level": ("the same captures at a quarter of the light", LIT),
    "field": ("the same captures at the corners of the field", LIT),
    "time": ("the same captures again, in the reverse order", None),
}
#: Distance below which no capture is worth listing beside others: predictions within a fifth of a standard deviation.
LEAST_DISTANCE = 0.02


@dataclass(frozen=True)
class CaptureProposal:
    """A capture, what it would tell, and the sequence that takes it (None: a station can't by itself)."""

    capture: NextCapture
    plan: CapturePlan | None


def proposals(
    recordings: RecordingSet, side: Side, verdict: Verdict, policy: DecisionPolicy
) -> tuple[CaptureProposal, ...]:
    """Captures to take next, best first; none where no rivals are left."""
    rivals = _rivals(verdict, policy)
    if len(rivals) < 2:
        return ()
    found = []
    for candidate in candidate_captures(recordings, side, verdict.model):
        lower = cholesky(candidate.covariance, lower=True)
        white = {h.name: solve_triangular(lower, candidate.predict(h), lower=True) for h in rivals}
        pairs = {(a, b): 0.5 * float(np.sum(np.square(white[a] - white[b]))) for a, b in combinations(white, 2)}
        nearest = min(pairs, key=lambda pair: pairs[pair])
        found.append((pairs[nearest], nearest, candidate))
    found.sort(key=lambda item: -item[0])
    # a capture that neither rival changes tells nothing: an f-number for darks
    found = [item for item in found if item[0] >= LEAST_DISTANCE] or found[:1]
    return tuple(
        CaptureProposal(
            NextCapture(
                side=side,
                capture=candidate.words,
                rivals=nearest,
                distance=distance,
                told_apart=float(ndtr(np.sqrt(0.5 * distance))),
            ),
            candidate.plan,
        )
        for distance, nearest, candidate in found[: policy.next_captures_listed]
    )


def _rivals(verdict: Verdict, policy: DecisionPolicy) -> list[Hypothesis]:
    """The effect whose rivals are likeliest, and these rivals, each fitted in its place: as many as together hold
    `next_capture_share`."""
    model, least = verdict.model, policy.least_rival_probability

    def rival_probability(candidate: Candidate) -> float:
        return sum(p for name, p in candidate.alternatives if name in library() and p >= least)

    candidates = [c for c in (*verdict.named, *verdict.abstained) if rival_probability(c) > 0]
    if not candidates:
        return []
    chosen = max(candidates, key=rival_probability)
    beside = tuple(e for e in verdict.effects if e.name != chosen.effect.name)
    found = [_hypothesis(model, chosen.effect.name, (*beside, chosen.effect))]
    own = dict(chosen.members).get(chosen.effect.name, chosen.probability)
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
            found.append(_hypothesis(model, name, fit.effects))
    return found


def _hypothesis(model: MeasurementModel, name: str, effects: tuple[Effect, ...]) -> Hypothesis:
    estimates = model.nuisance_estimates(effects)
    curves = {c: freed_curve(q, c, estimates) for c, q in model.camera.quantum_efficiency.items()}
    camera = model.camera.model_copy(update={"quantum_efficiency": curves})
    return Hypothesis(name, (*model.always, *effects), camera)


def next_sentence(found: Sequence[NextCapture], settling: str | None, policy: DecisionPolicy) -> str | None:
    """The best capture of all sides as a sentence. `settling`: what to capture for a mismatch that is left without a
    name."""
    if not found:
        return settling
    best = max(found, key=lambda one: one.distance)
    one, other = best.rivals
    if best.distance >= policy.next_capture_distance:
        return (
            f"{best.capture[0].upper()}{best.capture[1:]} would tell {one} from {other}: their predictions lie "
            f"{np.sqrt(2.0 * best.distance):.1f} "
            f"standard deviations apart there, which decides rightly in {100 * min(best.told_apart, 0.999):.3g} % of "
            "all cases."
        )
    beyond = (
        f"no capture that can be predicted tells {one} from {other} by more than {np.sqrt(2.0 * best.distance):.1f} "
        "standard deviations"
    )
    differs = library()[one].invariances ^ library()[other].invariances
    for thing, (capture, kind) in SETTLING.items():
        if thing in differs:
            steady, moving = (one, other) if thing in library()[one].invariances else (other, one)
            if _shows_in(moving, kind):
                return (
                    f"{capture[0].upper()}{capture[1:]} may tell them apart ({beyond}): only {steady} stays the same."
                )
    return f"{beyond[0].upper()}{beyond[1:]}: both depend on the same things."


def _shows_in(effect: str, kind: str | None) -> bool:
    """Whether an effect shows in captures of a kind."""
    kinds = set(visibility()[effect].capture_kinds) if effect in visibility() else set()
    return kind is None or bool(kinds - {"dark"} if kind == LIT else kinds & {kind})
