"""Every name with its rivals, each fitted in its place, so that a capture of another configuration can tell them
apart."""

from __future__ import annotations

from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.refit import refit
from lab.diagnose.inference.score import signatures
from lab.diagnose.outcome.model_posterior import lasting_means
from lab.diagnose.policy import DecisionPolicy
from lab.formats.model_posterior import NameInDoubt, RivalModel, StoredEffect
from sim.effects.base import Effect
from sim.effects.library import effects as library


def names_in_doubt(verdict: Verdict, policy: DecisionPolicy) -> tuple[NameInDoubt, ...]:
    """Every named effect or family, what the camera is without it, and what it is with each of its rivals."""
    model = verdict.model
    named = lasting_means(model, verdict.effects, verdict.kernels)

    def rival(name: str, probability: float, acting: tuple[Effect, ...]) -> RivalModel:
        means = lasting_means(model, acting, verdict.kernels)
        shift = {key: means.get(key, 0.0) - value for key, value in named.items()}
        return RivalModel(
            name=name, probability=probability, effects=tuple(map(StoredEffect.of, acting)),
            shift={key: float(f"{value:.6g}") for key, value in shift.items()},
        )  # fmt: skip

    found = []
    for candidate in verdict.named:
        beside = tuple(e for e in verdict.effects if e.name != candidate.effect.name)
        without = refit(model, beside, policy, passes=2).effects if beside else ()
        rivals = [rival("", 0.0, without)]
        likely = [(n, p) for n, p in candidate.alternatives if n in library() and p >= policy.least_rival_probability]
        for name, probability in likely[: policy.next_capture_rivals]:
            scores = signatures(model, model.camera, beside, [library()[name]]).scores()
            if scores and name not in {e.name for e in beside}:
                fit = refit(model, (*beside, scores[0].start), policy, passes=2)
                rivals.append(rival(name, probability, fit.effects))
        own = dict(candidate.members).get(candidate.effect.name, candidate.probability)
        found.append(
            NameInDoubt(
                effect=candidate.effect.name, told=candidate.told_name, probability=own,
                named=tuple(e.name for e in verdict.effects), rivals=tuple(rivals),
            )
        )  # fmt: skip
    return tuple(found)
